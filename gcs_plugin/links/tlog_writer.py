"""Telemetry logs (.tlog): each packet behind its time of arrival (8 bytes, big-endian, UTC microseconds)."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from gcs_plugin.links.packets import Framer, Packet

_TIME = struct.Struct(">Q")


class TlogWriter:
    """Appends packets to a telemetry log that every ground station can read.

    The file grows while it is written: a reader finds all whole packets at any moment, also after a crash.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._file: BinaryIO = path.open("ab", buffering=1 << 16)

    def write(self, time_s: float, raw: bytes) -> None:
        """Append one packet with its time in UTC epoch seconds."""
        self._file.write(_TIME.pack(int(time_s * 1e6)) + raw)

    def flush(self) -> None:
        """Hand everything to the operating system."""
        self._file.flush()

    def close(self) -> None:
        """Flush and close."""
        self._file.close()


def read_tlog(path: Path) -> Iterator[tuple[float, Packet]]:
    """Time of arrival (UTC epoch seconds) and packet, one after the other; broken stretches are skipped."""
    data = path.read_bytes()
    at, end = 0, len(data)
    while at + 16 <= end:
        marker = data[at + 8]
        size = data[at + 9] + (12 if marker == 0xFD else 8)
        if marker == 0xFD and data[at + 10] & 1:
            size += 13
        found = Framer().feed(data[at + 8 : at + 8 + size]) if marker in (0xFD, 0xFE) else []
        if found:
            yield _TIME.unpack_from(data, at)[0] / 1e6, found[0]
            at += 8 + size
        else:
            at += 1
