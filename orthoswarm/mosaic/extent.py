"""Extents: bounds of pictures and ground, drawn part of a canvas, level of the ground, overlap with a map."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.placement import MapWindow, PlacedFrame, Solution, Terrain
from orthoswarm.mosaic.footprint import footprint_boxes

FLAT_RELIEF_M: Final = 0.5  # relief of this standard deviation or less is noise to the adjustment's height prior
_MAP_COVER_SHARE: Final = 0.98  # a warning says what a map covers of the flight, up to this share of pictures
_RECORDED_HEIGHT_SIGMA_M: Final = 1.0  # sigma of a vehicle's recorded heights over its takeoff level, taken together
_GROUND_LEVEL_SIGMA_M: Final = 0.2  # sigma of the solved ground's median level, without its relief
_TAKEOFF_LEVEL_LIMIT_M: Final = 3.0  # a takeoff level farther from the refiner's zero is ignored ...
_TAKEOFF_LEVEL_RELIEFS: Final = 2.0  # ... and so many sigmas of the ground's heights


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
    """Median height of the bare ground below the cameras, metres; 0 without a terrain."""
    if terrain is None or not placed:
        return 0.0
    return float(np.median(terrain.bare_ground().height(np.array([p.camera.nadir for p in placed]))))


def ground_of_nearest(
    grounds: Sequence[Terrain | None], paths: Sequence[Array], reach_m: float, *, step_m: float, most_nodes: int
) -> Terrain:
    """Everywhere the ground of the vehicle whose camera is nearest, as that is drawn; 0 where it has none.

    grounds: of the vehicles. paths: where their cameras were, float64 (N, 2) each. reach_m: how far beyond them.
    step_m: distance of the nodes, more where they would be more than `most_nodes`.
    """
    from scipy.spatial import cKDTree

    path = np.concatenate(paths)
    box = BoundingBox.around_points(path, reach_m)
    step = max(step_m, float(np.sqrt(box.width * box.height / most_nodes)))
    rows, columns = (int(np.ceil(side / step)) + 1 for side in (box.height, box.width))
    out = Terrain(box.west, box.south, step, np.zeros((rows, columns), np.float32))
    nodes = out.nodes()
    nearest = np.repeat(np.arange(len(paths)), [len(own) for own in paths])[cKDTree(path).query(nodes)[1]]

    def joined(heights: Callable[[Terrain], Floats]) -> Floats:
        z = np.zeros((rows, columns), np.float32)
        for k, ground in enumerate(grounds):
            if ground is not None:
                z[nearest == k] = replace(ground, z=heights(ground)).height(nodes[nearest == k])
        return z

    return joined_grounds(out, grounds, joined)


def joined_grounds(
    place: Terrain, grounds: Sequence[Terrain | None], joined: Callable[[Callable[[Terrain], Floats]], Floats]
) -> Terrain:
    """Several grounds on the nodes of one: as drawn, and bare and up to their tops where any of them has these.

    joined: gives each node the height that its ground has by a function; called for each of the three.
    """
    bare = any(ground is not None and ground.bare is not None for ground in grounds)
    tops = any(ground is not None and ground.tops is not None for ground in grounds)
    return replace(
        place,
        z=joined(lambda g: g.z),
        bare=joined(lambda g: g.z if g.bare is None else g.bare) if bare else None,
        tops=joined(lambda g: g.z if g.tops is None else g.tops) if tops else None,
    )


def solved_level(solutions: Sequence[Solution]) -> float:
    """Level of the mapped ground, metres: the solutions' median, weighted by pictures; 0 where none has a terrain."""
    levels = [np.full(len(s.placed), s.ground_z_m) for s in solutions if s.terrain is not None]
    return float(np.median(np.concatenate(levels))) if any(map(len, levels)) else 0.0


def from_takeoff(
    placed: Sequence[PlacedFrame], level: float, terrain: Terrain | None
) -> tuple[Sequence[PlacedFrame], float]:
    """Cameras and ground moved together until heights count from the takeoff level as well as that is known.

    Images leave the zero of the heights open by some decimetres. Two observations fix it: the recorded heights count
    from the takeoff level, and the place of takeoff is part of the mapped ground, off its median level by no more than
    the relief. Their weighted mean becomes zero. No homography changes by this, only the heights stated with it.

    Args:
        placed: placed frames. level: of the mapped ground, metres.
        terrain: the ground below them; None: nothing was solved, and heights stay as they are.

    Returns:
        The frames, and the level of the ground.
    """
    if terrain is None or not placed:
        return placed, level
    ground = terrain.bare_ground().height(np.array([p.camera.nadir for p in placed]))
    relief = float(np.sqrt(max(0.0, ground.var() - FLAT_RELIEF_M**2)))  # less is the surface's noise
    recorded = [p.camera.position[2] - p.frame.fix.height_m for p in placed if p.frame.fix.height_m is not None]
    zeros = [(level, _GROUND_LEVEL_SIGMA_M**2 + relief**2)]
    if recorded:
        zeros.append((float(np.median(recorded)), _RECORDED_HEIGHT_SIGMA_M**2))
    limit = _TAKEOFF_LEVEL_LIMIT_M + _TAKEOFF_LEVEL_RELIEFS * relief
    zeros = [(zero, variance) for zero, variance in zeros if abs(zero) <= limit]
    if not zeros:
        return placed, level
    weight = np.array([1.0 / variance for _, variance in zeros])
    zero = float(weight @ [z for z, _ in zeros] / weight.sum())
    down = np.array([0.0, 0.0, zero])
    moved = [replace(p, camera=replace(p.camera, position=p.camera.position - down)) for p in placed]
    return moved, level - zero


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
    if inside.mean() > _MAP_COVER_SHARE:
        return []
    return [
        f"the basemap covers {inside.mean():.0%} of the pictures; the others lie on it only if neighbours carry them"
    ]
