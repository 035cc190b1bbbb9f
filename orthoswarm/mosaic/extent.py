"""Where pictures and their ground lie: bounds, the drawn part of a canvas, the ground's level, cover by a map."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.placement import MapWindow, PlacedFrame, Terrain
from orthoswarm.mosaic.footprint import footprint_boxes

RAISED_M = 2.0
"""Corners lie no higher than this over the ground around them (rubble, bushes, cars)."""


def placed_bounds(placed: Sequence[PlacedFrame], low: float, high: float) -> BoundingBox:
    """All ground between two heights that any picture sees.

    Raises:
        OrthoSwarmError: if none looks at the ground.
    """
    boxes = footprint_boxes([p.camera for p in placed], low, high)
    boxes = boxes[np.isfinite(boxes).all(axis=1)]
    if not len(boxes):
        raise OrthoSwarmError("no picture looks at the ground; check the pitch angles (-90 is straight down)")
    return BoundingBox.around(boxes)


def ground_level(placed: Sequence[PlacedFrame], terrain: Terrain | None) -> float:
    """Height of the plane on which homographies are stated: the middle of the bare ground below the cameras."""
    if terrain is None or not placed:
        return 0.0
    return float(np.median(terrain.bare_ground().height(np.array([p.camera.nadir for p in placed]))))


def from_takeoff(placed: Sequence[PlacedFrame], level: float) -> tuple[Sequence[PlacedFrame], float]:
    """Cameras and ground raised together until the ground lies on the takeoff level, where nothing else is known.

    The refiner holds the level of CORNERS, which sit on raised things, at the takeoff level, so that the ground comes
    out some decimetres below it and every camera with it. No homography changes by this, only what it is stated on.

    Args:
        placed: placed frames.
        level: ground level below them, metres.

    Returns:
        The frames, and their ground level: 0, or as it was where it is farther off than things on the ground are high.
    """
    if not 0.0 < abs(level) <= RAISED_M:
        return placed, level
    up = np.array([0.0, 0.0, -level])
    return [replace(p, camera=replace(p.camera, position=p.camera.position + up)) for p in placed], 0.0


def drawn_window(canvas: Canvas) -> tuple[int, int, int, int]:
    """The window of a canvas that holds what was drawn, on tiles and on pixels of its coarsest overview."""
    row0, row1, col0, col1 = canvas.drawn
    step = canvas.tile_px
    while max(row1 - row0, col1 - col0) > canvas.tile_px * step:
        step *= 2
    return row0 // step * step, row1, col0 // step * step, col1


def partial_cover(basemap: MapWindow, placed: Sequence[PlacedFrame]) -> list[str]:
    """A warning where pictures were taken outside the map."""
    west, south, east, north = basemap.bounds
    xy = np.array([p.camera.nadir for p in placed])
    inside = (xy[:, 0] >= west) & (xy[:, 0] <= east) & (xy[:, 1] >= south) & (xy[:, 1] <= north)
    if inside.mean() > 0.98:
        return []
    return [f"the basemap covers {inside.mean():.0%} of the pictures; the others are carried by their neighbours"]
