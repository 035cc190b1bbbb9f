"""The compiled sampling of the renderer: colours of one picture into the pixels of a tile that it owns.

Bicubic interpolation (cubic convolution, Keys 1981, a = -1/2) in fixed point, all three channels at once in 16-bit
lanes of one word: a sum of products of lanes is right in every lane as soon as every lane's result, with BIAS added
for the negative weights, lies within 0 to 65,535; what is carried between lanes meanwhile cancels.
"""

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import kernel
from orthoswarm.mosaic.kernels.lens_arrays import K1, K2, K3, F, U, V
from orthoswarm.mosaic.kernels.render_arrays import STEP

UNIT = 128
"""Sum of the weights, and number of steps of a fraction of a pixel."""
_LOW = 32  # a row's least value (-32) becomes 0
_BIAS = np.int64((_LOW * UNIT + UNIT // 2) * (1 + (1 << 16) + (1 << 32)))
_BIAS2 = np.int64((2 * _LOW * UNIT) * (1 + (1 << 16) + (1 << 32)))
_LANES = np.int64(0x01FF_01FF_01FF)


def cubic_weights() -> NDArray[np.int64]:
    """Weights at -1, 0, 1, 2 for every fraction k / UNIT, int64 (UNIT, 4), each row's sum UNIT."""
    t = np.arange(UNIT) / UNIT
    exact = np.stack(
        [
            t * (-0.5 + t * (1.0 - 0.5 * t)),
            1.0 + t * t * (1.5 * t - 2.5),
            t * (0.5 + t * (2.0 - 1.5 * t)),
            t * t * (0.5 * t - 0.5),
        ],
        1,
    )
    weights = np.rint(exact * UNIT).astype(np.int64)
    rows = np.arange(UNIT)
    weights[rows, np.where(t < 0.5, 1, 2)] += UNIT - weights.sum(1)
    return weights


WEIGHTS = cubic_weights()


@kernel
def _texel(flat, at):  # type: ignore[no-untyped-def]
    """Three bytes in lanes; at is unsigned, which spares the test for negative indices."""
    return np.int64(flat[at]) | (np.int64(flat[at + np.uint64(1)]) << 16) | (np.int64(flat[at + np.uint64(2)]) << 32)


@kernel
def _row(flat, row, x0, x1, x2, x3, w0, w1, w2, w3):  # type: ignore[no-untyped-def]
    """Three channels of a row, interpolated, each plus _LOW, 9 bits in 16-bit lanes."""
    total = (
        _texel(flat, np.uint64(row + x0)) * w0
        + _texel(flat, np.uint64(row + x1)) * w1
        + _texel(flat, np.uint64(row + x2)) * w2
        + _texel(flat, np.uint64(row + x3)) * w3
        + _BIAS
    )
    return (total >> 7) & _LANES


@kernel
def _level(lanes):  # type: ignore[no-untyped-def]
    """One channel, 0 to 255, of a sum of rows: both biases taken off, rounded."""
    value = ((lanes & 0xFFFF) - (3 * _LOW * UNIT - UNIT // 2)) >> 7
    return min(max(value, 0), 255)


@kernel
def _scaled(level, field, x, y):  # type: ignore[no-untyped-def]
    """A level under a factor that varies over the picture, rounded, 0 to 255."""
    half = np.float32(0.5)
    factor = field[0] + x * (field[1] + field[3] * x + field[4] * y) + y * (field[2] + field[5] * y)
    return np.int64(min(max(np.float32(level) * factor + half, np.float32(0.0)), np.float32(255.0)))


@kernel
def sample(rgba, label, mark, window, position, rotation, lens, lattice, gsd, picture, factor, field, weights):  # type: ignore[no-untyped-def]
    """Colour a tile's pixels of one label from a picture by bicubic interpolation; gives their number.

    The projection is render_arrays.project and the height its height_at, their sums over a row taken out of the loop.
    What the picture does not show stays.

    Args:
        rgba: uint8 (T, T, 4), changed in place.
        label: int32 (T, T).
        mark: the label.
        window: int32 (4,), row0, row1, col0, col1 that hold the label.
        position: float64 (3,), the camera in the tile's frame, see lattice.Shots.about.
        rotation: float64 (3, 3), ground to camera.
        lens: float64 (18,), see lattice.
        lattice: float32, the tile's heights.
        gsd: ground pixel, metres.
        picture: uint8 (H, W, 3).
        factor: by which the picture was reduced.
        field: float32 (3, 6), factors of red, green and blue over the picture, see radiometry.Field.
        weights: WEIGHTS.
    """
    height, width = picture.shape[0], picture.shape[1]
    flat, stride = picture.ravel(), 3 * width
    shrink = 1.0 / factor
    offset = 0.5 * shrink - 0.5 + 0.5 / UNIT  # of reduced pixels, and to round to the nearest fraction
    zero, right, bottom = np.float64(0.0), np.float64(width - 1), np.float64(height - 1)
    none, end_x, end_y = np.int64(0), np.int64(width - 1), np.int64(height - 1)
    flat_ground, z = True, np.float64(lattice[0, 0])
    for node in lattice.flat:
        flat_ground = flat_ground and node == lattice[0, 0]
    focal, k1, k2, k3 = lens[F], lens[K1], lens[K2], lens[K3]
    distorted = k1 != 0.0 or k2 != 0.0 or k3 != 0.0
    plain = True
    for channel in range(3):
        plain = plain and field[channel, 0] == 1.0 and not field[channel, 1:].any()
    per_px, tall = 2.0 / width, (height - 1.0) / width
    m = rotation
    count = 0
    nodes = np.empty(lattice.shape[1])  # heights along a row, at the lattice's columns
    first, last = window[2] // STEP, min((window[3] - 1) // STEP + 2, lattice.shape[1])
    for r in range(window[0], window[1]):
        labels, colors = label[r], rgba[r]
        if not flat_ground:
            node, fy = r // STEP, (r % STEP + 0.5) / STEP
            for k in range(first, last):
                nodes[k] = lattice[node, k] * (1.0 - fy) + lattice[node + 1, k] * fy
        dx, dy = 0.5 * gsd - position[0], (r + 0.5) * gsd - position[1]
        row_x, row_y = m[0, 0] * dx + m[0, 1] * dy, m[1, 0] * dx + m[1, 1] * dy
        row_d = m[2, 0] * dx + m[2, 1] * dy
        for c in range(np.uint32(window[2]), np.uint32(window[3])):  # unsigned: not tested for being negative
            if labels[c] != mark:
                continue
            if not flat_ground:
                at, fx = np.uint64(c // STEP), (c % STEP + 0.5) / STEP
                z = nodes[at] * (1.0 - fx) + nodes[at + np.uint64(1)] * fx
            x, dz = c * gsd, z - position[2]
            near = 1.0 / (row_d + m[2, 0] * x + m[2, 2] * dz)
            px, py = (row_x + m[0, 0] * x + m[0, 2] * dz) * near, (row_y + m[1, 0] * x + m[1, 2] * dz) * near
            scale = focal
            if distorted:
                r2 = px * px + py * py
                scale = focal * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))
            u, v = (px * scale + lens[U]) * shrink + offset, (py * scale + lens[V]) * shrink + offset
            if u < -1.0 or v < -1.0 or u > right + 1.5 or v > bottom + 1.5:
                continue  # beside a seam at the picture's very border
            fu, fv = np.int64(min(max(u, zero), right) * UNIT), np.int64(min(max(v, zero), bottom) * UNIT)
            j, i = fu >> 7, fv >> 7
            wx, wy = weights[fu & (UNIT - 1)], weights[fv & (UNIT - 1)]
            w0, w1, w2, w3 = wx[0], wx[1], wx[2], wx[3]
            x0, x1, x2, x3 = 3 * max(j - 1, none), 3 * j, 3 * min(j + 1, end_x), 3 * min(j + 2, end_x)
            y0, y1 = stride * max(i - 1, none), stride * i
            y2, y3 = stride * min(i + 1, end_y), stride * min(i + 2, end_y)
            total = (
                _row(flat, y0, x0, x1, x2, x3, w0, w1, w2, w3) * wy[0]
                + _row(flat, y1, x0, x1, x2, x3, w0, w1, w2, w3) * wy[1]
                + _row(flat, y2, x0, x1, x2, x3, w0, w1, w2, w3) * wy[2]
                + _row(flat, y3, x0, x1, x2, x3, w0, w1, w2, w3) * wy[3]
                + _BIAS2
            )
            red, green, blue = _level(total), _level(total >> 16), _level(total >> 32)
            if not plain:
                x, y = np.float32(u * per_px - 1.0), np.float32(v * per_px - tall)
                red = _scaled(red, field[0], x, y)
                green = _scaled(green, field[1], x, y)
                blue = _scaled(blue, field[2], x, y)
            colors[c, 0], colors[c, 1], colors[c, 2], colors[c, 3] = red, green, blue, 255
            count += 1
    return count
