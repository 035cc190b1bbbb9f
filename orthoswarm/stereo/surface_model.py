"""The surface model of placed frames: pairs are matched in parallel, their heights merged on one grid."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.config.mapping import StereoConfig
from orthoswarm.model.arrays import Bytes
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.model.task_runner import Run, serial
from orthoswarm.raster.picture_file import PictureError, read_gray, reduction
from orthoswarm.stereo.picture_pairs import choose_pairs
from orthoswarm.stereo.rectified_pair import PairView, match_pair
from orthoswarm.stereo.surface_cells import CellHeights, SurfaceCells, SurfaceModel, cell_heights

_PAIRS_PER_TASK = 12  # pairs of a task: enough of them share pictures
_PICTURES_HELD = 8  # number of decoded pictures that a task caches for its next pairs

_CELL_PIXELS: Final = 2.0  # side of a cell, ground pixels of the (reduced) pictures: fewer would hold no more detail
_MOST_CELLS: Final = 8_000_000  # larger cells beyond this many, for memory and disk: 50 bytes a cell


@dataclass(frozen=True, slots=True)
class _PairsTask:
    """Pairs of neighbouring pictures: frames, indices of pairs into them, ground below them, cells, settings."""

    frames: list[PlacedFrame]
    pairs: list[tuple[int, int]]
    terrain: Terrain
    grid: GroundGrid
    config: StereoConfig


def surface_model(
    frames: Sequence[PlacedFrame],
    terrain: Terrain,
    epsg: int,
    scratch: Path,
    *,
    config: StereoConfig,
    run: Run = serial,
    progress: Callable[[int, int], None] | None = None,
) -> SurfaceModel:
    """Measure the visible surface from refined frames, around the terrain below them.

    epsg: the grid of the area. scratch: an empty folder for temporary files. config: which pairs, and how far heights
    are searched. progress: called with the pairs done and all pairs.

    Raises:
        OrthoSwarmError: if no two pictures overlap enough.
    """
    pairs = choose_pairs(frames, terrain, config.partners)
    if not pairs:
        raise OrthoSwarmError("no two pictures overlap enough to measure heights")
    cells = SurfaceCells(_grid(frames, terrain, epsg, pairs, config.longest_px), scratch)
    done = 0
    for found, count in run(_match, _tasks(frames, pairs, terrain, cells.grid, config)):
        cells.add(found)
        done += count
        if progress is not None:
            progress(done, len(pairs))
    return cells.merged()


def _grid(
    frames: Sequence[PlacedFrame], terrain: Terrain, epsg: int, pairs: Sequence[tuple[int, int]], longest_px: int
) -> GroundGrid:
    """Cells over the footprints of all frames with a partner."""
    some = [frames[i] for i in sorted({i for pair in pairs for i in pair})]
    level = [float(terrain.height(p.camera.nadir)) for p in some]
    corners = np.concatenate([p.camera.corners(z) for p, z in zip(some, level)])
    bounds = BoundingBox.around_points(corners[np.isfinite(corners).all(1)], 0.0)
    pixel = [(p.camera.position[2] - z) / p.camera.lens.focal_px * _factor(p, longest_px) for p, z in zip(some, level)]
    west, south, east, north = bounds
    smallest = float(np.sqrt((east - west) * (north - south) / _MOST_CELLS))
    return GroundGrid.around(epsg, bounds, round(max(_CELL_PIXELS * float(np.median(pixel)), smallest), 3))


def _factor(placed: PlacedFrame, longest_px: int) -> int:
    lens = placed.camera.lens
    return reduction(lens.width, lens.height, longest_px)


def _tasks(
    frames: Sequence[PlacedFrame],
    pairs: Sequence[tuple[int, int]],
    terrain: Terrain,
    grid: GroundGrid,
    config: StereoConfig,
) -> list[_PairsTask]:
    bare = terrain.bare_ground()
    tasks = []
    for start in range(0, len(pairs), _PAIRS_PER_TASK):
        some = pairs[start : start + _PAIRS_PER_TASK]
        index = sorted({i for pair in some for i in pair})
        place = {i: k for k, i in enumerate(index)}
        tasks.append(
            _PairsTask([frames[i] for i in index], [(place[i], place[j]) for i, j in some], bare, grid, config)
        )
    return tasks


def _match(task: _PairsTask) -> tuple[list[CellHeights], int]:
    """The heights of a task's pairs, and how many pairs it had."""
    factors = [_factor(frame, task.config.longest_px) for frame in task.frames]

    @lru_cache(_PICTURES_HELD)
    def picture(index: int) -> Bytes | None:
        try:
            return read_gray(task.frames[index].frame.path, factors[index])
        except PictureError:
            return None  # it is named among the pictures that were not drawn

    out = []
    for i, j in task.pairs:
        first, second = task.frames[i], task.frames[j]
        one, two = picture(i), picture(j)
        if one is None or two is None:
            continue
        left, right = PairView(first.camera, one, factors[i]), PairView(second.camera, two, factors[j])
        found = match_pair(left, right, task.terrain, task.config)
        out.append(cell_heights(found, task.grid))
    return out, len(task.pairs)
