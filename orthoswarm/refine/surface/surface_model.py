"""The surface model of placed frames: the visible surface (ground, roofs, crowns) on the cells of a grid.

Each cell is measured by several pictures in turn, each of them compared with others around it (`plane_sweep`). A height
counts where the measurements agree: a false one is seen by its disagreement.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import cv2
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from orthoswarm.config.mapping import StereoConfig
from orthoswarm.model.arrays import Bytes, Flags, Floats
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import PlacedFrame, SurfaceModel, Terrain
from orthoswarm.model.task_runner import Run, serial
from orthoswarm.raster.picture_file import read_gray, reduction
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock, F
from orthoswarm.refine.features.working_pictures import Pictures
from orthoswarm.refine.surface.plane_sweep import (
    SweepCosts,
    SweepTask,
    SweepViews,
    ground_at_nodes,
    measured,
    sweep_tasks,
)

_CELL_PIXELS: Final = (
    1.5  # side of a cell, ground pixels of pictures of `longest_px`: in finer ones the cameras' errors show
)
_MOST_CELLS: Final = 8_000_000  # larger cells beyond this many (memory)
_TALLEST_HEIGHTS: Final = 0.45  # the highest searched, over the flying height, where `tallest_m` is more
_UNLIKE: Final = 0.7  # what fits worse is not known (mean of one less the two best correlations)
_COSTS: Final = SweepCosts(
    noise_levels=0.5, doubt=0.0, slope=0.15, edge=(0.2, 1.0), step_m=0.5, unlike=_UNLIKE, narrow=True
)
_SPECKLE_CELLS: Final = 60  # smaller regions of alike heights are false
_SPECKLE_SLOPE: Final = 0.5  # ... whose heights differ by less than this from cell to cell, in cells
_SPECKLE_PARTS: Final = 16  # heights are compared in this part of that difference (exactness)
_AGREE_SIGMAS: Final = 10.0  # heights farther from a cell's median, in sigmas of one, are left out
_LEAST_AGREE: Final = 2  # cells where fewer agree stay empty
_SIGMA_PX: Final = 0.17
"""One sigma of a height of one reference, in pixels of parallax at a base of 0.45 flying heights."""
_EDGE_SHARE: Final = 1.0
"""A cell's sigma gets this share of the range of heights around it (3 x 3 cells): windows reach over walls, and a
cell's middle may lie on either side."""
_BLOCK_SIGMA_M: Final = 0.05
"""What all measurements of a place have in common (the block's own bends), one sigma: the orthoimage's error, 0.04 to
0.07 m."""


def surface_model(
    frames: Sequence[PlacedFrame],
    terrain: Terrain,
    epsg: int,
    *,
    config: StereoConfig,
    run: Run = serial,
    progress: Callable[[int, int], None] | None = None,
) -> SurfaceModel:
    """Measure the visible surface from refined frames, around the terrain below them.

    epsg: the grid of the area. config: how many pictures measure a place, and how far heights are searched. progress:
    called with the tasks done and all tasks.

    Raises:
        OrthoSwarmError: if no place is seen by enough pictures.
    """
    usable = [p for p in frames if not (p.weak or p.frame.damaged)]
    views = SweepViews(_cameras(usable, config.longest_px), [_reader(p.frame, config.longest_px) for p in usable])
    bare = terrain.bare_ground()
    above = views.cameras.position[:, 2] - bare.height(views.cameras.position[:, :2])
    if len(usable) < 2 or not (height_m := float(np.median(above))) > 0.0:
        raise OrthoSwarmError("no two pictures overlap enough to measure heights")
    lens = np.median(views.cameras.lens, axis=0)
    pixel_m = height_m / float(lens[F]) * max(1.0, float(lens[[WIDTH, HEIGHT]].max()) / config.longest_px)
    grid = _grid(usable, bare, epsg, _CELL_PIXELS * pixel_m)
    cell, shape = grid.gsd_m, (grid.height, grid.width)
    nodes = ground_at_nodes(bare, grid.west + cell / 2, grid.north - (grid.height - 0.5) * cell, cell, shape)
    tallest = np.full(shape, min(config.tallest_m, _TALLEST_HEIGHTS * height_m), np.float32)
    costs = replace(_COSTS, references=config.partners, depth_m=config.depth_m)
    tasks = list(sweep_tasks(views, nodes, tallest, height_m=height_m, costs=costs))
    z, sigma = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    count = np.zeros(shape, np.uint8)
    merged = partial(_merged, sigma_m=_SIGMA_PX * pixel_m, least=min(_LEAST_AGREE, config.partners))
    for done, blocks in enumerate(run(merged, tasks), 1):
        for (top, bottom, left, right), parts in blocks:
            at = (slice(top, bottom), slice(left, right))
            z[at], sigma[at], count[at] = parts
        if progress is not None:
            progress(done, len(tasks))
    false = _speckles(z, _SPECKLE_SLOPE * cell)
    z[false], sigma[false], count[false] = np.nan, np.nan, 0
    if not count.any():
        raise OrthoSwarmError("no two pictures overlap enough to measure heights")
    z += nodes.z
    sigma = np.hypot(sigma, _EDGE_SHARE * _range_around(z))
    return _known_part(grid, *(np.ascontiguousarray(part[::-1]) for part in (z, sigma, count)))


def _cameras(frames: Sequence[PlacedFrame], longest_px: int) -> CameraBlock:
    """The frames' cameras, with the lenses of their reduced pictures."""
    position = np.array([p.camera.position for p in frames]).reshape(-1, 3)
    rotation = np.array([p.camera.rotation for p in frames]).reshape(-1, 3, 3)
    lens = [
        np.array([n.focal_px, n.k1, n.k2, n.k3, n.cx, n.cy, n.width, n.height])
        / np.where([1, 0, 0, 0, 1, 1, 1, 1], reduction(n.width, n.height, longest_px), 1.0)
        for n in (p.camera.lens for p in frames)
    ]
    return CameraBlock(position, rotation, np.arange(len(frames), dtype=np.int32), np.array(lens).reshape(-1, 8))


def _reader(frame: Frame, longest_px: int) -> Callable[[], Bytes]:
    """What reads a frame's reduced picture."""
    factor = reduction(frame.width, frame.height, longest_px)
    return partial(Pictures([frame], partial(_reduced, factor), max(frame.width, frame.height) // factor).once, 0)


def _reduced(factor: int, frame: Frame) -> Bytes:
    return read_gray(frame.path, factor)


def _grid(frames: Sequence[PlacedFrame], terrain: Terrain, epsg: int, cell_m: float) -> GroundGrid:
    """Cells over the footprints of all frames."""
    corners = np.concatenate([p.camera.corners(float(terrain.height(p.camera.nadir))) for p in frames])
    bounds = BoundingBox.around_points(corners[np.isfinite(corners).all(1)], 0.0)
    smallest = float(np.sqrt(bounds.width * bounds.height / _MOST_CELLS))
    return GroundGrid.around(epsg, bounds, round(max(cell_m, smallest), 3))


def _merged(
    task: SweepTask, sigma_m: float, least: int
) -> list[tuple[tuple[int, int, int, int], tuple[Floats, Floats, Bytes]]]:
    """Height over the ground, sigma and number of agreeing references of each block's cells."""
    return [(inner, merge_heights(heights, sigma_m, least)) for inner, heights in measured(task)]


def merge_heights(heights: Floats, sigma_m: float, least: int = _LEAST_AGREE) -> tuple[Floats, Floats, Bytes]:
    """The mean of the heights that agree with the median, cell by cell.

    Args:
        heights: float32 (K, rows, columns), by K references, NaN where it is not known. sigma_m: of each. least:
            cells where fewer agree stay empty.

    Returns:
        Height, sigma (both NaN where too few agree) and number of agreeing ones. They share pictures
        and errors: the sigma is that of one, enlarged where they scatter more.
    """
    known = np.isfinite(heights)
    middle = _median(heights, known)
    agree = known & (np.abs(heights - middle) <= _AGREE_SIGMAS * sigma_m)
    number = agree.sum(0)
    enough = number >= least
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(agree, heights, 0.0).sum(0) / number
        scatter2 = (np.where(agree, heights - mean, 0.0) ** 2).sum(0) / np.maximum(number - 1, 1)
    sigma = np.sqrt(sigma_m**2 + scatter2 + _BLOCK_SIGMA_M**2)
    z, sigma = (np.where(enough, values, np.nan).astype(np.float32) for values in (mean, sigma))
    return z, sigma, np.where(enough, number, 0).astype(np.uint8)


def _median(heights: Floats, known: Flags) -> Floats:
    """The lower median of the known heights of each cell, NaN without any."""
    order = np.sort(heights, axis=0)  # unknown ones come last
    return np.asarray(np.take_along_axis(order, (np.maximum(known.sum(0), 1)[None] - 1) // 2, 0)[0])


def _speckles(height_m: Floats, step_m: float) -> Flags:
    """Cells of small regions of alike heights, which differ by a step at most from cell to cell: false matches."""
    known = np.isfinite(height_m)
    whole = np.full(height_m.shape, np.iinfo(np.int16).min, np.int16)
    whole[known] = np.clip(height_m[known] / step_m * _SPECKLE_PARTS, -32_000, 32_000)
    cv2.filterSpeckles(whole, np.iinfo(np.int16).min, _SPECKLE_CELLS, _SPECKLE_PARTS)
    return np.asarray(known & (whole == np.iinfo(np.int16).min))


def _range_around(height_m: Floats) -> Floats:
    """Highest less lowest known height of the 3 x 3 cells around each, 0 without any."""
    known = np.isfinite(height_m)
    high = maximum_filter(np.where(known, height_m, -np.inf), 3)
    low = minimum_filter(np.where(known, height_m, np.inf), 3)
    return np.where(high >= low, high - low, 0.0).astype(np.float32)


def _known_part(grid: GroundGrid, height_m: Floats, sigma_m: Floats, number: Bytes) -> SurfaceModel:
    """The smallest window that holds all known cells."""
    known = np.isfinite(height_m)
    rows, columns = np.flatnonzero(known.any(1)), np.flatnonzero(known.any(0))
    window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    grid = replace(
        grid, west=grid.west + int(columns[0]) * grid.gsd_m, north=grid.north - int(rows[0]) * grid.gsd_m,
        width=int(columns[-1] - columns[0]) + 1, height=int(rows[-1] - rows[0]) + 1,
    )  # fmt: skip
    return SurfaceModel(grid, height_m[window], sigma_m[window], number[window])
