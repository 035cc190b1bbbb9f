"""The parts of H.264 and H.265 byte streams needed for SEI: NAL units, emulation prevention, SEI messages.

Sources: ITU-T H.264 (7.3.1, 7.3.2.3, annex B), H.265 (7.3.1, 7.3.5), ISO/IEC 14496-15 for length prefixes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

Codec = Literal["h264", "hevc"]

_H264_SEI, _HEVC_PREFIX_SEI, _HEVC_SUFFIX_SEI = 6, 39, 40
MAX_MESSAGES = 64
MAX_PAYLOAD = 1 << 16


@dataclass(frozen=True, slots=True)
class StreamFormat:
    """Framing of NAL units in a packet."""

    codec: Codec  # "h264" or "hevc"
    prefix: int = 0  # bytes of the length before each unit, 0 for Annex B start codes

    @classmethod
    def of(cls, codec: str, extradata: bytes | None) -> "StreamFormat | None":
        """Format of a stream from its codec's name and configuration record; None for other codecs."""
        name: Codec
        if codec in ("h264", "libx264"):
            name = "h264"
        elif codec in ("hevc", "h265", "libx265"):
            name = "hevc"
        else:
            return None
        data = extradata or b""
        if len(data) < 5 or data[:3] == b"\0\0\1" or data[:4] == b"\0\0\0\1" or data[0] != 1:
            return cls(name, 0)
        if name == "h264":
            return cls(name, (data[4] & 3) + 1)
        return cls(name, (data[21] & 3) + 1) if len(data) > 21 else cls(name, 0)

    @property
    def header_size(self) -> int:
        """Bytes of a NAL unit's header."""
        return 1 if self.codec == "h264" else 2

    def kind(self, first: int) -> int:
        """NAL unit type from the first byte of its header."""
        return first & 0x1F if self.codec == "h264" else (first >> 1) & 0x3F

    def is_sei(self, kind: int) -> bool:
        """Whether a unit carries SEI messages."""
        return kind == _H264_SEI if self.codec == "h264" else kind in (_HEVC_PREFIX_SEI, _HEVC_SUFFIX_SEI)

    def is_picture(self, kind: int) -> bool:
        """Whether a unit is a slice of a picture (VCL)."""
        return 1 <= kind <= 5 if self.codec == "h264" else kind < 32


def nal_units(data: bytes, form: StreamFormat) -> Iterator[tuple[int, int]]:
    """Start and end (header included, start code or length excluded) of each NAL unit of a packet."""
    if form.prefix:
        at, size = 0, len(data)
        while at + form.prefix < size:
            length = int.from_bytes(data[at : at + form.prefix], "big")
            start = at + form.prefix
            at = start + length
            if length == 0:
                continue
            if at > size:
                return
            yield start, at
        return
    start = data.find(b"\0\0\1")
    while start >= 0:
        start += 3
        end = data.find(b"\0\0\1", start)
        stop = len(data) if end < 0 else end
        # Zeros before the next start code belong to it, not to this unit.
        if data[stop - 1] == 0:
            stop = start + len(data[start:stop].rstrip(b"\0"))
        if stop > start:
            yield start, stop
        start = end


def unescape(data: bytes) -> bytes:
    """A unit's bytes without emulation prevention (00 00 03 -> 00 00)."""
    at = data.find(b"\0\0\3")
    if at < 0:
        return data
    parts, begin = [], 0
    while at >= 0:
        parts.append(data[begin : at + 2])
        begin = at + 3
        at = data.find(b"\0\0\3", begin)
    parts.append(data[begin:])
    return b"".join(parts)


def escape(data: bytes) -> bytes:
    """A unit's bytes with emulation prevention (00 00 before 00-03 gets an 03 between)."""
    out = bytearray()
    zeros = 0
    for byte in data:
        if zeros >= 2 and byte <= 3:
            out.append(3)
            zeros = 0
        out.append(byte)
        zeros = zeros + 1 if byte == 0 else 0
    return bytes(out)


def sei_messages(packet: bytes, form: StreamFormat) -> list[tuple[int, bytes]]:
    """Payload type and payload of every SEI message in a packet, at most MAX_MESSAGES; damage ends a unit's list.

    In H.265 a suffix SEI follows the slices, so the complete packet is searched.
    """
    found: list[tuple[int, bytes]] = []
    for start, end in nal_units(packet, form):
        kind = form.kind(packet[start])
        if form.is_sei(kind):
            found += _messages(unescape(packet[start + form.header_size : min(end, start + 4 * MAX_PAYLOAD)]))
            if len(found) >= MAX_MESSAGES:
                return found[:MAX_MESSAGES]
        elif form.codec == "h264" and form.is_picture(kind):
            break
    return found


def _messages(body: bytes) -> list[tuple[int, bytes]]:
    found: list[tuple[int, bytes]] = []
    at, size = 0, len(body)
    while at + 2 <= size and len(found) < MAX_MESSAGES:
        if body[at] == 0x80 and not body[at + 1 :].strip(b"\0"):
            break
        kind, at = _run(body, at)
        length, at = _run(body, at)
        if at + length > size or length > MAX_PAYLOAD:
            break
        found.append((kind, body[at : at + length]))
        at += length
    return found


def _run(body: bytes, at: int) -> tuple[int, int]:
    """A number coded as a run of 255 and a last byte, and the offset after it."""
    total, size = 0, len(body)
    while at < size and body[at] == 0xFF:
        total += 255
        at += 1
    return (total + body[at], at + 1) if at < size else (1 << 30, at)


def sei_unit(kind: int, payload: bytes, form: StreamFormat) -> bytes:
    """A NAL unit (without start code or length) that carries one SEI message."""
    body = b"\xff" * (kind // 255) + bytes([kind % 255])
    body += b"\xff" * (len(payload) // 255) + bytes([len(payload) % 255]) + payload + b"\x80"
    header = b"\x06" if form.codec == "h264" else b"\x4e\x01"
    return header + escape(body)


def insert_unit(packet: bytes, unit: bytes, form: StreamFormat) -> bytes:
    """The packet with a NAL unit inserted before its first slice (or at its end if it has none)."""
    at = len(packet)
    for start, _ in nal_units(packet, form):
        if form.is_picture(form.kind(packet[start])):
            at = start - (form.prefix or 3)
            if not form.prefix and at > 0 and packet[at - 1] == 0:
                at -= 1
            break
    lead = len(unit).to_bytes(form.prefix, "big") if form.prefix else b"\0\0\0\1"
    return packet[:at] + lead + unit + packet[at:]
