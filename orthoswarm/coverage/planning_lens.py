"""The field of view for planning a flight over gaps: the solved footprint at the recorded height.

An autopilot flies the next mission by its own height measurement. If that has a scale error, or if the adjustment
exchanged height for focal length (in nadir views of flat ground only their ratio is observable), the solved lens alone
gives a wrong footprint; the solved footprint at the recorded height is right in both cases.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from orthoswarm.coverage.view import View
from orthoswarm.model.robust import mad_sigma

_LENS_SIGMAS: Final = 2.0
"""Plans over gaps take the solved field of view less so many sigmas (98 % of the lenses are wider)."""


def planning_fov_rad(
    views: Sequence[View], *, ground_z_m: float = 0.0, heights_over_level_ground: bool = True
) -> float:
    """A vehicle's effective horizontal field of view lowered by two sigma, radians.

    Args:
        views: the vehicle's pictures, at least one; those with recorded poses count only where none is placed.
        ground_z_m: level of the ground below views that have no ground of their own.
        heights_over_level_ground: True where the planned altitude counts above level ground at takeoff. The angle is
            then 2 atan(h / h_r tan(fov / 2)) with h the solved height above the ground below and h_r the recorded
            height: its median over the pictures, and its sigma by their median absolute deviation (relief counts
            there). False where a height model gives the altitude above the ground: the solved lens, with the sigma of
            its solution.

    Returns:
        The angle; of the narrowest where there are pictures of several sizes.
    """
    cameras: dict[tuple[int, int], list[View]] = defaultdict(list)
    for view in [v for v in views if v.placed] or views:
        cameras[view.lens.width, view.lens.height].append(view)
    return min(_effective(members, ground_z_m, heights_over_level_ground) for members in cameras.values())


def planning_fovs_deg(
    views: Iterable[View], *, ground_z_m: float = 0.0, heights_over_level_ground: bool = True
) -> dict[str, float]:
    """Vehicle -> `planning_fov_rad` of its views, degrees."""
    vehicles: dict[str, list[View]] = defaultdict(list)
    for view in views:
        vehicles[view.vehicle].append(view)
    return {
        vehicle: math.degrees(
            planning_fov_rad(own, ground_z_m=ground_z_m, heights_over_level_ground=heights_over_level_ground)
        )
        for vehicle, own in vehicles.items()
    }


def _effective(views: Sequence[View], ground_z_m: float, heights_over_level_ground: bool) -> float:
    half_width = np.tan([0.5 * v.fov_rad for v in views])
    recorded = np.array([np.nan if v.recorded_height_m is None else v.recorded_height_m for v in views])
    known = recorded > 0.0
    if heights_over_level_ground and known.any():
        below = [ground_z_m if v.ground is None else v.ground.bare_ground().height(v.position[:2]) for v in views]
        above = np.array([float(v.position[2] - z) for v, z in zip(views, below, strict=True)])
        half_width = half_width[known] * above[known] / recorded[known]
        middle = float(np.median(half_width))
        sigma = mad_sigma(half_width - middle)
    else:
        middle = float(np.median(half_width))
        sigma = middle * float(np.median([v.focal_sigma for v in views]))
    return 2.0 * math.atan(max(middle - _LENS_SIGMAS * sigma, 0.0))
