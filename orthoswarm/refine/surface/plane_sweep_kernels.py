"""Compiled parts of the plane sweep: pictures on surfaces parallel to the ground, their likeness, semi-global labels.

Volumes are float32 (rows, columns, H): a cell's values at heights 0, 1, ... steps above the ground lie side by side.
Rows go north. `levels`, int32 (rows, columns), says how many heights a cell can have; 0: it is on the ground. Cells at
the border of the block are.
"""

import numpy as np

from orthoswarm.compute.jit import kernel

_FAR = np.float32(1e6)
"""Cost of a height that a cell cannot have; finite, so that sums of it stay numbers."""
_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


@kernel
def sample(image, factor, position, rotation, lens, west, south, cell, ground, levels, step, out):  # type: ignore[no-untyped-def]
    """Grey values of a picture where it sees cells at their heights above the ground; NaN beyond its border.

    Args:
        image: uint8 (rows, columns), the picture reduced by `factor` along each side.
        position: float64 (3,). rotation: float64 (3, 3), camera to ground. lens: float64 (8,), see block_arrays.
        west, south: place of cell (0, 0). cell: distance of cells, metres.
        ground: float32 (rows, columns). levels: int32, the same shape, heights wanted. step: float32, their distance,
        metres. out: a volume, set.
    """
    f = np.float32
    last_v, last_u = f(image.shape[0] - 1.0), f(image.shape[1] - 1.0)
    bx, by, bz = f(rotation[2, 0]), f(rotation[2, 1]), f(rotation[2, 2])
    focal, k1, k2, k3 = f(lens[0] / factor), f(lens[1]), f(lens[2]), f(lens[3])
    middle_u = f((0.5 * (lens[6] - 1.0) + lens[4] + 0.5) / factor - 0.5)
    middle_v = f((0.5 * (lens[7] - 1.0) + lens[5] + 0.5) / factor - 0.5)
    us, vs = np.empty(out.shape[2], np.float32), np.empty(out.shape[2], np.float32)
    for r in range(ground.shape[0]):
        for c in range(ground.shape[1]):
            n = levels[r, c]
            if n == 0:
                continue
            dx, dy, dz = west + c * cell - position[0], south + r * cell - position[1], ground[r, c] - position[2]
            ax = f(rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz)
            ay = f(rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz)
            az = f(rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz)
            for k in range(n):  # apart from the next loop, so that it is vectorised
                height = f(k) * step
                depth = az + height * bz
                x, y = (ax + height * bx) / depth, (ay + height * by) / depth
                r2 = x * x + y * y
                s = focal * (_ONE + r2 * (k1 + r2 * (k2 + r2 * k3)))
                us[k] = s * x + middle_u if depth > _ONE else -_ONE
                vs[k] = s * y + middle_v
            own = out[r, c]
            for k in range(n):
                u, v = us[k], vs[k]
                if not (u >= _ZERO and v >= _ZERO and u < last_u and v < last_v):
                    own[k] = np.nan
                    continue
                i, j = int(v), int(u)
                fv, fu = v - f(i), u - f(j)
                a, b = f(image[i, j]), f(image[i, j + 1])
                d, e = f(image[i + 1, j]), f(image[i + 1, j + 1])
                top = a + fu * (b - a)
                own[k] = top + fv * (d + fu * (e - d) - top)


@kernel
def unlikeness(volumes, levels, noise, doubt, cost):  # type: ignore[no-untyped-def]
    """One minus the mean of the two best correlations of the first picture with the others, over 3 x 3 cells.

    Args:
        volumes: float32 (N, rows, columns, H), N pictures, known at the heights of each cell's neighbours, too.
        levels: see above. noise: variance of grey values below which nothing is said: it is added to both variances.
        doubt: cost of all heights above the ground. cost: a volume, set; 1 where nothing is known.
    """
    count, rows, columns, most = volumes.shape
    ninth, least = np.float32(1.0 / 9.0), np.float32(9.0) * noise
    a, aa = np.empty(most, np.float32), np.empty(most, np.float32)
    b, bb, ab = np.empty(most, np.float32), np.empty(most, np.float32), np.empty(most, np.float32)
    first, second = np.empty(most, np.float32), np.empty(most, np.float32)
    for r in range(rows):
        for c in range(columns):
            levels_here = levels[r, c]
            if levels_here == 0:
                continue
            a[:], aa[:] = _ZERO, _ZERO
            for i in range(r - 1, r + 2):
                for j in range(c - 1, c + 2):
                    own = volumes[0, i, j]
                    for k in range(levels_here):
                        a[k] += own[k]
                        aa[k] += own[k] * own[k]
            first[:], second[:] = -_ONE, -_ONE
            for n in range(1, count):
                b[:], bb[:], ab[:] = _ZERO, _ZERO, _ZERO
                for i in range(r - 1, r + 2):
                    for j in range(c - 1, c + 2):
                        own, other = volumes[0, i, j], volumes[n, i, j]
                        for k in range(levels_here):
                            b[k] += other[k]
                            bb[k] += other[k] * other[k]
                            ab[k] += own[k] * other[k]
                for k in range(levels_here):
                    va, vb = aa[k] - a[k] * a[k] * ninth, bb[k] - b[k] * b[k] * ninth
                    score = (ab[k] - a[k] * b[k] * ninth) / np.sqrt((va + least) * (vb + least))
                    score = score if score == score else -_ONE
                    second[k] = max(second[k], min(first[k], score))
                    first[k] = max(first[k], score)
            own = cost[r, c]
            for k in range(levels_here):
                known = second[k] > -_ONE
                own[k] = (_ONE - _HALF * (first[k] + second[k]) if known else _ONE) + doubt
            own[0] -= doubt


@kernel
def _pass_on(before, least, cost, here, there, n, m, small, low, high, scale, step, own):  # type: ignore[no-untyped-def]
    """Set the path costs of a cell's n heights from those of the m heights of the cell before it; returns the least.

    Args:
        before, own: path costs, one more than heights, `_FAR` beyond the cell's own. least: the least of `before`.
        cost: of the cell. here, there: grey values on its heights at the cell and at the one before it.
        small, low, high, scale: see semi_global. step: room for a cost of each height.
    """
    for k in range(max(n, m)):
        d = (here[k] - there[k]) * scale
        s = low + (high - low) / (_ONE + d * d)
        step[k] = s if s == s else high
    own[0] = min(before[0], before[1] + small)
    for k in range(1, n):
        own[k] = min(before[k], min(before[k - 1], before[k + 1]) + small)
    lower = _FAR
    for k in range(n):  # from a lower cell: the edge is this cell's, at its height
        own[k] = min(own[k], lower + step[k])
        lower = min(lower, before[k])
    higher = _FAR
    for k in range(m - 1, n - 1, -1):
        higher = min(higher, before[k] + step[k])
    now = _FAR
    for k in range(n - 1, -1, -1):
        value = min(own[k], higher) + cost[k] - least
        own[k] = value
        now = min(now, value)
        higher = min(higher, before[k] + step[k])
    for k in range(n, len(own)):
        own[k] = _FAR
    return now


@kernel
def semi_global(cost, gray, levels, small, low, high, scale, total):  # type: ignore[no-untyped-def]
    """Sums of the path costs of eight directions (Hirschmüller 2008); cells without heights are on the ground.

    A step between two cells costs `high`, and less the more the picture differs between them on the upper one's height
    (down to `low`): a roof's edge is an edge of the picture where the picture is laid on the roof.

    Args:
        cost: a volume. gray: the volume of a picture. levels: see above.
        small: cost of a step to the next height. low, high: of a larger step. scale: one over the difference in grey
        values that halves what is between them. total: a volume, zeros; set.
    """
    rows, columns, most = cost.shape
    step = np.empty(most, np.float32)
    paths = np.empty((2, 4, columns + 2, most + 1), np.float32)
    least = np.empty((2, 4, columns + 2), np.float32)
    for turn in range(2):
        way = 1 if turn == 0 else -1
        paths[:], least[:] = _FAR, _ZERO
        paths[..., 0] = _ZERO
        for q in range(rows):
            r = q if turn == 0 else rows - 1 - q
            now, last = q % 2, 1 - q % 2
            for p in range(columns):
                c = p if turn == 0 else columns - 1 - p
                n = levels[r, c]
                for d in range(4):
                    own = paths[now, d, c + 1]
                    if n == 0:
                        own[:] = _FAR
                        own[0], least[now, d, c + 1] = _ZERO, _ZERO
                        continue
                    dr, dc = (0, -way) if d == 0 else (-way, (d - 2) * way)
                    row = now if d == 0 else last
                    i, j = r + dr, c + dc
                    least[now, d, c + 1] = _pass_on(
                        paths[row, d, j + 1], least[row, d, j + 1], cost[r, c], gray[r, c], gray[i, j], n,
                        max(levels[i, j], 1), small, low, high, scale, step, own,
                    )  # fmt: skip
                    sums = total[r, c]
                    for k in range(n):
                        sums[k] += own[k]


@kernel
def lowest(total, levels, step, out):  # type: ignore[no-untyped-def]
    """Height of least cost of each cell, metres, by a parabola between the heights; 0 on the ground."""
    rows, columns = levels.shape
    for r in range(rows):
        for c in range(columns):
            n = levels[r, c]
            own = total[r, c]
            best = 0
            for k in range(1, n):
                if own[k] < own[best]:
                    best = k
            if best == 0:
                continue
            shift = _ZERO
            if 1 < best < n - 1:
                left, right = own[best - 1] - own[best], own[best + 1] - own[best]
                if left + right > _ZERO:
                    shift = _HALF * (left - right) / (left + right)
            out[r, c] = step * (np.float32(best) + shift)
