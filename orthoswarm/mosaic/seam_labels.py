"""Ints of map pixels: each is drawn from the frame with the nearest nadir point of those that really see it.

Without the frames' borders this is the Voronoi diagram of the nadir points. Blocks of pixels are solved one by one:
candidates in order of their least distance to the block, until none can be nearer than what the block has.
A candidate that sees the whole block costs one distance per pixel; only where a picture's border crosses the block are
pixels projected into it, distortion and terrain included.
"""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Floats, Ints
from orthoswarm.mosaic.footprint import TAN_LIMIT
from orthoswarm.mosaic.kernels.lens_arrays import INNER, OUTER, U_HIGH, U_LOW, V_HIGH, V_LOW
from orthoswarm.mosaic.kernels.render_arrays import LATTICE_PX, Shots, lattice_height, project

_BLOCK = 64
OUTSIDE, _PARTLY, _INSIDE = 0, 1, 2
_ROUNDING = 1e-5  # of squared distances in float32, relative, with a margin


@in_place_kernel
def block_heights(lattice, r0, r1, c0, c1):  # type: ignore[no-untyped-def]
    """Least and greatest height of a tile's rows r0 to r1 and columns c0 to c1."""
    low, high = lattice[r0 // LATTICE_PX, c0 // LATTICE_PX], lattice[r0 // LATTICE_PX, c0 // LATTICE_PX]
    for i in range(r0 // LATTICE_PX, (r1 + LATTICE_PX - 1) // LATTICE_PX + 1):
        for j in range(c0 // LATTICE_PX, (c1 + LATTICE_PX - 1) // LATTICE_PX + 1):
            low, high = min(low, lattice[i, j]), max(high, lattice[i, j])
    return low, high


@in_place_kernel
def sight(position, rotation, lens, x0, x1, y0, y1, z0, z1):  # type: ignore[no-untyped-def]
    """Whether a camera sees a box of ground wholly, not at all, or perhaps; by its corners, since both are convex."""
    inside, behind, left, right, above, below = 0, 0, 0, 0, 0, 0
    for corner in range(8):
        dx = (x1 if corner & 1 else x0) - position[0]
        dy = (y1 if corner & 2 else y0) - position[1]
        dz = (z1 if corner & 4 else z0) - position[2]
        depth = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz
        if depth < 1e-2:
            behind += 1
            continue
        px = (rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz) / depth
        py = (rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz) / depth
        left += px < lens[OUTER]
        right += px > lens[OUTER + 1]
        above += py < lens[OUTER + 2]
        below += py > lens[OUTER + 3]
        inside += px >= lens[INNER] and px <= lens[INNER + 1] and py >= lens[INNER + 2] and py <= lens[INNER + 3]
        if inside < corner + 1 and max(left, right, above, below) < corner + 1:
            return _PARTLY  # neither wholly in nor wholly beyond one border
    if behind == 8:
        return OUTSIDE
    if behind > 0:
        return _PARTLY
    if inside == 8:
        return _INSIDE
    return OUTSIDE if max(left, right, above, below) == 8 else _PARTLY


@in_place_kernel
def _claim(best, label, r0, r1, c0, c1, mark, x, y, gsd):  # type: ignore[no-untyped-def]
    """Give a block's pixels to a frame that sees all of it where it is nearer; gives the block's greatest distance."""
    worst = np.float32(0.0)
    step = np.float32(gsd)
    for r in range(r0, r1):
        row, owner = best[r, c0:c1], label[r, c0:c1]
        dy = np.float32((r + 0.5) * gsd - y)
        dx0, dy2 = np.float32((c0 + 0.5) * gsd - x), dy * dy
        for i in range(c1 - c0):
            dx = dx0 + step * np.float32(i)
            d2 = dx * dx + dy2
            nearer = (d2 < row[i]) | ((d2 == row[i]) & (mark < owner[i]))
            owner[i] = mark if nearer else owner[i]
            row[i] = d2 if nearer else row[i]
            worst = max(worst, row[i])
    return worst


@in_place_kernel
def _contest(best, label, r0, r1, c0, c1, mark, position, rotation, lens, lattice, flat, gsd, tan2):  # type: ignore[no-untyped-def]
    """Give a frame that sees part of a block the pixels to which it is nearer; gives the block's greatest distance."""
    worst = np.float32(0.0)
    limit = np.float32(tan2)
    step = np.float32(gsd)
    z = np.float64(lattice[0, 0])
    for r in range(r0, r1):
        dy = np.float32((r + 0.5) * gsd - position[1])
        dx0, dy2 = np.float32((c0 + 0.5) * gsd - position[0]), dy * dy
        for c in range(c0, c1):
            dx = dx0 + step * np.float32(c - c0)
            d2 = dx * dx + dy2
            if d2 < best[r, c] or (d2 == best[r, c] and mark < label[r, c]):
                if not flat:
                    z = lattice_height(lattice, float(r), float(c))
                rise = position[2] - z
                if rise > 0.0 and d2 <= limit * rise * rise:
                    u, v = project(position, rotation, lens, (c + 0.5) * gsd, (r + 0.5) * gsd, z)
                    if u >= lens[U_LOW] and u <= lens[U_HIGH] and v >= lens[V_LOW] and v <= lens[V_HIGH]:
                        best[r, c], label[r, c] = d2, mark
            worst = max(worst, best[r, c])
    return worst


@in_place_kernel
def _beaten(owners, count, x0, x1, y0, y1, x, y):  # type: ignore[no-untyped-def]
    """Whether one of the frames that see all of a block is nearer than a nadir point everywhere in it.

    What one nadir point is nearer than another grows evenly across the block, so its corners tell; by more than the
    distances are rounded by.
    """
    for n in range(count):
        nearer = True
        for corner in range(4):
            cx, cy = x1 if corner & 1 else x0, y1 if corner & 2 else y0
            own = (cx - owners[n, 0]) ** 2 + (cy - owners[n, 1]) ** 2
            other = (cx - x) ** 2 + (cy - y) ** 2
            nearer &= own < other * (1.0 - _ROUNDING)
        if nearer:
            return True
    return False


@kernel
def _label(best, label, position, rotation, lens, marks, lattice, gsd, tan2):  # type: ignore[no-untyped-def]
    """Solve a tile: lower best (squared metres) and set label to a frame's mark wherever it is the nearest."""
    rows, columns = best.shape
    n = len(marks)
    least, owners = np.empty(n), np.empty((n, 2))
    low, high = block_heights(lattice, 0, rows, 0, columns)
    flat = low == high
    for r0 in range(0, rows, _BLOCK):
        for c0 in range(0, columns, _BLOCK):
            r1, c1 = min(rows, r0 + _BLOCK), min(columns, c0 + _BLOCK)
            x0, x1, y0, y1 = c0 * gsd, c1 * gsd, r0 * gsd, r1 * gsd
            z0, z1 = block_heights(lattice, r0, r1, c0, c1)
            for k in range(n):
                dx = max(x0 - position[k, 0], 0.0, position[k, 0] - x1)
                dy = max(y0 - position[k, 1], 0.0, position[k, 1] - y1)
                least[k] = dx * dx + dy * dy
            worst = np.float32(0.0)
            for r in range(r0, r1):
                for c in range(c0, c1):
                    worst = max(worst, best[r, c])
            owning = 0
            for k in np.argsort(least, kind="mergesort"):
                if least[k] > worst:
                    break
                if _beaten(owners, owning, x0, x1, y0, y1, position[k, 0], position[k, 1]):
                    continue
                seen = sight(position[k], rotation[k], lens[k], x0, x1, y0, y1, z0, z1)
                if seen == OUTSIDE:
                    continue
                far_x, far_y = (
                    max(x1 - position[k, 0], position[k, 0] - x0),
                    max(y1 - position[k, 1], position[k, 1] - y0),
                )
                rise = position[k, 2] - z1
                if seen == _INSIDE and rise > 0.0 and far_x * far_x + far_y * far_y <= tan2 * rise * rise:
                    worst = _claim(best, label, r0, r1, c0, c1, marks[k], position[k, 0], position[k, 1], gsd)
                    owners[owning, 0], owners[owning, 1] = position[k, 0], position[k, 1]
                    owning += 1
                else:
                    worst = _contest(
                        best, label, r0, r1, c0, c1, marks[k], position[k], rotation[k], lens[k], lattice, flat, gsd,
                        tan2,
                    )  # fmt: skip


def label_tile(
    label: Ints, shots: Shots, marks: Ints, *, lattice: Floats, west: float, north: float, gsd_m: float
) -> None:
    """Label the pixels of a tile that have none (0) with the mark of the nearest frame that sees them.

    Frames that are not weak come first everywhere; equal distance goes to the earlier frame.

    Args:
        label: int32 (rows, columns), changed in place; pixels that have a label keep it.
        shots: the candidates. marks: int32 (N,), their labels, positive and rising.
        lattice: float32, the tile's heights. west, north: its left and upper edge. gsd_m: ground pixel.
    """
    position, rotation = shots.about(west, north)
    limit = TAN_LIMIT**2
    for weak in (False, True):
        index = np.nonzero(shots.weak == weak)[0]
        if len(index) == 0:
            continue
        # what has a label is nearer than anything can be, and stays
        best = np.where(label == 0, np.float32(np.inf), np.float32(-1.0))
        _label(best, label, position[index], rotation[index], shots.lens[index], marks[index], lattice, gsd_m, limit)


@in_place_kernel
def _windows(label, count, windows):  # type: ignore[no-untyped-def]
    """Boxes (row0, row1, col0, col1, pixels) of the labels 1..count in a tile."""
    for k in range(count):
        windows[k, 0], windows[k, 2] = label.shape[0], label.shape[1]
    for r in range(label.shape[0]):
        for c in range(label.shape[1]):
            k = label[r, c] - 1
            if k >= 0:
                windows[k, 0], windows[k, 1] = min(windows[k, 0], r), r + 1
                windows[k, 2], windows[k, 3] = min(windows[k, 2], c), max(windows[k, 3], c + 1)
                windows[k, 4] += 1


def label_windows(local: Ints, count: int) -> Ints:
    """For labels 1..count of a tile: int32 (count, 5), row0, row1, col0, col1, pixels (0 where a label is absent)."""
    windows = np.zeros((count, 5), np.int32)
    _windows(local, count, windows)
    return windows


@in_place_kernel
def write_labels(local, ids, plane):  # type: ignore[no-untyped-def]
    """Put ids[k - 1] + 1 where a tile's local label is k > 0; the tile may be larger."""
    for r in range(local.shape[0]):
        for c in range(local.shape[1]):
            if local[r, c] > 0:
                plane[r, c] = ids[local[r, c] - 1] + 1
