"""Course over ground and straight legs from a vehicle's positions alone."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.angles import wrap_deg, wrap_rad
from orthoswarm.model.earth import MEAN_RADIUS_M

Array = NDArray[np.float64]


def local_metres(lat_deg: Sequence[float] | Array, lon_deg: Sequence[float] | Array) -> Array:
    """East and north (N, 2) in metres about the first position: for directions and distances within a flight."""
    lat = np.radians(np.asarray(lat_deg, float))
    lon = np.radians(np.asarray(lon_deg, float))
    if lat.size == 0:
        return np.zeros((0, 2))
    dlon = wrap_rad(lon - lon[0])
    return MEAN_RADIUS_M * np.stack([dlon * np.cos(np.median(lat)), lat - lat[0]], axis=-1)


def courses_deg(east_north: Array, *, least_step_m: float = 1.0, bend_deg: float = 40.0) -> Array:
    """Course over ground (N,) in degrees clockwise from north at each position; NaN in turns and while stationary."""
    count = len(east_north)
    result = np.full(count, np.nan)
    if count < 2:
        return result
    step = np.diff(east_north, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    heading = np.where(length >= least_step_m, np.degrees(np.arctan2(step[:, 0], step[:, 1])), np.nan)
    before = np.concatenate([[np.nan], heading])
    after = np.concatenate([heading, [np.nan]])
    change = wrap_deg(after - before)
    straight = np.abs(change) < bend_deg
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


def straight_legs(
    east_north: Array, *, bend_deg: float = 30.0, least_frames: int = 3, least_length_m: float = 5.0
) -> list[Straight]:
    """Straight runs of a track, in order.

    A run goes on while each step keeps within `bend_deg` of the run's own course; steps much shorter than usual
    (hovering) are bridged. Runs of fewer than `least_frames` positions or shorter than `least_length_m` are turns.
    """
    count = len(east_north)
    if count < 2:
        return []
    step = np.diff(east_north, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    usual = float(np.median(length))
    legs: list[Straight] = []
    first = 0
    for i in range(count - 1):
        if length[i] < 0.2 * usual:
            continue
        run = east_north[i] - east_north[first]
        if np.hypot(*run) < 0.2 * usual:
            continue
        bend = wrap_deg(float(np.degrees(np.arctan2(step[i, 0], step[i, 1]) - np.arctan2(run[0], run[1]))))
        if abs(float(bend)) > bend_deg:
            _close(legs, east_north, first, last=i, least_frames=least_frames, least_length_m=least_length_m)
            first = i if i - first < least_frames - 1 else i + 1
            if first == i:
                first = i
    _close(legs, east_north, first, last=count - 1, least_frames=least_frames, least_length_m=least_length_m)
    return legs


def _close(
    legs: list[Straight], points: Array, first: int, *, last: int, least_frames: int, least_length_m: float
) -> None:
    run = points[last] - points[first]
    if last - first + 1 >= least_frames and np.hypot(*run) >= least_length_m:
        legs.append(Straight(first, last, float(np.degrees(np.arctan2(run[0], run[1])))))
