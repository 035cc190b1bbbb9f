"""Telemetry logs (.tlog): each packet behind its time of arrival (8 bytes, big-endian, UTC microseconds).

Written, and copied by vehicle.
"""

import mmap
import os
import struct
from pathlib import Path
from typing import BinaryIO, Final

from gcs_plugin.links.packets import V2_MARKER, packet_bytes

_TIME = struct.Struct(">Q")
_STEP: Final = 8  # bytes of the time before each packet of a tlog


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


def write_link_log(log: Path, system: int, out: Path) -> int:
    """Copy a vehicle's packets, undecoded, from a telemetry log, which may still grow, into its own.

    `out` is written completely or not at all.

    Returns:
        Number of packets; 0 if there is no log.

    Raises:
        OSError: a file cannot be read or written.
    """
    if not log.is_file() or log.stat().st_size < 16:
        return 0
    part = out.with_suffix(".part")
    count = 0
    with log.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data, part.open("wb") as copy:
        at, end = 0, len(data)
        while at + _STEP + 8 <= end:
            size = packet_bytes(data, at + _STEP)
            if not size:  # an incomplete record after a power cut
                at += 1
                continue
            if at + _STEP + size > end:
                break
            if data[at + _STEP + (5 if data[at + _STEP] == V2_MARKER else 3)] == system:
                copy.write(data[at : at + _STEP + size])
                count += 1
            at += _STEP + size
    os.replace(part, out)
    return count
