"""Ground visible in any frame, at low resolution: the reference for the orthoimage's completeness."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from orthoswarm.model.arrays import Flags, Ints
from orthoswarm.model.camera import Camera
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.footprint import footprint_boxes
from orthoswarm.mosaic.kernels.drawn_heights import heights
from orthoswarm.mosaic.kernels.render_arrays import MARGIN_PX, Shots
from orthoswarm.mosaic.seam_labels import label_tile

_PART = 512


def coverage(cameras: Sequence[Camera], grid: GroundGrid, terrain: Terrain | None = None) -> Flags:
    """Where the centres of a coarse grid's cells are seen by at least one camera, bool (rows, columns).

    Seen means: within the picture up to its very edge, distortion and terrain honoured, at most 75 degrees off nadir.

    Args:
        cameras: where the pictures were taken.
        grid: the cells; metres to tens of metres wide, since the mask is in memory.
        terrain: the ground; level at 0 if None.
    """
    return nearest_cameras(cameras, [False] * len(cameras), grid, terrain or Terrain.flat(), margin_px=-0.5) > 0


def nearest_cameras(
    cameras: Sequence[Camera], weak: Sequence[bool], grid: GroundGrid, terrain: Terrain, *, margin_px: float = MARGIN_PX
) -> Ints:
    """Which camera shows each cell's centre in a map without seams: its index plus 1, 0 where none sees it.

    Args:
        cameras, grid, terrain: as of `coverage`. weak: cameras that show only what no other sees.
        margin_px: of the pictures that is not shown.
    """
    nearest = np.zeros((grid.height, grid.width), np.int32)
    shots = Shots.of(cameras, list(weak), margin_px=margin_px)
    for (r, c), ids in by_tile(cameras, grid, _PART, terrain).items():
        r1, c1 = min(grid.height, r + _PART), min(grid.width, c + _PART)
        west, north = grid.west + c * grid.gsd_m, grid.north - r * grid.gsd_m
        label = np.zeros((r1 - r, c1 - c), np.int32)
        lattice = heights(terrain, west, north, grid.gsd_m, _PART)
        label_tile(label, shots.take(ids), ids + 1, lattice=lattice, west=west, north=north, gsd_m=grid.gsd_m)
        nearest[r:r1, c:c1] = label
    return nearest


def by_tile(cameras: Sequence[Camera], grid: GroundGrid, tile_px: int, terrain: Terrain) -> dict[tuple[int, int], Ints]:
    """For each tile (first row, first column in pixels) that any camera may see: indices of those cameras, in order."""
    if len(cameras) == 0:
        return {}
    boxes = footprint_boxes(cameras, float(terrain.z.min()), float(terrain.z.max()))
    side = tile_px * grid.gsd_m
    top = np.array([-(-grid.height // tile_px), -(-grid.width // tile_px)]) - 1.0
    first = np.floor(np.stack([grid.north - boxes[:, 3], boxes[:, 0] - grid.west], 1) / side)
    last = np.floor(np.stack([grid.north - boxes[:, 1], boxes[:, 2] - grid.west], 1) / side)
    touching = np.nonzero(((last >= 0) & (first <= top) & (first <= last)).all(1))[0]
    spans = np.concatenate([np.clip(first, 0, top), np.clip(last, 0, top)], 1)[touching].astype(int)
    lists: dict[tuple[int, int], list[int]] = defaultdict(list)
    for i, (r0, c0, r1, c1) in zip(touching.tolist(), spans.tolist()):
        for r in range(r0, r1 + 1):
            for c in range(c0, c1 + 1):
                lists[r * tile_px, c * tile_px].append(i)
    return {key: np.array(lists[key], np.int32) for key in sorted(lists)}
