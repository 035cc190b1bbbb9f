"""Compiled Lucas-Kanade tracking of small windows with a predicted rotation and scale for each.

Translation only, inverse compositional (Baker and Matthews 2004), two levels. The template is sampled in the later
picture's geometry through a local affine map, so a rotation between pictures does no harm; a brightness offset is
allowed.
"""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.refine.features.window_sums import LANES, SIZE, WIDE, add_gradients, add_residuals

_HALF = SIZE // 2


@in_place_kernel
def _derivative(homography, u, v, affine):  # type: ignore[no-untyped-def]
    """Derivative of a homography (3, 3) at a pixel, into affine (2, 2)."""
    w = homography[2, 0] * u + homography[2, 1] * v + homography[2, 2]
    for a in range(2):
        q = (homography[a, 0] * u + homography[a, 1] * v + homography[a, 2]) / w
        for b in range(2):
            affine[a, b] = (homography[a, b] - q * homography[2, b]) / w


@in_place_kernel
def _template(gray, u, v, affine, wide):  # type: ignore[no-untyped-def]
    """Fill wide (17, 17) from the earlier picture about (u, v); False if it leaves the picture."""
    rows, cols = gray.shape
    reach, one = _HALF + 1, np.uint32(1)
    span_u = reach * (abs(affine[0, 0]) + abs(affine[0, 1]))
    span_v = reach * (abs(affine[1, 0]) + abs(affine[1, 1]))
    if u - span_u < 0 or v - span_v < 0 or u + span_u >= cols - 1 or v + span_v >= rows - 1:
        return False
    for r in range(WIDE):
        line, y = wide[r], r - reach
        u0, v0 = u + affine[0, 1] * y - affine[0, 0] * reach, v + affine[1, 1] * y - affine[1, 0] * reach
        for c in range(WIDE):
            uc, vc = u0 + affine[0, 0] * c, v0 + affine[1, 0] * c
            ui, vi = np.uint32(np.int32(uc)), np.uint32(np.int32(vc))  # unsigned: not tested for being negative
            fu, fv = np.float32(uc - ui), np.float32(vc - vi)
            upper, lower = gray[vi], gray[vi + one]
            left, below = np.float32(upper[ui]), np.float32(lower[ui])
            high = left + fu * (np.float32(upper[ui + one]) - left)
            line[c] = high + fv * (below + fu * (np.float32(lower[ui + one]) - below) - high)
    return True


@kernel
def _scratch():  # type: ignore[no-untyped-def]
    """Template, its gradients, what lies under it, sums: see `window_sums`."""
    return (
        np.zeros((WIDE, WIDE), np.float32),
        np.zeros((2, SIZE, LANES), np.float32),
        np.zeros((SIZE + 1, LANES + 1), np.float32),
        np.zeros((5, LANES), np.float32),
    )


@in_place_kernel
def _total(lanes):  # type: ignore[no-untyped-def]
    """Sum of the lanes that belong to the window."""
    total = 0.0
    for c in range(SIZE):
        total += lanes[c]
    return total


@in_place_kernel
def _refine(gray, scratch, q, rounds, texture, step):  # type: ignore[no-untyped-def]
    """Move q (2,) to the template's place in a picture; returns the final mean square error, negative if lost.

    rounds: most iterations. texture: least eigenvalue of the gradient matrix per pixel. step: stop below this step, px.
    """
    wide, gradient, under, sums = scratch
    rows, cols = gray.shape
    n = float(SIZE * SIZE)
    add_gradients(wide, gradient, sums)
    mx, my = _total(sums[3]), _total(sums[4])
    hxx, hxy, hyy = _total(sums[0]) - mx * mx / n, _total(sums[1]) - mx * my / n, _total(sums[2]) - my * my / n
    det = hxx * hyy - hxy * hxy
    smallest = 0.5 * (hxx + hyy - np.sqrt((hxx - hyy) ** 2 + 4 * hxy * hxy))
    if smallest < texture * n or det <= 0:
        return -1.0
    error, at_u, at_v = -1.0, -1, -1
    for _ in range(rounds):
        u0, v0 = q[0] - _HALF, q[1] - _HALF
        ui, vi = int(np.floor(u0)), int(np.floor(v0))
        if ui < 0 or vi < 0 or ui + SIZE >= cols or vi + SIZE >= rows:
            return -1.0
        if ui != at_u or vi != at_v:
            at_u, at_v = ui, vi
            for r in range(SIZE + 1):
                seen, to = gray[vi + r, ui : ui + SIZE + 1], under[r]
                for c in range(SIZE + 1):
                    to[c] = seen[c]
        add_residuals(under, wide, gradient, np.float32(u0 - ui), np.float32(v0 - vi), sums)
        total = _total(sums[2])
        bx, by = _total(sums[0]) - mx * total / n, _total(sums[1]) - my * total / n
        error = (_total(sums[3]) - total * total / n) / n
        du, dv = (hyy * bx - hxy * by) / det, (hxx * by - hxy * bx) / det
        q[0] -= du
        q[1] -= dv
        if du * du + dv * dv < step * step:
            break
    return error


@in_place_kernel
def _variance(wide):  # type: ignore[no-untyped-def]
    """Grey variance of a template."""
    total = square = 0.0
    for r in range(1, SIZE + 1):
        for c in range(1, SIZE + 1):
            total += wide[r, c]
            square += wide[r, c] * wide[r, c]
    n = SIZE * SIZE
    return square / n - (total / n) ** 2


@kernel
def track(  # type: ignore[no-untyped-def]
    before, before_half, after, after_half, points, homography, back, rounds, texture, step, mismatch, noise,
    guess, found, ok,
):  # fmt: skip
    """Track K windows from one picture into the next.

    Args:
        before, after: uint8 pictures; before_half, after_half: the same at half size.
        points: float32 (K, 2) in `before`.
        homography: float64 (3, 3), predicted, from `before` to `after`. back: its inverse.
        rounds: most iterations at half and at full size. texture, step: see the configuration (klt_least_texture,
            klt_step_px). mismatch, noise: largest mean square error as a share of the window's variance, plus noise.
        guess: float32 (K, 2) out, as predicted. found: float32 (K, 2) out. ok: bool (K,) out.
    """
    scratch = _scratch()
    wide, affine, q = scratch[0], np.empty((2, 2)), np.empty(2)
    for k in range(len(points)):
        ok[k] = False
        x, y = float(points[k, 0]), float(points[k, 1])
        w = homography[2, 0] * x + homography[2, 1] * y + homography[2, 2]
        for a in range(2):
            guess[k, a] = (homography[a, 0] * x + homography[a, 1] * y + homography[a, 2]) / w
            found[k, a], q[a] = guess[k, a], (guess[k, a] + 0.5) * 0.5 - 0.5
        _derivative(back, float(guess[k, 0]), float(guess[k, 1]), affine)
        u, v = (points[k, 0] + 0.5) * 0.5 - 0.5, (points[k, 1] + 0.5) * 0.5 - 0.5
        if (
            _template(before_half, u, v, affine, wide)
            and _refine(after_half, scratch, q, rounds[0], texture, step) >= 0
        ):
            q[0], q[1] = (q[0] + 0.5) * 2 - 0.5, (q[1] + 0.5) * 2 - 0.5
        else:
            q[0], q[1] = guess[k, 0], guess[k, 1]
        if not _template(before, points[k, 0], points[k, 1], affine, wide):
            continue
        error = _refine(after, scratch, q, rounds[1], texture, step)
        if error < 0 or error > mismatch * _variance(wide) + noise:
            continue
        found[k, 0], found[k, 1] = q[0], q[1]
        ok[k] = True


@kernel
def anchor(  # type: ignore[no-untyped-def]
    stack, chain, slot, points, after, here, limit, rounds, texture, step, mismatch, noise, found, ok
):
    """Compare K windows with their first observation, so that errors do not accumulate from picture to picture.

    Args:
        stack: uint8 (R, rows, columns), pictures in memory. chain: float64 (R, 3, 3), homographies from the first
            picture to them. slot: int64 (K,), the picture of each first observation.
        points: float32 (K, 2), its place there. after: the picture now.
        here: float64 (3, 3), homography from the picture now to the first one.
        limit: farthest move in pixels. rounds (one number), texture, step, mismatch, noise: as for `track`.
        found: float32 (K, 2); in: as tracked from the last picture, out: improved.
        ok: bool (K,) out, False where the window no longer matches its first observation.
    """
    scratch = _scratch()
    wide, affine, q, back = scratch[0], np.empty((2, 2)), np.empty(2), np.empty((3, 3))
    for k in range(len(points)):
        ok[k] = False
        for a in range(3):
            for b in range(3):
                back[a, b] = 0.0
                for i in range(3):
                    back[a, b] += chain[slot[k], a, i] * here[i, b]
        _derivative(back, float(found[k, 0]), float(found[k, 1]), affine)
        if not _template(stack[slot[k]], points[k, 0], points[k, 1], affine, wide):
            continue
        q[0], q[1] = found[k, 0], found[k, 1]
        error = _refine(after, scratch, q, rounds, texture, step)
        if error < 0 or error > mismatch * _variance(wide) + noise:
            continue
        if (q[0] - found[k, 0]) ** 2 + (q[1] - found[k, 1]) ** 2 > limit * limit:
            continue
        found[k, 0], found[k, 1] = q[0], q[1]
        ok[k] = True
