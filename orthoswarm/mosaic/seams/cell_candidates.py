"""Candidate pictures of each cell of a tile, with their costs and grey levels in the cell.

The cost of a picture grows with the squared tangent of its view angle (obliqueness), with the contrast that it lacks
against the clearest picture on the same ground (haze), and with the sharpness that it lacks as a whole (blur). One from
which something taller hides the cell would show that twice: it is used only where no other picture sees the cell.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Floats, Ints
from orthoswarm.mosaic.footprint import TAN_LIMIT
from orthoswarm.mosaic.kernels.lens_arrays import U_HIGH, U_LOW, V_HIGH, V_LOW
from orthoswarm.mosaic.kernels.line_of_sight import HIDES_M, first_over
from orthoswarm.mosaic.kernels.render_arrays import LATTICE_PX, Shots, lattice_height, project
from orthoswarm.mosaic.seam_labels import OUTSIDE, block_heights, sight
from orthoswarm.mosaic.seams.previews import GLARE_LEVEL, Previews

SLOTS = 5  # candidates a cell: the cheapest ones
BLOCK = 16  # cells a side of the blocks at whose corners contrasts are compared

_WEAK_COST: Final = 1e6
"""Cost of a picture that is used only where no other sees: it is damaged, weakly determined, or something taller hides
the cell from it."""
_CANDIDATE_TAN2: Final = 0.5  # pictures more oblique than the best by this squared tangent are none of a cell's (time)
_OBLIQUENESS_COST: Final = 15000.0
"""Cost of obliqueness, times the squared tangent of the view angle. Chosen by looking at four sets."""
_HAZE_COST: Final = 6000.0
"""Cost of less local contrast than the clearest picture has on the same ground, times the logarithm of the ratio: half
the contrast outweighs a view that is some 20 degrees more oblique."""
_HAZE_IGNORED_LOG: Final = 0.3  # log ratios of contrast up to this cost nothing: parallax, shadows, noise
_GLARE_COST: Final = 3000.0  # cost of ground that is burnt out (glints of water): as of a view at 25 degrees
_BLUR_COST: Final = 6000.0
"""Cost of a picture that is less sharp than the median of those around, times the logarithm of the ratio."""
_BLUR_IGNORED_LOG: Final = 0.25  # log ratios of sharpness up to this cost nothing


@dataclass(frozen=True, slots=True)
class CandidateCells:
    """Candidates of a region of cells.

    Attributes:
        candidate: int32 (rows, columns, SLOTS), indices of the shots, cheapest first; -1 where there are fewer.
        cost: float32, the same shape, in levels; infinite where there is none.
        level: float32, the same shape, grey levels of the pictures, evened out by their fields.
        texture: float32 (rows, columns), local contrast of the cheapest candidate, levels.
    """

    candidate: Ints
    cost: Floats
    level: Floats
    texture: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """A square of cells on the ground.

    west: easting of its left edge. north: northing of its upper edge. gsd_m: ground pixel. cell_px: pixels a cell.
    side: cells a side. lattice: float32, its heights, see render_arrays.heights.
    """

    west: float
    north: float
    gsd_m: float
    cell_px: int
    side: int
    lattice: Floats


def cell_candidates(region: Region, shots: Shots, tone: Floats, previews: Previews) -> CandidateCells:
    """The candidates of a region's cells.

    region: the cells. shots: N pictures that may see it. tone: float32 (N, 6), factor of brightness over each picture
    (mean of the rows of radiometry.Field). previews: of the N pictures; one that has none is not a candidate.
    """
    position, rotation = shots.about(region.west, region.north)
    height = float(np.median(position[:, 2] - float(np.median(region.lattice)))) if len(position) else 1.0
    unit = region.cell_px * region.gsd_m / max(height, 1.0)  # of an area cost against the cost of a cell's side
    sharpness = previews.sharpness
    blur = np.log(np.maximum(np.median(sharpness), 1e-3) / np.maximum(sharpness, 1e-3)) - _BLUR_IGNORED_LOG
    penalty = unit * _BLUR_COST * np.maximum(blur, 0.0) + _WEAK_COST * shots.weak
    usable = np.nonzero(previews.written)[0]
    local = previews.contrast * np.maximum(tone[:, :1, None], 0.1)
    contrast = np.log(np.maximum(_smoothed(local), 0.5)).astype(np.float32)
    shape = (region.side, region.side, SLOTS)
    cells = CandidateCells(
        np.full(shape, -1, np.int32),
        np.full(shape, np.inf, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape[:2], np.float32),
    )
    pictures = (position, rotation, shots.lens, shots.size, usable)
    ground = (region.lattice, region.gsd_m, region.cell_px)
    nodes = -(-region.side // BLOCK) + 1
    haze = np.zeros((nodes, nodes, len(position)), np.float32)
    _haze(pictures, contrast, ground, haze)
    haze *= np.float32(unit * _HAZE_COST)
    grays = (previews.gray, previews.rows, tone, np.ascontiguousarray(local, np.float32))
    costs = (penalty, haze, unit * _OBLIQUENESS_COST, unit * _GLARE_COST, TAN_LIMIT**2)
    _candidates(pictures, ground, grays, costs, (cells.candidate, cells.cost, cells.level, cells.texture))
    return cells


def _smoothed(contrast: Floats) -> Floats:
    """Local contrasts (N, rows, columns) averaged over 5 x 5 blocks (rms): haze is larger than what it hides."""
    import cv2

    return np.array([np.sqrt(cv2.blur(c * c, (5, 5), borderType=cv2.BORDER_REPLICATE)) for c in contrast], np.float32)


@in_place_kernel
def _haze(pictures, contrast, ground, haze):  # type: ignore[no-untyped-def]
    """Log of the contrast that each picture lacks against the clearest one, at the corners of blocks of cells."""
    position, rotation, lens, size, usable = pictures
    lattice, gsd, cell = ground
    ignored = np.float32(_HAZE_IGNORED_LOG)
    last = (lattice.shape[0] - 1) * LATTICE_PX - 1
    rows, columns = contrast.shape[1], contrast.shape[2]
    for i in range(haze.shape[0]):
        for j in range(haze.shape[1]):
            r, c = min(i * BLOCK * cell, last), min(j * BLOCK * cell, last)
            z = lattice_height(lattice, float(r), float(c))
            best = np.float32(-1e9)
            for k in usable:
                u, v = project(position[k], rotation[k], lens[k], (c + 0.5) * gsd, (r + 0.5) * gsd, z)
                x = min(max(int((u + 0.5) / size[k, 0] * columns), 0), columns - 1)
                y = min(max(int((v + 0.5) / size[k, 1] * rows), 0), rows - 1)
                haze[i, j, k] = contrast[k, y, x]
                if u >= 0.0 and v >= 0.0 and u <= size[k, 0] - 1.0 and v <= size[k, 1] - 1.0:
                    best = max(best, contrast[k, y, x])
            for k in usable:
                haze[i, j, k] = max(best - haze[i, j, k] - ignored, np.float32(0.0))


@in_place_kernel
def _gray(gray, tone, u, v, width, height):  # type: ignore[no-untyped-def]
    """A picture's grey level at a pixel of the full picture, bilinear in its preview, evened out."""
    rows, columns = gray.shape
    x = min(max((u + 0.5) / width * columns - 0.5, 0.0), columns - 1.000001)
    y = min(max((v + 0.5) / height * rows - 0.5, 0.0), rows - 1.000001)
    j, i = int(x), int(y)
    fx, fy = x - j, y - i
    top = gray[i, j] * (1.0 - fx) + gray[i, j + 1] * fx
    low = gray[i + 1, j] * (1.0 - fx) + gray[i + 1, j + 1] * fx
    px, py = (2.0 * u + 1.0) / width - 1.0, (2.0 * v + 1.0 - height) / width
    factor = tone[0] + px * (tone[1] + tone[3] * px + tone[4] * py) + py * (tone[2] + tone[5] * py)
    return (top * (1.0 - fy) + low * fy) * factor


@in_place_kernel
def _hidden(lattice, position, x, y, z, gsd, top):  # type: ignore[no-untyped-def]
    """Whether the ground stands more than `HIDES_M` over the line from a point (x, y, z) to a camera.

    Nodes of the lattice are met at every step along the line, from the second on, up to the height `top`.
    """
    step = LATTICE_PX * gsd
    dx, dy = position[0] - x, position[1] - y
    away = max(np.hypot(dx, dy), 1e-6)
    rise = (position[2] - z) / away * step
    return first_over(lattice, y / step, x / step, dy / away, dx / away, z + HIDES_M, rise, top, 1) >= 0


@kernel
def _candidates(pictures, ground, grays, costs, cells):  # type: ignore[no-untyped-def]
    """Fill the cells with their cheapest candidates.

    Args:
        pictures: position, rotation, lens, size of all, and which are usable. ground: lattice, pixel, pixels a cell.
        grays: all previews, which are meant, tone and local contrast.
        costs: penalty and haze of each picture, weight of obliqueness, cost of glare, greatest squared tangent.
        cells: candidate, cost, level and texture, changed.
    """
    position, rotation, lens, size, usable = pictures
    lattice, gsd, cell = ground
    gray, record, tone, local = grays
    penalty, haze, weight, glare, tan2_limit = costs
    candidate, cost, level, texture = cells
    side = candidate.shape[0]
    top = np.float64(lattice.max())
    step, spread = cell * gsd, np.float32(weight * _CANDIDATE_TAN2)
    least = np.empty(len(usable))
    for b0 in range(0, side, BLOCK):
        for b1 in range(0, side, BLOCK):
            r1, c1 = min(side, b0 + BLOCK), min(side, b1 + BLOCK)
            x0, x1, y0, y1 = b1 * step, c1 * step, b0 * step, r1 * step
            z0, z1 = block_heights(lattice, b0 * cell, r1 * cell, b1 * cell, c1 * cell)
            for n in range(len(usable)):
                k = usable[n]
                dx = max(x0 - position[k, 0], 0.0, position[k, 0] - x1)
                dy = max(y0 - position[k, 1], 0.0, position[k, 1] - y1)
                rise = max(position[k, 2] - z0, 1e-3)
                least[n] = penalty[k] + weight * (dx * dx + dy * dy) / (rise * rise)
            worst = np.float32(np.inf)
            for n in np.argsort(least, kind="mergesort"):
                k = usable[n]
                if least[n] >= worst:
                    break
                if sight(position[k], rotation[k], lens[k], x0, x1, y0, y1, z0, z1) == OUTSIDE:
                    continue
                border = 1.0 + step * lens[k, 0] / max(position[k, 2] - z1, 1e-3)
                worst = np.float32(0.0)
                for r in range(b0, r1):
                    y = (r + 0.5) * step
                    fy = (r - b0 + 0.5) / BLOCK
                    for c in range(b1, c1):
                        x = (c + 0.5) * step
                        fx = (c - b1 + 0.5) / BLOCK
                        z = lattice_height(lattice, (r + 0.5) * cell - 0.5, (c + 0.5) * cell - 0.5)
                        dx, dy, rise = x - position[k, 0], y - position[k, 1], position[k, 2] - z
                        limit = min(cost[r, c, SLOTS - 1], cost[r, c, 0] + spread)
                        tan2 = (dx * dx + dy * dy) / (rise * rise) if rise > 0.0 else np.inf
                        here = penalty[k] + weight * tan2
                        if here < limit and tan2 <= tan2_limit:
                            i, j = b0 // BLOCK, b1 // BLOCK
                            here += (haze[i, j, k] * (1.0 - fx) + haze[i, j + 1, k] * fx) * (1.0 - fy) + (
                                haze[i + 1, j, k] * (1.0 - fx) + haze[i + 1, j + 1, k] * fx
                            ) * fy
                            if here < limit:
                                u, v = project(position[k], rotation[k], lens[k], x, y, z)
                                inside = (
                                    u >= lens[k, U_LOW] + border
                                    and u <= lens[k, U_HIGH] - border
                                    and v >= lens[k, V_LOW] + border
                                    and v <= lens[k, V_HIGH] - border
                                )
                                if inside:
                                    g = _gray(gray[record[k]], tone[k], u, v, size[k, 0], size[k, 1])
                                    if g >= GLARE_LEVEL:
                                        here += glare
                                    if here < limit and _hidden(lattice, position[k], x, y, z, gsd, top):
                                        here += _WEAK_COST
                                if inside and here < limit:
                                    s = SLOTS - 1
                                    while s > 0 and cost[r, c, s - 1] > here:
                                        cost[r, c, s] = cost[r, c, s - 1]
                                        candidate[r, c, s] = candidate[r, c, s - 1]
                                        level[r, c, s] = level[r, c, s - 1]
                                        s -= 1
                                    cost[r, c, s], candidate[r, c, s] = here, k
                                    level[r, c, s] = g
                                    if s == 0:
                                        i = min(int((v + 0.5) / size[k, 1] * local.shape[1]), local.shape[1] - 1)
                                        j = min(int((u + 0.5) / size[k, 0] * local.shape[2]), local.shape[2] - 1)
                                        texture[r, c] = local[k, i, j]
                                    limit = min(cost[r, c, SLOTS - 1], cost[r, c, 0] + spread)
                        worst = max(worst, limit)
