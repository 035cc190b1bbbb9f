"""The payload of FILE_TRANSFER_PROTOCOL (MAVLink FTP, https://mavlink.io/en/services/ftp.html).

Twelve bytes of header and up to 239 of data. Requests carry an opcode; answers are an ACK or NAK that names it, with
the request's number plus one.
"""

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from gcs_plugin.links.mavlink import Message, dialect

MOST_DATA: Final = 239
FRAME_BYTES: Final = 12 + 3 + 12 + MOST_DATA
"""A full packet on the link: MAVLink 2's frame, the address, the header and the data."""
_HEADER: Final = struct.Struct("<HBBBBBBI")
_PAYLOAD: Final = 251


class Opcode(IntEnum):
    """Requests, and the two kinds of answer."""

    TERMINATE_SESSION = 1
    RESET_SESSIONS = 2
    LIST_DIRECTORY = 3
    OPEN_FILE_RO = 4
    READ_FILE = 5
    CALC_FILE_CRC32 = 14
    ACK = 128
    NAK = 129


class Nak(IntEnum):
    """Errors that matter here; the first byte of a NAK's data."""

    FAIL = 1
    FAIL_ERRNO = 2
    INVALID_DATA_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS = 5
    END_OF_FILE = 6
    UNKNOWN_COMMAND = 7
    FILE_NOT_FOUND = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class FtpPayload:
    """A request or an answer.

    Attributes:
        number: counts requests; an answer has that of its request plus one.
        opcode: what is asked for, or the kind of answer. session: of an open file. request: opcode that is answered.
        offset: into the file, bytes; for LIST_DIRECTORY the entry. size: of the data, or bytes to read.
        data: at most MOST_DATA bytes.
    """

    number: int
    opcode: int
    session: int = 0
    request: int = 0
    offset: int = 0
    size: int = 0
    data: bytes = b""

    def pack(self) -> bytes:
        """251 bytes."""
        size = len(self.data) or self.size
        head = _HEADER.pack(self.number & 0xFFFF, self.session, self.opcode, size, self.request, 0, 0, self.offset)
        return (head + self.data).ljust(_PAYLOAD, b"\0")

    @staticmethod
    def unpack(payload: bytes) -> "FtpPayload | None":
        """The content of 251 bytes; None if they are none."""
        if len(payload) < _HEADER.size:
            return None
        number, session, opcode, size, request, _, _, offset = _HEADER.unpack_from(payload)
        if size > MOST_DATA:
            return None
        data = bytes(payload[_HEADER.size : _HEADER.size + size])
        return FtpPayload(
            number=number, opcode=opcode, session=session, request=request, offset=offset, size=size, data=data
        )

    def message(self, system: int, component: int) -> Message:
        """The MAVLink message that carries it."""
        return dialect.MAVLink_file_transfer_protocol_message(0, system, component, list(self.pack()))

    @property
    def nak(self) -> int:
        """The error of a NAK; FAIL if it names none."""
        return self.data[0] if self.data else Nak.FAIL


def payload_of(message: Message) -> FtpPayload | None:
    """The content of a received FILE_TRANSFER_PROTOCOL message; None if it makes no sense."""
    return FtpPayload.unpack(bytes(message.payload))


def file_crc32(data: bytes) -> int:
    """CRC-32 of CALC_FILE_CRC32: the usual polynomial, from 0 and without the final inversion."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF
