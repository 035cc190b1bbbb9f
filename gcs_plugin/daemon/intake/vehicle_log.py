"""One vehicle's part of the daemon's telemetry log, for pictures that arrive long after exposure."""

import mmap
import os
from pathlib import Path
from typing import Final

_STEP: Final = 8  # bytes of the time before each packet of a tlog
_MARKS: Final = (0xFD, 0xFE)


def write_link_log(log: Path, system: int, out: Path) -> int:
    """Copy a vehicle's packets, undecoded, from a telemetry log into its own.

    Args:
        log: `telemetry.tlog` of the workspace; it may still grow.
        system: the vehicle's MAVLink system id.
        out: written completely or not at all.

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
            mark = data[at + _STEP]
            if mark == 0xFD:
                size = _STEP + 12 + data[at + _STEP + 1] + (13 if data[at + _STEP + 2] & 1 else 0)
                sender = data[at + _STEP + 5]
            elif mark == 0xFE:
                size = _STEP + 8 + data[at + _STEP + 1]
                sender = data[at + _STEP + 3]
            else:  # an incomplete record after a power cut
                at += 1
                continue
            if at + size > end:
                break
            if sender == system:
                copy.write(data[at : at + size])
                count += 1
            at += size
    os.replace(part, out)
    return count
