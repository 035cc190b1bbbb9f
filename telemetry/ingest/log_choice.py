"""Which of several logs belongs to some pictures: the one that fits best, and none if several fit equally well.

A CAN log and the autopilot's log of the same vehicle become one log with the more accurate values of the two.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.model.earth import MEAN_RADIUS_M, distance_m
from orthoswarm.model.frame import UNSTATED_SIGMA_M
from telemetry.formats.log.log_data import FlightLog
from telemetry.ingest.survey import SourceInfo
from telemetry.samples.findings import Finding
from telemetry.samples.sample import Sample
from telemetry.samples.timeline import Timeline

LOG_SAME_EXPOSURE_S: Final = 1.0  # exposures of two logs at most so far apart in time (and 3 m) are one exposure
_POSITION = ("lat_deg", "lon_deg", "altitude_m", "sigma_m")
BUS_SAME_VEHICLE_M: Final = 20.0
"""A CAN log belongs to the autopilot's log whose track is within this distance (median)."""
_BUS_LEAST_COMMON: Final = 10  # positions at common times that this takes


@dataclass(slots=True, kw_only=True)
class LogSource:
    """A log, the folder that it applies to, whether it was used, and what in it comes from a CAN log."""

    folder: Path
    log: FlightLog
    source: SourceInfo
    timeline: Timeline
    used: bool = False
    better: str = ""

    @property
    def name(self) -> str:
        """The file's name, and which values come from a CAN bus."""
        return f"{self.log.path.name}, with {self.better}" if self.better else self.log.path.name


@dataclass(frozen=True, slots=True, kw_only=True)
class LogMatch:
    """A log that fits some pictures."""

    entry: LogSource  # the log
    offset_s: float  # the pictures' clock minus UTC
    how: str  # what it fits by, for messages
    rank: int  # 0 for the strongest evidence
    misfit: float = 0.0  # in it, smaller is better; differences up to `margin` decide nothing
    margin: float = 0.0
    by_positions: bool = False  # whether the misfit is a distance, metres


def best_log(matches: Sequence[LogMatch], what: str, is_named: Callable[[FlightLog], bool]) -> LogMatch | Finding:
    """The match that fits best, or a finding that says why there is none.

    Where logs of several vehicles fit equally well, only one that is named like the pictures (`is_named`) is taken: the
    vehicles of a swarm fly at the same time, so that a guess would put pictures elsewhere without a sign of it.

    matches: at least one. what: the pictures, for messages ("a.mp4").
    """
    best = min(matches, key=lambda match: (match.rank, match.misfit))
    rivals = [m for m in matches if m.rank == best.rank and m.misfit <= best.misfit + best.margin]
    rivals = [m for m in rivals if m is best or not same_flight(m.entry, best.entry)]
    if len(rivals) < 2:
        return best
    named = [m for m in rivals if is_named(m.entry.log)]
    if len(named) == 1:
        return named[0]
    text = (
        f"{rivals[0].entry.log.path.name} and {rivals[1].entry.log.path.name} fit {what} equally well ({best.how}), "
        f"so none is used: put each log into the folder of its vehicle's pictures, or name it like them"
    )
    return Finding("log-ambiguous", text)


def same_flight(a: LogSource, b: LogSource) -> bool:
    """Whether two logs, of autopilot and ground station perhaps, record one vehicle's flight."""
    distance = apart_m(a.log, b.log)
    distance = _exposures_apart_m(a.log, b.log) if distance is None else distance
    return distance is not None and distance <= BUS_SAME_VEHICLE_M


def _exposures_apart_m(a: FlightLog, b: FlightLog) -> float | None:
    """Median distance of the exposures of the same moments, metres; None if less than half of one log's are in both."""
    few, many = sorted((a.events, b.events), key=len)
    times = np.array([event.time_s for event in many], dtype=np.float64)
    apart = []
    for event in few:
        i = int(np.argmin(np.abs(times - (event.time_s or 0.0))))
        own, other = event.sample, many[i].sample
        if abs(times[i] - (event.time_s or 0.0)) > LOG_SAME_EXPOSURE_S:
            continue
        if own.has_position and other.has_position:
            apart.append(distance_m(*own.place, *other.place))
    return float(np.median(apart)) if apart and len(apart) >= 0.5 * len(few) else None


def apart_m(log: FlightLog, bus: FlightLog) -> float | None:
    """Median distance of the tracks of two logs in metres; None if they share too little time."""
    own = [sample for sample in log.samples if sample.has_position]
    if not own:
        return None
    times = np.array([sample.time_s for sample in own])
    track = bus.timeline()
    lat, lon = (np.array([getattr(s, name) for s in own], np.float64) for name in ("lat_deg", "lon_deg"))
    north = np.radians(track.values("lat_deg", times) - lat)
    east = np.radians(track.values("lon_deg", times) - lon) * np.cos(np.radians(lat))
    distance = MEAN_RADIUS_M * np.hypot(north, east)
    common = distance[np.isfinite(distance)]
    return float(np.median(common)) if len(common) >= _BUS_LEAST_COMMON else None


def bettered(log: FlightLog, bus: FlightLog) -> tuple[FlightLog, list[str]] | None:
    """The autopilot's log with values of the CAN bus that state a lower sigma, and a description of these.

    Positions are compared by their stated sigmas; without one `records.position_sigma_m` holds. A gimbal on
    the bus is used where the autopilot reports none. None if the logs are not of one vehicle, or nothing is more
    accurate.
    """
    distance = apart_m(log, bus)
    if distance is None or distance > BUS_SAME_VEHICLE_M:
        return None
    track, unstated_m = bus.timeline(), UNSTATED_SIGMA_M
    sigmas_m = log.position_sigma_m or unstated_m, unstated_m
    samples = [_placed(sample, track, *sigmas_m) for sample in log.samples]
    events = [replace(event, sample=_placed(event.sample, track, *sigmas_m)) for event in log.events]
    changed = sum(new is not old for new, old in zip(samples, log.samples, strict=True))
    better = ["positions"] if changed else []
    gimbal = bus.has_gimbal and not log.has_gimbal
    if gimbal:
        better.append("camera angles")
        samples += [sample for sample in bus.samples if sample.yaw_deg is not None]
        samples.sort(key=lambda sample: sample.time_s or 0.0)
    if not better:
        return None
    return replace(log, samples=samples, events=events, has_gimbal=log.has_gimbal or gimbal), better


def _placed(sample: Sample, track: Timeline, own_sigma_m: float, bus_sigma_m: float) -> Sample:
    """The sample, with the position of the bus if that is known at its time and more accurate.

    Where a position states no sigma, the one given for its source holds.
    """
    if not sample.has_position or sample.time_s is None:
        return sample
    known = track.at(sample.time_s)
    if not known.has_position or (known.sigma_m or bus_sigma_m) >= (sample.sigma_m or own_sigma_m):
        return sample
    return replace(sample, **{name: getattr(known, name) for name in _POSITION})
