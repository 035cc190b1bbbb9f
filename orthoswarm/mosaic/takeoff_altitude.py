"""Altitudes of solved cameras: heights over the takeoff level, plus one altitude of that level for each block.

Vehicles that were solved together have heights over one zero. An altitude of each vehicle's own would move them apart
by what their receivers disagree, and their pictures would no longer show the same ground at the same place.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.frame import UNSTATED_SIGMA_M
from orthoswarm.model.placement import PlacedFrame
from orthoswarm.model.robust import mad_sigma
from orthoswarm.trajectory.near_paths import NearPaths

_LEVELS_M = (-500.0, 9000.0)  # lowest and highest ground that can be true, metres

_VERTICAL_SIGMAS: Final = 2.0
"""Sigma of a recorded altitude over that of the recorded place (an axis): satellites stand on one side of the receiver
only (vertical dilution of precision is 1.5 to 2.5 times the horizontal one of an axis)."""


@dataclass(frozen=True, slots=True)
class TakeoffLevel:
    """Where the zero of the heights of some vehicles lies.

    Attributes:
        altitude_m: of that level, as the receivers state it. sigma_m: one sigma of it: the receivers' own, or what
            vehicles and pictures disagree by, whichever is more.
        common_sigma_m: one sigma that the heights of all their cameras have in common (a wrong focal length). It is in
            no altitude of a camera, since the level was found from the same heights.
    """

    altitude_m: float
    sigma_m: float
    common_sigma_m: float = 0.0

    def of_camera(self, placed: PlacedFrame) -> tuple[float, float]:
        """Altitude of a camera and one sigma of it, metres."""
        own = max(height_sigma_m(placed) ** 2 - self.common_sigma_m**2, 0.0)
        return float(placed.camera.position[2]) + self.altitude_m, math.hypot(self.sigma_m, math.sqrt(own))


def height_sigma_m(placed: PlacedFrame) -> float:
    """One sigma of a camera's height, metres: the adjustment's; as for receivers where it states none."""
    if placed.pose_covariance is None:
        return _VERTICAL_SIGMAS * placed.sigma_m
    return math.sqrt(max(float(placed.pose_covariance[2, 2]), 0.0))


def takeoff_levels(placed: Sequence[PlacedFrame]) -> dict[str, TakeoffLevel]:
    """Vehicle -> altitude of its takeoff level, from photos with an altitude; absent without one.

    Vehicles whose refined pictures lie side by side were solved together and share the median of their levels, also
    those that recorded no altitude. A vehicle that lies as recorded has its own: its heights count from where it
    took off.
    """
    frames: dict[str, list[PlacedFrame]] = {}
    for p in placed:
        frames.setdefault(p.frame.vehicle, []).append(p)
    refined = {vehicle: [p for p in own if p.stage != "realtime"] for vehicle, own in frames.items()}
    paths = {vehicle: np.array([p.camera.position for p in own]) for vehicle, own in refined.items() if own}
    alone = [[vehicle] for vehicle in frames if vehicle not in paths]
    found: dict[str, TakeoffLevel] = {}
    for block in [*_blocks(paths), *alone]:
        level = _common_level([refined[vehicle] or frames[vehicle] for vehicle in block])
        if level is not None:
            found |= dict.fromkeys(block, level)
    return found


def _common_level(vehicles: Sequence[Sequence[PlacedFrame]]) -> TakeoffLevel | None:
    """The level of a block, each vehicle counting once; None where no photo has an altitude."""
    levels, stated, scatter = [], [], []
    for own in vehicles:
        found = _recorded_levels(own)
        if not len(found[0]):
            continue
        levels.append(float(np.median(found[0])))
        scatter.append(mad_sigma(found[0] - levels[-1]))
        across = np.where(np.isfinite(found[1]), found[1], UNSTATED_SIGMA_M)
        stated.append(_VERTICAL_SIGMAS * float(np.median(across)))
    if not levels:
        return None
    level = float(np.median(levels))
    sigma = max(float(np.median(stated)), float(np.median(scatter)), mad_sigma(np.array(levels) - level))
    of_heights = [height_sigma_m(p) for own in vehicles for p in own]
    common = min((s for s in of_heights if math.isfinite(s)), default=0.0)
    return TakeoffLevel(level, sigma, common)


def _recorded_levels(placed: Sequence[PlacedFrame]) -> tuple[Array, Array]:
    """Recorded altitude less height of each camera that has one, and the stated sigma of its position, else NaN."""
    low, high = _LEVELS_M
    rows = [
        (p.frame.fix.altitude_m - float(p.camera.position[2]), p.frame.fix.position_sigma_m or np.nan)
        for p in placed
        if p.frame.fix.altitude_m is not None and low < p.frame.fix.altitude_m - float(p.camera.position[2]) < high
    ]
    level, sigma = np.array(rows, np.float64).reshape(-1, 2).T
    return level, sigma


def _blocks(paths: Mapping[str, Array]) -> list[list[str]]:
    """Vehicles in blocks, from camera positions (N, 3) of each: those whose paths come near are in one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    names = list(paths)
    if not names:
        return []
    neighbours = NearPaths(list(paths.values()))
    edges = [(k, other) for k in range(len(names)) for other in neighbours.of(k)]
    rows, columns = np.array(edges).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(names), len(names)))
    count, label = connected_components(graph, directed=False)
    return [[names[k] for k in np.flatnonzero(label == block)] for block in range(count)]
