"""Merging the heights of many pairs into one surface on the cells of a grid."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from orthoswarm.model.arrays import Bytes, Floats, Indices
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.robust import MAD_TO_SIGMA
from orthoswarm.stereo.rectified_pair import PairPoints

_HEIGHT_BITS, _HEIGHT_STEP_M = 20, 1e-3
_HIGHEST = (1 << _HEIGHT_BITS) - 1
"""Cell and height are packed into one integer, which is sorted in a third of the time of two columns."""
_ROWS_AT_ONCE = 256  # rows of cells that are merged at a time, for memory

_CELL_MATCHES: Final = 2  # matched pixels that a pair has in a cell at least
_PAIRS_KEPT: Final = 8  # heights of different pairs that are kept a cell; later ones change little
_LEAST_PAIRS: Final = 2  # cells with heights of fewer pairs stay empty: a false match is seen by its disagreement only
_INLIER_SIGMAS: Final = 3.0  # heights farther from a cell's median, in sigmas of pair and cell, are left out
_INDEPENDENCE: Final = 0.5
"""n agreeing pairs count as n to the power of this: they share pictures and errors of matching. Fitted, with the next
one, to two simulated cities (0.67 and 0.47 m a pixel): 74 and 73 % of all cells lie within one sigma, 94 % within
two."""
_EDGE_SHARE: Final = 0.5
"""A cell's sigma gets this share of the range of heights around it (3 x 3 cells): blocks of matching reach over walls,
and a cell's middle may lie on either side."""
_BLOCK_SIGMA_M: Final = 0.05
"""What all pairs of a place have in common (the block's own bends), one sigma: the orthoimage's error on the same sets,
0.04 to 0.07 m."""


@dataclass(frozen=True, slots=True)
class CellHeights:
    """The heights of one pair by cell: int64 (N,) cell, float32 (N,) metres, float32 (N,) sigma."""

    cell: Indices
    height_m: Floats
    sigma_m: Floats


@dataclass(frozen=True, slots=True)
class SurfaceModel:
    """The visible surface.

    Attributes:
        grid: its cells.
        height_m: float32 (rows, columns), over the cameras' zero of heights, NaN where it is not known.
        sigma_m: float32 (rows, columns), one sigma against the heights around, without what all heights have in common
            (a wrong focal length moves and stretches them all).
        pairs: uint8 (rows, columns), pairs of pictures that agree.
    """

    grid: GroundGrid
    height_m: Floats
    sigma_m: Floats
    pairs: Bytes


def cell_heights(found: PairPoints, grid: GroundGrid) -> CellHeights:
    """The median height of a pair in each cell."""
    column, row = np.floor(grid.to_pixel(found.points[:, :2]) + 0.5).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < grid.width) & (row < grid.height)
    cell, z, sigma = (row * grid.width + column)[inside], found.points[inside, 2], found.sigma_m[inside]
    lowest = float(z.min()) if len(z) else 0.0
    steps = np.clip((z - lowest) / _HEIGHT_STEP_M, 0, _HIGHEST).astype(np.int64)
    order = np.argsort((cell << _HEIGHT_BITS) + steps)
    cell, z, sigma = cell[order], z[order], sigma[order]
    first = np.flatnonzero(np.diff(cell, prepend=-1))
    count = np.diff(first, append=len(cell))
    enough = count >= _CELL_MATCHES
    middle = (first + (count - 1) // 2)[enough]
    return CellHeights(cell[middle], z[middle].astype(np.float32), sigma[middle].astype(np.float32))


class SurfaceCells:
    """Collects the heights of pairs in files of a folder, so that memory does not grow with the area."""

    def __init__(self, grid: GroundGrid, folder: Path) -> None:
        self.grid = grid
        best_pairs = _PAIRS_KEPT
        shape = (best_pairs, grid.width * grid.height)
        self._height = np.memmap(folder / "height", np.float32, "w+", shape=shape)
        self._sigma = np.memmap(folder / "sigma", np.float16, "w+", shape=shape)
        self._count = np.zeros(shape[1], np.uint8)

    def add(self, pairs: Sequence[CellHeights]) -> None:
        """Add pairs; a cell with the largest number of pairs ignores further ones."""
        for pair in pairs:
            room = self._count[pair.cell] < len(self._height)
            cell = pair.cell[room]
            slot = self._count[cell]
            self._height[slot, cell] = pair.height_m[room]
            self._sigma[slot, cell] = pair.sigma_m[room]
            self._count[cell] += 1

    def merged(self) -> SurfaceModel:
        """The surface of all pairs."""
        grid = self.grid
        shape = (grid.height, grid.width)
        height, sigma = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
        pairs = np.zeros(shape, np.uint8)
        for row in range(0, grid.height, _ROWS_AT_ONCE):
            rows = slice(row, min(row + _ROWS_AT_ONCE, grid.height))
            part = slice(rows.start * grid.width, rows.stop * grid.width)
            z, s, n = merge_heights(self._height[:, part], self._sigma[:, part], self._count[part])
            for target, values in ((height, z), (sigma, s), (pairs, n)):
                target[rows] = values.reshape(-1, grid.width)
        sigma = np.hypot(sigma, _EDGE_SHARE * _range_around(height))
        return _known_part(SurfaceModel(grid, height, sigma, pairs))


def merge_heights(
    height_m: NDArray[np.floating], sigma_m: NDArray[np.floating], count: Bytes
) -> tuple[Floats, Floats, Bytes]:
    """The weighted mean of the heights that agree with the median, cell by cell.

    Args:
        height_m, sigma_m: (K, N), the first `count` values of a column count. count: (N,).

    Returns:
        Height, sigma (both NaN where fewer than `_LEAST_PAIRS` agree) and number of agreeing pairs. The sigma is
        that of the mean of pairs that are partly independent, enlarged where they scatter more than they state.
    """
    z, s = np.asarray(height_m, np.float64), np.asarray(sigma_m, np.float64)
    valid = np.arange(len(z))[:, None] < count
    z = np.where(valid, z, np.nan)
    known = count >= 1
    middle = np.full(z.shape[1], np.nan)
    spread = np.zeros(z.shape[1])
    if known.any():
        middle[known] = np.nanmedian(z[:, known], axis=0)
        spread[known] = MAD_TO_SIGMA * np.nanmedian(np.abs(z[:, known] - middle[known]), axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        agree = valid & (np.abs(z - middle) <= _INLIER_SIGMAS * np.hypot(s, spread))
        weight = np.where(agree, 1.0 / (s**2 + _BLOCK_SIGMA_M**2), 0.0)
        total, number = weight.sum(0), agree.sum(0)
        mean = np.where(agree, weight * np.where(agree, z, 0.0), 0.0).sum(0) / total
        chi2 = np.where(agree, weight * (np.where(agree, z, 0.0) - mean) ** 2, 0.0).sum(0)
        scatter = np.sqrt(np.maximum(1.0, chi2 / np.maximum(number - 1, 1)))
        independent = np.maximum(number, 1) ** (_INDEPENDENCE - 1.0)
        sigma = np.hypot(scatter / np.sqrt(total * independent), _BLOCK_SIGMA_M)
    enough = number >= _LEAST_PAIRS
    return (
        np.where(enough, mean, np.nan).astype(np.float32),
        np.where(enough, sigma, np.nan).astype(np.float32),
        np.where(enough, number, 0).astype(np.uint8),
    )


def _range_around(height_m: Floats) -> Floats:
    """Highest less lowest known height of the 3 x 3 cells around each, 0 without any."""
    known = np.isfinite(height_m)
    high = maximum_filter(np.where(known, height_m, -np.inf), 3)
    low = minimum_filter(np.where(known, height_m, np.inf), 3)
    return np.where(high >= low, high - low, 0.0).astype(np.float32)


def _known_part(surface: SurfaceModel) -> SurfaceModel:
    """The smallest window that holds all known cells."""
    known = np.isfinite(surface.height_m)
    rows, columns = np.flatnonzero(known.any(1)), np.flatnonzero(known.any(0))
    if not len(rows):
        return surface
    window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    grid = replace(
        surface.grid, west=surface.grid.west + int(columns[0]) * surface.grid.gsd_m,
        north=surface.grid.north - int(rows[0]) * surface.grid.gsd_m,
        width=int(columns[-1] - columns[0]) + 1, height=int(rows[-1] - rows[0]) + 1,
    )  # fmt: skip
    return SurfaceModel(grid, surface.height_m[window], surface.sigma_m[window], surface.pairs[window])
