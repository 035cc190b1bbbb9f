"""Flight logs: tlog, ArduPilot's DataFlash .BIN, PX4's .ulg, CAN buses, lists of exposures; poses and camera events.

All give samples over UTC and exposures in order. Readers decode only the messages they need and tolerate
truncation and damage: a bad record is skipped up to the next good one.
"""

import mmap
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from telemetry.formats.log.can_log import SUFFIXES as CAN_LOGS
from telemetry.formats.log.can_log import read_can_log
from telemetry.formats.log.dataflash import read_dataflash
from telemetry.formats.log.exposure_list import read_exposure_list
from telemetry.formats.log.log_data import LEAST_STEP_S, FlightLog, NotALog, mapped
from telemetry.formats.log.mavlink_poses import TYPES, ExposureEvent, MavlinkPoses
from telemetry.formats.log.receiver_track import TRACK_SUFFIXES, is_nmea, read_track
from telemetry.formats.log.ulog import read_ulog
from telemetry.samples.findings import Finding, plural
from telemetry.samples.sample import Sample

__all__ = ["LOG_SUFFIXES", "FlightLog", "NotALog", "read_log", "read_tlog"]

OF_ONE_VEHICLE: Final[dict[str, Callable[[Path], FlightLog]]] = {
    ".bin": read_dataflash, ".ulg": read_ulog, ".pos": read_exposure_list, ".mrk": read_exposure_list,
    **dict.fromkeys(CAN_LOGS, read_can_log), **dict.fromkeys(TRACK_SUFFIXES, read_track),
}  # fmt: skip
"""Reader of each kind of log, by its suffix; a tlog may be of several vehicles."""
LOG_SUFFIXES: Final = frozenset({".tlog", *OF_ONE_VEHICLE})


def read_log(path: Path) -> list[FlightLog]:
    """Read a log of any kind; returns one entry for each vehicle in it.

    Raises NotALog: it is not a flight log, or holds nothing that can be used.
    """
    suffix = path.suffix.lower()
    reader = OF_ONE_VEHICLE.get(suffix)
    if suffix not in LOG_SUFFIXES:
        raise NotALog(f"the file is not a flight log ({', '.join(sorted(LOG_SUFFIXES))})")
    try:
        if path.stat().st_size == 0:
            raise NotALog("the log is empty; copy it again")
        if suffix == ".log" and is_nmea(path):
            reader = read_track
        logs = read_tlog(path) if reader is None else [reader(path)]
    except OSError as error:
        raise NotALog(f"the log cannot be read ({error.strerror}); check its permissions") from None
    for log in logs:
        finish(log)
    logs = [log for log in logs if log.samples or log.events]
    if not logs:
        raise NotALog("the log holds neither positions nor camera events; check that it is the right one")
    return logs


def finish(log: FlightLog) -> None:
    """Sort a log's events by time and remove repetitions; a trigger is dropped if its picture is reported, too."""
    kinds = {event.kind for event in log.events}
    for richer, poorer in (
        ("CAMERA_IMAGE_CAPTURED", "CAMERA_FEEDBACK"),
        ("CAMERA_FEEDBACK", "CAMERA_TRIGGER"),
        ("CAMERA_IMAGE_CAPTURED", "CAMERA_TRIGGER"),
        ("CAM", "TRIG"),
        ("camera_capture", "camera_trigger"),
    ):
        if richer in kinds:
            log.events = [event for event in log.events if event.kind != poorer]
    seen: set[tuple[int | None, int]] = set()
    events = []
    for event in sorted((e for e in log.events if e.time_s is not None), key=lambda e: e.time_s or 0.0):
        key = (event.number, round((event.time_s or 0.0) * 100))
        if key not in seen:
            seen.add(key)
            event.sample.time_s = event.time_s
            events.append(event)
    lost = len(log.events) - len(events)
    undated = sum(e.time_s is None for e in log.events)
    if undated:
        text = f"{plural(undated, 'camera event')} of {log.path.name} have no time"
        log.findings.append(Finding("event-without-time", text))
    elif lost:
        text = f"{plural(lost, 'camera event')} of {log.path.name} were repeated"
        log.findings.append(Finding("event-repeated", text, note=True))
    log.events = events
    log.samples.sort(key=lambda s: s.time_s or 0.0)
    numbers = sorted({e.number for e in log.events if e.number is not None})
    missing = (numbers[-1] - numbers[0] + 1 - len(numbers)) if numbers else 0
    if 0 < missing < 10 * len(numbers):
        text = f"{plural(missing, 'camera event')} of {log.path.name} are missing by their numbers"
        log.findings.append(Finding("event-gaps", text))


_HEADER = 8
_MAX_RECORDS = 100_000_000


def read_tlog(path: Path) -> list[FlightLog]:
    """Read a tlog: 8 bytes of arrival time (microseconds, big-endian) before each MAVLink packet.

    Raises OSError: it cannot be read; NotALog: no packet in it.
    """
    os.environ.setdefault("MAVLINK20", "1")
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    wanted = {number: cls.msgname for number, cls in mavlink.mavlink_map.items() if cls.msgname in TYPES}
    decoder = mavlink.MAVLink(None)
    decoder.robust_parsing = True
    vehicles: dict[int, _TlogVehicle] = {}
    with mapped(path) as data:
        at, size, packets = 0, len(data), 0
        while at + _HEADER + 8 <= size:
            length, number, system = _packet_at(data, at + _HEADER)
            if length == 0 or at + _HEADER + length > size:
                at = _resync(data, at + 1)
                continue
            packets += 1
            if number in wanted:
                try:
                    message = decoder.decode(bytearray(data[at + _HEADER : at + _HEADER + length]))
                except mavlink.MAVError:
                    at = _resync(data, at + 1)
                    continue
                arrival_s = int.from_bytes(data[at : at + _HEADER], "big") * 1e-6
                if system not in vehicles:
                    vehicles[system] = _TlogVehicle()
                vehicles[system].feed(message, arrival_s)
            at += _HEADER + length
    if not packets:
        raise NotALog("the file holds no MAVLink packet; it is not a tlog")
    return [vehicle.log(path, system) for system, vehicle in sorted(vehicles.items())]


def _packet_at(data: mmap.mmap, at: int) -> tuple[int, int, int]:
    """Length, message id and system id of the MAVLink packet at an offset; length 0 if there is none."""
    if data[at] == 0xFD and at + 10 <= len(data):
        length = 12 + data[at + 1] + (13 if data[at + 2] & 1 else 0)
        return length, int.from_bytes(data[at + 7 : at + 10], "little"), data[at + 5]
    if data[at] == 0xFE:
        return 8 + data[at + 1], data[at + 5], data[at + 3]
    return 0, 0, 0


def _resync(data: mmap.mmap, at: int) -> int:
    """The next offset where a record may begin: a plausible time (years 2000 to 2100), then a packet's start byte."""
    for start in range(at, min(len(data) - _HEADER, at + 70_000)):
        if data[start + _HEADER] in (0xFD, 0xFE) and data[start] == 0 and 0x03 <= data[start + 1] <= 0x0E:
            return start
    return len(data)


class _TlogVehicle:
    """Collects one vehicle's messages; times since boot become UTC at the end of each boot."""

    def __init__(self) -> None:
        self._poses = MavlinkPoses()
        self._samples: list[Sample] = []
        self._events: list[ExposureEvent] = []
        self._done: tuple[list[Sample], list[ExposureEvent]] = ([], [])
        self._clocks: list[float] = []
        self._arrivals: list[tuple[float, float]] = []
        self._paces: list[float] = []
        self._latest: dict[tuple[bool, bool, bool], float] = {}

    def feed(self, message: object, arrival_s: float) -> None:
        bases = self._poses.clocks.bases
        found = self._poses.feed(message, arrival_s)
        if self._poses.clocks.bases != bases:
            self._close()
        clock = self._poses.clocks.utc_minus_boot_s
        if clock is not None and (not self._clocks or clock != self._clocks[-1]):
            self._clocks.append(clock)
        if isinstance(found, Sample):
            kind = (found.has_position, found.yaw_deg is None, found.height_is_ground)
            boot_s = found.time_s or 0.0
            if not 0.0 <= boot_s - self._latest.get(kind, -1.0) < LEAST_STEP_S:
                self._latest[kind] = boot_s
                self._arrivals.append((boot_s, arrival_s))
                self._samples.append(found)
        elif found is not None:
            self._events.append(found)

    def _close(self) -> None:
        """Convert times since boot to UTC, by the vehicle's clock, else by the arrivals."""
        offset = None
        if self._clocks:
            offset = float(np.median(self._clocks))
        elif self._arrivals:
            offset = float(np.median([arrival - boot for boot, arrival in self._arrivals]))
        if len(self._arrivals) > 100:
            boot, arrival = np.array(self._arrivals).T
            if np.ptp(arrival) > 1.0:
                self._paces.append(float(np.ptp(boot) / np.ptp(arrival)))
        for sample in self._samples:
            sample.time_s = None if offset is None else (sample.time_s or 0.0) + offset
        for event in self._events:
            if event.time_s is None and event.boot_s is not None and offset is not None:
                event.time_s = event.boot_s + offset
        self._done[0].extend(self._samples)
        self._done[1].extend(self._events)
        self._samples, self._events, self._clocks, self._arrivals = [], [], [], []

    def log(self, path: Path, system: int) -> FlightLog:
        self._close()
        samples, events = self._done
        log = FlightLog(path=path, kind="tlog", vehicle=f"sysid{system}", samples=samples, events=events)
        log.has_gimbal, log.position_sigma_m = self._poses.has_gimbal, self._poses.position_sigma_m
        if self._poses.clocks.reboots:
            text = f"the vehicle of {path.name} was restarted {plural(self._poses.clocks.reboots, 'time')}"
            log.findings.append(Finding("reboot", text))
        pace = max(self._paces, default=1.0)
        if not 0.8 < pace < 1.25:
            text = (
                f"the vehicle's times in {path.name} run {pace:.1f} times as fast as their arrival (a simulation "
                "or a replay); the vehicle's times are used"
            )
            log.findings.append(Finding("tlog-pace", text))
        return log
