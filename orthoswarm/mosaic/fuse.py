"""The compiled heart of the real-time module: one picture onto one tile, in one pass over the tile's rows.

Per row: the span of the convex footprint, then the orthogonality test (before anything else, because most pixels
of most frames do not win), then source coordinates, bilinear samples in 8-bit fixed point, colours, and scores last.
Loops are split so that all but the sampling compile to vector code; constants are float32 for the same reason.
"""

import numpy as np

from orthoswarm.kernels import kernel

_EVEN = np.uint32(0x00FF00FF)
_ODD = np.uint32(0xFF00FF00)
_HALF = np.uint32(0x00800080)
_ONE = np.uint32(1)
_8 = np.uint32(8)
_FULL = np.uint32(256)
_FRACTION = np.uint32(255)


@kernel
def aim(position, rotation, corners, ground_z_m, least, west, north, gsd_m, planes, box):  # type: ignore[no-untyped-def]
    """The footprint of a picture on the canvas as half planes and a box; gives the number of half planes, 0 if none.

    The picture is clipped where its rays go down by less than `least` per unit of depth, so the footprint is finite.

    Args:
        position: float64 (3,), easting, northing, height of the camera.
        rotation: float64 (3, 3), camera to ground.
        corners: float64 (4,), x low, x high, y low, y high of a box in undistorted normalised coordinates.
        ground_z_m: height of the ground plane.
        least: smallest descent of a ray.
        west: easting of the canvas's left edge.
        north: northing of its upper edge.
        gsd_m: its ground pixel.
        planes: float64 (8, 3), set to rows a, b, c with a column + b row <= c inside, canvas pixels.
        box: float64 (4,), set to the least and greatest column, least and greatest row.
    """
    rays, kept = np.empty((4, 3)), np.empty((8, 3))
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
            kept[n] = here
            n += 1
        if (a >= 0.0) != (b >= 0.0):
            kept[n] = here + (there - here) * (a / (a - b))
            n += 1
    if n < 3:
        return 0
    height = position[2] - ground_z_m
    box[0], box[1], box[2], box[3] = np.inf, -np.inf, np.inf, -np.inf
    for i in range(n):
        scale = height / -kept[i, 2]
        column = (position[0] + kept[i, 0] * scale - west) / gsd_m - 0.5
        row = (north - position[1] - kept[i, 1] * scale) / gsd_m - 0.5
        kept[i, 0], kept[i, 1] = column, row
        box[0], box[1] = min(box[0], column), max(box[1], column)
        box[2], box[3] = min(box[2], row), max(box[3], row)
    twice = 0.0
    for i in range(n):
        j = (i + 1) % n
        twice += (kept[i, 0] - box[0]) * (kept[j, 1] - box[2]) - (kept[j, 0] - box[0]) * (kept[i, 1] - box[2])
    turn = 1.0 if twice > 0.0 else -1.0
    for i in range(n):
        j = (i + 1) % n
        planes[i, 0], planes[i, 1] = turn * (kept[j, 1] - kept[i, 1]), turn * (kept[i, 0] - kept[j, 0])
        planes[i, 2] = planes[i, 0] * kept[i, 0] + planes[i, 1] * kept[i, 1]
    return n


@kernel
def row_span(planes, centre, radius, row, first, last):  # type: ignore[no-untyped-def]
    """Columns [first, last) cut down to the pixel centres in a convex polygon and a circle, on a row.

    Args:
        planes: float64 (K, 3), a column + b row <= c inside.
        centre: float64 (2,), the circle's centre.
        radius: its radius.
        row: the row.
        first: first column.
        last: past the last column.
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


@kernel
def touches(planes, centre, radius, row0, col0, rows, columns):  # type: ignore[no-untyped-def]
    """Whether any pixel centre of a part of the canvas lies in the polygon and the circle."""
    for r in range(row0, row0 + rows):
        first, last = row_span(planes, centre, radius, r, col0, col0 + columns)
        if last > first:
            return True
    return False


@kernel
def _distort(us, vs, k1, k2, k3):  # type: ignore[no-untyped-def]
    """Apply radial distortion in place; far outside where it folds the picture over and nothing is visible."""
    one = np.float32(1.0)
    three, five, seven = np.float32(3.0) * k1, np.float32(5.0) * k2, np.float32(7.0) * k3
    for i in range(us.shape[0]):
        r2 = us[i] * us[i] + vs[i] * vs[i]
        s = one + r2 * (k1 + r2 * (k2 + r2 * k3))
        if one + r2 * (three + r2 * (five + r2 * seven)) < np.float32(0.2):
            s = np.float32(1e6)
        us[i] *= s
        vs[i] *= s


@kernel
def _blend(texels, stride, at, weight, keep, target):  # type: ignore[no-untyped-def]
    """Bilinear samples of packed pixels into a row where keep > 0; two channels at a time in 16-bit lanes.

    The four weights sum to 256, so no lane overflows.
    """
    zero = np.float32(0.0)
    for i in range(target.shape[0]):
        p = at[i]
        q = p + stride
        t00, t01, t10, t11 = texels[p], texels[p + _ONE], texels[q], texels[q + _ONE]
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


@kernel
def fuse(packed, score, row0, col0, picture, planes, centre, radius, matrix, lens, gsd_m, reals, integers):  # type: ignore[no-untyped-def]
    """Draw a picture where it sees the ground more orthogonally than what is there; gives the number of pixels won.

    Paper III.B: a pixel takes the picture with the largest 1 / ||P_oc - P||. Equal distance: what is there stays.

    Args:
        packed: uint32 (T, C), the tile's colours.
        score: float32 (T, C), 1 / squared distance in 1/m^2, 0 = empty.
        row0: the tile's first row on the canvas.
        col0: its first column.
        picture: uint32 (H, W), colours R, G, B, 255 in memory order.
        planes: float64 (K, 3), half planes of the footprint in canvas pixels.
        centre: float64 (2,), nadir point in canvas pixels (column, row).
        radius: greatest distance drawn, pixels.
        matrix: float64 (3, 3), from (column, row) about the nadir point, 1, to homogeneous undistorted normalised
            picture coordinates.
        lens: float64 (10,), k1, k2, k3, focal length in pixels, principal column and row, least and greatest column
            used, least and greatest row used (they may lie half a pixel beyond the outermost centres).
        gsd_m: ground pixel.
        reals: float32 (3, C), scratch.
        integers: uint32 (2, C), scratch.
    """
    height, width = picture.shape
    columns = packed.shape[1]
    k1, k2, k3 = np.float32(lens[0]), np.float32(lens[1]), np.float32(lens[2])
    distorted = lens[0] != 0.0 or lens[1] != 0.0 or lens[2] != 0.0
    # in 1/256 pixels, rounded
    focal, pu, pv = np.float32(256.0 * lens[3]), np.float32(256.0 * lens[4] + 0.5), np.float32(256.0 * lens[5] + 0.5)
    u_low, u_high = np.float32(256.0 * lens[6] + 0.5), np.float32(256.0 * lens[7] + 0.5)
    v_low, v_high = np.float32(256.0 * lens[8] + 0.5), np.float32(256.0 * lens[9] + 0.5)
    u_last, v_last = np.float32(256 * (width - 1) - 1), np.float32(256 * (height - 1) - 1)
    area, least = np.float32(gsd_m * gsd_m), np.float32(1e-6)
    zero, one, stride = np.float32(0.0), np.float32(1.0), np.uint32(width)
    mx, my, mw = np.float32(matrix[0, 0]), np.float32(matrix[1, 0]), np.float32(matrix[2, 0])
    texels = picture.ravel()
    won = np.int64(0)
    for r in range(packed.shape[0]):
        first, last = row_span(planes, centre, radius, row0 + r, col0, col0 + columns)
        count = last - first
        if count <= 0:
            continue
        row_score, row_packed = score[r, first - col0 : last - col0], packed[r, first - col0 : last - col0]
        new = reals[0, :count]
        dx0, dy = np.float32(first - centre[0]), np.float32(row0 + r - centre[1])
        dy2 = dy * dy
        wins = np.int32(0)
        for i in range(count):
            dx = dx0 + np.float32(i)
            new[i] = one / max((dx * dx + dy2) * area, least)
            wins += np.int32(new[i] > row_score[i])
        if wins == 0:
            continue
        skip = 0
        while new[skip] <= row_score[skip]:
            skip += 1
        while new[count - 1] <= row_score[count - 1]:
            count -= 1
        first, count = first + skip, count - skip
        row_score, row_packed, new = row_score[skip:], row_packed[skip : skip + count], new[skip:]
        us, vs, at, weight = reals[1, :count], reals[2, :count], integers[0, :count], integers[1, :count]
        east, south = first - centre[0], row0 + r - centre[1]
        x0 = np.float32(matrix[0, 0] * east + matrix[0, 1] * south + matrix[0, 2])
        y0 = np.float32(matrix[1, 0] * east + matrix[1, 1] * south + matrix[1, 2])
        w0 = np.float32(matrix[2, 0] * east + matrix[2, 1] * south + matrix[2, 2])
        for i in range(count):
            step = np.float32(i)
            inverse = one / (w0 + mw * step)
            us[i] = (x0 + mx * step) * inverse
            vs[i] = (y0 + my * step) * inverse
        if distorted:
            _distort(us, vs, k1, k2, k3)
        hits = wins - wins
        for i in range(count):
            fu, fv = us[i] * focal + pu, vs[i] * focal + pv
            inside = (fu >= u_low) & (fv >= v_low) & (fu <= u_high) & (fv <= v_high) & (new[i] > row_score[i])
            new[i] = new[i] if inside else zero
            ui, vi = np.uint32(min(max(fu, zero), u_last)), np.uint32(min(max(fv, zero), v_last))
            at[i] = (vi >> _8) * stride + (ui >> _8)
            weight[i] = (ui & _FRACTION) | ((vi & _FRACTION) << _8)
            hits += np.int32(inside)
        if hits == 0:
            continue
        won += hits
        _blend(texels, stride, at, weight, new, row_packed)
        for i in range(count):
            row_score[i] = max(row_score[i], new[i])
    return won
