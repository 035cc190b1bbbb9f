"""PX4's ULog (.ulg): formats, subscriptions and data of the topics with positions, attitudes and exposures.

Source: the ULog file format specification of PX4 (header, definitions, data; messages of u16 size and u8 type).
"""

import math
import mmap
import struct
from pathlib import Path
from typing import Any

import numpy as np

from telemetry.formats.log.log_data import FlightLog, NotALog, Row, add_sample, each, is_later, mapped
from telemetry.formats.log.mavlink_poses import ExposureEvent, euler_deg, gimbal_rotation, put_capture_attitude
from telemetry.samples.rotations import camera_angles_deg, quaternion_ned
from telemetry.samples.sample import Sample, checked

_MAGIC = b"ULog\x01\x12\x35"
_TYPES = {
    "int8_t": "b", "uint8_t": "B", "bool": "?", "char": "c", "int16_t": "h", "uint16_t": "H", "int32_t": "i",
    "uint32_t": "I", "int64_t": "q", "uint64_t": "Q", "float": "f", "double": "d",
}  # fmt: skip
_WANTED = frozenset(
    {
        "vehicle_global_position", "vehicle_attitude", "camera_capture", "camera_trigger", "home_position",
        "distance_sensor", "gimbal_device_attitude_status", "sensor_gps", "vehicle_gps_position",
    }
)  # fmt: skip
_EVENTS = frozenset({"camera_capture", "camera_trigger"})
_RECEIVERS = ("sensor_gps", "vehicle_gps_position")
"""Topics of which all instances count: the first of two receivers may have no fix."""
_FIX_3D = 3


def read_ulog(path: Path) -> FlightLog:
    """Read a ULog; a truncated one as far as it goes.

    Raises OSError: it cannot be read; NotALog: it is not a ULog, or nothing in it can be dated.
    """
    with mapped(path) as data:
        if data[:7] != _MAGIC:
            raise NotALog("the file is not a ULog; check its name")
        instances = _rows(data)
    log = FlightLog(path=path, kind="ULog", vehicle=path.stem)
    rows = {name: found for (name, instance), found in instances.items() if instance == 0}
    receivers = [found for name in _RECEIVERS for (topic, _), found in sorted(instances.items()) if topic == name]
    fixes = max(receivers, key=lambda found: sum(map(_has_fix, found)), default=[])
    clock = _utc_minus_boot([row for found in receivers for row in found])
    homes = [r["alt"] for r in rows.get("home_position", []) if isinstance(r.get("alt"), float)]
    home = next((alt for alt in homes if math.isfinite(alt)), None)
    headings: list[tuple[float, float]] = []

    def position(row: Row) -> None:
        altitude = float(row["alt"])
        height = None if home is None else altitude - home
        _add(log, row, clock, lat_deg=row["lat"], lon_deg=row["lon"], altitude_m=altitude, height_m=height)

    def attitude(row: Row) -> None:
        yaw, pitch, roll = euler_deg(quaternion_ned(*row["q"]))
        headings.append((row["timestamp"], yaw))
        _add(log, row, clock, flight_yaw_deg=yaw, flight_pitch_deg=pitch, flight_roll_deg=roll)

    def distance(row: Row) -> None:
        if row["orientation"] == 25 and 0.5 < row["current_distance"] < 5000.0:
            _add(log, row, clock, height_m=float(row["current_distance"]), height_is_ground=True)

    def event(row: Row, name: str) -> None:
        found = _event(row, name, clock, home)
        if found is not None:
            log.events.append(found)
            log.has_gimbal |= found.sample.yaw_deg is not None

    def fix(row: Row) -> None:
        """A receiver's position: degrees and metres since PX4 1.14, 1e-7 degrees and millimetres before."""
        if not _has_fix(row):
            return
        if "latitude_deg" in row:
            lat, lon, altitude = row["latitude_deg"], row["longitude_deg"], float(row["altitude_msl_m"])
        else:
            lat, lon, altitude = row["lat"] * 1e-7, row["lon"] * 1e-7, row["alt"] * 1e-3
        height = None if home is None else altitude - home
        _add(log, row, clock, lat_deg=lat, lon_deg=lon, altitude_m=altitude, height_m=height, sigma_m=row.get("eph"))

    if "vehicle_global_position" in rows:
        each(rows["vehicle_global_position"], position)
    else:
        each(fixes, fix)
    each(rows.get("vehicle_attitude", []), attitude)
    each(rows.get("distance_sensor", []), distance)
    each(rows.get("gimbal_device_attitude_status", []), lambda row: _gimbal(log, row, clock, headings))
    each(rows.get("camera_capture", []), lambda row: event(row, "camera_capture"))
    each(rows.get("camera_trigger", []), lambda row: event(row, "camera_trigger"))
    if clock is None and rows and all(e.time_s is None for e in log.events):
        raise NotALog("the log holds no UTC, since no receiver had a fix; use a log with a fix")
    return log


def _rows(data: mmap.mmap) -> dict[tuple[str, int], list[Row]]:
    """Data of the wanted topics by topic and instance: the first of each, all of receivers."""
    formats: dict[str, list[tuple[str, str, int]]] = {}
    topics: dict[int, tuple[tuple[str, int], list[tuple[str, struct.Struct]]]] = {}
    found: dict[tuple[str, int], list[Row]] = {}
    at, size = 16, len(data)
    while at + 3 <= size:
        length, kind = struct.unpack_from("<HB", data, at)
        body = data[at + 3 : at + 3 + length]
        at += 3 + length
        if len(body) < length:
            break
        if kind == ord("F"):
            name, _, fields = body.decode("ascii", "replace").partition(":")
            formats[name] = _fields(fields)
        elif kind == ord("A") and length >= 3:
            multi, number = struct.unpack_from("<BH", body)
            name = body[3:].decode("ascii", "replace")
            if (multi == 0 or name in _RECEIVERS) and name in _WANTED and name in formats:
                topics[number] = ((name, multi), _layout(name, formats))
        elif kind == ord("D") and length >= 2:
            topic = topics.get(int.from_bytes(body[:2], "little"))
            if topic is not None:
                row = _row(body[2:], topic[1])
                rows = found.setdefault(topic[0], [])
                if row is not None and (
                    topic[0][0] in _EVENTS or not rows or is_later((row["timestamp"] - rows[-1]["timestamp"]) * 1e-6)
                ):
                    rows.append(row)
    return found


def _fields(text: str) -> list[tuple[str, str, int]]:
    """Name, type and array length of each field of a format."""
    found = []
    for part in text.split(";"):
        kind, _, name = part.strip().partition(" ")
        if not name:
            continue
        base, _, count = kind.partition("[")
        found.append((name, base, int(count[:-1]) if count[:-1].isdigit() else 0))
    return found


def _layout(
    name: str, formats: dict[str, list[tuple[str, str, int]]], depth: int = 0
) -> list[tuple[str, struct.Struct]]:
    """Fields of a topic with their structs, nested ones as bytes; padding is included."""
    layout = []
    for field, base, count in formats[name]:
        code = _TYPES.get(base)
        if code is not None:
            layout.append((field, struct.Struct(f"<{count or 1}{code}" if code != "c" else f"<{count or 1}s")))
        elif base in formats and depth < 4:
            inner = sum(s.size for _, s in _layout(base, formats, depth + 1))
            layout.append((field, struct.Struct(f"<{inner * (count or 1)}s")))
        else:
            break
    return layout


def _row(body: bytes, layout: list[tuple[str, struct.Struct]]) -> Row | None:
    row: Row = {}
    at = 0
    for field, form in layout:
        if at + form.size > len(body):
            break  # trailing padding is left out of the last message
        values = form.unpack_from(body, at)
        row[field] = values[0] if len(values) == 1 else values
        at += form.size
    return row if isinstance(row.get("timestamp"), int) else None


def _has_fix(row: Row) -> bool:
    kind = row.get("fix_type")
    return isinstance(kind, int) and kind >= _FIX_3D


def _utc_minus_boot(rows: list[Row]) -> float | None:
    """UTC less time since boot in seconds; without a fix receivers tell the time of a clock that may never be set."""
    offsets = [
        (_has_fix(row), (row["time_utc_usec"] - int(row["timestamp"])) * 1e-6)
        for row in rows
        if isinstance(row.get("time_utc_usec"), int) and 10**15 < row["time_utc_usec"] < 10**16
    ]
    best = [offset for fixed, offset in offsets if fixed] or [offset for _, offset in offsets]
    return float(np.median(best)) if best else None


def _add(log: FlightLog, row: Row, clock: float | None, **values: Any) -> None:
    add_sample(log, None if clock is None else row["timestamp"] * 1e-6 + clock, **values)


def _gimbal(log: FlightLog, row: Row, clock: float | None, headings: list[tuple[float, float]]) -> None:
    heading = None
    if headings:
        times = np.array([t for t, _ in headings])
        heading = headings[min(int(np.searchsorted(times, row["timestamp"])), len(headings) - 1)][1]
    rotation = gimbal_rotation(row["q"], int(row.get("device_flags", 0)), heading)
    if rotation is None:
        return
    log.has_gimbal = True
    yaw, pitch, roll = camera_angles_deg(rotation)
    _add(log, row, clock, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)


def _event(row: Row, kind: str, clock: float | None, home: float | None) -> ExposureEvent | None:
    if kind == "camera_capture" and row.get("result", 1) < 0:
        return None
    boot_s = row["timestamp"] * 1e-6
    utc_us = row.get("timestamp_utc", 0)
    time_s = utc_us * 1e-6 if utc_us > 10**15 else None if clock is None else boot_s + clock
    sample = Sample()
    if kind == "camera_capture":
        altitude = float(row.get("alt", np.nan))
        sample = Sample(lat_deg=row.get("lat"), lon_deg=row.get("lon"), altitude_m=altitude)
        above = float(row.get("ground_distance", -1.0))
        if above > 0.5:
            sample.height_m, sample.height_is_ground = above, True
        elif home is not None:
            sample.height_m = altitude - home
        if "q" in row:
            put_capture_attitude(sample, row["q"])
    number = row.get("seq")
    return ExposureEvent(time_s, boot_s, None if number is None else int(number), checked(sample) or Sample(), kind)
