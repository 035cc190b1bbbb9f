"""Compiled parts of the plane sweep: pictures on surfaces parallel to the ground, their likeness, semi-global labels.

Volumes are float32 (rows, columns, H): a cell's values at H heights above the ground lie side by side. Rows go north.
"""

import numpy as np

from orthoswarm.compute.jit import kernel

_FAR = np.float32(1e6)
"""Cost of a height that a cell cannot have; finite, so that sums of it stay numbers."""


@kernel
def sample(image, factor, position, rotation, lens, west, south, cell, ground, wanted, heights, out):  # type: ignore[no-untyped-def]
    """Grey values of a picture where it sees the wanted cells at each height above the ground; NaN beyond its border.

    Args:
        image: uint8 (rows, columns), the picture reduced by `factor` along each side.
        position: float64 (3,). rotation: float64 (3, 3), camera to ground. lens: float64 (8,), see block_arrays.
        west, south: place of cell (0, 0). cell: distance of cells, metres.
        ground: float32 (rows, columns). wanted: bool, the same shape. heights: float64 (H,). out: a volume, set.
    """
    last_v, last_u = image.shape[0] - 1.0, image.shape[1] - 1.0
    bx, by, bz = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    shrink, offset = 1.0 / factor, 0.5 / factor - 0.5
    pu, pv = 0.5 * (lens[6] - 1.0) + lens[4], 0.5 * (lens[7] - 1.0) + lens[5]
    for r in range(ground.shape[0]):
        for c in range(ground.shape[1]):
            if not wanted[r, c]:
                continue
            dx, dy, dz = west + c * cell - position[0], south + r * cell - position[1], ground[r, c] - position[2]
            ax = rotation[0, 0] * dx + rotation[1, 0] * dy + bx * dz
            ay = rotation[0, 1] * dx + rotation[1, 1] * dy + by * dz
            az = rotation[0, 2] * dx + rotation[1, 2] * dy + bz * dz
            for k in range(len(heights)):
                depth = az + heights[k] * bz
                x, y = (ax + heights[k] * bx) / depth, (ay + heights[k] * by) / depth
                r2 = x * x + y * y
                s = lens[0] * (1.0 + r2 * (lens[1] + r2 * (lens[2] + r2 * lens[3])))
                u, v = (s * x + pu) * shrink + offset, (s * y + pv) * shrink + offset
                if not (depth > 1.0 and u >= 0.0 and v >= 0.0 and u < last_u and v < last_v):
                    out[r, c, k] = np.nan
                    continue
                i, j = int(v), int(u)
                fv, fu = np.float32(v - i), np.float32(u - j)
                a, b = np.float32(image[i, j]), np.float32(image[i, j + 1])
                d, e = np.float32(image[i + 1, j]), np.float32(image[i + 1, j + 1])
                top = a + fu * (b - a)
                out[r, c, k] = top + fv * (d + fu * (e - d) - top)


@kernel
def unlikeness(volumes, wanted, noise, cost):  # type: ignore[no-untyped-def]
    """One minus the mean of the two best correlations of the first picture with the others, over 3 x 3 cells.

    Args:
        volumes: float32 (N, rows, columns, H), N pictures. wanted: bool (rows, columns), not at the border.
        noise: variance of grey values below which nothing is said: it is added to both variances.
        cost: a volume, set; 1 where nothing is known.
    """
    count, rows, columns, levels = volumes.shape
    ninth = np.float32(1.0 / 9.0)
    a, aa = np.empty(levels, np.float32), np.empty(levels, np.float32)
    b, bb, ab = np.empty(levels, np.float32), np.empty(levels, np.float32), np.empty(levels, np.float32)
    first, second = np.empty(levels, np.float32), np.empty(levels, np.float32)
    for r in range(rows):
        for c in range(columns):
            if not wanted[r, c]:
                continue
            a[:], aa[:] = 0.0, 0.0
            for i in range(r - 1, r + 2):
                for j in range(c - 1, c + 2):
                    own = volumes[0, i, j]
                    for k in range(levels):
                        a[k] += own[k]
                        aa[k] += own[k] * own[k]
            first[:], second[:] = -1.0, -1.0
            for n in range(1, count):
                b[:], bb[:], ab[:] = 0.0, 0.0, 0.0
                for i in range(r - 1, r + 2):
                    for j in range(c - 1, c + 2):
                        own, other = volumes[0, i, j], volumes[n, i, j]
                        for k in range(levels):
                            b[k] += other[k]
                            bb[k] += other[k] * other[k]
                            ab[k] += own[k] * other[k]
                for k in range(levels):
                    va, vb = aa[k] - a[k] * a[k] * ninth, bb[k] - b[k] * b[k] * ninth
                    score = (ab[k] - a[k] * b[k] * ninth) / np.sqrt((va + 9.0 * noise) * (vb + 9.0 * noise))
                    score = score if score == score else np.float32(-1.0)
                    second[k] = max(second[k], min(first[k], score))
                    first[k] = max(first[k], score)
            own = cost[r, c]
            for k in range(levels):
                known = second[k] > np.float32(-1.0)
                own[k] = np.float32(1.0) - np.float32(0.5) * (first[k] + second[k]) if known else np.float32(1.0)


@kernel
def _pass_on(before, cost, here, there, small, low, high, scale, own):  # type: ignore[no-untyped-def]
    """The path cost of a cell's heights from those of the cell before it."""
    levels = len(cost)
    least = before[0]
    for k in range(1, levels):
        least = min(least, before[k])
    lower = _FAR
    for k in range(levels):
        d = (here[k] - there[k]) * scale
        step = low + (high - low) / (np.float32(1.0) + d * d)
        step = step if step == step else high
        best = min(before[k], lower + step)  # from a lower cell: the edge is this cell's, at its height
        if k > 0:
            best = min(best, before[k - 1] + small)
        if k + 1 < levels:
            best = min(best, before[k + 1] + small)
        lower = min(lower, before[k])
        own[k] = best
    higher = _FAR
    for k in range(levels - 1, -1, -1):
        own[k] = min(own[k], higher) + cost[k] - least
        d = (here[k] - there[k]) * scale
        step = low + (high - low) / (np.float32(1.0) + d * d)
        step = step if step == step else high
        higher = min(higher, before[k] + step)


@kernel
def semi_global(cost, gray, wanted, small, low, high, scale, total):  # type: ignore[no-untyped-def]
    """Sums of the path costs of eight directions (Hirschmüller 2008); cells that are not wanted are on the ground.

    A step between two cells costs `high`, and less the more the picture differs between them on the upper one's height
    (down to `low`): a roof's edge is an edge of the picture where the picture is laid on the roof.

    Args:
        cost: a volume. gray: the volume of a picture. wanted: bool (rows, columns).
        small: cost of a step to the next height. low, high: of a larger step. scale: one over the difference in grey
        values that halves what is between them. total: a volume, zeros; set.
    """
    rows, columns, levels = cost.shape
    ground = np.full(levels, _FAR, np.float32)
    ground[0] = 0.0
    paths = np.empty((2, 4, columns + 2, levels), np.float32)
    for turn in range(2):
        way = 1 if turn == 0 else -1
        paths[:] = ground
        for n in range(rows):
            r = n if turn == 0 else rows - 1 - n
            now, last = paths[n % 2], paths[1 - n % 2]
            for m in range(columns):
                c = m if turn == 0 else columns - 1 - m
                for d in range(4):
                    dr, dc = (0, -way) if d == 0 else (-way, (d - 2) * way)
                    own = now[d, c + 1]
                    if not wanted[r, c]:
                        own[:] = ground
                        continue
                    before = now[d, c + 1 + dc] if d == 0 else last[d, c + 1 + dc]
                    i, j = min(max(r + dr, 0), rows - 1), min(max(c + dc, 0), columns - 1)
                    _pass_on(before, cost[r, c], gray[r, c], gray[i, j], small, low, high, scale, own)
                    total[r, c] += own


@kernel
def lowest(total, wanted, step, out):  # type: ignore[no-untyped-def]
    """Height of least cost of each wanted cell, by a parabola between the heights; 0 on the ground and elsewhere."""
    rows, columns, levels = total.shape
    for r in range(rows):
        for c in range(columns):
            if not wanted[r, c]:
                continue
            own = total[r, c]
            best = 0
            for k in range(1, levels):
                if own[k] < own[best]:
                    best = k
            if best == 0:
                continue
            shift = np.float32(0.0)
            if 1 < best < levels - 1:
                left, right = own[best - 1] - own[best], own[best + 1] - own[best]
                if left + right > 0.0:
                    shift = np.float32(0.5) * (left - right) / (left + right)
            out[r, c] = step * (best + shift)
