"""Compiled parts of the bundle adjustment: linearised observations, elimination of the points, back substitution.

Unknowns of a camera are 3 of position and 3 of rotation (R <- R Exp(omega), camera frame); of a lens 6:
log f, k1, k2, k3, cx, cy. Points are eliminated one by one (Schur complement); cameras whose slot is -1 are held.
The camera system is stored as LAPACK's lower band (row = distance from the diagonal), the lens part as dense columns.
"""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.compute.robust_kernel import robust_weight
from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import LEAST_RADIAL_SLOPE


@in_place_kernel
def linearise(position, rotation, lens, x, y, z, u, v, r, jc, jp, jl):  # type: ignore[no-untyped-def]
    """Residual (2,), px, and Jacobians by camera (2, 6), point (2, 3), lens (2, 6); False where it is not visible."""
    ax, ay, az = x - position[0], y - position[1], z - position[2]
    dx = rotation[0, 0] * ax + rotation[1, 0] * ay + rotation[2, 0] * az
    dy = rotation[0, 1] * ax + rotation[1, 1] * ay + rotation[2, 1] * az
    dz = rotation[0, 2] * ax + rotation[1, 2] * ay + rotation[2, 2] * az
    if dz < 1e-3:
        return False
    f, k1, k2, k3 = lens[0], lens[1], lens[2], lens[3]
    px, py = dx / dz, dy / dz
    r2 = px * px + py * py
    if 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3)) < LEAST_RADIAL_SLOPE:
        return False
    s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    ds = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    r[0] = u - (f * s * px + 0.5 * (lens[6] - 1.0) + lens[4])
    r[1] = v - (f * s * py + 0.5 * (lens[7] - 1.0) + lens[5])
    uxx, uxy, uyy = f * (s + 2.0 * px * px * ds), f * 2.0 * px * py * ds, f * (s + 2.0 * py * py * ds)
    iz = 1.0 / dz
    # derivative by the point in camera axes
    a0, a1, a2 = uxx * iz, uxy * iz, -(uxx * px + uxy * py) * iz
    b0, b1, b2 = uxy * iz, uyy * iz, -(uxy * px + uyy * py) * iz
    for k in range(3):
        jp[0, k] = a0 * rotation[k, 0] + a1 * rotation[k, 1] + a2 * rotation[k, 2]
        jp[1, k] = b0 * rotation[k, 0] + b1 * rotation[k, 1] + b2 * rotation[k, 2]
        jc[0, k] = -jp[0, k]
        jc[1, k] = -jp[1, k]
    # d(R^T a)/d(omega) = [d]x
    jc[0, 3], jc[0, 4], jc[0, 5] = a1 * dz - a2 * dy, a2 * dx - a0 * dz, a0 * dy - a1 * dx
    jc[1, 3], jc[1, 4], jc[1, 5] = b1 * dz - b2 * dy, b2 * dx - b0 * dz, b0 * dy - b1 * dx
    for k, p in ((0, px), (1, py)):
        jl[k, 0] = f * s * p
        jl[k, 1] = f * p * r2
        jl[k, 2] = f * p * r2 * r2
        jl[k, 3] = f * p * r2 * r2 * r2
        jl[k, 4] = 1.0 if k == 0 else 0.0
        jl[k, 5] = 1.0 if k == 1 else 0.0
    return True


@in_place_kernel
def invert3(a, out):  # type: ignore[no-untyped-def]
    """Inverse of a symmetric positive 3x3 matrix; returns False (and zeros) where it is singular."""
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    det = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    if not det > 1e-30:
        out[:] = 0.0
        return False
    out[0, 0], out[0, 1], out[0, 2] = c00 / det, c01 / det, c02 / det
    out[1, 1] = (a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2]) / det
    out[1, 2] = (a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]) / det
    out[2, 2] = (a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]) / det
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return True


@in_place_kernel
def _subtract_block(band, row, column, left, right):  # type: ignore[no-untyped-def]
    """Subtract left (6, 3) times the transpose of right (6, 3) from a block below the diagonal of a lower band."""
    for q in range(6):
        r0, r1, r2 = right[q, 0], right[q, 1], right[q, 2]
        to = band[row - column - q : row - column - q + 6, column + q]
        for a in range(6):
            to[a] -= left[a, 0] * r0 + left[a, 1] * r1 + left[a, 2] * r2


@in_place_kernel
def _subtract_own_block(band, row, left, right, both):  # type: ignore[no-untyped-def]
    """As `_subtract_block`, on the diagonal; both: also the transpose, for another observation by the camera."""
    for a in range(6):
        for q in range(6):
            value = left[a, 0] * right[q, 0] + left[a, 1] * right[q, 1] + left[a, 2] * right[q, 2]
            if a >= q:
                band[a - q, row + q] -= value
            if both and q >= a:
                band[q - a, row + a] -= value


def room_of_a_point() -> tuple[Array, ...]:
    """Room for a residual, its three Jacobians, and a point's normal matrix, right side and product with it."""
    return tuple(np.zeros(shape) for shape in (2, (2, 6), (2, 3), (2, 6), (3, 3), 3, (6, 3)))


@in_place_kernel
def build(cameras, points, observations, slot, c, heights, ties, system, substitution, obs_weight, tie_residual, room):  # type: ignore[no-untyped-def]
    """Accumulate the reduced normal equations of all points.

    Args (P points, M observations sorted by point, N cameras, n free ones, L lenses):
        cameras: CameraBlock.arrays. points: (P, 3).
        observations: start (P + 1,), each point's first one; camera (M,); uv (M, 2); weight (M,), 1 / sigma^2.
        slot: (N,) place of a free camera in the band, -1 if held. c: robust scale of reprojection.
        heights: prior on Z: expected (P,), weight, robust scale, and a weight that is not robust.
        ties: to the map, (X, Y) = xy, height free: (P,) row of a point's tie or -1; xy (Q, 2); weight (Q,); robust
            scale.
        system: band (6 (bandwidth + 1), 6 n), lower; side (6 n, 6 L); corner (6 L, 6 L); rhs (6 n,); rhs of the lenses.
        substitution: w_obs (M, 6, 3), w_lens (P, L, 6, 3), v_inverse (P, 3, 3), b_point (P, 3).
        obs_weight: (M,) robust weights (0 where invisible). tie_residual: (Q, 2). room: see `room_of_a_point`.
    """
    position, rotation, lens_id, lens = cameras
    start, camera, uv, weight = observations
    height, height_weight, height_c, height_soft = heights
    tie_point, tie_xy, tie_weight, tie_c = ties
    band, side, corner, rhs, rhs_lens = system
    w_obs, w_lens, v_inverse, b_point = substitution
    r, jc, jp, jl, v, b, wv = room
    lenses = lens.shape[0]
    for p in range(len(points)):
        v[:] = 0.0
        b[:] = 0.0
        for li in range(lenses):
            w_lens[p, li] = 0.0
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        for m in range(start[p], start[p + 1]):
            i = camera[m]
            li = lens_id[i]
            w_obs[m] = 0.0
            obs_weight[m] = 0.0
            if not linearise(position[i], rotation[i], lens[li], x, y, z, uv[m, 0], uv[m, 1], r, jc, jp, jl):
                continue
            obs_weight[m] = robust_weight((r[0] * r[0] + r[1] * r[1]) * weight[m], c, 1.0)
            w = obs_weight[m] * weight[m]
            s = slot[i]
            for a in range(3):
                b[a] += w * (jp[0, a] * r[0] + jp[1, a] * r[1])
                for q in range(3):
                    v[a, q] += w * (jp[0, a] * jp[0, q] + jp[1, a] * jp[1, q])
                for q in range(6):
                    w_lens[p, li, q, a] += w * (jl[0, q] * jp[0, a] + jl[1, q] * jp[1, a])
            for a in range(6):
                rhs_lens[6 * li + a] += w * (jl[0, a] * r[0] + jl[1, a] * r[1])
                for q in range(6):
                    corner[6 * li + a, 6 * li + q] += w * (jl[0, a] * jl[0, q] + jl[1, a] * jl[1, q])
            if s >= 0:
                for a in range(6):
                    rhs[6 * s + a] += w * (jc[0, a] * r[0] + jc[1, a] * r[1])
                    for q in range(a + 1):
                        band[a - q, 6 * s + q] += w * (jc[0, a] * jc[0, q] + jc[1, a] * jc[1, q])
                    for q in range(6):
                        side[6 * s + a, 6 * li + q] += w * (jc[0, a] * jl[0, q] + jc[1, a] * jl[1, q])
                    for q in range(3):
                        w_obs[m, a, q] = w * (jc[0, a] * jp[0, q] + jc[1, a] * jp[1, q])
        e = height[p] - z
        hw = height_weight * robust_weight(e * e * height_weight, height_c, 1.0) + height_soft
        v[2, 2] += hw
        b[2] += hw * e
        t = tie_point[p]
        if t >= 0:
            ex = tie_xy[t, 0] - x
            ey = tie_xy[t, 1] - y
            tie_residual[t, 0], tie_residual[t, 1] = ex, ey
            tw = tie_weight[t] * robust_weight((ex * ex + ey * ey) * tie_weight[t], tie_c, 1.0)
            v[0, 0] += tw
            v[1, 1] += tw
            b[0] += tw * ex
            b[1] += tw * ey
        for a in range(3):
            v[a, a] += 1e-9
            b_point[p, a] = b[a]
        if not invert3(v, v_inverse[p]):
            continue
        vi = v_inverse[p]
        # eliminate: S -= W V^-1 W^T, rhs -= W V^-1 b
        for m in range(start[p], start[p + 1]):
            s = slot[camera[m]]
            if s < 0 or obs_weight[m] == 0.0:
                continue
            for a in range(6):
                for q in range(3):
                    wv[a, q] = w_obs[m, a, 0] * vi[0, q] + w_obs[m, a, 1] * vi[1, q] + w_obs[m, a, 2] * vi[2, q]
                rhs[6 * s + a] -= wv[a, 0] * b[0] + wv[a, 1] * b[1] + wv[a, 2] * b[2]
            for li in range(lenses):
                for a in range(6):
                    for q in range(6):
                        side[6 * s + a, 6 * li + q] -= (
                            wv[a, 0] * w_lens[p, li, q, 0]
                            + wv[a, 1] * w_lens[p, li, q, 1]
                            + wv[a, 2] * w_lens[p, li, q, 2]
                        )
            for n in range(start[p], start[p + 1]):
                o = slot[camera[n]]
                if o < 0 or o > s or obs_weight[n] == 0.0:
                    continue
                if o < s:
                    _subtract_block(band, 6 * s, 6 * o, wv, w_obs[n])
                elif n <= m:
                    _subtract_own_block(band, 6 * s, wv, w_obs[n], n != m)
        for li in range(lenses):
            for a in range(6):
                t0 = t1 = t2 = 0.0
                for q in range(3):
                    t0 += w_lens[p, li, a, q] * vi[q, 0]
                    t1 += w_lens[p, li, a, q] * vi[q, 1]
                    t2 += w_lens[p, li, a, q] * vi[q, 2]
                rhs_lens[6 * li + a] -= t0 * b[0] + t1 * b[1] + t2 * b[2]
                for lj in range(lenses):
                    for q in range(6):
                        corner[6 * li + a, 6 * lj + q] -= (
                            t0 * w_lens[p, lj, q, 0] + t1 * w_lens[p, lj, q, 1] + t2 * w_lens[p, lj, q, 2]
                        )


@in_place_kernel
def back_substitute(points, observations, substitution, step_camera, step_lens, limit):  # type: ignore[no-untyped-def]
    """Move the points (P, 3) in place by V^-1 (b - W^T step), a step no longer than `limit` metres; see `build`."""
    start, camera, slot = observations
    w_obs, w_lens, v_inverse, b_point = substitution
    lenses = w_lens.shape[1]
    for p in range(len(points)):
        b0, b1, b2 = b_point[p, 0], b_point[p, 1], b_point[p, 2]
        for m in range(start[p], start[p + 1]):
            s = slot[camera[m]]
            if s < 0:
                continue
            for a in range(6):
                d = step_camera[6 * s + a]
                b0 -= w_obs[m, a, 0] * d
                b1 -= w_obs[m, a, 1] * d
                b2 -= w_obs[m, a, 2] * d
        for li in range(lenses):
            for a in range(6):
                d = step_lens[6 * li + a]
                b0 -= w_lens[p, li, a, 0] * d
                b1 -= w_lens[p, li, a, 1] * d
                b2 -= w_lens[p, li, a, 2] * d
        vi = v_inverse[p]
        d0 = vi[0, 0] * b0 + vi[0, 1] * b1 + vi[0, 2] * b2
        d1 = vi[1, 0] * b0 + vi[1, 1] * b1 + vi[1, 2] * b2
        d2 = vi[2, 0] * b0 + vi[2, 1] * b1 + vi[2, 2] * b2
        length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        q = 1.0 if length <= limit else limit / length
        points[p, 0] += q * d0
        points[p, 1] += q * d1
        points[p, 2] += q * d2


@kernel
def residuals(cameras, points, point, camera, uv, out):  # type: ignore[no-untyped-def]
    """Residuals (M, 2) in pixels of all observations (NaN where invisible)."""
    position, rotation, lens_id, lens = cameras
    r, jc, jp, jl = np.zeros(2), np.zeros((2, 6)), np.zeros((2, 3)), np.zeros((2, 6))
    for m in range(len(point)):
        i, x = camera[m], points[point[m]]
        own = lens[lens_id[i]]
        if linearise(position[i], rotation[i], own, x[0], x[1], x[2], uv[m, 0], uv[m, 1], r, jc, jp, jl):
            out[m] = r
        else:
            out[m] = np.nan
