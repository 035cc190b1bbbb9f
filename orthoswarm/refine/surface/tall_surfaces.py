"""What stands on the ground: heights are swept near raised points, and what the pictures do not decide stays on it."""

from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.placement import Terrain
from orthoswarm.model.task_runner import Run
from orthoswarm.mosaic.confidence import UNMEASURED_M
from orthoswarm.refine.surface.plane_sweep import SweepCosts, SweepViews, ground_at_nodes, measured, sweep_tasks
from orthoswarm.refine.surface.seen_objects import seen_objects
from orthoswarm.refine.surface.vertical_line_locus import REFERENCE_HEIGHT_M

TALL_FROM_M: Final = 1.5  # what differs less from the ground belongs to it
_TALL_COSTS: Final = SweepCosts(noise_levels=1.0, doubt=0.07, slope=0.15, edge=(0.15, 1.2))
"""Measured: with a noise of 2 a tenth fewer of a plain roof's nodes are right within 1 m; less than 1 is the noise of a
JPEG. What is not sure is ground: with a doubt of 0.05 more roofs are whole and more of the ground beside them is
raised, with 0.1 the other way round. Edges of 0.3 and 1.2 give 0.4 per cent fewer right nodes, 0.3 and 1.8 another
0.7."""
_TALL_NEAR_M: Final = 18.0  # heights are measured within this distance of raised points at the reference height
_TALL_ABOVE_M: Final = 2.0
"""... and up to so much above the highest of them (0 and larger distances change the share of nodes within 1 m by at
most 0.008 on two scenes)."""
_TALL_CELL_M: Final = 1.25  # distance of the nodes whose heights are measured at the reference height


def with_tall_surfaces(
    ground: Terrain, points: Array, views: SweepViews, *, height_m: float, most_nodes: int, run: Run
) -> Terrain:
    """The bare ground plus the tops of what stands near raised points, where pictures see the ground behind it too.

    points: float64 (K, 3) at free positions on the visible surface. height_m: flying height above the ground.
    most_nodes: the ground gets no more nodes than this.
    """
    over = points[:, 2] - ground.height(points[:, :2])
    raised = over > TALL_FROM_M
    if not raised.any():
        return ground
    scale = height_m / REFERENCE_HEIGHT_M
    parts = max(1, round(ground.step_m / (_TALL_CELL_M * scale)))
    while parts > 1 and ground.z.size * parts**2 > most_nodes:
        parts -= 1
    rows, columns = ((n - 1) * parts + 1 for n in ground.z.shape)
    fine = ground_at_nodes(ground, ground.west, ground.south, ground.step_m / parts, (rows, columns))
    tallest = _tallest(points[raised, :2], over[raised], fine, _TALL_NEAR_M * scale)
    heights = _tall_heights(views, fine, tallest, height_m=height_m, run=run)
    heights[heights < TALL_FROM_M] = 0.0
    may_stand = np.where((tallest > 0.0) & (heights == 0.0), np.float32(UNMEASURED_M), heights)
    return seen_objects(replace(fine, z=fine.z + heights, bare=fine.z, tops=fine.z + may_stand), views.cameras)


def _tall_heights(views: SweepViews, ground: Terrain, tallest: Floats, *, height_m: float, run: Run) -> Floats:
    """Heights above the ground, float32 (rows, columns) of its nodes, 0 where it is the surface; see `sweep_tasks`."""
    out = np.zeros(tallest.shape, np.float32)
    for blocks in run(measured, list(sweep_tasks(views, ground, tallest, height_m=height_m, costs=_TALL_COSTS))):
        for (top, bottom, left, right), heights in blocks:
            out[top:bottom, left:right] = heights[0]
    return out


def _tallest(xy: Array, over: Array, nodes: Terrain, near_m: float) -> Floats:
    """How high something may stand at each node, metres: above all raised points within a distance; 0 without any."""
    place = np.rint((xy - (nodes.west, nodes.south)) / nodes.step_m).astype(int)
    within = ((place >= 0) & (place < nodes.z.shape[::-1])).all(1)
    columns, rows = place[within].T
    highest = np.zeros(nodes.z.shape, np.float32)
    np.maximum.at(highest, (rows, columns), np.float32(_TALL_ABOVE_M) + over[within].astype(np.float32))
    side = 2 * int(near_m / nodes.step_m) + 1
    return np.asarray(cv2.dilate(highest, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))), np.float32)
