"""Course over ground and straight legs from a vehicle's positions alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from orthoswarm.model.angles import wrap_deg, wrap_rad
from orthoswarm.model.arrays import Array
from orthoswarm.model.earth import MEAN_RADIUS_M

_LEAST_STEP_M: Final = 1.0  # shorter steps have no course: receivers at rest wander
_COURSE_BEND_DEG: Final = 40.0  # a bend from which a position lies in a turn
_LEG_BEND_DEG: Final = 30.0  # a step that is off a leg's own course by more ends it
_LEAST_LEG_M: Final = 5.0  # what is shorter is a part of a turn


class Placed(Protocol):
    """What has a position: a photo, a sample, a frame's fix."""

    @property
    def lat_deg(self) -> float | None:
        """Latitude, WGS 84."""

    @property
    def lon_deg(self) -> float | None:
        """Longitude."""


def local_metres(lat_deg: Sequence[float] | Array, lon_deg: Sequence[float] | Array) -> Array:
    """East and north (N, 2) in metres about the first position: for directions and distances within a flight."""
    lat = np.radians(np.asarray(lat_deg, float))
    lon = np.radians(np.asarray(lon_deg, float))
    if lat.size == 0:
        return np.zeros((0, 2))
    dlon = wrap_rad(lon - lon[0])
    return MEAN_RADIUS_M * np.stack([dlon * np.cos(np.median(lat)), lat - lat[0]], axis=-1)


def ground_track(places: Sequence[Placed]) -> Array:
    """East and north (N, 2) in metres about the first place."""
    return local_metres([p.lat_deg or 0.0 for p in places], [p.lon_deg or 0.0 for p in places])


def length_m(east_north: Array) -> float:
    """Length of a track (N, 2), metres."""
    return float(np.hypot(*np.diff(east_north, axis=0).T).sum()) if len(east_north) > 1 else 0.0


def courses_deg(east_north: Array) -> Array:
    """Course over ground (N,) in degrees clockwise from north at each position; NaN in turns and while stationary."""
    count = len(east_north)
    result = np.full(count, np.nan)
    if count < 2:
        return result
    step = np.diff(east_north, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    heading = np.where(length >= _LEAST_STEP_M, np.degrees(np.arctan2(step[:, 0], step[:, 1])), np.nan)
    before = np.concatenate([[np.nan], heading])
    after = np.concatenate([heading, [np.nan]])
    change = wrap_deg(after - before)
    straight = np.abs(change) < _COURSE_BEND_DEG
    result[straight] = before[straight] + 0.5 * change[straight]
    result[0] = heading[0]
    result[-1] = heading[-1]
    return wrap_deg(result)


@dataclass(frozen=True, slots=True)
class Straight:
    """A straight run: indices first to last, inclusive, and its course in degrees."""

    first: int
    last: int
    course_deg: float


def straight_legs(east_north: Array, *, least_frames: int = 3) -> list[Straight]:
    """Straight runs of a track, in order.

    A run goes on while each step keeps near the run's own course; steps much shorter than usual (hovering) are bridged.
    Short runs, and those of fewer than `least_frames` positions, are turns.
    """
    count = len(east_north)
    if count < 2:
        return []
    step = np.diff(east_north, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    usual = float(np.median(length))
    legs: list[Straight] = []
    first = 0

    def close(last: int) -> None:
        run = east_north[last] - east_north[first]
        if last - first + 1 >= least_frames and np.hypot(*run) >= _LEAST_LEG_M:
            legs.append(Straight(first, last, float(np.degrees(np.arctan2(run[0], run[1])))))

    for i in range(count - 1):
        if length[i] < 0.2 * usual:
            continue
        run = east_north[i] - east_north[first]
        if np.hypot(*run) < 0.2 * usual:
            continue
        bend = wrap_deg(float(np.degrees(np.arctan2(step[i, 0], step[i, 1]) - np.arctan2(run[0], run[1]))))
        if abs(float(bend)) > _LEG_BEND_DEG:
            close(i)
            first = i if i - first < least_frames - 1 else i + 1
    close(count - 1)
    return legs
