"""GoPro's metadata track (GPMF) in MP4: positions of GPS5 and GPS9.

Nested entries: four letters, type, size of a structure, number of structures (big-endian), values padded to four bytes;
type 0 holds entries. SCAL divides the values that follow in its stream. GPS5: latitude, longitude, altitude (mean sea
level; above the ellipsoid before HERO9), speed over ground and in space; GPSU is the UTC of its packet, GPSF the fix.
GPS9 adds days since 2000, seconds of the day, precision and fix to each sample. Source: GoPro's gpmf-parser, README.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

from telemetry.samples.sample import Sample, checked
from telemetry.samples.times import YEAR_2000_S, epoch_of

_MOST_ENTRIES = 4096
_MOST_DEPTH = 4
_GPS9 = struct.Struct(">7iHH")


class _GpmfEntry(NamedTuple):
    key: bytes
    kind: int
    size: int
    rows: int
    value: bytes


def is_gpmf(data: bytes) -> bool:
    """Whether a packet begins like one of this track."""
    return data[:4] == b"DEVC"


def read_gpmf(data: bytes) -> list[Sample]:
    """Positions of one packet in order, evenly spread over its duration; empty if it has none. Never raises."""
    samples: list[Sample] = []
    for stream in _streams(data, 0):
        entries = {entry.key: entry for entry in stream}
        scale = _scale(entries.get(b"SCAL"))
        if b"GPS9" in entries:
            samples += _gps9(entries[b"GPS9"], scale)
        elif b"GPS5" in entries:
            fix = entries[b"GPSF"].value[:4] if b"GPSF" in entries else b""
            if len(fix) < 4 or int.from_bytes(fix, "big") >= 2:
                samples += _gps5(entries[b"GPS5"], scale, _utc(entries.get(b"GPSU")))
    return samples


def _entries(data: bytes) -> Iterator[_GpmfEntry]:
    at = 0
    for _ in range(_MOST_ENTRIES):
        if at + 8 > len(data):
            return
        key, kind, size, count = struct.unpack_from(">4sBBH", data, at)
        length = size * count
        if at + 8 + length > len(data):
            return
        yield _GpmfEntry(key, kind, size, count, data[at + 8 : at + 8 + length])
        at += 8 + (length + 3) // 4 * 4


def _streams(data: bytes, depth: int) -> Iterator[list[_GpmfEntry]]:
    """The entries of each innermost STRM."""
    for entry in _entries(data):
        if entry.kind == 0 and entry.key == b"STRM":
            yield list(_entries(entry.value))
        elif entry.kind == 0 and depth < _MOST_DEPTH:
            yield from _streams(entry.value, depth + 1)


def _scale(entry: _GpmfEntry | None) -> list[float]:
    if entry is None or entry.kind not in b"ls":
        return [1.0]
    width = 4 if entry.kind == ord("l") else 2
    count = len(entry.value) // width
    code = "i" if width == 4 else "h"
    return [float(value) or 1.0 for value in struct.unpack_from(f">{count}{code}", entry.value)] or [1.0]


def _utc(entry: _GpmfEntry | None) -> float | None:
    """UTC of `yymmddhhmmss.sss`."""
    text = b"" if entry is None else entry.value[:16]
    digits = text.decode("ascii", "replace").rstrip("\0 ")
    return epoch_of(f"20{digits[0:2]}-{digits[2:4]}-{digits[4:6]} {digits[6:8]}:{digits[8:10]}:{digits[10:]}")


def _gps5(entry: _GpmfEntry, scale: list[float], utc: float | None) -> list[Sample]:
    scale = (scale * 5)[:5] if len(scale) < 5 else scale
    rows = [struct.unpack_from(">5i", entry.value, 20 * i) for i in range(len(entry.value) // 20)]
    found = []
    for i, row in enumerate(rows):
        time_s = None if utc is None else utc + i / len(rows)
        sample = Sample(
            time_s=time_s, lat_deg=row[0] / scale[0], lon_deg=row[1] / scale[1], altitude_m=row[2] / scale[2]
        )
        found.append(checked(sample) or Sample())
    return found


def _gps9(entry: _GpmfEntry, scale: list[float]) -> list[Sample]:
    if len(scale) < 9:
        return []
    found = []
    for i in range(len(entry.value) // _GPS9.size):
        lat, lon, altitude, _, _, days, seconds, _, fix = _GPS9.unpack_from(entry.value, _GPS9.size * i)
        time_s = YEAR_2000_S + days / scale[5] * 86_400.0 + seconds / scale[6]
        sample = Sample(time_s=time_s, lat_deg=lat / scale[0], lon_deg=lon / scale[1], altitude_m=altitude / scale[2])
        found.append((checked(sample) if fix >= 2 else None) or Sample())
    return found
