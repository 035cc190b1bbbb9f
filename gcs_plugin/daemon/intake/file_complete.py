"""Checks whether a file that is being copied is complete, by the end of its picture data."""

import struct
from pathlib import Path
from typing import Final

_SOI: Final = b"\xff\xd8"
_SOS: Final = 0xDA
_EOI: Final = b"\xff\xd9"
_BARE: Final = frozenset({0x01, *range(0xD0, 0xD8)})
"""JPEG markers without a length."""


def is_complete(data: bytes, suffix: str) -> bool:
    """Whether a picture's bytes are complete; True for formats in which this is unknown.

    A stalled copy, or one whose reserved space is still zeros, is not complete.

    Args:
        data: the file's bytes so far. suffix: of its name, with the dot.
    """
    kind = suffix.lower()
    if kind in (".jpg", ".jpeg"):
        return _jpeg(data)
    if kind == ".png":
        return b"IEND\xaeB`\x82" in data[-64:]
    if kind == ".webp":
        return len(data) >= 12 and len(data) >= 8 + int(struct.unpack_from("<I", data, 4)[0])
    if kind == ".bmp":
        return len(data) >= 6 and len(data) >= int(struct.unpack_from("<I", data, 2)[0])
    return _opens(data)


def _jpeg(data: bytes) -> bool:
    """Whether the main picture's end of image is there (ITU-T T.81, B.1): thumbnails in APP segments end earlier."""
    if not data.startswith(_SOI):
        return len(data) > 4  # not a JPEG: its reader reports that
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return False
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
        elif marker in _BARE:
            at += 2
        elif marker == _SOS:
            return data.find(_EOI, at) >= 0
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return False


def _opens(data: bytes) -> bool:
    """Whether a picture of another kind (TIFF) can be decoded to its last row."""
    import io

    from PIL import Image

    from orthoswarm.raster.picture_file import PictureError, picture_size

    try:
        picture_size(data)
    except PictureError:
        return len(data) > 64  # not a picture, or too large: its reader reports that
    try:
        with Image.open(io.BytesIO(data)) as picture:
            picture.load()
    except (OSError, ValueError, SyntaxError, EOFError, struct.error, Image.DecompressionBombError):
        return False
    return True


def is_video_complete(path: Path) -> bool:
    """Whether an MP4 or MOV contains all its boxes, including the index; True for other formats.

    Raises:
        OSError: the file cannot be read.
    """
    if path.suffix.lower() not in (".mp4", ".mov", ".m4v"):
        return True
    size, at, index = path.stat().st_size, 0, False
    with path.open("rb") as file:
        while at + 8 <= size:
            file.seek(at)
            head = file.read(16)
            length, kind = int.from_bytes(head[:4], "big"), head[4:8]
            if at == 0 and kind not in (b"ftyp", b"moov", b"mdat", b"free", b"wide", b"skip", b"styp"):
                return True  # not such a file
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            index |= kind in (b"moov", b"moof")
            if length == 0:  # to the end of the file
                return index or kind == b"moov"
            if length < 8:
                return False
            at += length
    return index and at <= size
