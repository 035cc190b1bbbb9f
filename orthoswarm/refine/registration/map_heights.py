"""Heights of the ground that only oblique views show, from where the map has it.

Beyond the outermost leg ground is seen at 40 degrees and more off nadir, from one side and by few pictures: its height
is poorly triangulated, and an error of it displaces the orthoimage by nearly as much. The map shows it: ground that is
higher than assumed appears farther out in a picture, displaced along the line of sight.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from orthoswarm.config import active
from orthoswarm.model.arrays import Array, Flags, Ints
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock
from orthoswarm.refine.flight.relative_block import Flight
from orthoswarm.refine.registration.absolute_orientation import TIE_HALF_PX, TIE_REACH_PX, clear_matches
from orthoswarm.refine.registration.map_windows import LoadedMap
from orthoswarm.refine.registration.tie_points import match_points
from orthoswarm.refine.surface.ground_densification import cells_near, flying_height, sight_reach
from orthoswarm.refine.surface.vehicle_ground import GroundModel

_OBLIQUE_CELL_M: Final = 5.0  # at least this far apart, however small the picture
_OBLIQUE_SLOPE: Final = 0.35  # horizontal distance over height from which on a view counts as oblique: 19 degrees
_OBLIQUE_HALF_M: Final = 10.0  # half a patch: smaller than a tie point's
_OBLIQUE_REACH_M: Final = 6.0  # how far a patch is searched
_OBLIQUE_ACROSS_M: Final = 0.6  # what is found lies this near to the line of sight, metres, or is another place
_OBLIQUE_SIGMA_SHARE: Final = 1.5
"""Sigma of such a place, in sigmas of the tie points, which are averages over a leg's views."""
_OBLIQUE_VIEWS: Final = 8  # most cameras, nearest first, that are asked whether they show a position (for its time)


def map_heights(
    flight: Flight,
    surface: GroundModel,
    ground: LoadedMap,
    *,
    others: Array,
    tie_sigma_m: Array,
    pictures: Flags | None = None,
) -> tuple[Array, Array]:
    """Ground points (K, 3) and one sigma of their heights (K,), where this flight's views are oblique.

    Args:
        flight: adjusted on the map. surface: its ground.
        ground: the map under it.
        others: float64 (M, 2), where other vehicles' cameras were; ground that they see more steeply is left out.
        tie_sigma_m: float64 (Q,), one sigma of the flight's ties to the map.
        pictures: bool (N,), the ones to compare with the map, None for all on legs.
    """
    cameras, own = flight.cameras(), np.flatnonzero((flight.leg >= 0) & (True if pictures is None else pictures))
    if not len(tie_sigma_m) or not len(own):
        return np.zeros((0, 3)), np.zeros(0)
    cells = _positions(flight, flying_height(flight, surface), own, others)
    points = np.column_stack([cells, surface.terrain().height(cells)])
    camera = _best_views(cameras, points, own)
    chosen = np.flatnonzero(camera >= 0)
    half = max(TIE_HALF_PX, round(_OBLIQUE_HALF_M / ground.gsd_m))
    reach = max(TIE_REACH_PX, round(_OBLIQUE_REACH_M / ground.gsd_m))
    gray, level = flight.pictures.gray, points[:, 2]
    found = clear_matches(
        match_points(
            cameras,
            points,
            chosen,
            camera=camera,
            gray=gray,
            ground=ground,
            half=half,
            reach=reach,
            level=level,
            texture=True,
        )
    )
    sight = points[found.point] - cameras.position[found.camera]
    out = np.hypot(sight[:, 0], sight[:, 1])
    slope = out / np.maximum(-sight[:, 2], 1.0)
    east, north = (sight[:, :2] / np.maximum(out, 1.0)[:, None]).T
    along = found.shift[:, 0] * east + found.shift[:, 1] * north
    across = found.shift[:, 1] * east - found.shift[:, 0] * north
    good = (np.abs(across) < _OBLIQUE_ACROSS_M) & (slope > _OBLIQUE_SLOPE)
    where = points[found.point[good]].copy()
    where[:, :2] += found.shift[good]
    where[:, 2] -= along[good] / slope[good]
    return where, _OBLIQUE_SIGMA_SHARE * float(np.median(tie_sigma_m)) / slope[good]


def _positions(flight: Flight, height_m: float, own: NDArray[np.integer], others: Array) -> Array:
    """Centres (K, 2) of cells that own cameras see obliquely and no other vehicle sees more steeply."""
    config = active().registration
    path, reach = flight.cameras().position[:, :2], sight_reach(flight)
    cell = max(config.oblique_cell_share * height_m, _OBLIQUE_CELL_M)
    cells = cells_near(path, cell, reach + cell)
    mine, _ = cKDTree(path[own]).query(cells)
    keep = (mine > _OBLIQUE_SLOPE * height_m) & (mine < reach)
    if len(others):
        keep &= mine <= cKDTree(others).query(cells)[0]
    return np.asarray(cells[keep])


def _best_views(cameras: CameraBlock, points: Array, own: NDArray[np.integer]) -> Ints:
    """For each point (K, 3) the camera nearest above it that sees it, -1 for none."""
    best = np.full(len(points), -1, np.int32)
    if not len(points) or not len(own):
        return best
    _, near = cKDTree(cameras.position[own, :2]).query(points[:, :2], k=min(_OBLIQUE_VIEWS, len(own)))
    for rank in np.atleast_2d(near.T):
        left = best < 0
        camera = own[rank]
        uv = cameras.project(camera, points)
        size = cameras.lens[cameras.lens_id[camera]][:, [WIDTH, HEIGHT]]
        seen = np.isfinite(uv).all(1) & (uv > 0).all(1) & (uv < size - 1).all(1)
        best[left & seen] = camera[left & seen]
    return best
