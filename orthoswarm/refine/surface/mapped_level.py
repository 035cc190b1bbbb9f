"""The level of the mapped ground: the height of the plane on which homographies are stated."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from orthoswarm.model.arrays import Array
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.extent import FLAT_RELIEF_M
from orthoswarm.refine.surface.terrain import lower_flank

TERRAIN_POINTS: Final = 60  # with fewer points no terrain is fitted; the ground stays level, or as it was
_LEVEL_SPACING_M: Final = 7.5  # nodes nearer to each other are thinned for the level of the mapped ground
_LEVEL_REACH_HEIGHTS: Final = 0.5
"""Ground within so many flying heights of a camera counts for the level of the mapped ground: what lies farther out is
seen obliquely, and its height is known less well (on flat ground 0 to 1 agree within 0.05 m)."""


def mapped_ground_level(terrain: Terrain | None, camera_position: Array, dense: Sequence[Array]) -> float:
    """Median height of the mapped ground, metres, in the datum of the cameras.

    Points lie on the ground and on rubble, hedges and cars, which only raise them: so the open ground is at the lower
    flank of their heights (`lower_flank`). On level ground these are heights above zero, else heights above the
    terrain, whose median below the cameras and around them is added.

    Args:
        terrain: the ground, in the frame of the cameras; None: 0.
        camera_position: float64 (N, 3).
        dense: ground points (K, 3) at free positions (not at corners), one array per vehicle.
    """
    if terrain is None or not len(camera_position):
        return 0.0
    ground = terrain.bare_ground()
    position = np.asarray(camera_position, float)
    below = ground.height(position[:, :2])
    height = float(np.median(position[:, 2] - below))
    stride = max(1, int(_LEVEL_SPACING_M / ground.step_m))
    z = ground.z[::stride, ::stride]
    rows, columns = np.indices(z.shape) * stride
    nodes = np.column_stack([columns.ravel(), rows.ravel()]) * ground.step_m + [ground.west, ground.south]
    near = cKDTree(position[:, :2]).query(nodes, distance_upper_bound=_LEVEL_REACH_HEIGHTS * height)[0]
    mapped = np.isfinite(near)
    heights = z.ravel()[mapped] if mapped.any() else below
    level = float(np.median(heights))
    points = np.concatenate([np.zeros((0, 3)), *dense])
    if len(points) < TERRAIN_POINTS:
        return level
    if float(np.std(heights)) <= FLAT_RELIEF_M:
        return lower_flank(points[:, 2])
    return level + lower_flank(points[:, 2] - ground.height(points[:, :2]))
