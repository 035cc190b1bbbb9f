"""ArduPilot's DataFlash log (.BIN): self-describing binary records.

Each record: A3 95, type, then the columns that the type's FMT record (type 128) names. Only CAM, TRIG, POS, ATT, MNT,
RFND, TERR, GPS and AHR2 are read. Source: ArduPilot's AP_Logger documentation.

Time since boot is TimeUS (microseconds) since 2015, TimeMS (milliseconds) before; in GPS records of that time TimeMS is
the GPS time of week and T the time since boot.
"""

import contextlib
import mmap
import struct
from pathlib import Path
from typing import Any

import numpy as np

from telemetry.formats.log.log_data import FlightLog, NotALog, Row, add_sample, each, is_later, mapped
from telemetry.formats.log.mavlink_poses import ExposureEvent
from telemetry.samples.rotations import camera_angles_deg, euler_ned
from telemetry.samples.sample import Sample, checked
from telemetry.samples.times import GPS_EPOCH_S, GPS_MINUS_UTC_S, WEEK_S
from telemetry.samples.unreadable import beginning

_MARK = b"\xa3\x95"
_FMT, _FMT_SIZE = 128, 89
_CODES = {
    "a": "64s", "b": "b", "B": "B", "h": "h", "H": "H", "i": "i", "I": "I", "f": "f", "d": "d", "n": "4s", "N": "16s",
    "Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "M": "B", "q": "q", "Q": "Q", "g": "e",
}  # fmt: skip
_SCALES = {"c": 1e-2, "C": 1e-2, "e": 1e-2, "E": 1e-2, "L": 1e-7}
_EVENTS = frozenset({"CAM", "TRIG"})
_WANTED = frozenset({"CAM", "TRIG", "POS", "ATT", "AHR2", "MNT", "RFND", "TERR", "GPS"})


class _Format:
    """One record type."""

    def __init__(self, name: str, length: int, codes: str, columns: str) -> None:
        self.name, self.length = name, length
        self._names = columns.split(",") if columns else []
        self._scales = [_SCALES.get(code) for code in codes]
        self._struct = struct.Struct("<" + "".join(_CODES[code] for code in codes))
        if self._struct.size != length - 3 or len(self._names) != len(codes):
            raise ValueError("the columns do not fill the record")

    def read(self, data: mmap.mmap, at: int) -> Row:
        values = self._struct.unpack_from(data, at + 3)
        return {
            name: value if scale is None else value * scale
            for name, value, scale in zip(self._names, values, self._scales, strict=True)
        }


def read_dataflash(path: Path) -> FlightLog:
    """Read a DataFlash log; damaged parts are skipped.

    Raises OSError: it cannot be read; NotALog: it is not a DataFlash log.
    """
    with mapped(path) as data:
        rows = _rows(data)
    if not rows:
        raise NotALog("the file holds no DataFlash record; it is not an ArduPilot log")
    log = FlightLog(path=path, kind="DataFlash", vehicle=path.stem)
    clock = _utc_minus_boot(rows.get("GPS", []))

    def add(row: Row, **values: Any) -> None:
        add_sample(log, _utc_s(row, clock), **values)

    def position(row: Row) -> None:
        height = row.get("RelHomeAlt", row.get("RelAlt"))
        add(row, lat_deg=row["Lat"], lon_deg=row["Lng"], altitude_m=row.get("Alt"), height_m=height)

    def fix(row: Row) -> None:
        if _has_fix(row) and row.get("I", 0) == 0:
            position(row)

    def attitude(row: Row) -> None:
        add(row, flight_yaw_deg=row["Yaw"], flight_pitch_deg=row["Pitch"], flight_roll_deg=row["Roll"])

    def rangefinder(row: Row) -> None:
        if row.get("Orient", 25) == 25 and row.get("Stat", 4) == 4 and 0.5 < row["Dist"] < 5000.0:
            add(row, height_m=float(row["Dist"]), height_is_ground=True)

    def terrain(row: Row) -> None:
        if row.get("Status", 2) == 2 and row["CHeight"] > 0.5:
            add(row, height_m=float(row["CHeight"]), height_is_ground=True)

    def gimbal(row: Row) -> None:
        stated = [row.get("YawE", row.get("Yaw", np.nan)), row.get("Pitch", np.nan), row.get("Roll", np.nan)]
        if not np.isfinite(stated).all():
            return
        log.has_gimbal = True
        yaw, pitch, roll = camera_angles_deg(euler_ned(*map(float, stated)))
        add(row, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)

    # Receivers' positions only where the filter's are not logged.
    each(rows["POS"] if "POS" in rows else rows.get("GPS", []), position if "POS" in rows else fix)
    each(rows.get("ATT") or rows.get("AHR2", []), attitude)
    for kind, take in (("RFND", rangefinder), ("TERR", terrain), ("MNT", gimbal)):
        each(rows.get(kind, []), take)
    for kind in ("CAM", "TRIG"):
        each(rows.get(kind, []), lambda row, kind=kind: log.events.append(_event(row, kind, clock)))  # type: ignore[misc]
    if clock is None and not any(event.time_s is not None for event in log.events):
        raise NotALog("the log has no GPS time, so nothing in it can be dated; log GPS records or use the tlog")
    return log


def has_dataflash_records(path: Path) -> bool:
    """Whether a file begins like a DataFlash log: with a record that describes a format."""
    return _MARK + bytes([_FMT]) in beginning(path, 1 << 16)


def _rows(data: mmap.mmap) -> dict[str, list[Row]]:
    """Records of the wanted types, in order of the file."""
    formats: dict[int, _Format | None] = {}
    lengths: dict[int, int] = {_FMT: _FMT_SIZE}
    found: dict[str, list[Row]] = {}
    at, size = data.find(_MARK), len(data)
    while 0 <= at < size - 3:
        kind = data[at + 2]
        length = lengths.get(kind)
        if length is None or at + length > size or (data[at + length : at + length + 2] not in (_MARK, b"")):
            # Unknown, cut off, or not followed by a record: damage; go on from the next mark.
            at = data.find(_MARK, at + 1)
            continue
        if kind == _FMT:
            _learn(data, at, formats, lengths)
        else:
            form = formats.get(kind)
            if form is not None:
                row, rows = form.read(data, at), found.setdefault(form.name, [])
                if form.name in _EVENTS or not rows or _is_later(row, rows[-1]):
                    rows.append(row)
        at += length
    return found


def _learn(data: mmap.mmap, at: int, formats: dict[int, _Format | None], lengths: dict[int, int]) -> None:
    kind, length, name, codes, columns = struct.unpack_from("<BB4s16s64s", data, at + 3)
    if length < 3 or kind == _FMT:
        return
    lengths[kind] = length
    text = name.rstrip(b"\0").decode("ascii", "replace")
    formats[kind] = None
    if text in _WANTED:
        with contextlib.suppress(ValueError, KeyError):
            formats[kind] = _Format(text, length, *(part.rstrip(b"\0").decode("ascii") for part in (codes, columns)))


def _utc_minus_boot(rows: list[Row]) -> float | None:
    """Offset from TimeUS to UTC, by the GPS weeks and milliseconds of good fixes."""
    offsets = []
    for row in rows:
        week, week_ms, boot_s = row.get("GWk", row.get("Week")), row.get("GMS", row.get("TimeMS")), _boot_s(row)
        if isinstance(week, int) and week > 1000 and week_ms is not None and boot_s is not None and _has_fix(row):
            offsets.append(GPS_EPOCH_S + week * WEEK_S + week_ms * 1e-3 - GPS_MINUS_UTC_S - boot_s)
    # A fix is logged some time after its measurement, so the largest offsets are the best.
    return float(np.quantile(offsets, 0.9)) if offsets else None


def _boot_s(row: Row) -> float | None:
    """Seconds since boot of a record, None where it has none."""
    if "TimeUS" in row:
        return float(row["TimeUS"]) * 1e-6
    milliseconds = row["T"] if "T" in row and "Week" in row else row.get("TimeMS")
    return None if milliseconds is None else float(milliseconds) * 1e-3


def _is_later(row: Row, last: Row) -> bool:
    """Whether a record is late enough after the last stored one to be stored, too."""
    now, before = _boot_s(row), _boot_s(last)
    return now is None or before is None or is_later(now - before)


def _has_fix(row: Row) -> bool:
    return bool(row.get("Status", 3) >= 3)


def _utc_s(row: Row, clock: float | None) -> float | None:
    boot_s = _boot_s(row)
    return None if clock is None or boot_s is None else boot_s + clock


def _event(row: Row, kind: str, clock: float | None) -> ExposureEvent:
    sample = Sample(
        lat_deg=row.get("Lat"), lon_deg=row.get("Lng"), altitude_m=row.get("Alt"), height_m=row.get("RelAlt"),
        flight_roll_deg=row.get("R", row.get("Roll")), flight_pitch_deg=row.get("P", row.get("Pitch")),
        flight_yaw_deg=row.get("Y", row.get("Yaw")),
    )  # fmt: skip
    time_s = _utc_s(row, clock)
    if time_s is None and row.get("GPSWeek", 0) > 1000:
        time_s = GPS_EPOCH_S + row["GPSWeek"] * WEEK_S + row["GPSTime"] * 1e-3 - GPS_MINUS_UTC_S
    number = row.get("Img", row.get("ImageNo"))
    return ExposureEvent(
        time_s, _boot_s(row), None if number is None else int(number), checked(sample) or Sample(), kind
    )
