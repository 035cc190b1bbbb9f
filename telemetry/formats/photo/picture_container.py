"""Picture files by their content: kind, size and metadata blocks, without decoding a pixel.

Reads the head of a JPEG (and two kilobytes of its end, to check that it is complete); PNG and WebP chunk by
chunk; TIFF through a memory map. A photo costs a few tens of microseconds.
"""

import struct
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from orthoswarm.stores.ranges import Parts, open_parts
from telemetry.formats.photo import exif, xmp
from telemetry.samples.unreadable import Unreadable

_HEAD = 1 << 16
_TAIL = 1 << 11
_MAX_SEGMENTS = 4096
_START_OF_FRAME = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})


_HEIF_BRANDS = frozenset({b"heic", b"heix", b"hevc", b"mif1", b"msf1", b"avif", b"heim", b"heis"})


class NotAPicture(Unreadable):
    """A file with a picture's suffix is not a picture, or is damaged; the text is one sentence for the user."""


@dataclass(slots=True, kw_only=True)
class Container:
    """Kind, size and metadata of a picture file."""

    kind: str  # "jpeg", "png", "webp", "tiff" or "bmp"
    width: int  # columns as stored
    height: int  # rows
    exif: exif.Exif  # its EXIF tags
    xmp: bytes = b""  # its XMP packet, b"" if none
    georeferenced: bool = False  # True for a GeoTIFF, which is a map, not a picture of a camera
    raw: bool = False  # True for a DNG, which has to be developed first


def read_container(path: Path) -> Container:
    """Read a picture file's kind, size and metadata.

    Raises:
        NotAPicture: empty, unreadable, of another type, or cut off.
        StoreLostError: the store that it lies in cannot be reached.
    """
    with ExitStack() as stack:
        try:
            parts = stack.enter_context(open_parts(path))
        except OSError as error:
            raise NotAPicture(f"the file cannot be opened ({error.strerror}); check its permissions") from None
        if not parts.is_file:  # reading from a named pipe could block for ever
            raise NotAPicture("this is not a file but a pipe or a device; copy the picture itself here")
        try:
            head = parts.read(0, _HEAD)
            if parts.size == 0 or not head:
                raise NotAPicture("the file is empty; copy it again from the camera")
            return _by_content(parts, head, parts.size)
        except struct.error:
            raise NotAPicture("the picture is cut off; copy it again from the camera") from None
        except (OSError, ValueError, OverflowError) as error:
            raise NotAPicture(f"the file cannot be read ({error}); copy it again from the camera") from None


def _by_content(parts: Parts, head: bytes, size: int) -> Container:
    if head[:3] == b"\xff\xd8\xff":
        return _jpeg(parts, head, size)
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        return _png(parts)
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return _webp(parts, size)
    if head[:4] in (b"II*\0", b"MM\0*"):
        return _tiff(parts)
    if head[:4] in (b"II+\0", b"MM\0+"):
        return _big_tiff(parts, head[:1] == b"I")
    if head[:2] == b"BM" and len(head) >= 26:
        width, height = struct.unpack_from("<ii", head, 18)
        return Container(kind="bmp", width=abs(width), height=abs(height), exif=exif.Exif())
    if head[4:8] == b"ftyp" and head[8:12] in _HEIF_BRANDS:
        raise NotAPicture("HEIC and AVIF pictures cannot be read here; convert them to JPEG, which keeps their tags")
    raise NotAPicture("the content is not a picture that can be read (JPEG, PNG, TIFF, WebP, BMP); leave the file out")


def _jpeg(parts: Parts, head: bytes, size: int) -> Container:
    """Segments up to the start of the scan, then the end."""
    base, data, at = 0, head, 2
    found: Container | None = None
    tags, packet = exif.Exif(), b""
    for _ in range(_MAX_SEGMENTS):
        if at + 4 - base > len(data):
            base, data = at, parts.read(at, _HEAD)
        if len(data) - (at - base) < 4:
            break
        mark, code, length = struct.unpack_from(">BBH", data, at - base)
        if mark != 0xFF:
            break
        if code == 0xFF or code == 0x01 or 0xD0 <= code <= 0xD7:
            at += 1 if code == 0xFF else 2
            continue
        if code == 0xDA or code == 0xD9:
            break
        wanted = code == 0xE1 or code in _START_OF_FRAME
        if wanted and at + 2 + length - base > len(data):
            base, data = at, parts.read(at, 2 + length)
        body = data[at + 4 - base : at + 2 + length - base] if wanted else b""
        if code in _START_OF_FRAME and len(body) >= 5:
            height, width = struct.unpack_from(">HH", body, 1)
            found = Container(kind="jpeg", width=width, height=height, exif=tags, xmp=packet)
        elif code == 0xE1 and body[:6] == b"Exif\0\0" and not tags.main:
            tags = exif.parse_tiff(body[6:])
        elif code == 0xE1 and not packet and b"adobe.com/xap" in body[:32]:
            packet = body[body.find(b"\0") + 1 :]
        elif code == 0xE1 and not packet and (start := body[:256].find(xmp.PACKET_START)) >= 0:
            packet = body[start:]
        at += 2 + max(length, 2)
    if found is None or found.width == 0 or found.height == 0:
        raise NotAPicture("the JPEG is cut off in its header; copy it again from the camera")
    if not _jpeg_is_complete(parts, at, size):
        raise NotAPicture("the JPEG is cut off (its end is missing); copy it again from the camera")
    found.exif, found.xmp = tags, packet
    return found


def _jpeg_is_complete(parts: Parts, scan: int, size: int) -> bool:
    """Whether an end-of-image mark follows the scan; within a scan the encoder never writes those two bytes."""
    start = max(scan, size - _TAIL)
    if b"\xff\xd9" in parts.read(start, size - start):
        return True
    end = start
    while end > scan:  # rare: long trailing data after the picture, or a truncated file
        start = max(scan, end - (1 << 20))
        if b"\xff\xd9" in parts.read(start, end - start + 1):
            return True
        end = start
    return False


def _png(parts: Parts) -> Container:
    at, width, height = 8, 0, 0
    tags, packet = exif.Exif(), b""
    for _ in range(_MAX_SEGMENTS):
        head = parts.read(at, 8)
        if len(head) < 8:
            break
        length, kind = struct.unpack(">I4s", head)
        if kind == b"IHDR":
            width, height = struct.unpack(">II", parts.read(at + 8, 8))
        elif kind == b"eXIf" and length < 1 << 20:
            tags = exif.parse_tiff(parts.read(at + 8, length))
        elif kind == b"iTXt" and length < 1 << 20:
            body = parts.read(at + 8, length)
            packet = body[max(body.find(xmp.PACKET_START), 0) :] if xmp.PACKET_START in body else packet
        elif kind == b"IEND":
            if width and height:
                return Container(kind="png", width=width, height=height, exif=tags, xmp=packet)
            break
        at += 12 + length
    raise NotAPicture("the PNG is cut off; copy it again")


def _webp(parts: Parts, size: int) -> Container:
    at, width, height = 12, 0, 0
    tags, packet = exif.Exif(), b""
    for _ in range(_MAX_SEGMENTS):
        head = parts.read(at, 8)
        if len(head) < 8:
            break
        kind, length = struct.unpack("<4sI", head)
        if at + 8 + length > size:
            raise NotAPicture("the WebP file is cut off; copy it again")
        if kind == b"VP8X":
            body = parts.read(at + 8, 10)
            width = int.from_bytes(body[4:7], "little") + 1
            height = int.from_bytes(body[7:10], "little") + 1
        elif kind == b"VP8 ":
            body = parts.read(at + 8, 10)
            width, height = (v & 0x3FFF for v in struct.unpack("<HH", body[6:10]))
        elif kind == b"VP8L":
            bits = int.from_bytes(parts.read(at + 9, 4), "little")
            width, height = (bits & 0x3FFF) + 1, ((bits >> 14) & 0x3FFF) + 1
        elif kind == b"EXIF" and length < 1 << 20:
            body = parts.read(at + 8, length)
            tags = exif.parse_tiff(body[6:] if body[:6] == b"Exif\0\0" else body)
        elif kind == b"XMP " and length < 1 << 20:
            packet = parts.read(at + 8, length)
        at += 8 + length + (length & 1)
    if not width or not height:
        raise NotAPicture("the WebP file is damaged; copy it again")
    return Container(kind="webp", width=width, height=height, exif=tags, xmp=packet)


def _big_tiff(parts: Parts, little: bool) -> Container:
    """A BigTIFF, whose offsets have 64 bits: a map if it is georeferenced; no camera writes such pictures."""
    order = "<" if little else ">"
    (first,) = struct.unpack(order + "Q", parts.read(8, 8))
    (count,) = struct.unpack(order + "Q", parts.read(first, 8))
    entries = parts.read(first + 8, 20 * min(count, _MAX_SEGMENTS))
    tags = {struct.unpack_from(order + "H", entries, at)[0] for at in range(0, len(entries) - 19, 20)}
    if exif.GEO_KEYS not in tags:
        raise NotAPicture("a BigTIFF is not a picture of a camera; save it as TIFF or JPEG")
    return Container(kind="tiff", width=0, height=0, exif=exif.Exif(), georeferenced=True)


def _tiff(parts: Parts) -> Container:
    with parts.whole_file() as data:
        tags = exif.parse_tiff(data)
    width, height = exif.number(tags.main.get(exif.WIDTH)), exif.number(tags.main.get(exif.HEIGHT))
    if not width or not height:
        raise NotAPicture("the TIFF is cut off or has no picture in it; copy it again")
    geo = exif.GEO_KEYS in tags.main and (
        exif.TIE_POINTS in tags.main or exif.GEO_TRANSFORM in tags.main or exif.PIXEL_SCALE in tags.main
    )
    packet = tags.main.get(exif.XMP)
    return Container(
        kind="tiff", width=int(width), height=int(height), exif=tags, xmp=packet if isinstance(packet, bytes) else b"",
        georeferenced=geo, raw=exif.DNG_VERSION in tags.main,
    )  # fmt: skip
