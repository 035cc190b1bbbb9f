"""Compiled Lucas-Kanade tracking of small windows with a predicted rotation and scale for each.

Translation only, inverse compositional (Baker and Matthews 2004), two levels. The template is sampled in the later
picture's geometry through a local affine map, so a rotation between pictures does no harm; a brightness offset is
allowed.

The sums over a window are made in vector registers, one lane for each column: the compiler does not reorder the
additions of a loop, since that changes rounding, so it adds one number after the other. Here sixteen columns are added
at once, in an order that is always the same (see `shift_products` for why this is written in LLVM's terms).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.refine.features.shift_products import everywhere

SIZE = 15  # side of a window, pixels: a layout of the compiled code (Lucas and Kanade 1981)
WIDE = SIZE + 2  # side of a template: the window and the pixels around it, for its gradients
LANES = 16  # columns that are added at once: those of a window and one that is not used
_HALF = SIZE // 2

_VECTOR = ir.VectorType(ir.FloatType(), LANES)


class _Lanes:
    """Writes vector code into the function that numba compiles."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        self.builder = builder
        self.data = [
            context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
            for kind, value in zip(signature.args, arguments, strict=True)
        ]
        self.number = context.get_constant(types.intp, 0).type

    def rows(self) -> Any:
        """A loop over the rows of a window."""
        return cgutils.for_range(self.builder, ir.Constant(self.number, SIZE))

    def place(self, array: int, at: Any) -> Any:
        """The address of a vector in an array (its number among the arguments)."""
        return self.builder.bitcast(self.builder.gep(self.data[array], [at]), _VECTOR.as_pointer())

    def load(self, array: int, row: Any, width: int, offset: int) -> Any:
        """The vector at an offset from the beginning of a row, in an array of so many columns."""
        at = self.builder.add(self.builder.mul(row, ir.Constant(self.number, width)), ir.Constant(self.number, offset))
        return self.builder.load(self.place(array, at), align=4)

    def store(self, value: Any, array: int, row: Any, offset: int) -> None:
        """Put a vector into an array of LANES columns."""
        at = self.builder.add(self.builder.mul(row, ir.Constant(self.number, LANES)), ir.Constant(self.number, offset))
        self.builder.store(value, self.place(array, at), align=4)

    def totals(self, count: int) -> list[Any]:
        """So many vectors of zeros that stay in registers."""
        return [cgutils.alloca_once_value(self.builder, ir.Constant(_VECTOR, None)) for _ in range(count)]

    def add(self, totals: list[Any], values: Sequence[Any]) -> None:
        """Add a vector to each of the totals."""
        for total, value in zip(totals, values, strict=True):
            self.builder.store(self.builder.fadd(self.builder.load(total), value), total)

    def write(self, totals: list[Any], array: int) -> None:
        """Put the totals into the lines of an array of LANES columns."""
        for line, total in enumerate(totals):
            self.store(self.builder.load(total), array, ir.Constant(self.number, line), 0)


@intrinsic
def add_gradients(typing, wide, gradient, sums):  # type: ignore[no-untyped-def]
    """Gradients (2, SIZE, LANES) of a template, last lane 0; sums over columns of xx, xy, yy, x, y: (5, LANES)."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = _Lanes(context, builder, signature, arguments)
        totals = lanes.totals(5)
        half = ir.Constant(_VECTOR, [0.5] * SIZE + [0.0] * (LANES - SIZE))
        with lanes.rows() as row:
            right, left = (lanes.load(0, row.index, WIDE, WIDE + k) for k in (2, 0))
            low, high = (lanes.load(0, row.index, WIDE, WIDE * k + 1) for k in (2, 0))
            x, y = builder.fmul(half, builder.fsub(right, left)), builder.fmul(half, builder.fsub(low, high))
            lanes.store(x, 1, row.index, 0)
            lanes.store(y, 1, row.index, SIZE * LANES)
            lanes.add(totals, (builder.fmul(x, x), builder.fmul(x, y), builder.fmul(y, y), x, y))
        lanes.write(totals, 2)
        return context.get_dummy_value()

    return types.void(wide, gradient, sums), generate


@intrinsic
def add_residuals(typing, under, wide, gradient, part_u, part_v, sums):  # type: ignore[no-untyped-def]
    """What a template differs from a picture by, e: sums of gx e, gy e, e, e e over its columns, (5, LANES).

    under: float32 (SIZE + 1, LANES + 1), the picture from the pixel before the window's place on. wide, gradient: of
    the template, see `add_gradients`. part_u, part_v: float32, part of a pixel to the place.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = _Lanes(context, builder, signature, arguments)
        totals = lanes.totals(4)
        u, v = (everywhere(builder, value, LANES) for value in arguments[3:5])
        with lanes.rows() as row:
            rows = []
            for k in range(2):
                left, right = (lanes.load(0, row.index, LANES + 1, (LANES + 1) * k + q) for q in range(2))
                rows.append(builder.fadd(left, builder.fmul(u, builder.fsub(right, left))))
            seen = builder.fadd(rows[0], builder.fmul(v, builder.fsub(rows[1], rows[0])))
            error = builder.fsub(seen, lanes.load(1, row.index, WIDE, WIDE + 1))
            x, y = lanes.load(2, row.index, LANES, 0), lanes.load(2, row.index, LANES, SIZE * LANES)
            lanes.add(totals, (builder.fmul(x, error), builder.fmul(y, error), error, builder.fmul(error, error)))
        lanes.write(totals, 5)
        return context.get_dummy_value()

    return types.void(under, wide, gradient, part_u, part_v, sums), generate


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
    """Template, its gradients, what lies under it, sums."""
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
def track(before, before_half, after, after_half, points, homography, back, limits, guess, found, ok):  # type: ignore[no-untyped-def]
    """Track K windows from one picture into the next.

    Args:
        before, after: uint8 pictures; before_half, after_half: the same at half size.
        points: float32 (K, 2) in `before`.
        homography: float64 (3, 3), predicted, from `before` to `after`. back: its inverse.
        limits: most iterations at half and at full size; texture and step, see `_refine`; largest mean square error as
            a share of the window's variance, and noise that is added to that.
        guess: float32 (K, 2) out, as predicted. found: float32 (K, 2) out. ok: bool (K,) out.
    """
    rounds, texture, step, mismatch, noise = limits
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
        if not _template(before, float(points[k, 0]), float(points[k, 1]), affine, wide):
            continue
        error = _refine(after, scratch, q, rounds[1], texture, step)
        if error < 0 or error > mismatch * _variance(wide) + noise:
            continue
        found[k, 0], found[k, 1] = q[0], q[1]
        ok[k] = True


@kernel
def anchor(stack, chain, slot, points, after, here, farthest, limits, found, ok):  # type: ignore[no-untyped-def]
    """Compare K windows with their first observation, so that errors do not accumulate from picture to picture.

    Args:
        stack: uint8 (R, rows, columns), pictures in memory. chain: float64 (R, 3, 3), homographies from the first
            picture to them. slot: int64 (K,), the picture of each first observation.
        points: float32 (K, 2), its place there. after: the picture now.
        here: float64 (3, 3), homography from the picture now to the first one.
        farthest: move in pixels. limits: as for `track`, with one number of iterations.
        found: float32 (K, 2); in: as tracked from the last picture, out: improved.
        ok: bool (K,) out, False where the window no longer matches its first observation.
    """
    rounds, texture, step, mismatch, noise = limits
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
        if not _template(stack[slot[k]], float(points[k, 0]), float(points[k, 1]), affine, wide):
            continue
        q[0], q[1] = found[k, 0], found[k, 1]
        error = _refine(after, scratch, q, rounds, texture, step)
        if error < 0 or error > mismatch * _variance(wide) + noise:
            continue
        if (q[0] - found[k, 0]) ** 2 + (q[1] - found[k, 1]) ** 2 > farthest * farthest:
            continue
        found[k, 0], found[k, 1] = q[0], q[1]
        ok[k] = True
