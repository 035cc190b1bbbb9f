"""Compiled parts of the plane sweep: pictures on surfaces parallel to the ground, their likeness, semi-global labels.

Volumes are float32 (rows, H, columns): a row's cells at heights 0, 1, ... steps above the ground, so that loops over
columns are vectorised. Rows go north. `levels`, int32 (rows, columns), says how many heights a cell can have; 0: it is
on the ground. Cells at the border of the block have 0 and may lie at any height: what is beyond is not known.
"""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Floats, Ints

_FAR = np.float32(1e6)  # cost of a height that a cell cannot have; finite, so that sums of it stay numbers
_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


@kernel
def sample(image, factor, position, rotation, lens, west, south, cell, ground, levels, step, out):  # type: ignore[no-untyped-def]
    """Grey values of a picture where it sees cells at their heights above the ground; NaN beyond its border.

    Args:
        image: uint8 (rows, columns), the picture reduced by `factor` along each side.
        position: float64 (3,). rotation: float64 (3, 3), camera to ground. lens: float64 (8,), see block_arrays.
        west, south: place of cell (0, 0). cell: distance of cells, metres.
        ground: float32 (rows, columns). levels: int32, the same shape, heights wanted. step: float32, their distance,
        metres. out: a volume, set; 0 at heights that are not wanted.
    """
    f = np.float32
    rows, columns = ground.shape
    last_v, last_u = f(image.shape[0] - 1.0), f(image.shape[1] - 1.0)
    bx, by, bz = f(rotation[2, 0]), f(rotation[2, 1]), f(rotation[2, 2])
    focal, k1, k2, k3 = f(lens[0] / factor), f(lens[1]), f(lens[2]), f(lens[3])
    middle_u = f((0.5 * (lens[6] - 1.0) + lens[4] + 0.5) / factor - 0.5)
    middle_v = f((0.5 * (lens[7] - 1.0) + lens[5] + 0.5) / factor - 0.5)
    ax, ay, az = np.empty(columns, np.float32), np.empty(columns, np.float32), np.empty(columns, np.float32)
    us, vs = np.empty(columns, np.float32), np.empty(columns, np.float32)
    for r in range(rows):
        here = levels[r]
        most = here.max()
        for c in range(columns):
            dx, dy, dz = west + c * cell - position[0], south + r * cell - position[1], ground[r, c] - position[2]
            ax[c] = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
            ay[c] = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
            az[c] = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
        for k in range(most):
            height = f(k) * step
            for c in range(columns):
                depth = az[c] + height * bz
                x, y = (ax[c] + height * bx) / depth, (ay[c] + height * by) / depth
                r2 = x * x + y * y
                s = focal * (_ONE + r2 * (k1 + r2 * (k2 + r2 * k3)))
                us[c] = s * x + middle_u if depth > _ONE else -_ONE
                vs[c] = s * y + middle_v
            own = out[r, k]
            for c in range(columns):
                u, v = us[c], vs[c]
                if k >= here[c]:
                    own[c] = _ZERO
                elif u >= _ZERO and v >= _ZERO and u < last_u and v < last_v:
                    i, j = int(v), int(u)
                    fv, fu = v - f(i), u - f(j)
                    a, b = f(image[i, j]), f(image[i, j + 1])
                    d, e = f(image[i + 1, j]), f(image[i + 1, j + 1])
                    top = a + fu * (b - a)
                    own[c] = top + fv * (d + fu * (e - d) - top)
                else:
                    own[c] = np.nan
        out[r, most:] = _ZERO


@in_place_kernel
def _window_sums(a, b, r, k, down, out):  # type: ignore[no-untyped-def]
    """Sums over 3 x 3 cells of the product of two volumes at a row and height; down: room for a row."""
    a0, a1, a2 = a[r - 1, k], a[r, k], a[r + 1, k]
    b0, b1, b2 = b[r - 1, k], b[r, k], b[r + 1, k]
    for c in range(len(down)):
        down[c] = a0[c] * b0[c] + a1[c] * b1[c] + a2[c] * b2[c]
    _three(down, out)


@in_place_kernel
def _three(down, out):  # type: ignore[no-untyped-def]
    """Sums of three columns, but at the border."""
    n = len(down)
    left, middle, right, inner = down[: n - 2], down[1 : n - 1], down[2:], out[1 : n - 1]
    for c in range(n - 2):
        inner[c] = left[c] + middle[c] + right[c]


@in_place_kernel
def _plain_sums(a, r, k, down, out):  # type: ignore[no-untyped-def]
    """Sums over 3 x 3 cells of a volume at a row and height; down: room for a row."""
    a0, a1, a2 = a[r - 1, k], a[r, k], a[r + 1, k]
    for c in range(len(down)):
        down[c] = a0[c] + a1[c] + a2[c]
    _three(down, out)


@kernel
def unlikeness(volumes, levels, noise, doubt, cost):  # type: ignore[no-untyped-def]
    """One minus the mean of the two best correlations of the first picture with the others, over 3 x 3 cells.

    Args:
        volumes: float32 (N, rows, H, columns), N pictures, known at the heights of each cell's neighbours, too.
        levels: see above. noise: variance of grey values below which nothing is said: it is added to both variances.
        doubt: cost of all heights above the ground. cost: a volume, set; 1 where nothing is known, 0 on the ground of
        cells without heights and at the border, `_FAR` at heights that a cell cannot have.
    """
    count, rows, _, columns = volumes.shape
    ninth, least = np.float32(1.0 / 9.0), np.float32(9.0) * noise
    down = np.empty(columns, np.float32)
    a, va = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    b, vb, ab = np.zeros(columns, np.float32), np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    first, second = np.empty(columns, np.float32), np.empty(columns, np.float32)
    for r in range(rows):
        here = levels[r]
        high = here.max()
        cost[r] = _FAR
        if high == 0:
            cost[r, 0] = _ZERO
            continue
        for k in range(high):
            _plain_sums(volumes[0], r, k, down, a)
            _window_sums(volumes[0], volumes[0], r, k, down, va)
            first[:], second[:] = -_ONE, -_ONE
            for n in range(1, count):
                _plain_sums(volumes[n], r, k, down, b)
                _window_sums(volumes[n], volumes[n], r, k, down, vb)
                _window_sums(volumes[0], volumes[n], r, k, down, ab)
                for c in range(columns):
                    spread = (va[c] - a[c] * a[c] * ninth + least) * (vb[c] - b[c] * b[c] * ninth + least)
                    score = (ab[c] - a[c] * b[c] * ninth) / np.sqrt(spread)
                    down[c] = score if score == score else -_ONE
                for c in range(columns):
                    second[c] = max(second[c], min(first[c], down[c]))
                    first[c] = max(first[c], down[c])
            own, more = cost[r, k], doubt if k > 0 else _ZERO
            for c in range(columns):
                known = _ONE - _HALF * (first[c] + second[c]) if second[c] > -_ONE else _ONE
                possible = known + more if k < here[c] else _FAR
                own[c] = _ZERO if here[c] == 0 and k == 0 else possible
    cost[0], cost[rows - 1] = _ZERO, _ZERO
    cost[:, :, 0], cost[:, :, columns - 1] = _ZERO, _ZERO


@kernel
def _shifted(row, d, fill, out):  # type: ignore[no-untyped-def]
    """Each cell's neighbour d columns before it, at all heights; `fill` where there is none."""
    columns = row.shape[1]
    first, stop = max(0, d), columns + min(0, d)
    for k in range(len(row)):
        out[k, :first], out[k, stop:] = fill, fill
        out[k, first:stop] = row[k, first - d : stop - d]


@in_place_kernel
def _pass_on(before, least, cost, here, there, n, small, low, high, scale, step, lower, higher, own, now):  # type: ignore[no-untyped-def]
    """Path costs of a row's cells at n heights from those of the cells before them.

    Args:
        before, own: (H + 2, columns) path costs, from the height below the ground to that above the last; `own` is set.
        least, now: the least of them at each cell; `now` is set. cost: (H, columns), the cells' own.
        here, there: (H, columns), grey values of the cells and of those before them.
        small, low, high, scale: see semi_global, `steps`. step: room for (H, columns). lower, higher: for a row.
    """
    columns = len(least)
    for k in range(n):
        for c in range(columns):
            d = (here[k, c] - there[k, c]) * scale
            s = low + (high - low) / (_ONE + d * d)
            step[k, c] = s if s == s else high
    lower[:], higher[:], now[:] = _FAR, _FAR, _FAR
    for k in range(n):
        for c in range(columns):
            own[k + 1, c] = min(before[k + 1, c], min(before[k, c], before[k + 2, c]) + small)
        for c in range(columns):  # from a lower cell: the edge is this cell's, at its height
            own[k + 1, c] = min(own[k + 1, c], lower[c] + step[k, c])
        for c in range(columns):
            lower[c] = min(lower[c], before[k + 1, c])
    for k in range(n - 1, -1, -1):
        for c in range(columns):
            own[k + 1, c] = min(own[k + 1, c], higher[c]) + cost[k, c] - least[c]
        for c in range(columns):
            higher[c] = min(higher[c], before[k + 1, c] + step[k, c])
        for c in range(columns):
            now[c] = min(now[c], own[k + 1, c])
    own[n + 1 :] = _FAR


def semi_global(
    cost: Floats, gray: Floats, levels: Ints, steps: tuple[np.float32, np.float32, np.float32, np.float32]
) -> Floats:
    """The volume of the sums of path costs from eight directions (Hirschmüller 2008).

    A step between two cells costs `high`, and less the more the picture differs between them on the upper one's height
    (down to `low`): a roof's edge is an edge of the picture where the picture is laid on the roof.

    Args:
        cost: a volume, see `unlikeness`. gray: the volume of a picture. levels: see above.
        steps: cost of a step to the next height; of a larger one (low, high); and one over the difference in grey
            values that halves what is between them.
    """
    total = np.zeros_like(cost)
    _from_rows(cost, gray, levels, 1, *steps, total)
    turned, shade = (np.ascontiguousarray(volume.transpose(2, 1, 0)) for volume in (cost, gray))
    across = np.zeros_like(turned)
    _from_rows(turned, shade, np.ascontiguousarray(levels.T), 0, *steps, across)
    return total + across.transpose(2, 1, 0)


@kernel
def _from_rows(cost, gray, levels, aslant, small, low, high, scale, total):  # type: ignore[no-untyped-def]
    """Add the costs of the paths that come from the rows before and after; aslant: 1: along both diagonals, too."""
    rows, most, columns = cost.shape
    step, there = np.empty((most, columns), np.float32), np.zeros((most, columns), np.float32)
    paths, before = np.empty((2, 3, most + 2, columns), np.float32), np.empty((most + 2, columns), np.float32)
    least, least_before = np.empty((2, 3, columns), np.float32), np.empty(columns, np.float32)
    lower, higher = np.empty(columns, np.float32), np.empty(columns, np.float32)
    for turn in range(2):
        way = 1 if turn == 0 else -1
        paths[:], least[:] = _FAR, _ZERO
        paths[:, :, 1 : most + 1] = _ZERO
        for q in range(1, rows):
            r = q if turn == 0 else rows - 1 - q
            n = max(levels[r].max(), levels[r - way].max(), 1)
            for d in range(-aslant, aslant + 1):
                last, own = paths[1 - q % 2, 1 + d], paths[q % 2, 1 + d]
                _shifted(last[: n + 2], d, _FAR, before)
                _shifted(gray[r - way, :n], d, _ZERO, there)
                first, stop = max(0, d), columns + min(0, d)
                least_before[:] = _FAR
                least_before[first:stop] = least[1 - q % 2, 1 + d, first - d : stop - d]
                _pass_on(
                    before, least_before, cost[r], gray[r], there, n, small, low, high, scale, step, lower, higher, own,
                    least[q % 2, 1 + d],
                )  # fmt: skip
                for k in range(n):
                    for c in range(columns):
                        total[r, k, c] += own[k + 1, c]


@in_place_kernel
def lowest(total, levels, step, out):  # type: ignore[no-untyped-def]
    """Set out to the height of least cost of each cell, metres, by a parabola between the heights; 0: the ground."""
    rows, columns = levels.shape
    for r in range(rows):
        for c in range(columns):
            n = levels[r, c]
            best = 0
            for k in range(1, n):
                if total[r, k, c] < total[r, best, c]:
                    best = k
            out[r, c] = _ZERO
            if best == 0:
                continue
            shift = _ZERO
            if 1 < best < n - 1:
                middle = total[r, best, c]
                left, right = total[r, best - 1, c] - middle, total[r, best + 1, c] - middle
                if left + right > _ZERO:
                    shift = _HALF * (left - right) / (left + right)
            out[r, c] = step * (np.float32(best) + shift)
