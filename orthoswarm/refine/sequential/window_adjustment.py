"""Compiled adjustment of a window of a dozen pictures: the equations of `refine.bundle`, solved densely in one call.

Unknowns are the pictures' poses and the points; the lens is known. The general adjustment does the same for any number
of pictures, and spends more time on setting itself up than this takes in all.
"""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.compute.robust_kernel import robust_weight
from orthoswarm.refine.bundle.adjustment import POINT_STEP_LIMIT_M
from orthoswarm.refine.bundle.normal_equations import back_substitute, build
from orthoswarm.refine.bundle.priors import POSITION_ROBUST_C


@kernel
def adjust_window(cameras, points, observations, slot, scales, heights, ties, priors, rooms, out):  # type: ignore[no-untyped-def]
    """Take Gauss-Newton steps, in place.

    Args (N pictures, all free, with one lens; P points; M observations sorted by point):
        cameras, points, observations, slot, heights, ties: as for `normal_equations.build`.
        scales: float64 (S,), robust scale of each step's reprojection residuals, squared sigmas.
        priors: position (N, 3), its weights (N, 3); rotation (N, 3, 3), its weights (N, 3) about the camera's axes.
        rooms: see `room_of_a_point`.
        out: weights (M,) of the observations, residuals (Q, 2) of the ties, covariance (6, 6) of the newest picture's
            position and rotation; all of the last step.

    Returns:
        False where the equations cannot be solved.
    """
    position, rotation = cameras[0], cameras[1]
    obs_weight, tie_residual, covariance = out
    n = 6 * len(slot)
    band, matrix, rhs = np.zeros((n, n)).T, np.zeros((n, n)), np.zeros(n)  # LAPACK's order, as `build` is compiled for
    side, corner, rhs_lens, step_lens = np.zeros((n, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    w_obs, w_lens = np.zeros((len(obs_weight), 6, 3)), np.zeros((len(points), 1, 6, 3))
    v_inverse, b_point = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    for c in scales:
        band[:] = 0.0
        rhs[:] = 0.0
        build(
            cameras, points, observations, slot, c, heights, ties, (band, side, corner, rhs, rhs_lens),
            (w_obs, w_lens, v_inverse, b_point), obs_weight, tie_residual, rooms,
        )  # fmt: skip
        for i in range(len(slot)):
            _add_record(
                position[i], rotation[i], priors[0][i], priors[1][i], priors[2][i], priors[3][i], band, rhs, 6 * i
            )
        if not _factorise(band, matrix):
            return False
        _solve(matrix, rhs)
        for i in range(len(slot)):
            _move(position[i], rotation[i], rhs[6 * i : 6 * i + 6])
        back_substitute(
            points, (observations[0], observations[1], slot), (w_obs, w_lens, v_inverse, b_point), rhs, step_lens,
            POINT_STEP_LIMIT_M,
        )  # fmt: skip
    unit = np.zeros(n)
    for k in range(6):
        unit[:] = 0.0
        unit[n - 6 + k] = 1.0
        _solve(matrix, unit)
        covariance[k] = unit[n - 6 :]
    return True


@in_place_kernel
def _add_record(position, rotation, place, place_weight, attitude, attitude_weight, band, rhs, at):  # type: ignore[no-untyped-def]
    """Add a picture's record to the diagonal of a lower band and the right side."""
    e2 = 0.0
    for a in range(2):
        e2 += (position[a] - place[a]) ** 2 * place_weight[a]
    robust = robust_weight(e2, POSITION_ROBUST_C, 1.0)
    for a in range(3):
        weight = place_weight[a] * (robust if a < 2 else 1.0)
        band[0, at + a] += weight
        rhs[at + a] -= weight * (position[a] - place[a])
        # the rotation vector from the record to the present attitude, to first order: both are near each other
        b, c = (a + 1) % 3, (a + 2) % 3
        turn = 0.0
        for k in range(3):
            turn += 0.5 * (attitude[k, c] * rotation[k, b] - attitude[k, b] * rotation[k, c])
        band[0, at + 3 + a] += attitude_weight[a]
        rhs[at + 3 + a] -= attitude_weight[a] * turn


@in_place_kernel
def _factorise(band, matrix):  # type: ignore[no-untyped-def]
    """Cholesky factor, the lower triangle of `matrix`, of a symmetric lower band of full width; False if singular."""
    n = len(matrix)
    for r in range(n):
        for c in range(r + 1):
            total = band[r - c, c]
            for k in range(c):
                total -= matrix[r, k] * matrix[c, k]
            if r == c:
                if not total > 0.0:
                    return False
                matrix[r, r] = np.sqrt(total)
            else:
                matrix[r, c] = total / matrix[c, c]
    return True


@in_place_kernel
def _solve(factor, right):  # type: ignore[no-untyped-def]
    """Solve with a Cholesky factor, in place."""
    n = len(right)
    for r in range(n):
        for k in range(r):
            right[r] -= factor[r, k] * right[k]
        right[r] /= factor[r, r]
    for r in range(n - 1, -1, -1):
        right[r] /= factor[r, r]
        for k in range(r):
            right[k] -= factor[r, k] * right[r]


@in_place_kernel
def _move(position, rotation, step):  # type: ignore[no-untyped-def]
    """Move a camera (3,), (3, 3) by metres and by a rotation vector about its own axes, in place."""
    for a in range(3):
        position[a] += step[a]
    x, y, z = step[3], step[4], step[5]
    angle = np.sqrt(x * x + y * y + z * z)
    s = 1.0 if angle < 1e-8 else np.sin(angle) / angle
    q = 0.5 if angle < 1e-4 else (1.0 - np.cos(angle)) / (angle * angle)
    for k in range(3):
        a, b, c = rotation[k, 0], rotation[k, 1], rotation[k, 2]
        # row times (1 + s [w]x + q [w]x^2), where v [w]x^2 = (v.w) w - (w.w) v
        dot = q * (a * x + b * y + c * z)
        keep = 1.0 - q * angle * angle
        rotation[k, 0] = keep * a + s * (b * z - c * y) + dot * x
        rotation[k, 1] = keep * b + s * (c * x - a * z) + dot * y
        rotation[k, 2] = keep * c + s * (a * y - b * x) + dot * z
