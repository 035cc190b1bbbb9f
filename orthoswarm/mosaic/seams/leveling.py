"""Seam leveling: a smooth correction of each picture in its drawn part, which removes remaining steps at seams.

Seam leveling (Lempitsky and Ivanov 2007; Waechter, Moehrle and Goesele 2014). The unknowns are the logarithms of
factors of red, green and blue for each picture in each cell of the map where it is drawn. Three kinds of equations are
solved together by least squares:

    at a seam              factor of one picture - factor of the other = - log ratio of their colours at the same ground
    inside a picture       difference of neighbouring cells = 0
    everywhere             factor = 0, weakly, so that nothing drifts

The ratios are those of the finished seams at full resolution, since near a seam both pictures are drawn. A ratio counts
by its sigma, which grows with the spread of the ratio from pixel to pixel: on lawns, water and roads the step
vanishes; roofs and crowns, where the two pictures do not fit, hardly count.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.canvas.tile_store import Key, Tile
from orthoswarm.model.arrays import Array, Flags, Floats, Indices, Ints
from orthoswarm.mosaic.kernels.leveling_kernels import (
    BOTH,
    SLOTS,
    apply_factors,
    count_pixels,
    laplacian,
    level_listed,
    sum_seams,
)
from orthoswarm.mosaic.overlap_colors import BRIGHT_LEVEL, DARK_LEVEL
from orthoswarm.mosaic.radiometry import GREATEST_FACTOR, conjugate_gradients
from orthoswarm.mosaic.seams.seam_pixels import SeamPixels

_LEVEL_CELLS: Final = 32
"""Cells across a picture in which it is corrected, about 3 m of the ground at a height of 75 m (the factor of a lawn
must not reach the road beside it)."""
_LEVEL_MOST_CELLS: Final = 300_000  # most of these cells in a map; they grow beyond it (memory)
_LEVEL_LEAST_PX: Final = 8.0  # fewest pixels that two pictures share in a cell for their ratio to count
_LEVEL_SIGMA: Final = 0.02  # log ratio in a cell of even ground (0.01, 0.02 tried: no difference on four flights)
_LEVEL_CORRELATED_PX: Final = 4.0  # pixels with one error of the ratio in common (4, 16 tried: no difference)
_LEVEL_RISE: Final = 0.05
"""Sigma of the difference of a picture's log factors in neighbouring cells (0.02 and 0.05 tried: with 0.02 seams keep a
little more of their step)."""
_LEVEL_STEP: Final = 0.2
"""Scale of Welsch's kernel on log ratios: 0.1 is a step of tone (weight 0.9), 0.7 is roof against ground (0.002). With
0.25 a roof that only one picture shows tints the lawn beside it."""
_LEVEL_REACH: Final = 0.5
"""How far a correction reaches from its seam before it fades, widths of a picture (0.3 and 1.0 tried: no difference on
four flights)."""
_LEVEL_STEPS: Final = 80  # most steps of conjugate gradients (12 to 70 were needed)
_LEVEL_TOLERANCE: Final = 0.01  # preconditioned residual, as a share of the first one, at which they end


@dataclass(frozen=True, slots=True)
class CellSize:
    """The cells of a map: side in pixels, a divisor of the tiles' side, and cells across a picture and a tile."""

    px: int
    across_picture: float
    across_tile: int


def cell_size(picture_px: float, tile_px: int, map_px: int) -> CellSize:
    """Cells for a map: about `_LEVEL_CELLS` across a picture.

    picture_px: width of a picture, pixels of the map. tile_px: side of the tiles. map_px: pixels of the map.
    """
    wanted = max(picture_px / _LEVEL_CELLS, float(np.sqrt(map_px / _LEVEL_MOST_CELLS)), 4.0)
    fitting = [px for px in range(1, tile_px + 1) if tile_px % px == 0]
    px = min(fitting, key=lambda px: abs(np.log(px / wanted)))
    return CellSize(px, picture_px / px, tile_px // px)


@dataclass(frozen=True, slots=True)
class TileColors:
    """What a tile shows, by cell and picture.

    Attributes:
        place: int64 (M, 3), row and column of a cell of the whole map, and the label of a picture there.
        pixels: float32 (M,), how many it has there.
        seam: int64 (S, 4), row, column, and two labels, where two pictures meet.
        both: float32 (S, 9), sums over the pixels that both show, see sum_seams.
    """

    place: Indices
    pixels: Floats
    seam: Indices
    both: Floats


def tile_colors(key: Key, tile: Tile, near: SeamPixels | None, cell_px: int) -> TileColors:
    """Sum what a tile, and the other pictures near its seams, if there are any, show."""
    side = len(tile.plane) // cell_px
    labels, pixels = np.zeros((side, side, SLOTS), np.int32), np.zeros((side, side, SLOTS), np.float32)
    pairs, both = np.zeros((side, side, SLOTS, 2), np.int32), np.zeros((side, side, SLOTS, BOTH))
    count_pixels(tile.packed, tile.plane, cell_px, labels, pixels)
    if near is not None:
        sum_seams(
            tile.packed, tile.plane, near.index, near.label, near.colors, cell_px, DARK_LEVEL, BRIGHT_LEVEL, labels,
            pairs, both,
        )  # fmt: skip
    corner = np.array(key) * side
    cells = np.nonzero(labels)
    place = np.column_stack([np.stack(cells[:2], 1) + corner, labels[cells]]).astype(np.int64)
    met = np.nonzero(both[..., 0])
    seam = np.column_stack([np.stack(met[:2], 1) + corner, pairs[met]]).astype(np.int64)
    return TileColors(place, pixels[cells], seam, both[met].astype(np.float32))


@dataclass(frozen=True, slots=True)
class TileFactors:
    """Factors of the pictures of a tile.

    cell_px: side of the cells. labels: int32 (R + 2, C + 2, SLOTS), pictures in the tile's cells and one beyond each
    border, 0 = none. factors: float32 (R + 2, C + 2, SLOTS, 3), of their red, green and blue.
    """

    cell_px: int
    labels: Ints
    factors: Floats

    def apply(self, tile: Tile, near: SeamPixels | None) -> None:
        """Multiply a tile's colours, and those near its seams."""
        apply_factors(tile.rgba, tile.plane, self.cell_px, self.labels, self.factors)
        if near is not None:
            side = len(tile.plane)
            level_listed(near.colors, near.index, near.label, side, self.cell_px, self.labels, self.factors)


class Leveling:
    """The correction of a whole map.

    tiles: of all its tiles. columns: cells across the map (whole tiles). cells: their size.
    """

    def __init__(self, tiles: Sequence[TileColors], columns: int, cells: CellSize) -> None:
        self._columns, self._cells = columns + 1, cells  # a column of no picture ends each row of cells
        place = np.concatenate([np.empty((0, 3), np.int64), *(t.place for t in tiles)])
        self._labels = int(place[:, 2].max(initial=0)) + 1
        key = self._key(place[:, 0], place[:, 1], place[:, 2])
        order = np.argsort(key)
        self._keys = key[order]
        self._pixels = np.concatenate([np.empty(0, np.float32), *(t.pixels for t in tiles)])[order]
        seam = np.concatenate([np.empty((0, 4), np.int64), *(t.seam for t in tiles)])
        both = np.concatenate([np.empty((0, BOTH), np.float32), *(t.both for t in tiles)]).astype(np.float64)
        self._log = self._solved(*self._steps(seam, both)) if len(self._keys) else np.empty((0, 3))

    def of_tile(self, key: Key) -> TileFactors:
        """The factors for a tile."""
        side, limit = self._cells.across_tile, float(np.log(GREATEST_FACTOR))
        labels = np.zeros((side + 2, side + 2, SLOTS), np.int32)
        factors = np.ones((side + 2, side + 2, SLOTS, 3), np.float32)
        west, east = max(key[1] * side - 1, 0), min((key[1] + 1) * side + 1, self._columns)
        for row in range(max(key[0] * side - 1, 0), (key[0] + 1) * side + 1):
            ends = np.array([row * self._columns + west, row * self._columns + east]) * self._labels
            part = slice(*np.searchsorted(self._keys, ends).tolist())
            cell, label = np.divmod(self._keys[part], self._labels)
            slot = np.arange(len(cell)) - np.searchsorted(cell, cell)
            at = (row - key[0] * side + 1, cell % self._columns - key[1] * side + 1, slot)
            labels[at] = label
            factors[at] = np.exp(np.clip(self._log[part], -limit, limit))
        return TileFactors(self._cells.px, labels, factors)

    def _key(self, row: Indices, column: Indices, label: Indices) -> Indices:
        return (row * self._columns + column) * self._labels + label

    def _index(self, key: Indices) -> tuple[Indices, Flags]:
        """Where keys are among the unknowns, and whether."""
        at = np.searchsorted(self._keys, key).clip(0, len(self._keys) - 1)
        return at, self._keys[at] == key

    def _steps(self, seam: Indices, both: Array) -> tuple[Indices, Indices, Array, Array]:
        """Pairs of unknowns at seams (S,), the log ratio of their colours (S, 3), and its weight (S,)."""
        one, found = self._index(self._key(seam[:, 0], seam[:, 1], seam[:, 2]))
        other, too = self._index(self._key(seam[:, 0], seam[:, 1], seam[:, 3]))
        good = found & too & (both[:, 0] >= _LEVEL_LEAST_PX)
        one, other, both = one[good], other[good], both[good]
        ratio = np.log(both[:, 1:4] / both[:, 4:7])
        n = both[:, 0]
        variance = np.maximum(both[:, 8] / n - np.square(both[:, 7] / n), 0.0)
        sigma2 = _LEVEL_SIGMA**2 + variance * _LEVEL_CORRELATED_PX / n
        robust = np.exp(-0.5 * np.square(ratio.mean(1) / _LEVEL_STEP))  # Welsch's kernel
        return one, other, ratio, _LEVEL_RISE**2 / sigma2 * robust

    def _solved(self, one: Indices, other: Indices, ratio: Array, weight: Array) -> Array:
        """Log factors (M, 3), by conjugate gradients."""
        firsts, seconds, weights = [one], [other], [weight]
        for ahead in (self._labels, self._columns * self._labels):  # the next cell to the east and to the south
            at, found = self._index(self._keys + ahead)
            firsts.append(np.nonzero(found)[0])
            seconds.append(at[found])
            weights.append(np.ones(int(found.sum())))
        first, second = (np.concatenate(parts).astype(np.int32) for parts in (firsts, seconds))
        links, count = np.concatenate(weights), len(self._keys)
        reach = _LEVEL_REACH * self._cells.across_picture
        anchor = np.maximum(self._pixels / self._cells.px**2, 1e-3) / reach**2
        right = np.zeros((count, 3))
        for channel in range(3):
            pull = weight * ratio[:, channel]
            right[:, channel] = np.bincount(other, pull, count) - np.bincount(one, pull, count)
        diagonal = anchor + np.bincount(first, links, count) + np.bincount(second, links, count)
        image = np.empty_like(right)

        def applied(x: Array) -> Array:
            laplacian(first, second, links, anchor, x, image)
            return image

        log = conjugate_gradients(applied, diagonal[:, None], right, _LEVEL_TOLERANCE, _LEVEL_STEPS)
        return np.asarray(log - self._pixels @ log / self._pixels.sum())
