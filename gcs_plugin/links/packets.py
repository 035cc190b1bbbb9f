"""Bytes to MAVLink packets: finds whole packets in what a link delivers, checks them, and decodes on demand.

pymavlink decodes every byte. A ground station for a hundred vehicles only passes most packets on (to the
log, to a counter), so finding, checking and decoding are separate here. The checksum is
CRC-16/MCRF4XX, which is CRC-16/CCITT on mirrored bits, and that one is in the standard library in C.
"""

import binascii
import operator
from dataclasses import dataclass, field
from typing import Any, Final

from gcs_plugin.links.mavlink import Message, dialect

V1_MARKER: Final = 0xFE
V2_MARKER: Final = 0xFD
SIGNED: Final = 0x01
SIGNATURE_BYTES: Final = 13

_MIRROR8 = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))
_CRC_EXTRA: dict[int, bytes] = {number: bytes([kind.crc_extra]) for number, kind in dialect.mavlink_map.items()}
_DECODER = dialect.MAVLink(None)


def checksum(data: bytes) -> int:
    """CRC-16/MCRF4XX, the checksum of MAVLink (https://mavlink.io/en/guide/serialization.html#checksum)."""
    mirrored = binascii.crc_hqx(data.translate(_MIRROR8), 0xFFFF)
    return _MIRROR8[mirrored >> 8] | (_MIRROR8[mirrored & 0xFF] << 8)


def packet_bytes(data: Any, at: int) -> int:
    """Length of the packet that begins at a place, by its first three bytes; 0 where none does."""
    if data[at] == V2_MARKER:
        return int(data[at + 1]) + 12 + (SIGNATURE_BYTES if data[at + 2] & SIGNED else 0)
    return int(data[at + 1]) + 8 if data[at] == V1_MARKER else 0


@dataclass(slots=True, kw_only=True)
class Packet:
    """One complete packet with a correct checksum.

    Attributes:
        raw: its bytes as received, signature included (not yet checked).
        system, component: ids of the sender; seq: its packet counter, 0 to 255. kind: message id.
    """

    raw: bytes
    system: int
    component: int
    seq: int
    kind: int
    signed: bool
    _message: Message = field(default=None, repr=False)

    @property
    def message(self) -> Message:
        """The decoded message."""
        if self._message is None:
            maker = _MAKERS.get(self.kind)
            self._message = _DECODER.decode(bytearray(self.raw)) if maker is None else _make(self, *maker)
        return self._message


def _make(packet: Packet, kind: Any, size: int, order: Any) -> Message:
    """Decode a message of plain numbers, twice as fast as pymavlink, which repeats the checks."""
    raw = packet.raw
    start = 10 if raw[0] == V2_MARKER else 6
    payload = raw[start : start + min(size, raw[1])]
    if len(payload) < size:  # trailing zeros are not sent
        payload += bytes(size - len(payload))
    message = kind(*order(kind.unpacker.unpack(payload)))
    message._payload = raw[start : start + raw[1]]  # with fields that this version of the dialect does not know
    header = message.get_header()
    header.mlen, header.seq, header.srcSystem, header.srcComponent = raw[1], packet.seq, packet.system, packet.component
    return message


def _makers() -> dict[int, tuple[Any, int, Any]]:
    """Classes, sizes and field orders of the messages without arrays and texts."""
    plain = {}
    for number, kind in dialect.mavlink_map.items():
        if len(kind.orders) > 1 and all(length == 1 for length in kind.lengths) and "char" not in kind.fieldtypes:
            plain[number] = (kind, kind.unpacker.size, operator.itemgetter(*kind.orders))
    return plain


_MAKERS: Final = _makers()


@dataclass(slots=True)
class Framer:
    """Splits a stream, received in pieces of any size, into packets.

    Attributes:
        bad_checksums: packets dropped for a wrong checksum.
        unknown: packets of message ids that the dialect does not have.
    """

    bad_checksums: int = 0
    unknown: int = 0
    _rest: bytes = b""

    def feed(self, data: bytes) -> list[Packet]:
        """All complete packets; remaining bytes wait for the next call."""
        if not self._rest and len(data) > 2 and data[0] == V2_MARKER and len(data) == data[1] + 12 and not data[2]:
            packet = self._check(data)  # a datagram with one packet, the usual case
            return [] if packet is None else [packet]
        if self._rest:
            data, self._rest = self._rest + data, b""
        packets: list[Packet] = []
        at, end = 0, len(data)
        while at < end:
            if data[at] not in (V2_MARKER, V1_MARKER):
                following = [i for i in (data.find(V2_MARKER, at), data.find(V1_MARKER, at)) if i >= 0]
                at = min(following, default=end)
                continue
            if end - at < 3:
                break
            size = packet_bytes(data, at)
            if end - at < size:
                break
            packet = self._check(data[at : at + size])
            if packet is None and not (at + size == end or data[at + size] in (V2_MARKER, V1_MARKER)):
                at += 1  # not a packet at all: the marker was a byte of something else
                continue
            if packet is not None:
                packets.append(packet)
            at += size
        self._rest = data[at:]
        return packets

    def _check(self, raw: bytes) -> Packet | None:
        if raw[0] == V2_MARKER:
            kind = raw[7] | (raw[8] << 8) | (raw[9] << 16)
            body, head = 10 + raw[1], 5
            signed = bool(raw[2] & SIGNED)
            if raw[2] & ~SIGNED:
                self.unknown += 1
                return None
        else:
            kind, body, head, signed = raw[5], 6 + raw[1], 3, False
        extra = _CRC_EXTRA.get(kind)
        if extra is None:
            self.unknown += 1
            return None
        if checksum(raw[1:body] + extra) != raw[body] | (raw[body + 1] << 8):
            self.bad_checksums += 1
            return None
        return Packet(raw=raw, system=raw[head], component=raw[head + 1], seq=raw[head - 1], kind=kind, signed=signed)
