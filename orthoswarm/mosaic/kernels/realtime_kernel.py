"""The compiled heart of the real-time module: one picture onto one tile, in one pass over the tile's rows.

Per row: the span of the convex footprint, then the orthogonality test (before anything else, because most pixels
of most frames do not win), then source coordinates, bilinear samples in 8-bit fixed point, colours, and scores last.
Loops are split so that all but the sampling compile to vector code; constants are float32 for the same reason.
"""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.camera import LEAST_RADIAL_SLOPE

_EVEN = np.uint32(0x00FF00FF)
_ODD = np.uint32(0xFF00FF00)
_HALF = np.uint32(0x00800080)
_8 = np.uint32(8)
_FULL = np.uint32(256)
_FRACTION = np.uint32(255)
RUN = 32  # pixels that vector code handles at once


@kernel
def aim(position, rotation, corners, ground_z_m, least, west, north, gsd_m, planes, box):  # type: ignore[no-untyped-def]
    """The footprint of a picture on the canvas as half planes and a box; gives the number of half planes, 0 if none.

    The picture is clipped where its rays go down by less than `least` per unit of depth, so the footprint is finite.

    Args:
        position: float64 (3,), easting, northing, height of the camera. rotation: float64 (3, 3), camera to ground.
        corners: float64 (4,), x low, x high, y low, y high of a box in undistorted normalised coordinates.
        west, north, gsd_m: the canvas's left and upper edge, and its ground pixel.
        planes: float64 (8, 3), set to rows a, b, c with a column + b row <= c inside, canvas pixels.
        box: float64 (4,), set to the least and greatest column, least and greatest row.
    """
    rays, ring = np.empty((4, 3)), np.empty((8, 3))
    for i in range(4):
        x = corners[1] if i == 1 or i == 2 else corners[0]
        y = corners[3] if i >= 2 else corners[2]
        for j in range(3):
            rays[i, j] = rotation[j, 0] * x + rotation[j, 1] * y + rotation[j, 2]
    n = 0
    for i in range(4):
        here, there = rays[i], rays[(i + 1) % 4]
        a, b = -here[2] - least, -there[2] - least
        if a >= 0.0:
            ring[n] = here
            n += 1
        if (a >= 0.0) != (b >= 0.0):
            ring[n] = here + (there - here) * (a / (a - b))
            n += 1
    if n < 3:
        return 0
    height = position[2] - ground_z_m
    box[0], box[1], box[2], box[3] = np.inf, -np.inf, np.inf, -np.inf
    for i in range(n):
        scale = height / -ring[i, 2]
        column = (position[0] + ring[i, 0] * scale - west) / gsd_m - 0.5
        row = (north - position[1] - ring[i, 1] * scale) / gsd_m - 0.5
        ring[i, 0], ring[i, 1] = column, row
        box[0], box[1] = min(box[0], column), max(box[1], column)
        box[2], box[3] = min(box[2], row), max(box[3], row)
    twice = 0.0
    for i in range(n):
        j = (i + 1) % n
        twice += (ring[i, 0] - box[0]) * (ring[j, 1] - box[2]) - (ring[j, 0] - box[0]) * (ring[i, 1] - box[2])
    turn = 1.0 if twice > 0.0 else -1.0
    for i in range(n):
        j = (i + 1) % n
        planes[i, 0], planes[i, 1] = turn * (ring[j, 1] - ring[i, 1]), turn * (ring[i, 0] - ring[j, 0])
        planes[i, 2] = planes[i, 0] * ring[i, 0] + planes[i, 1] * ring[i, 1]
    return n


@in_place_kernel
def row_span(planes, centre, radius, row, first, last):  # type: ignore[no-untyped-def]
    """Columns [first, last) cut down to the pixel centres in a convex polygon and a circle, on a row.

    planes: float64 (K, 3), a column + b row <= c inside. centre: float64 (2,) and radius of the circle.
    """
    low, high = float(first), last - 1.0
    dy = row - centre[1]
    room = radius * radius - dy * dy
    if room < 0.0:
        return first, first
    half = np.sqrt(room)
    low, high = max(low, centre[0] - half), min(high, centre[0] + half)
    for k in range(planes.shape[0]):
        a, rest = planes[k, 0], planes[k, 2] - planes[k, 1] * row
        if a > 1e-12:
            high = min(high, rest / a)
        elif a < -1e-12:
            low = max(low, rest / a)
        elif rest < 0.0:
            return first, first
    if not high >= low:
        return first, first
    return int(np.ceil(low)), int(np.floor(high)) + 1


@in_place_kernel
def touches(planes, centre, radius, row0, col0, rows, columns):  # type: ignore[no-untyped-def]
    """Whether any pixel centre of a part of the canvas lies in the polygon and the circle."""
    for r in range(row0, row0 + rows):
        first, last = row_span(planes, centre, radius, r, col0, col0 + columns)
        if last > first:
            return True
    return False


@in_place_kernel
def _distort(us, vs, k1, k2, k3):  # type: ignore[no-untyped-def]
    """Apply radial distortion in place; far outside where it folds the picture over and nothing is visible."""
    one = np.float32(1.0)
    three, five, seven = np.float32(3.0) * k1, np.float32(5.0) * k2, np.float32(7.0) * k3
    for i in range(us.shape[0]):
        r2 = us[i] * us[i] + vs[i] * vs[i]
        s = one + r2 * (k1 + r2 * (k2 + r2 * k3))
        if one + r2 * (three + r2 * (five + r2 * seven)) < np.float32(LEAST_RADIAL_SLOPE):
            s = np.float32(1e6)
        us[i] *= s
        vs[i] *= s


@in_place_kernel
def _blend(texels, stride, at, weight, keep, corners, target):  # type: ignore[no-untyped-def]
    """Bilinear samples of packed pixels into a row where keep > 0; two channels at a time in 16-bit lanes.

    The four weights sum to 256, so no lane overflows. The four texels of each pixel are fetched first, into corners:
    fetching cannot be vector code, and with it in the same loop nothing else would be.
    """
    zero, one, below = np.float32(0.0), np.uint64(1), np.uint64(stride)
    here, right, low, low_right = corners[0], corners[1], corners[2], corners[3]
    for i in range(target.shape[0]):
        p = np.uint64(at[i])
        q = p + below
        here[i], right[i], low[i], low_right[i] = texels[p], texels[p + one], texels[q], texels[q + one]
    for i in range(target.shape[0]):
        t00, t01, t10, t11 = here[i], right[i], low[i], low_right[i]
        fx, fy = weight[i] & _FRACTION, weight[i] >> _8
        w11 = (fx * fy) >> _8
        w01, w10 = fx - w11, fy - w11
        w00 = _FULL - fx - w10
        even = (t00 & _EVEN) * w00 + (t01 & _EVEN) * w01 + (t10 & _EVEN) * w10 + (t11 & _EVEN) * w11 + _HALF
        odd = (
            ((t00 >> _8) & _EVEN) * w00
            + ((t01 >> _8) & _EVEN) * w01
            + ((t10 >> _8) & _EVEN) * w10
            + ((t11 >> _8) & _EVEN) * w11
            + _HALF
        )
        target[i] = ((even >> _8) & _EVEN) | (odd & _ODD) if keep[i] > zero else target[i]


@in_place_kernel
def _score(new, row_score, dx0, dy2, area, outside_left, inside_end):  # type: ignore[no-untyped-def]
    """Set new to the orthogonality of a row's pixels where it beats what is there, else 0; first and last such pixel.

    Pixels before outside_left and from inside_end on are not in the footprint.
    """
    zero, one, least = np.float32(0.0), np.float32(1.0), np.float32(1e-6)
    begin, end = np.int32(outside_left), np.int32(inside_end)
    first, last = np.int32(1 << 30), np.int32(0)
    for k in range(new.shape[0]):
        i = np.int32(k)
        dx = dx0 + np.float32(i)
        q = one / max((dx * dx + dy2) * area, least)
        better = (q > row_score[k]) & (i >= begin) & (i < end)
        new[k] = q if better else zero
        first = min(first, i if better else np.int32(1 << 30))
        last = max(last, i + np.int32(1) if better else np.int32(0))
    return first, last


@in_place_kernel
def _locate(new, us, vs, at, weight, start, step, lens, limits, stride):  # type: ignore[no-untyped-def]
    """Texel indices and weights of a run of pixels; sets new to 0 outside the picture; gives how many stay.

    start and step: homogeneous coordinates (x, y, w) of the first pixel and from pixel to pixel, float32.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    x0, y0, w0 = start
    mx, my, mw = step
    k1, k2, k3, focal, pu, pv = lens
    u_low, u_high, v_low, v_high, u_last, v_last = limits
    for i in range(new.shape[0]):
        n = np.float32(i)
        inverse = one / (w0 + mw * n)
        us[i] = (x0 + mx * n) * inverse
        vs[i] = (y0 + my * n) * inverse
    if k1 != zero or k2 != zero or k3 != zero:
        _distort(us, vs, k1, k2, k3)
    hits = np.int32(0)
    for i in range(new.shape[0]):
        fu, fv = us[i] * focal + pu, vs[i] * focal + pv
        inside = (fu >= u_low) & (fv >= v_low) & (fu <= u_high) & (fv <= v_high) & (new[i] > zero)
        new[i] = new[i] if inside else zero
        ui, vi = np.uint32(min(max(fu, zero), u_last)), np.uint32(min(max(fv, zero), v_last))
        at[i] = (vi >> _8) * stride + (ui >> _8)
        weight[i] = (ui & _FRACTION) | ((vi & _FRACTION) << _8)
        hits += np.int32(inside)
    return hits


@kernel
def fuse(packed, score, part, picture, planes, centre, radius, matrix, lens, gsd_m, reals, integers):  # type: ignore[no-untyped-def]
    """Draw a picture where it sees the ground more orthogonally than what is there; gives the number of pixels won.

    Paper III.B: a pixel takes the picture with the largest 1 / ||P_oc - P||. Equal distance: what is there stays.
    Runs are widened to multiples of RUN pixels, because what is left over by vector code would be most of a short run.

    Args:
        packed: uint32 (T, T), the tile's colours; T a multiple of RUN.
        score: float32 (T, T), 1 / squared distance in 1/m^2, 0 = empty.
        part: the tile's first row and column on the canvas, and how many of its rows and columns lie on it.
        picture: uint32 (H, W), colours R, G, B, 255 in memory order.
        planes: float64 (K, 3), half planes of the footprint in canvas pixels.
        centre: float64 (2,), nadir point in canvas pixels (column, row).
        radius: greatest distance drawn, pixels.
        matrix: float64 (3, 3), from (column, row) about the nadir point, 1, to homogeneous undistorted normalised
            picture coordinates.
        lens: float64 (10,), k1, k2, k3, focal length in pixels, principal column and row, least and greatest column
            used, least and greatest row used (they may lie half a pixel beyond the outermost centres).
        gsd_m: ground pixel. reals: float32 (3, T + RUN), scratch. integers: uint32 (6, T + RUN), scratch.
    """
    row0, col0, rows, columns = part
    height, width = picture.shape
    f32 = np.float32
    # picture coordinates in 1/256 pixels, plus 1/2 to round
    optics = (
        f32(lens[0]),
        f32(lens[1]),
        f32(lens[2]),
        f32(256.0 * lens[3]),
        f32(256.0 * lens[4] + 0.5),
        f32(256.0 * lens[5] + 0.5),
    )
    limits = (
        f32(256.0 * lens[6] + 0.5), f32(256.0 * lens[7] + 0.5), f32(256.0 * lens[8] + 0.5), f32(256.0 * lens[9] + 0.5),
        f32(256 * (width - 1) - 1), f32(256 * (height - 1) - 1),
    )  # fmt: skip
    step = (f32(matrix[0, 0]), f32(matrix[1, 0]), f32(matrix[2, 0]))
    area, stride, zero = f32(gsd_m * gsd_m), np.uint32(width), f32(0.0)
    texels = picture.ravel()
    won = np.int64(0)
    for r in range(rows):
        first, last = row_span(planes, centre, radius, row0 + r, col0, col0 + columns)
        if last <= first:
            continue
        left = (first - col0) // RUN * RUN
        right = (last - col0 + RUN - 1) // RUN * RUN
        row_score, new = score[r, left:right], reals[0, : right - left]
        south = row0 + r - centre[1]
        dx0, dy = f32(col0 + left - centre[0]), f32(south)
        begin, end = _score(new, row_score, dx0, dy * dy, area, first - col0 - left, last - col0 - left)
        if end == 0:
            continue
        wide = (end - begin + RUN - 1) // RUN * RUN
        reals[0, right - left : right - left + RUN] = zero  # what a widened run may reach
        run = reals[0, begin : begin + wide]
        at, weight = integers[0, :wide], integers[1, :wide]
        east = col0 + left + begin - centre[0]
        start = (
            f32(matrix[0, 0] * east + matrix[0, 1] * south + matrix[0, 2]),
            f32(matrix[1, 0] * east + matrix[1, 1] * south + matrix[1, 2]),
            f32(matrix[2, 0] * east + matrix[2, 1] * south + matrix[2, 2]),
        )
        hits = _locate(run, reals[1, :wide], reals[2, :wide], at, weight, start, step, optics, limits, stride)
        if hits == 0:
            continue
        won += hits
        _blend(texels, stride, at, weight, run, integers[2:], packed[r, left + begin : left + end])
        row_score, new = row_score[begin:end], new[begin:end]
        for i in range(end - begin):
            row_score[i] = max(row_score[i], new[i])
    return won
