"""Compiled Lucas-Kanade tracking of small windows with a predicted rotation and scale for each.

Translation only, inverse compositional (Baker and Matthews 2004), two levels. The template is sampled in the later
picture's geometry through a local affine map, so a rotation between pictures does no harm; a brightness offset is
allowed.
"""

import numpy as np

from orthoswarm.compute.jit import kernel

HALF = 7
"""Half the window, pixels: a layout of the compiled code (windows of 15 x 15, Lucas and Kanade 1981)."""
_SIZE = 2 * HALF + 1


@kernel
def _sample(gray, u, v):  # type: ignore[no-untyped-def]
    ui, vi = int(np.floor(u)), int(np.floor(v))
    fu, fv = np.float32(u - ui), np.float32(v - vi)
    low = gray[vi, ui] * (1 - fu) + gray[vi, ui + 1] * fu
    high = gray[vi + 1, ui] * (1 - fu) + gray[vi + 1, ui + 1] * fu
    return low * (1 - fv) + high * fv


@kernel
def _template(gray, u, v, affine, wide):  # type: ignore[no-untyped-def]
    """Fill wide (17, 17) from the earlier picture about (u, v); False if it leaves the picture."""
    rows, cols = gray.shape
    reach = HALF + 1
    span_u = reach * (abs(affine[0, 0]) + abs(affine[0, 1]))
    span_v = reach * (abs(affine[1, 0]) + abs(affine[1, 1]))
    if u - span_u < 0 or v - span_v < 0 or u + span_u >= cols - 1 or v + span_v >= rows - 1:
        return False
    for r in range(2 * reach + 1):
        for c in range(2 * reach + 1):
            x, y = c - reach, r - reach
            wide[r, c] = _sample(gray, u + affine[0, 0] * x + affine[0, 1] * y, v + affine[1, 0] * x + affine[1, 1] * y)
    return True


@kernel
def _refine(gray, wide, q, rounds, texture, step):  # type: ignore[no-untyped-def]
    """Move q (2,) to the template's place in a picture; returns the final mean square error, negative if lost.

    rounds: most iterations. texture: least eigenvalue of the gradient matrix per pixel. step: stop below this step, px.
    """
    rows, cols = gray.shape
    gx, gy = np.empty((_SIZE, _SIZE), np.float32), np.empty((_SIZE, _SIZE), np.float32)
    hxx = hxy = hyy = np.float32(0.0)
    mx = my = mean = np.float32(0.0)
    for r in range(_SIZE):
        for c in range(_SIZE):
            a = np.float32(0.5) * (wide[r + 1, c + 2] - wide[r + 1, c])
            b = np.float32(0.5) * (wide[r + 2, c + 1] - wide[r, c + 1])
            gx[r, c], gy[r, c] = a, b
            hxx += a * a
            hxy += a * b
            hyy += b * b
            mx += a
            my += b
            mean += wide[r + 1, c + 1]
    n = np.float32(_SIZE * _SIZE)
    mean /= n
    hxx -= mx * mx / n
    hxy -= mx * my / n
    hyy -= my * my / n
    det = hxx * hyy - hxy * hxy
    smallest = 0.5 * (hxx + hyy - np.sqrt((hxx - hyy) ** 2 + 4 * hxy * hxy))
    if smallest < texture * n or det <= 0:
        return -1.0
    error = np.float32(-1.0)
    for _ in range(rounds):
        u0, v0 = q[0] - HALF, q[1] - HALF
        ui, vi = int(np.floor(u0)), int(np.floor(v0))
        if ui < 0 or vi < 0 or ui + _SIZE >= cols or vi + _SIZE >= rows:
            return -1.0
        fu, fv = np.float32(u0 - ui), np.float32(v0 - vi)
        w00, w01, w10, w11 = (1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv
        bx = by = total = square = np.float32(0.0)
        for r in range(_SIZE):
            for c in range(_SIZE):
                e = (
                    w00 * gray[vi + r, ui + c]
                    + w01 * gray[vi + r, ui + c + 1]
                    + w10 * gray[vi + r + 1, ui + c]
                    + w11 * gray[vi + r + 1, ui + c + 1]
                    - wide[r + 1, c + 1]
                )
                bx += gx[r, c] * e
                by += gy[r, c] * e
                total += e
                square += e * e
        bx -= mx * total / n
        by -= my * total / n
        error = (square - total * total / n) / n
        du, dv = (hyy * bx - hxy * by) / det, (hxx * by - hxy * bx) / det
        q[0] -= du
        q[1] -= dv
        if du * du + dv * dv < step * step:
            break
    return error


@kernel
def variance(wide):  # type: ignore[no-untyped-def]
    """Grey variance of a template."""
    total = square = 0.0
    for r in range(1, _SIZE + 1):
        for c in range(1, _SIZE + 1):
            total += wide[r, c]
            square += wide[r, c] * wide[r, c]
    n = _SIZE * _SIZE
    return square / n - (total / n) ** 2


@kernel
def track(  # type: ignore[no-untyped-def]
    before,
    before_half,
    after,
    after_half,
    points,
    guess,
    affine,
    rounds,
    texture,
    step,
    mismatch,
    noise,
    found,
    ok,
):
    """Track K windows from one picture into the next.

    Args:
        before, after: uint8 pictures; before_half, after_half: the same at half size.
        points: float32 (K, 2) in `before`. guess: float32 (K, 2) start in `after`.
        affine: float64 (K, 2, 2), derivative of the map from `after` back to `before` at each point.
        rounds: most iterations at half and at full size. texture, step: see the configuration (klt_least_texture,
            klt_step_px). mismatch, noise: largest mean square error as a share of the window's variance, plus noise.
        found: float32 (K, 2) out. ok: bool (K,) out.
    """
    wide = np.empty((_SIZE + 2, _SIZE + 2), np.float32)
    q = np.empty(2)
    for k in range(len(points)):
        ok[k] = False
        found[k, 0], found[k, 1] = guess[k, 0], guess[k, 1]
        q[0], q[1] = (guess[k, 0] + 0.5) * 0.5 - 0.5, (guess[k, 1] + 0.5) * 0.5 - 0.5
        u, v = (points[k, 0] + 0.5) * 0.5 - 0.5, (points[k, 1] + 0.5) * 0.5 - 0.5
        if (
            _template(before_half, u, v, affine[k], wide)
            and _refine(after_half, wide, q, rounds[0], texture, step) >= 0
        ):
            q[0], q[1] = (q[0] + 0.5) * 2 - 0.5, (q[1] + 0.5) * 2 - 0.5
        else:
            q[0], q[1] = guess[k, 0], guess[k, 1]
        if not _template(before, points[k, 0], points[k, 1], affine[k], wide):
            continue
        error = _refine(after, wide, q, rounds[1], texture, step)
        if error < 0 or error > mismatch * variance(wide) + noise:
            continue
        found[k, 0], found[k, 1] = q[0], q[1]
        ok[k] = True


@kernel
def anchor(  # type: ignore[no-untyped-def]
    stack,
    slot,
    points,
    after,
    affine,
    limit,
    rounds,
    texture,
    step,
    mismatch,
    noise,
    found,
    ok,
):
    """Compare K windows with their first observation, so that errors do not accumulate from picture to picture.

    Args:
        stack: uint8 (R, rows, columns), pictures in memory. slot: int64 (K,), the picture of each first observation.
        points: float32 (K, 2), its place there. after: the picture now.
        affine: float64 (K, 2, 2), derivative of the map from `after` back to that picture.
        limit: farthest move in pixels. rounds (one number), texture, step, mismatch, noise: as for `track`.
        found: float32 (K, 2); in: as tracked from the last picture, out: improved.
        ok: bool (K,) out, False where the window no longer matches its first observation.
    """
    wide = np.empty((_SIZE + 2, _SIZE + 2), np.float32)
    q = np.empty(2)
    for k in range(len(points)):
        ok[k] = False
        if not _template(stack[slot[k]], points[k, 0], points[k, 1], affine[k], wide):
            continue
        q[0], q[1] = found[k, 0], found[k, 1]
        error = _refine(after, wide, q, rounds, texture, step)
        if error < 0 or error > mismatch * variance(wide) + noise:
            continue
        if (q[0] - found[k, 0]) ** 2 + (q[1] - found[k, 1]) ** 2 > limit * limit:
            continue
        found[k, 0], found[k, 1] = q[0], q[1]
        ok[k] = True
