"""Which candidate each cell takes: least cost of all cells and of the seams between them.

A seam costs most where the two pictures differ (a roof that leans two ways, a car that was there only once) and over
what stands above the ground; the energy is that of Kwatra et al. 2003 (Graphcut Textures) with a cost for each cell
added. It is lowered by moves of square blocks to a neighbour's label, large blocks first (iterated conditional modes,
Besag 1986, on several scales): a block the size of a house escapes minima in which single cells stay.
"""

from typing import Final

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Floats, Ints
from orthoswarm.mosaic.seams.cell_candidates import SLOTS, CandidateCells

NONE, FOREIGN = -1, -2
"""Labels of cells that no picture sees, and of a neighbour's cells whose picture is not a candidate here."""
_MOST_LABELS = 8  # room for the labels in and around a block; a block of 8 cells seldom has more than four

_SEAM_COST: Final = 3.0  # cost of a seam where pictures are alike: short and few; by looking at four sets
_DIFFERENCE_SCALE: Final = 16.0  # the squared difference of the two pictures, in levels, is divided by this
_TEXTURE_LEVEL: Final = 8.0  # local contrast, levels, at which that scale doubles (it grows with the square)
_DIFFERENCE_MOST: Final = 80.0  # greatest cost of a difference, so that one roof edge does not decide alone
_HEIGHT_COST: Final = 20.0  # cost of a seam over what stands above the bare ground, a metre of its height
_HEIGHT_MOST_M: Final = 10.0  # greater heights cost no more
_BLOCK_SIDES: Final = (8, 4, 2, 1)
"""Sides of the blocks of cells that are moved to another picture, in cells, one sweep each: 8 cells are about a
house."""
_BLOCK_OFFSETS: Final = (0, 2, 1, 0)  # where the first of these blocks begins, cells before the tile's corner


def relax(cells: CandidateCells, fixed: Ints, standing_m: Floats) -> Ints:
    """Labels int32 (rows, columns) of cells: indices of shots, NONE where there is no candidate.

    cells: the candidates. fixed: int32 (rows, columns), labels that are settled already (FOREIGN included), NONE
    elsewhere. standing_m: float32 (rows, columns), height over the bare ground.
    """
    label = np.where(fixed == NONE, cells.candidate[..., 0], fixed).astype(np.int32)
    held = fixed != NONE
    over = (np.float32(_HEIGHT_COST) * np.clip(standing_m, 0.0, _HEIGHT_MOST_M)).astype(np.float32)
    costs = np.array([_SEAM_COST, _DIFFERENCE_MOST], np.float32)
    scale = (1.0 / (_DIFFERENCE_SCALE * (1.0 + np.square(cells.texture / _TEXTURE_LEVEL)))).astype(np.float32)
    for side, offset in zip(_BLOCK_SIDES, _BLOCK_OFFSETS, strict=True):
        _sweep(label, held, cells.candidate, cells.cost, cells.level, scale, over, costs, side, offset)
    return label


@in_place_kernel
def _slot(candidate, r, c, k):  # type: ignore[no-untyped-def]
    for s in range(SLOTS):
        if candidate[r, c, s] == k:
            return s
    return -1


@in_place_kernel
def _differ(candidate, level, scale, r, c, a, b, costs):  # type: ignore[no-untyped-def]
    """Cost of the difference of two pictures at a cell."""
    s, t = _slot(candidate, r, c, a), _slot(candidate, r, c, b)
    if s < 0 or t < 0:
        return costs[1]
    d = level[r, c, s] - level[r, c, t]
    return min(d * d * scale[r, c], costs[1])


@in_place_kernel
def _edge(candidate, level, scale, over, costs, r, c, a, r2, c2, b):  # type: ignore[no-untyped-def]
    """Cost of the seam between two neighbouring cells with labels a and b."""
    if a == b or min(a, b) == NONE or max(a, b) == NONE:
        return np.float32(0.0)
    half = np.float32(0.5)
    total = costs[0] + half * (over[r, c] + over[r2, c2])
    if a == FOREIGN or b == FOREIGN:
        return total + half * costs[1]
    return total + half * (
        _differ(candidate, level, scale, r, c, a, b, costs) + _differ(candidate, level, scale, r2, c2, a, b, costs)
    )


@in_place_kernel
def _moved(label, held, candidate, r, c, k):  # type: ignore[no-untyped-def]
    """A cell's label once its block is moved to k: the old one where k is not a candidate."""
    if k < 0 or held[r, c] or _slot(candidate, r, c, k) < 0:
        return label[r, c]
    return k


@in_place_kernel
def _energy(label, held, candidate, cost, level, scale, over, costs, r0, r1, c0, c1, k):  # type: ignore[no-untyped-def]
    """Cost of a block and of all seams in and around it, once it is moved to k (-1: as it is)."""
    rows, columns = label.shape
    total = np.float32(0.0)
    for r in range(r0, r1):
        for c in range(c0, c1):
            a = _moved(label, held, candidate, r, c, k)
            if a >= 0 and not held[r, c]:
                total += cost[r, c, _slot(candidate, r, c, a)]
            if c + 1 < columns:
                b = _moved(label, held, candidate, r, c + 1, k) if c + 1 < c1 else label[r, c + 1]
                total += _edge(candidate, level, scale, over, costs, r, c, a, r, c + 1, b)
            if r + 1 < rows:
                b = _moved(label, held, candidate, r + 1, c, k) if r + 1 < r1 else label[r + 1, c]
                total += _edge(candidate, level, scale, over, costs, r, c, a, r + 1, c, b)
            if c == c0 and c > 0:
                total += _edge(candidate, level, scale, over, costs, r, c, a, r, c - 1, label[r, c - 1])
            if r == r0 and r > 0:
                total += _edge(candidate, level, scale, over, costs, r, c, a, r - 1, c, label[r - 1, c])
    return total


@kernel
def _sweep(label, held, candidate, cost, level, scale, over, costs, side, offset):  # type: ignore[no-untyped-def]
    """Move each block to the label among its own and its neighbours' that costs least."""
    rows, columns = label.shape
    found = np.empty(_MOST_LABELS, np.int32)
    for top in range(-offset, rows, side):
        for left in range(-offset, columns, side):
            r0, r1, c0, c1 = max(top, 0), min(top + side, rows), max(left, 0), min(left + side, columns)
            count = 0
            free = False
            for r in range(max(r0 - 1, 0), min(r1 + 1, rows)):
                for c in range(max(c0 - 1, 0), min(c1 + 1, columns)):
                    k = label[r, c]
                    if k >= 0 and count < _MOST_LABELS and (count == 0 or k != found[count - 1]):
                        new = True
                        for n in range(count):
                            new = new and found[n] != k
                        if new:
                            found[count] = k
                            count += 1
                    inside = r >= r0 and r < r1 and c >= c0 and c < c1
                    free = free or (inside and not held[r, c] and k >= 0)
            if count < 2 or not free:
                continue
            best, least = (
                np.int32(-1),
                _energy(label, held, candidate, cost, level, scale, over, costs, r0, r1, c0, c1, np.int32(-1)),
            )
            for n in range(count):
                energy = _energy(label, held, candidate, cost, level, scale, over, costs, r0, r1, c0, c1, found[n])
                if energy < least - np.float32(1e-3):
                    best, least = found[n], energy
            if best >= 0:
                for r in range(r0, r1):
                    for c in range(c0, c1):
                        label[r, c] = _moved(label, held, candidate, r, c, best)


@in_place_kernel
def to_pixels(label, candidate, cell, border, pixels):  # type: ignore[no-untyped-def]
    """Draw the labels of cells (plus 1) on the pixels of a tile, seams rounded: each pixel by the nearest cells' vote.

    label: int32 (side, side) of the region. candidate: its candidates. cell: pixels a cell. border: cells of the region
    beyond the tile, to each side. pixels: int32 (rows, columns), the tile; changed where a cell has a label.
    """
    rows, columns = pixels.shape
    last, half = label.shape[0] - 1, cell // 2
    for i in range(border - 1, border + rows // cell + 1):
        i0, i1 = max(i, 0), min(i + 1, last)
        r0, r1 = max((i - border) * cell + half, 0), min((i + 1 - border) * cell + half, rows)
        for j in range(border - 1, border + columns // cell + 1):
            j0, j1 = max(j, 0), min(j + 1, last)
            c0, c1 = max((j - border) * cell + half, 0), min((j + 1 - border) * cell + half, columns)
            a, b, d, e = label[i0, j0], label[i0, j1], label[i1, j0], label[i1, j1]
            if a == b and a == d and a == e:
                pixels[r0:r1, c0:c1] = max(a + 1, 0)
                continue
            for r in range(r0, r1):
                fy = (r + 0.5) / cell - 0.5 + border - i
                for c in range(c0, c1):
                    fx = (c + 0.5) / cell - 0.5 + border - j
                    own_i, own_j = r // cell + border, c // cell + border
                    own = label[own_i, own_j]
                    if own < 0:
                        continue
                    best, most = own, -1.0
                    for k in (own, a, b, d, e):
                        if k < 0:
                            continue
                        vote = (
                            (1.0 - fx) * (1.0 - fy) * (a == k)
                            + fx * (1.0 - fy) * (b == k)
                            + (1.0 - fx) * fy * (d == k)
                            + fx * fy * (e == k)
                        )
                        if vote > most + 1e-9 and (k == own or _slot(candidate, own_i, own_j, k) >= 0):
                            best, most = k, vote
                    pixels[r, c] = best + 1
