"""A CAN log combined with the autopilot's log of the same vehicle: the more accurate values of the two are used."""

from dataclasses import replace
from typing import Final

import numpy as np

from orthoswarm.config import active
from orthoswarm.model.earth import MEAN_RADIUS_M
from telemetry.formats.log.log_data import FlightLog
from telemetry.samples.sample import Sample
from telemetry.samples.timeline import Timeline

_POSITION = ("lat_deg", "lon_deg", "altitude_m", "sigma_m")

BUS_SAME_VEHICLE_M: Final = 20.0
"""A CAN log belongs to the autopilot's log whose track is within this distance (median)."""
_BUS_LEAST_COMMON: Final = 10  # positions at common times that this takes


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
    track = bus.timeline()
    sigma_m = log.position_sigma_m or active().records.position_sigma_m
    samples = [_placed(sample, track, sigma_m) for sample in log.samples]
    events = [replace(event, sample=_placed(event.sample, track, sigma_m)) for event in log.events]
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


def _placed(sample: Sample, track: Timeline, sigma_m: float) -> Sample:
    """The sample with the position of the bus if that is known at its time and more accurate.

    Else the sample itself.
    """
    if not sample.has_position or sample.time_s is None:
        return sample
    known = track.at(sample.time_s)
    if not known.has_position or (known.sigma_m or active().records.position_sigma_m) >= (sample.sigma_m or sigma_m):
        return sample
    return replace(sample, **{name: getattr(known, name) for name in _POSITION})
