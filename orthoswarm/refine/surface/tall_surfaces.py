"""The surface that pictures are drawn on: the ground with what stands on it, where the pictures tell its height.

The ground is fitted from below. Drawn on it, the top of a hall 10 m high that is seen 40 degrees off nadir would lie
8 m from its place.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from orthoswarm.config import active
from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.placement import Terrain
from orthoswarm.model.task_runner import Run
from orthoswarm.refine.surface.plane_sweep import SweepViews, tall_heights
from orthoswarm.refine.surface.vertical_line_locus import REFERENCE_HEIGHT_M

_TALL_NEAR_M: Final = 18.0  # heights are measured within this distance of raised points at the reference height
_TALL_ABOVE_M: Final = 2.0
"""... and up to so much above the highest of them (0 and larger distances change the share of nodes within 1 m by at
most 0.008 on two scenes)."""
_TALL_CELL_M: Final = 1.25  # distance of the nodes whose heights are measured at the reference height


def with_tall_surfaces(
    ground: Terrain, points: Array, views: Sequence[SweepViews], *, height_m: float, most_nodes: int, run: Run
) -> Terrain:
    """The ground plus the tops of what stands near raised points; the ground itself where there are none.

    Args:
        ground: bare ground.
        points: float64 (K, 3) at free positions on the visible surface.
        views: pictures of each vehicle. height_m: flying height above the ground.
        most_nodes: the ground gets no more nodes than this. run: how tasks are run.
    """
    c = active().surface
    over = points[:, 2] - ground.height(points[:, :2])
    raised = over > c.tall_from_m
    if not raised.any():
        return ground
    scale = height_m / REFERENCE_HEIGHT_M
    parts = max(1, round(ground.step_m / (_TALL_CELL_M * scale)))
    while parts > 1 and ground.z.size * parts**2 > most_nodes:
        parts -= 1
    fine = _finer(ground, parts)
    tallest = _tallest(points[raised, :2], over[raised], fine, _TALL_NEAR_M * scale)
    heights = tall_heights(views, fine, tallest, height_m=height_m, run=run)
    heights[heights < c.tall_from_m] = 0.0
    if not heights.any():
        return ground
    return replace(fine, z=fine.z + heights, bare=fine.z)


def _finer(ground: Terrain, parts: int) -> Terrain:
    """A ground with its nodes closer: each step divided into so many parts."""
    rows, columns = ((n - 1) * parts + 1 for n in ground.z.shape)
    step = ground.step_m / parts
    east, north = ground.west + step * np.arange(columns), ground.south + step * np.arange(rows)
    z = np.empty((rows, columns), np.float32)
    for row in range(rows):
        z[row] = ground.height(np.column_stack([east, np.full(columns, north[row])]))
    return Terrain(ground.west, ground.south, step, z)


def _tallest(xy: Array, over: Array, nodes: Terrain, near_m: float) -> Floats:
    """How high something may stand at each node, metres: above all raised points within a distance; 0 without any."""
    place = np.rint((xy - (nodes.west, nodes.south)) / nodes.step_m).astype(int)
    within = ((place >= 0) & (place < nodes.z.shape[::-1])).all(1)
    columns, rows = place[within].T
    highest = np.zeros(nodes.z.shape, np.float32)
    np.maximum.at(highest, (rows, columns), np.float32(_TALL_ABOVE_M) + over[within].astype(np.float32))
    side = 2 * int(near_m / nodes.step_m) + 1
    return np.asarray(cv2.dilate(highest, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))), np.float32)
