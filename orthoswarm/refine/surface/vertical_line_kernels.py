"""Compiled parts of the vertical line locus: choice of pictures, rectified strips, correlation, peaks.

Cameras come as CameraBlock.arrays; `plane` is float64 (C, 3): terrain height and slope (east, north) by cell.
"""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.raster.subpixel_peak import vertex
from orthoswarm.refine.bundle.block_arrays import project_point


@in_place_kernel
def _sees(position, rotation, lens, x, y, z, half_m):  # type: ignore[no-untyped-def]
    """True where a camera sees a complete patch of this half width (its diagonal counts)."""
    u, v = project_point(position, rotation, lens, x, y, z)
    margin = 1.42 * half_m * lens[0] / max(position[2] - z, 1.0) + 1.5
    return u > margin and v > margin and u < lens[6] - 1.0 - margin and v < lens[7] - 1.0 - margin


@in_place_kernel
def choose(cameras, usable, heading, cells, plane, half_m, wished, least, ref, partner):  # type: ignore[no-untyped-def]
    """For each cell the picture nearest to nadir, and those nearest to wished places before and behind it on its leg.

    usable: int32 (K,), pictures; heading: float64 (K, 2), their legs' directions. wished: float64 (W,), signed
    distances along the leg; where it ends, pictures of other legs are nearest. least: shortest baseline. ref: int32
    (C,), partner: int32 (C, W), set where there is one.
    """
    position, rotation, lens_id, lens = cameras
    for c in range(len(cells)):
        x, y, z = cells[c, 0], cells[c, 1], plane[c, 0]
        best, r = np.inf, -1
        for k in range(len(usable)):
            i = usable[k]
            d = (position[i, 0] - x) ** 2 + (position[i, 1] - y) ** 2
            if d < best and _sees(position[i], rotation[i], lens[lens_id[i]], x, y, z, half_m):
                best, r = d, k
        if r < 0:
            continue
        ref[c] = usable[r]
        ox, oy = position[ref[c], 0], position[ref[c], 1]
        for w in range(len(wished)):
            wx, wy = ox + wished[w] * heading[r, 0], oy + wished[w] * heading[r, 1]
            nearest = np.inf
            for k in range(len(usable)):
                i = usable[k]
                px, py = position[i, 0], position[i, 1]
                d = (px - wx) ** 2 + (py - wy) ** 2
                if d >= nearest or (px - ox) ** 2 + (py - oy) ** 2 < least * least:
                    continue
                chosen = False
                for q in range(w):
                    chosen = chosen or partner[c, q] == i
                if not chosen and _sees(position[i], rotation[i], lens[lens_id[i]], x, y, z, half_m):
                    nearest, partner[c, w] = d, i


@in_place_kernel
def _on_plane(x, y, z, gx, gy, cx, cy, cz, px, py, pz, h):  # type: ignore[no-untyped-def]
    """Where a partner's (p) ray meets the plane, for the point at height h above it on the reference's (c) ray.

    The plane goes through (x, y, z) with slope (gx, gy), and the reference's ray through that point.
    """
    hc = cz - z - gx * (cx - x) - gy * (cy - y)
    t = (hc - h) / hc
    qx, qy = cx + t * (x - cx), cy + t * (y - cy)
    hp = pz - z - gx * (px - x) - gy * (py - y)
    s = hp / (hp - h)
    return px + s * (qx - px), py + s * (qy - py)


@kernel
def _rectify(image, factor, position, rotation, lens, x, y, plane, ex, ey, step, half_u, half_v, out):  # type: ignore[no-untyped-def]
    """Sample a picture on a plane: out[j, i] at (i - half_u) step along e and (j - half_v) step across it, NaN outside.

    Nine projections and biquadratic interpolation between them: exact to 0.01 px over such small windows.
    """
    rows, columns = int(lens[7] / factor), int(lens[6] / factor)
    u, v = np.empty((3, 3)), np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            s, t = (b - 1) * half_u * step, (a - 1) * half_v * step
            px, py = s * ex - t * ey, s * ey + t * ex
            pu, pv = project_point(position, rotation, lens, x + px, y + py, plane[0] + plane[1] * px + plane[2] * py)
            u[a, b], v[a, b] = (pu + 0.5) / factor - 0.5, (pv + 0.5) / factor - 0.5
    for j in range(2 * half_v + 1):
        t = (j - half_v) / half_v
        c0, c1, c2 = 0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)
        ul, vl = c0 * u[0, 0] + c1 * u[1, 0] + c2 * u[2, 0], c0 * v[0, 0] + c1 * v[1, 0] + c2 * v[2, 0]
        um, vm = c0 * u[0, 1] + c1 * u[1, 1] + c2 * u[2, 1], c0 * v[0, 1] + c1 * v[1, 1] + c2 * v[2, 1]
        ur, vr = c0 * u[0, 2] + c1 * u[1, 2] + c2 * u[2, 2], c0 * v[0, 2] + c1 * v[1, 2] + c2 * v[2, 2]
        ua, ub, va, vb = 0.5 * (ur - ul), 0.5 * (ur + ul) - um, 0.5 * (vr - vl), 0.5 * (vr + vl) - vm
        for i in range(2 * half_u + 1):
            s = (i - half_u) / half_u
            uu, vv = um + s * (ua + s * ub), vm + s * (va + s * vb)
            if not (uu >= 0.0 and vv >= 0.0 and uu < columns - 1.0 and vv < rows - 1.0):
                out[j, i] = np.nan
                continue
            iu, iv = int(uu), int(vv)
            fu, fv = np.float32(uu - iu), np.float32(vv - iv)
            p, q = np.float32(image[iv, iu]), np.float32(image[iv, iu + 1])
            c, d = np.float32(image[iv + 1, iu]), np.float32(image[iv + 1, iu + 1])
            low = p + fu * (q - p)
            out[j, i] = low + fv * (c + fu * (d - c) - low)


@in_place_kernel
def _zncc_along(patch, strip, least_variance, score):  # type: ignore[no-untyped-def]
    """Normalised correlation of a square patch with every place in a strip; NaN where either has no data."""
    n = len(patch)
    count = np.float32(n * n)
    mean = np.float32(patch.sum()) / count
    energy = np.float32(0.0)
    for j in range(n):
        for i in range(n):
            patch[j, i] -= mean
            energy += patch[j, i] * patch[j, i]
    score[:] = np.nan
    if not energy >= least_variance * count:
        return
    for k in range(len(score)):
        dot, total, square = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for j in range(n):
            for i in range(n):
                q = strip[j, k + i] - mean
                dot += patch[j, i] * q
                total += q
                square += q * q
        score[k] = dot / np.sqrt(energy * max(square - total * total / count, count))


@kernel
def _pair(cameras, pictures, x, y, plane, r, p, heights, half, step, least_variance, total, seen):  # type: ignore[no-untyped-def]
    """Add one partner's correlation at each height to `total`, and count it in `seen`."""
    position, rotation, lens_id, lens = cameras
    stack, slot, factor = pictures
    n, top = 2 * half + 1, heights[-1]
    cx, cy, cz = position[r]
    px, py, pz = position[p]
    z, gx, gy = plane
    lowest = min(cz - gx * (cx - x) - gy * (cy - y), pz - gx * (px - x) - gy * (py - y)) - z
    if lowest < 1.5 * top:  # the sweep would reach the cameras' height
        return
    ax, ay = _on_plane(x, y, z, gx, gy, cx, cy, cz, px, py, pz, -top)
    bx, by = _on_plane(x, y, z, gx, gy, cx, cy, cz, px, py, pz, top)
    length = np.sqrt((bx - ax) ** 2 + (by - ay) ** 2)
    if not length > 2.0 * step:  # no parallax
        return
    ex, ey = (bx - ax) / length, (by - ay) / length
    low, high = (ax - x) * ex + (ay - y) * ey, (bx - x) * ex + (by - y) * ey
    reach = int(max(-low, high) / step) + 3
    half_u = half + reach
    patch, strip = np.empty((n, n), np.float32), np.empty((n, 2 * half_u + 1), np.float32)
    _rectify(
        stack[slot[r]], factor, position[r], rotation[r], lens[lens_id[r]], x, y, plane, ex, ey, step, half, half, patch
    )  # fmt: skip
    _rectify(
        stack[slot[p]], factor, position[p], rotation[p], lens[lens_id[p]], x, y, plane, ex, ey, step, half_u, half,
        strip,
    )  # fmt: skip
    score = np.empty(2 * reach + 1, np.float32)
    _zncc_along(patch, strip, least_variance, score)
    for h in range(len(heights)):
        qx, qy = _on_plane(x, y, z, gx, gy, cx, cy, cz, px, py, pz, heights[h])
        s = ((qx - x) * ex + (qy - y) * ey) / step + reach
        i = int(s)
        if i < 1 or i + 2 > 2 * reach:
            continue
        f, s0, s1, s2, s3 = s - i, score[i - 1], score[i], score[i + 1], score[i + 2]
        value = s1 + 0.5 * f * (  # Catmull-Rom: linear interpolation would pull peaks to the samples
            s2 - s0 + f * (2.0 * s0 - 5.0 * s1 + 4.0 * s2 - s3 + f * (3.0 * (s1 - s2) + s3 - s0))
        )
        if not np.isnan(value):
            total[h] += value
            seen[h] += 1


@kernel
def correlate(cameras, pictures, cells, plane, ref, partner, heights, half, step, least_variance, curve):  # type: ignore[no-untyped-def]
    """Mean normalised correlation over partners for each cell and height; NaN with fewer than two partners.

    pictures: uint8 (slots, rows, columns) those in memory, each camera's slot, and by how much they are reduced.
    """
    total, seen = np.empty(len(heights)), np.empty(len(heights), np.int64)
    for c in range(len(cells)):
        total[:], seen[:] = 0.0, 0
        for k in range(partner.shape[1]):
            if partner[c, k] >= 0:
                _pair(
                    cameras, pictures, cells[c, 0], cells[c, 1], plane[c], ref[c], partner[c, k], heights, half, step,
                    least_variance, total, seen,
                )  # fmt: skip
        for h in range(len(heights)):
            curve[c, h] = total[h] / seen[h] if seen[h] >= 2 else np.nan


@in_place_kernel
def peaks(curve, heights, rival_m, rival_share, found):  # type: ignore[no-untyped-def]
    """Height and score of each curve's peak; score -1 if it lies at an end or if another peak is about as high.

    Also -1 for a curve with gaps in the inner half of the heights, where the true peak may be.
    """
    step = heights[1] - heights[0]
    for c in range(len(curve)):
        best, at = -2.0, -1
        for h in range(len(heights)):
            if curve[c, h] > best:
                best, at = curve[c, h], h
        found[c, 0], found[c, 1] = 0.0, -1.0
        if at < 1 or at > len(heights) - 2:
            continue
        left, right = curve[c, at - 1], curve[c, at + 1]
        if np.isnan(left) or np.isnan(right):
            continue
        ambiguous = False
        for h in range(len(heights)):
            if np.isnan(curve[c, h]) and 2.0 * abs(heights[h]) <= heights[-1]:
                ambiguous = True
            if abs(heights[h] - heights[at]) > rival_m and curve[c, h] > rival_share * best:
                ambiguous = True
        if not ambiguous and left + right < 2.0 * best:
            found[c, 0] = heights[at] + step * vertex(left, best, right)
            found[c, 1] = best


@in_place_kernel
def raise_points(position, ref, cells, plane, height, points):  # type: ignore[no-untyped-def]
    """Points at heights above the cells' planes, on the reference cameras' rays through the cells."""
    for m in range(len(cells)):
        cx, cy, cz = position[ref[m]]
        x, y, z, gx, gy = cells[m, 0], cells[m, 1], plane[m, 0], plane[m, 1], plane[m, 2]
        above = cz - z - gx * (cx - x) - gy * (cy - y)
        t = (above - height[m]) / above
        points[m, 0], points[m, 1], points[m, 2] = cx + t * (x - cx), cy + t * (y - cy), cz + t * (z - cz)
