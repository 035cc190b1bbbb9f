"""Legs and their straight lines (paper III.C): grouping by heading and path, Eq. 2 and Eq. 3."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Ints
from orthoswarm.refine.bundle.flight_records import FlightRecords
from orthoswarm.trajectory.legs import split_legs

_LEG_HEADING_DEG: Final = 20.0  # frames of a leg differ in heading from its mean by less
_LEG_PHOTOS: Final = 3  # least photos of a leg
_LINE_DISTANCE_M: Final = 4.0  # photos before and after a leg belong to it within this distance of its line ...
_LINE_SIGMAS: Final = 3.0  # ... or within so many standard deviations of its photos across the line


@dataclass(frozen=True, slots=True)
class Line:
    """The straight line of a leg."""

    point: Array  # float64 (2,), a point on it (the middle of the positions)
    direction: Array  # float64 (2,), unit, along flight
    sigma_m: float  # standard deviation of the positions across it

    def project(self, position: Array) -> Array:
        """Eq. 3: the foot points (N, 2) of positions (N, 2) on the line."""
        along = (position - self.point) @ self.direction
        return np.asarray(self.point + along[:, None] * self.direction)

    def along(self, position: Array) -> Array:
        """Distance flown along the line, metres from its point, of positions (N, 2)."""
        return np.asarray((position - self.point) @ self.direction)


def fit_line(position: Array) -> Line:
    """Eq. 2: the line through positions (N, 2) of a leg, by TOTAL least squares.

    The paper minimises the error of y = kx + b in y. This has no solution for a leg due north (x = const) and is
    biased for steep legs. Minimising perpendicular distances has neither fault and agrees with it for legs due east.
    """
    middle = position.mean(axis=0)
    _, spread, axes = np.linalg.svd(position - middle, full_matrices=False)
    direction = axes[0] if (position[-1] - position[0]) @ axes[0] >= 0 else -axes[0]
    across = float(spread[1]) / np.sqrt(max(len(position) - 2, 1)) if len(spread) > 1 else 0.0
    return Line(middle, direction, across)


def find_legs(records: FlightRecords) -> Ints:
    """Leg of each frame, int32 (N,), -1 in turns; a leg is straight and has one camera heading."""
    path = split_legs(records.position, records.time_s if records.timed else None)
    out = np.full(len(path), -1, np.int32)
    number = 0
    for k in range(int(path.max()) + 1 if len(path) else 0):
        for run in _one_heading(np.flatnonzero(path == k).astype(np.int32), records.yaw):
            if len(run) >= _LEG_PHOTOS:
                out[run] = number
                number += 1
    return _grown(out, records)


def _grown(leg: Ints, records: FlightRecords) -> Ints:
    """Legs extended over the frames before and after them that are on their line and have the same heading.

    The path alone detects a turn a few frames too early or too late.
    """
    most_turned = np.radians(_LEG_HEADING_DEG)
    out = leg.copy()
    for k in range(int(leg.max()) + 1 if len(leg) else 0):
        members = np.flatnonzero(leg == k)
        line = fit_line(records.position[members, :2])
        reach = max(_LINE_SIGMAS * line.sigma_m, _LINE_DISTANCE_M)
        mean = np.angle(np.exp(1j * records.yaw[members]).mean())
        for start, step in ((members[-1] + 1, 1), (members[0] - 1, -1)):
            i = int(start)
            last = line.along(records.position[i - step, None, :2])[0]
            while 0 <= i < len(out) and out[i] < 0:
                offset = records.position[i, :2] - line.project(records.position[i, None, :2])[0]
                along = line.along(records.position[i, None, :2])[0]
                turned = abs(wrap_rad(float(records.yaw[i] - mean))) > most_turned
                if turned or np.hypot(*offset) > reach or (along - last) * step <= 0:
                    break
                out[i], last = k, along
                i += step
    return out


def _one_heading(members: Ints, yaw: Array) -> list[Ints]:
    """Runs of frames whose heading stays near the run's mean."""
    most_turned = np.radians(_LEG_HEADING_DEG)
    runs: list[list[int]] = []
    for i in members.tolist():
        if runs:
            mean = np.angle(np.exp(1j * yaw[runs[-1]]).mean())
            if abs(wrap_rad(float(yaw[i] - mean))) <= most_turned:
                runs[-1].append(i)
                continue
        runs.append([i])
    return [np.array(r, np.int32) for r in runs]
