"""Reading pictures: as stored in the file (EXIF rotation not applied), 8 bit, grey or RGB."""

import io
import os
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Bytes
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.raster.kept_ranges import kept_range, limits
from orthoswarm.stores.addresses import is_stored
from orthoswarm.stores.local_copies import content
from orthoswarm.stores.requests import NotStoredError, StoreRequestError

if TYPE_CHECKING:
    from rawpy import RawPy

RAW_SUFFIX: Final = ".dng"
PICTURE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", RAW_SUFFIX})


MOST_PIXELS: Final = 200_000_000
"""Larger pictures are refused before they are decoded: 200 megapixels, as the largest phones' and aerial cameras' have,
take 0.6 GB in colour. A file of some hundred kilobytes can hold a picture that takes many gigabytes."""


_PNG: Final = b"\x89PNG\r\n\x1a\n"
_TIFF: Final = (b"II*\0", b"MM\0*")
_MARKER: Final = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")  # of a JPEG, besides those within a scan
_STRAY_BYTES: Final = 15  # so many bytes of any value may follow a JPEG's scan: cameras write words of up to 16 bytes
_LARGE_BLOCK: Final = 24  # ... if 16 x 16 pixels take more in the mean: a decoder reads up to 8 bytes ahead, unseen
_DEEP: Final = (np.uint16, np.float32)
_DEPTH_PICTURES: Final = 9  # pictures of a folder that tell the range of its 16-bit pictures (for its time)


class PictureError(OrthoSwarmError):
    """A picture cannot be decoded.

    reason: the fault without the picture's name, the same for all pictures that have it.
    """

    def __init__(self, text: str, reason: str = "") -> None:
        super().__init__(text)
        self.reason = reason or text

    @classmethod
    def of(cls, path: Path, fault: str, detail: str = "") -> "PictureError":
        """The error that a picture `fault` ("is not ...; what to do"); `detail` differs from picture to picture."""
        what, separator, advice = fault.partition(";")
        return cls(f"{path.name} {what}{detail and f' ({detail})'}{separator}{advice}", f"it {fault}")


def reduction(width: int, height: int, longest: int) -> int:
    """Factor by which a picture of a size may be reduced while decoding: 8, 4, 2 or 1.

    The greatest that leaves at least `longest` pixels on the longer side and divides both sides, so that column u of
    the picture is column (u + 0.5) / factor - 0.5 of the reduced one everywhere.
    """
    wanted = (f for f in (8, 4, 2) if width % f == 0 and height % f == 0 and max(width, height) // f >= longest)
    return next(wanted, 1)


def read_gray(path: Path, factor: int = 1) -> Bytes:
    """A picture's grey values, uint8 (rows, columns); for a JPEG its luma, without colour conversion.

    Args:
        path: the file.
        factor: reduce it by 2, 4 or 8 (see `reduction`); of a JPEG then only the low frequencies are transformed, which
            takes two thirds of the time, and a large picture is never in memory.

    Raises:
        PictureError: if the file is not a picture or is damaged beyond decoding.
    """
    data = _bytes(path)
    if _is_jpeg(data):
        return _decode_jpeg(path, data, "GRAY", fast_upsample=False, factor=factor)[..., 0]
    return _mean(_decode_other(path, data, gray=True), factor)


def read_rgb(path: Path, longest: int | None = None) -> Bytes:
    """A picture's colours, uint8 (rows, columns, 3), red first; grey pictures are repeated in all three.

    Args:
        path: the file.
        longest: reduce it by the factor of `reduction` to this longer side; None not to.

    Raises:
        PictureError: if the file is not a picture or is damaged beyond decoding.
    """
    data = _bytes(path)
    if _is_jpeg(data):
        width, height = _jpeg_size(data)
        factor = 1 if longest is None else reduction(width, height, longest)
        return _decode_jpeg(path, data, "RGB", fast_upsample=True, factor=factor)
    picture = _decode_other(path, data, gray=False)
    height, width = picture.shape[:2]
    reduced = picture if longest is None else _mean(picture, reduction(width, height, longest))
    return np.ascontiguousarray(reduced[..., ::-1])


def read_rgba(path: Path) -> Bytes:
    """A picture's colours with alpha 255, uint8 (rows, columns, 4); a JPEG costs no more than by read_rgb.

    Raises:
        PictureError: if the file is not a picture or is damaged beyond decoding.
    """
    data = _bytes(path)
    if _is_jpeg(data):
        return _decode_jpeg(path, data, "RGBA", fast_upsample=True)
    import cv2

    return np.asarray(cv2.cvtColor(_decode_other(path, data, gray=False), cv2.COLOR_BGR2RGBA))


def read_values(path: Path) -> NDArray[Any] | None:
    """A picture's values as they are stored, (rows, columns) or (rows, columns, channels); None if they cannot be read.

    Raises:
        PictureError: if the file cannot be read, or is not a picture.
    """
    import cv2

    return cv2.imdecode(np.frombuffer(_bytes(path), np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)


def _is_jpeg(data: bytes) -> bool:
    return data[:2] == b"\xff\xd8"


def _decode_jpeg(path: Path, data: bytes, colors: str, *, fast_upsample: bool, factor: int = 1) -> Bytes:
    """A JPEG's pixels, uint8 (rows, columns, channels) in a colour space of simplejpeg."""
    import simplejpeg

    width, height = _jpeg_size(data) if factor > 1 else (0, 0)  # 0: as large as it is
    fault = ""
    for jpeg in _without_filler(data):
        try:
            return np.asarray(
                simplejpeg.decode_jpeg(
                    jpeg, colorspace=colors, fastdct=True, fastupsample=fast_upsample,
                    min_width=-(-width // factor), min_height=-(-height // factor),
                )
            )  # fmt: skip
        except ValueError as error:
            fault = fault or str(error)
    raise PictureError.of(path, "is a damaged JPEG; copy it again from the camera", fault)


def _without_filler(data: bytes) -> Iterator[bytes]:
    """A JPEG as it is, then without bytes between its scan and its end, which some cameras write: one value, or a few.

    That they stood behind the last block is shown by decoding the rest without a warning: without a part of the scan it
    ends too early. A scan that lost or won bytes in the middle ends too late as well, but by whole blocks.
    """
    yield data
    end = _end_of_scan(data)
    run = end - len(data[:end].rstrip(data[end - 1 : end]))
    width, height = _jpeg_size(data)
    large = len(data) * 16 * 16 > _LARGE_BLOCK * width * height
    stray = range(1, _STRAY_BYTES + 1) if large and 0 < run <= _STRAY_BYTES else ()
    filler = (run, run - 1) if 1 < run < end else ()  # the scan may end in the same value
    for count in dict.fromkeys((*filler, *stray)):
        yield data[: end - count] + data[end:]


def _end_of_scan(data: bytes) -> int:
    """Where a JPEG's end marker is, 0 if it has none; thumbnails before it and previews behind it have their own."""
    at = 2
    while marker := _MARKER.search(data, at):
        at = marker.start()
        if data[at + 1] == 0xD9:
            return at
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return 0


def picture_size(data: bytes, formats: Sequence[str] | None = None) -> tuple[int, int, str]:
    """Columns, rows and format (Pillow's name: JPEG, PNG, ...) of an encoded picture, without decoding it.

    Args:
        data: the whole file. formats: those that are allowed, all that Pillow knows by default.

    Raises:
        PictureError: it is not a picture, or larger than MOST_PIXELS.
    """
    from PIL import Image, UnidentifiedImageError

    Image.MAX_IMAGE_PIXELS = MOST_PIXELS  # beyond that Pillow warns, beyond twice as many it raises
    try:
        with Image.open(io.BytesIO(data), formats=formats) as picture:
            (width, height), kind = picture.size, picture.format or ""
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise PictureError("it has more pixels than any camera; leave it out or send a smaller one") from None
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, TypeError, OverflowError, struct.error):
        raise PictureError("it is not a readable picture; leave it out or copy it again") from None
    if width * height > MOST_PIXELS or min(width, height) < 1:
        text = f"it has {width} x {height} pixels, more than {MOST_PIXELS // 1_000_000} megapixels"
        raise PictureError(f"{text}; leave it out or send a smaller one")
    return width, height, kind


def _bytes(path: Path) -> bytes:
    """A picture file's content, after checking its size."""
    data = _content(path)
    if data[:2] == b"\xff\xd8":
        width, height = _jpeg_size(data)
        if width * height > MOST_PIXELS:
            raise PictureError.of(path, f"has {width} x {height} pixels, more than any camera; leave it out")
        return data
    try:
        (raw_size if path.suffix.lower() == RAW_SUFFIX else picture_size)(data)
    except PictureError as error:
        raise PictureError.of(path, error.reason.removeprefix("it ")) from None
    return data


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Columns and rows from a JPEG's header; 0, 0 if that is damaged, which decoding reports better."""
    import simplejpeg

    try:
        height, width, *_ = simplejpeg.decode_jpeg_header(data)
    except ValueError:
        return 0, 0
    return int(width), int(height)


def _content(path: Path) -> bytes:
    try:
        return content(path) if is_stored(path) else path.read_bytes()
    except (NotStoredError, StoreRequestError) as error:
        raise PictureError(str(error)) from None
    except OSError as error:
        raise PictureError.of(path, f"cannot be read ({error.strerror}); check the file") from None


def raw_size(data: bytes) -> tuple[int, int]:
    """Columns and rows of a raw picture (DNG) as it is developed.

    Raises:
        PictureError: the extra "raw" is not installed, or the file is damaged or larger than MOST_PIXELS.
    """
    with _opened_raw(data) as raw:
        width, height = raw.sizes.width, raw.sizes.height
    if width * height > MOST_PIXELS:
        raise PictureError(f"it has {width} x {height} pixels, more than any camera; leave it out")
    return width, height


def _developed(data: bytes) -> Bytes:
    """The colours of a raw picture, blue first, all pictures by the same curve."""
    with _opened_raw(data) as raw:
        import rawpy

        linear = rawpy.DemosaicAlgorithm.LINEAR  # a third of the usual one's time
        rgb = raw.postprocess(demosaic_algorithm=linear, use_camera_wb=True, no_auto_bright=True, user_flip=0)
    return np.ascontiguousarray(rgb[..., ::-1])


@contextmanager
def _opened_raw(data: bytes) -> "Iterator[RawPy]":
    try:
        import rawpy
    except ImportError:
        raise PictureError(
            "it is a raw picture (DNG), which needs the extra 'raw'; pip install 'orthoswarm[raw]', or use the JPEG of "
            "the same exposure"
        ) from None
    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            yield raw
    except rawpy.LibRawError:
        raise PictureError("it is a raw picture that cannot be developed; copy it again from the camera") from None


def _decode_other(path: Path, data: bytes, *, gray: bool) -> Bytes:
    import cv2

    if path.suffix.lower() == RAW_SUFFIX:
        picture = _developed(data)
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)) if gray else picture
    flags = (cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR) | cv2.IMREAD_IGNORE_ORIENTATION
    image = _decoded(data, flags)
    if image is not None and image.dtype in _DEEP:
        folder, suffix = path.parent, path.suffix.lower()
        used = kept_range(folder.parent, image, suffix) if _is_spread(path) else _used_range(folder, suffix)
        if used is not None:
            low, high = used
            scaled = (image.astype(np.float32) - np.float32(low)) * np.float32(255.0 / (high - low))
            return np.asarray(np.clip(np.nan_to_num(scaled) + 0.5, 0, 255).astype(np.uint8))
    if image is not None and image.dtype != np.uint8:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None and _mode(data) == "I":
        raise PictureError.of(path, "holds 32-bit whole numbers, not colours; export it with 8 or 16 bits a pixel")
    if image is None:
        raise PictureError.of(path, "is not a readable picture; leave it out or copy it again")
    return np.asarray(image)


def _mean(picture: Bytes, factor: int) -> Bytes:
    """The means of blocks of a picture, whose sides the factor divides."""
    if factor == 1:
        return picture
    import cv2

    size = (picture.shape[1] // factor, picture.shape[0] // factor)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def _decoded(data: bytes, flags: int) -> NDArray[Any] | None:
    """A picture as OpenCV decodes it, with its depth, and in the channels that the flags ask for."""
    import cv2

    if data[:4] not in _TIFF or _mode(data) != "F":
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_ANYDEPTH) if data else None
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)  # else it refuses numbers of 32 bits
    return image if image is None or flags & cv2.IMREAD_COLOR == 0 else np.repeat(image[..., None], 3, axis=2)


def _mode(data: bytes) -> str:
    """Pillow's name of what pixels are: "F" numbers of 32 bits, as temperatures in degrees are, "I" whole ones."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as picture:
            return str(picture.mode)
    except (OSError, ValueError, SyntaxError):
        return ""


def _is_spread(path: Path) -> bool:
    """Whether a ground station has spread it over folders of two digits of its name, which are no flights."""
    digits = re.fullmatch("([0-9a-f]{2})[0-9a-f]{62}", path.stem)
    return digits is not None and digits[1] == path.parent.name and not is_stored(path)


def deep_picture(data: bytes) -> NDArray[Any] | None:
    """The values of a picture of 16 or 32 bits, uint16 or float32 (rows, columns, 3); None for any other file."""
    import cv2

    if data[:8] == _PNG and data[24:25] != b"\x10":  # its header says so at once
        return None
    image = _decoded(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(image) if image is not None and image.dtype in _DEEP else None


@lru_cache(maxsize=256)
def _used_range(folder: Path, suffix: str) -> tuple[float, float] | None:
    """Values that become 0 and 255 in the 16-bit pictures of a folder; None where they use all 16 bits.

    Thermal and multispectral cameras write 10 to 14 bits. The range comes from some pictures of the folder, the same
    ones in every process, so that neighbouring pictures are alike. It is not looked for in object storage; for a ground
    station's pictures see `kept_ranges`.
    """
    if is_stored(folder):
        return None
    try:
        names = sorted(name for name in os.listdir(folder) if Path(name).suffix.lower() == suffix)
    except OSError:
        return None
    pictures = []
    for k in np.unique(np.linspace(0, len(names) - 1, _DEPTH_PICTURES).round().astype(int)) if names else ():
        try:
            data = _bytes(folder / names[k])
        except PictureError:
            continue
        image = deep_picture(data)
        if image is not None:
            pictures.append(image)
    return limits(pictures) if pictures else None
