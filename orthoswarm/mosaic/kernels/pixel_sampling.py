"""The compiled sampling of the renderer: colours of one picture into the pixels of a tile that it owns.

Two steps, so that it is known which part of a picture is wanted before any of it is read: `place` finds the pixels of
a tile that a picture owns and where they lie in it, `blend` colours them.

Bicubic interpolation (cubic convolution, Keys 1981, a = -1/2) in fixed point, all three channels at once in 16-bit
lanes of one word: a sum of products of lanes is right in every lane as soon as every lane's result, with BIAS added
for the negative weights, lies within 0 to 65,535; what is carried between lanes meanwhile cancels.
"""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Array, Indices
from orthoswarm.mosaic.kernels.lens_arrays import K1, K2, K3, F, U, V
from orthoswarm.mosaic.kernels.render_arrays import LATTICE_PX, lattice_height

UNIT = 128  # sum of the weights, and number of steps of a fraction of a pixel
BEFORE, AFTER = 1, 2
"""Pixels that interpolation takes before and after that which holds the place, across and down."""
_LOW = 32  # a row's least value (-32) becomes 0
_BIAS = np.int64((_LOW * UNIT + UNIT // 2) * (1 + (1 << 16) + (1 << 32)))
_BIAS2 = np.int64((2 * _LOW * UNIT) * (1 + (1 << 16) + (1 << 32)))
_LANES = np.int64(0x01FF_01FF_01FF)


def cubic_convolution(t: Array) -> Array:
    """Weights of the samples at -1, 0, 1, 2 for places t (N,) between 0 and 1 (Keys 1981, a = -1/2), float64 (4, N)."""
    return np.stack(
        [
            t * (-0.5 + t * (1.0 - 0.5 * t)),
            1.0 + t * t * (1.5 * t - 2.5),
            t * (0.5 + t * (2.0 - 1.5 * t)),
            t * t * (0.5 * t - 0.5),
        ]
    )


def cubic_weights() -> Indices:
    """Weights at -1, 0, 1, 2 for every fraction k / UNIT, int64 (UNIT, 4), each row's sum UNIT."""
    t = np.arange(UNIT) / UNIT
    exact = cubic_convolution(t).T
    weights = np.rint(exact * UNIT).astype(np.int64)
    rows = np.arange(UNIT)
    weights[rows, np.where(t < 0.5, 1, 2)] += UNIT - weights.sum(1)
    return weights


WEIGHTS = cubic_weights()


@in_place_kernel
def _owned(label, mark, window, lattice, index, at):  # type: ignore[no-untyped-def]
    """The pixels of a tile that have a label: their number in the tile, column, row and height; gives how many.

    The height is that of render_arrays.lattice_height, its sums over a row taken out of the loop.
    """
    r0, r1, c0, c1 = np.int64(window[0]), np.int64(window[1]), np.int64(window[2]), np.int64(window[3])
    level = np.float64(lattice[0, 0])
    flat = True
    for row in range(r0 // LATTICE_PX, (r1 - 1) // LATTICE_PX + 2):
        for k in range(c0 // LATTICE_PX, (c1 - 1) // LATTICE_PX + 2):
            flat &= np.float64(lattice[row, k]) == level
    columns, rows, heights = at[0], at[1], at[2]
    count, side = np.uint64(0), label.shape[1]
    one = np.uint64(1)
    for r in range(r0, r1):
        labels = label[r]
        node, fy = r // LATTICE_PX, (r % LATTICE_PX + 0.5) / LATTICE_PX
        before = count
        for c in range(c0, c1):
            if labels[np.uint64(c)] == mark:  # unsigned: not tested for being negative
                columns[count], index[count] = np.float64(c), np.int32(r * side + c)
                count += one
        for n in range(before, count):
            rows[n], heights[n] = np.float64(r), level
        if not flat:
            for n in range(before, count):
                column = np.int64(columns[n])
                at_left, fx = np.uint64(column // LATTICE_PX), (column % LATTICE_PX + 0.5) / LATTICE_PX
                at_right = at_left + one
                left = lattice[node, at_left] * (1.0 - fy) + lattice[node + 1, at_left] * fy
                right = lattice[node, at_right] * (1.0 - fy) + lattice[node + 1, at_right] * fy
                heights[n] = left * (1.0 - fx) + right * fx
    return count


@in_place_kernel
def _project(count, at, position, m, lens, gsd, size, shrink, spots, sights):  # type: ignore[no-untyped-def]
    """Where some pixels (column, row, height) lie in the picture, see `place`; gives how many the picture shows."""
    offset = 0.5 * shrink - 0.5 + 0.5 / UNIT  # of reduced pixels, and to round to the nearest fraction
    zero, right, bottom = np.float64(0.0), np.float64(size[0] - 1), np.float64(size[1] - 1)
    per_px, tall = 2.0 / size[0], (size[1] - 1.0) / size[0]
    focal, k1, k2, k3, pu, pv = lens[F], lens[K1], lens[K2], lens[K3], lens[U], lens[V]
    m00, m01, m02, m10, m11, m12 = m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2]
    m20, m21, m22 = m[2, 0], m[2, 1], m[2, 2]
    dx, top, height = 0.5 * gsd - position[0], position[1], position[2]
    columns, rows, heights = at[0], at[1], at[2]
    us, vs, xs, ys, shown = spots[0], spots[1], sights[0], sights[1], sights[2]
    none, all_ = np.float32(0.0), np.float32(1.0)
    for n in range(count):
        x, dz = columns[n] * gsd, heights[n] - height
        dy = (rows[n] + 0.5) * gsd - top
        near = np.divide(
            1.0, (m20 * dx + m21 * dy) + m20 * x + m22 * dz
        )  # not tested for zero, which keeps vector code
        px, py = (
            ((m00 * dx + m01 * dy) + m00 * x + m02 * dz) * near,
            ((m10 * dx + m11 * dy) + m10 * x + m12 * dz) * near,
        )
        r2 = px * px + py * py
        scale = focal * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))
        u, v = (px * scale + pu) * shrink + offset, (py * scale + pv) * shrink + offset
        inside = (u >= -1.0) & (v >= -1.0) & (u <= right + 1.5) & (v <= bottom + 1.5)
        us[n], vs[n] = np.int32(min(max(u, zero), right) * UNIT), np.int32(min(max(v, zero), bottom) * UNIT)
        xs[n], ys[n] = np.float32(u * per_px - 1.0), np.float32(v * per_px - tall)
        shown[n] = all_ if inside else none
    seen = np.uint64(0)
    for n in range(count):
        seen += np.uint64(shown[n] > none)
    return seen


@in_place_kernel
def _range(values):  # type: ignore[no-untyped-def]
    low = high = values[0]
    for value in values:
        low, high = min(low, value), max(high, value)
    return low // np.int32(UNIT), high // np.int32(UNIT)


@kernel
def _columns_of(rows, chosen):  # type: ignore[no-untyped-def]
    columns = np.empty((rows.shape[0], chosen.sum()), rows.dtype)
    for k in range(rows.shape[0]):
        columns[k] = rows[k][chosen]
    return columns


@kernel
def _shown(index, at, position, rotation, lens, gsd, size, shrink):  # type: ignore[no-untyped-def]
    """Where pixels (column, row, height) lie in a picture, of those that it shows; see `place`."""
    count = len(index)
    spots, sights = np.empty((2, count), np.int32), np.empty((3, count), np.float32)
    shown = _project(count, at, position, rotation, lens, gsd, size, shrink, spots, sights)
    if shown < count:  # beside a seam, at the picture's very border
        visible = sights[2] > 0.0
        index, spots, sights = index[visible], _columns_of(spots, visible), _columns_of(sights, visible)
    box = np.zeros(4, np.int32)
    if shown > 0:
        box[0], box[1] = _range(spots[0])
        box[2], box[3] = _range(spots[1])
    return index, spots, sights, box


@kernel
def place(label, mark, window, position, rotation, lens, lattice, gsd, size, factor):  # type: ignore[no-untyped-def]
    """Find a tile's pixels of one label in a picture, by the projection of render_arrays.

    Args:
        label: int32 (T, T). mark: the label. window: int32 (4,), row0, row1, col0, col1 that hold it.
        position, rotation, lens: the camera in the tile's frame, (3,), (3, 3), (18,), see render_arrays.Shots.about.
        lattice: float32, the tile's heights. gsd: ground pixel, metres.
        size: int32 (2,), columns and rows of the picture reduced by `factor`.

    Returns:
        For N pixels that the picture shows: int32 (N,), their numbers in the tile; int32 (2, N), their columns and rows
        in the reduced picture, in 1 / UNIT pixels; float32 (3, N), the same as radiometry.Field wants it (the third row
        means nothing); and int32 (4,), the least and greatest column, least and greatest row that they lie in.
    """
    owned = np.uint64(0)
    for r in range(window[0], window[1]):
        labels = label[r, window[2] : window[3]]
        for c in range(labels.shape[0]):
            owned += np.uint64(labels[c] == mark)
    index, at = np.empty(owned, np.int32), np.empty((3, owned))
    _owned(label, mark, window, lattice, index, at)
    return _shown(index, at, position, rotation, lens, gsd, size, 1.0 / factor)


@kernel
def place_listed(index, side, position, rotation, lens, lattice, gsd, size, factor):  # type: ignore[no-untyped-def]
    """Find some pixels of a tile in a picture: their numbers in the list, and the rest as of `place`.

    index: int32 (N,), their numbers in the tile. side: of the tile, pixels. The rest: see `place`.
    """
    at = np.empty((3, len(index)))
    for n in range(len(index)):
        row, column = index[n] // side, index[n] % side
        at[0, n], at[1, n], at[2, n] = column, row, lattice_height(lattice, row, column)
    numbers = np.arange(len(index)).astype(np.int32)
    return _shown(numbers, at, position, rotation, lens, gsd, size, 1.0 / factor)


SPOT_PX = 2  # pixels of a picture along each side that count as one part
_SPOT_BITS = (UNIT * SPOT_PX).bit_length() - 1


@in_place_kernel
def drawn_again(index, spots, side, corner, far_px, low, first):  # type: ignore[no-untyped-def]
    """How many pixels show a part of a picture that is drawn elsewhere already.

    Args:
        index, spots: of the pixels, see `place`, in ascending order. side: of the tile, pixels.
        corner: int32 (2,), its first row, column. far_px: pixels of the map from which on two places count as two.
        low: int32 (2,), row and column of the least part, of SPOT_PX.
        first: int32 (rows, columns, 2), row and column where a part was drawn first, -1 where it was not; changed.
    """
    again = 0
    us, vs = spots[0], spots[1]
    row, start = np.int64(corner[0]), np.int64(0)
    for n in range(index.shape[0]):
        while index[n] >= start + side:  # a division costs more than all the rest
            start += side
            row += 1
        at = first[(vs[n] >> _SPOT_BITS) - low[0], (us[n] >> _SPOT_BITS) - low[1]]
        column = corner[1] + index[n] - start
        if at[0] < 0:
            at[0], at[1] = row, column
        elif max(abs(at[0] - row), abs(at[1] - column)) > far_px:
            again += 1
    return again


@kernel
def widen(part, corner, box, size, lanes):  # type: ignore[no-untyped-def]
    """The colours in a box of a picture and around it as one word each; at the picture's border they repeat.

    Args:
        part: uint8 (H, W, 3), a part of the picture. corner: int32 (2,), column and row of its corner.
        box: int32 (4,), see `place`; `part` holds it, with BEFORE and AFTER as far as the picture goes.
        size: int32 (2,), columns and rows of the whole picture.
        lanes: int64 (rows, columns) of the box with BEFORE and AFTER added, set.
    """
    rows, columns = lanes.shape
    left, top = box[0] - BEFORE, box[2] - BEFORE
    first, last = max(-left, 0), min(size[0] - left, columns)  # of the lanes, those that lie in the picture
    for i in range(rows):
        r = min(max(top + i, 0), size[1] - 1) - corner[1]
        source, target = part[r].ravel(), lanes[i]
        start = 3 * (left + first - corner[0])
        flat, inner = source[start : start + 3 * (last - first)], target[first:last]
        for j in range(inner.shape[0]):
            inner[j] = np.int64(flat[3 * j]) | (np.int64(flat[3 * j + 1]) << 16) | (np.int64(flat[3 * j + 2]) << 32)
        for j in range(first):
            target[j] = target[first]
        for j in range(last, columns):
            target[j] = target[last - 1]


@in_place_kernel
def _row(flat, at, w0, w1, w2, w3):  # type: ignore[no-untyped-def]
    """Three channels of a row, interpolated, each plus _LOW, 9 bits in 16-bit lanes."""
    one = np.uint64(1)
    total = flat[at] * w0 + flat[at + one] * w1 + flat[at + one + one] * w2 + flat[at + one + one + one] * w3 + _BIAS
    return (total >> 7) & _LANES


@in_place_kernel
def _totals(index, spots, flat, stride, left, top, weights, totals):  # type: ignore[no-untyped-def]
    """Sums of the rows, all channels."""
    us, vs = spots[0], spots[1]
    for n in range(index.shape[0]):
        fu, fv = np.int64(us[n]), np.int64(vs[n])
        at = np.uint64((fv >> 7) - top) * stride + np.uint64((fu >> 7) - left)
        wx, wy = weights[np.uint64(fu & (UNIT - 1))], weights[np.uint64(fv & (UNIT - 1))]
        w0, w1, w2, w3 = wx[0], wx[1], wx[2], wx[3]
        totals[n] = (
            _row(flat, at, w0, w1, w2, w3) * wy[0]
            + _row(flat, at + stride, w0, w1, w2, w3) * wy[1]
            + _row(flat, at + stride + stride, w0, w1, w2, w3) * wy[2]
            + _row(flat, at + stride + stride + stride, w0, w1, w2, w3) * wy[3]
            + _BIAS2
        )


@in_place_kernel
def _level(lanes):  # type: ignore[no-untyped-def]
    """One channel, 0 to 255, of a sum of rows: both biases taken off, rounded."""
    value = (np.int32(lanes & 0xFFFF) - np.int32(3 * _LOW * UNIT - UNIT // 2)) >> 7
    return np.int32(min(max(value, np.int32(0)), np.int32(255)))


@in_place_kernel
def _colors(totals, sights, field, colors):  # type: ignore[no-untyped-def]
    """Sums of rows as colours, one word each, under factors that vary over the picture."""
    half, low, high = np.float32(0.5), np.float32(0.0), np.float32(255.0)
    xs, ys = sights[0], sights[1]
    for channel in range(3):
        f0, f1, f2 = field[channel, 0], field[channel, 1], field[channel, 2]
        f3, f4, f5 = field[channel, 3], field[channel, 4], field[channel, 5]
        shift, empty = np.int64(16 * channel), channel == 0
        for n in range(totals.shape[0]):
            x, y = xs[n], ys[n]
            factor = f0 + x * (f1 + f3 * x + f4 * y) + y * (f2 + f5 * y)
            level = np.float32(_level(totals[n] >> shift)) * factor + half
            word = np.uint32(np.int32(min(max(level, low), high))) << np.uint32(8 * channel)
            colors[n] = np.uint32(0xFF000000 | word) if empty else np.uint32(colors[n] | word)


@kernel
def blend(packed, index, spots, sights, lanes, box, field, weights):  # type: ignore[no-untyped-def]
    """Colour pixels of a tile from a picture by bicubic interpolation.

    Args:
        packed: uint32 (T, T), the tile's colours, changed in place.
        index: int32 (N,), the pixels, see `place`. spots: int32 (2, N). sights: float32 (3, N).
        lanes: see `widen`. box: int32 (4,), as given there.
        field: float32 (3, 6), factors of red, green and blue over the picture, see radiometry.Field.
        weights: WEIGHTS.
    """
    count = len(index)
    totals, colors, target = np.empty(count, np.int64), np.empty(count, np.uint32), packed.ravel()
    _totals(index, spots, lanes.ravel(), np.uint64(lanes.shape[1]), np.int64(box[0]), np.int64(box[2]), weights, totals)
    _colors(totals, sights, field, colors)
    for n in range(count):
        target[np.uint64(index[n])] = colors[n]
