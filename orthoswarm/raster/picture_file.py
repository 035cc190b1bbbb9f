"""Reading pictures: as stored in the file (EXIF rotation not applied), 8 bit, grey or RGB."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.errors import OrthoSwarmError

Bytes = NDArray[np.uint8]
PICTURE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".dng"})


class PictureError(OrthoSwarmError):
    """A picture cannot be decoded."""


def read_gray(path: Path) -> Bytes:
    """A picture's grey values, uint8 (rows, columns); for a JPEG its luma, without colour conversion.

    Raises:
        PictureError: if the file is no picture or is damaged beyond decoding.
    """
    data = _bytes(path)
    if data[:2] == b"\xff\xd8":
        import simplejpeg

        try:
            return np.asarray(simplejpeg.decode_jpeg(data, colorspace="GRAY", fastdct=True)[..., 0])
        except ValueError as error:
            raise PictureError(f"{path.name} is a damaged JPEG ({error}); copy it again from the camera") from None
    return _decode_other(path, data, gray=True)


def read_rgb(path: Path) -> Bytes:
    """A picture's colours, uint8 (rows, columns, 3), red first; grey pictures are repeated in all three.

    Raises:
        PictureError: if the file is no picture or is damaged beyond decoding.
    """
    data = _bytes(path)
    if data[:2] == b"\xff\xd8":
        import simplejpeg

        try:
            return np.asarray(simplejpeg.decode_jpeg(data, colorspace="RGB", fastdct=True, fastupsample=True))
        except ValueError as error:
            raise PictureError(f"{path.name} is a damaged JPEG ({error}); copy it again from the camera") from None
    return np.ascontiguousarray(_decode_other(path, data, gray=False)[..., ::-1])


def read_rgba(path: Path) -> Bytes:
    """A picture's colours with alpha 255, uint8 (rows, columns, 4); a JPEG costs no more than by read_rgb.

    Raises:
        PictureError: if the file is no picture or is damaged beyond decoding.
    """
    data = _bytes(path)
    if data[:2] == b"\xff\xd8":
        import simplejpeg

        try:
            return np.asarray(simplejpeg.decode_jpeg(data, colorspace="RGBA", fastdct=True, fastupsample=True))
        except ValueError as error:
            raise PictureError(f"{path.name} is a damaged JPEG ({error}); copy it again from the camera") from None
    import cv2

    return np.asarray(cv2.cvtColor(_decode_other(path, data, gray=False), cv2.COLOR_BGR2RGBA))


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise PictureError(f"{path.name} cannot be read ({error.strerror}); check the file") from None


def _decode_other(path: Path, data: bytes, *, gray: bool) -> Bytes:
    import cv2

    flags = (cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR) | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise PictureError(f"{path.name} is no readable picture; leave it out or copy it again")
    return np.asarray(image)
