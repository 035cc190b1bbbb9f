"""Heights that pictures are drawn on, on the lattice of a tile: smooth on ground and roofs, with steps at walls.

Between the nodes of the surface heights are interpolated. Across a wall that would make a slope, on which a picture
shows roof and facade once more, mirrored. At a wall each place is either on its top or at its foot.
"""

from typing import Final

import numpy as np

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.kernels.pixel_sampling import cubic_convolution
from orthoswarm.mosaic.kernels.render_arrays import LATTICE_PX

_NEAR_WALL, _WALL = np.uint8(1), np.uint8(2)

_WALL_SLOPE: Final = 1.2  # steeper measured surfaces are walls (50 degrees; roofs and rubble are flatter)


def heights(terrain: Terrain, west: float, north: float, gsd_m: float, tile_px: int) -> Floats:
    """Heights every LATTICE_PX pixels from a tile's corner, float32 (tile_px / LATTICE_PX + 1, ...), rows going south.

    Cubic convolution (Keys 1981, a = -1/2) between the terrain's nodes, so slopes are continuous; constant beyond
    its border. Where tall things were measured (`terrain.bare`), no height lies between the top of a wall and its foot.
    """
    n = tile_px // LATTICE_PX + 1
    offset = np.arange(n) * (LATTICE_PX * gsd_m)
    columns = _Taps(np.asarray((west + offset - terrain.west) / terrain.step_m, float), terrain.z.shape[1])
    rows = _Taps(np.asarray((north - offset - terrain.south) / terrain.step_m, float), terrain.z.shape[0])
    z = np.ascontiguousarray(terrain.z[rows.nodes, columns.nodes])
    out = np.empty((n, n), np.float32)
    _smooth(z, rows.index, rows.cubic, columns.index, columns.cubic, np.empty((len(z), n), np.float32), out)
    if terrain.bare is not None:
        walls = np.zeros(z.shape, np.uint8)
        wall = np.float32(_WALL_SLOPE * terrain.step_m)
        if _find_walls(z, wall, walls):
            _step(z, walls, rows.index, rows.spline, columns.index, columns.spline, out)
    return out


class _Taps:
    """Where places lie between the nodes of an axis.

    nodes: the nodes that are used. index: int32 (4, N), two nodes before and two after each place, from the first of
    them on. cubic, spline: float32 (4, N), their weights by cubic convolution, and by a cubic B-spline, which smooths.
    """

    def __init__(self, at: Array, count: int) -> None:
        at = np.clip(at, 0.0, count - 1.0)
        base = np.minimum(at.astype(np.int32), max(0, count - 2))
        index = np.clip(base + np.arange(-1, 3, dtype=np.int32)[:, None], 0, count - 1)
        self.nodes = slice(int(index.min()), int(index.max()) + 1)
        self.index = index - self.nodes.start
        t, s = at - base, 1.0 - (at - base)
        spline = [s**3, 4.0 + t * t * (3.0 * t - 6.0), 4.0 + s * s * (3.0 * s - 6.0), t**3]
        self.cubic = cubic_convolution(t).astype(np.float32)
        self.spline = np.array(spline, np.float32) * np.float32(1.0 / 6.0)


@in_place_kernel
def _smooth(z, rows, down, columns, across, between, out):  # type: ignore[no-untyped-def]
    """Heights by cubic convolution, along rows first; rows, down, columns, across: see _Taps. between: room."""
    n = columns.shape[1]
    for r in range(len(z)):
        line, part = z[r], between[r]
        for j in range(n):
            part[j] = (
                across[0, j] * line[columns[0, j]] + across[1, j] * line[columns[1, j]]
                + across[2, j] * line[columns[2, j]] + across[3, j] * line[columns[3, j]]
            )  # fmt: skip
    for i in range(rows.shape[1]):
        a, b, c, d = between[rows[0, i]], between[rows[1, i]], between[rows[2, i]], between[rows[3, i]]
        wa, wb, wc, wd = down[0, i], down[1, i], down[2, i], down[3, i]
        line = out[i]
        for j in range(n):
            line[j] = wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]


@in_place_kernel
def _find_walls(z, wall, walls):  # type: ignore[no-untyped-def]
    """Mark cells between four nodes that differ by more than a height, and those around them; whether there are any.

    walls: uint8, a cell at the node of its least row and column, 0 before; set to _WALL or _NEAR_WALL.
    """
    found = False
    for r in range(z.shape[0] - 1):
        for c in range(z.shape[1] - 1):
            a, b, d, e = z[r, c], z[r, c + 1], z[r + 1, c], z[r + 1, c + 1]
            if max(max(a, b), max(d, e)) - min(min(a, b), min(d, e)) > wall:
                found = True
                for i in range(max(r - 1, 0), min(r + 2, z.shape[0] - 1)):
                    for j in range(max(c - 1, 0), min(c + 2, z.shape[1] - 1)):
                        walls[i, j] = max(walls[i, j], _NEAR_WALL)
                walls[r, c] = _WALL
    return found


@in_place_kernel
def _step(z, walls, rows, down, columns, across, out):  # type: ignore[no-untyped-def]
    """Put heights in a wall on its top or at its foot, and keep those beside it between the nodes around them.

    The edge runs where the surface, smoothed, is half as high. The top is the mean of those of the 16 nodes around that
    are nearer to the highest of them.
    """
    for i in range(rows.shape[1]):
        for j in range(columns.shape[1]):
            mark = walls[rows[1, i], columns[1, j]]
            if mark == 0:
                continue
            low, high, blurred = np.float32(np.inf), np.float32(-np.inf), np.float32(0.0)
            first, last = (0, 4) if mark == _WALL else (1, 3)
            for p in range(first, last):
                for q in range(first, last):
                    v = z[rows[p, i], columns[q, j]]
                    low, high = min(low, v), max(high, v)
                    blurred += down[p, i] * across[q, j] * v
            if mark == _NEAR_WALL:
                out[i, j] = min(max(out[i, j], low), high)  # beside a wall cubic convolution swings over
                continue
            middle = np.float32(0.5) * (low + high)
            top, foot, n_top, n_foot = np.float32(0.0), np.float32(0.0), 0, 0
            for p in range(4):
                for q in range(4):
                    v = z[rows[p, i], columns[q, j]]
                    if v > middle:
                        top += v
                        n_top += 1
                    else:
                        foot += v
                        n_foot += 1
            top, foot = top / np.float32(max(n_top, 1)), foot / np.float32(max(n_foot, 1))
            out[i, j] = top if blurred > np.float32(0.5) * (top + foot) else foot
