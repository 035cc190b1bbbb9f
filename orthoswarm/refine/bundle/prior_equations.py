"""The records' part of the normal equations: priors of lenses, attitudes, positions, biases, lag and drift."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array, Flags, Ints
from orthoswarm.refine.bundle.banded_solver import BandedSystem
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.bundle.priors import Layout, Priors
from orthoswarm.refine.bundle.robust_kernel import robust_weights
from orthoswarm.refine.bundle.rotation_vectors import log_rotation

_HELD = 1e18
"""Weight of an unknown that is held."""

_ATTITUDE_ROBUST_C: Final = 25.0  # robust scale of recorded attitudes, squared sigmas: wider than that of positions


def add_priors(
    system: BandedSystem,
    cameras: CameraBlock,
    priors: Priors,
    layout: Layout,
    *,
    common: Array,
    free: Flags,
    slot: Ints,
) -> None:
    """Add all priors to the normal equations, in place.

    Args:
        system: of the free cameras. cameras, priors, layout: of all N.
        common: float64 (layout.size,), values of the common unknowns. free: bool (N,). slot: int32 (N,).
    """
    weight = np.where(priors.lens_sigma > 0, 1.0 / np.maximum(priors.lens_sigma, 1e-12) ** 2, _HELD).ravel()
    diagonal = np.arange(layout.lens_columns)
    system.corner[diagonal, diagonal] += weight
    system.rhs_common[: layout.lens_columns] -= weight * common[: layout.lens_columns]
    index = np.flatnonzero(free)
    _add_attitudes(system, cameras, priors, layout=layout, common=common, index=index, at=6 * slot[index])
    residual = position_residuals(cameras, priors, layout, common)[index]
    _add_positions(system, priors, layout, residual=residual, index=index, at=6 * slot[index])
    for g, model in enumerate(priors.models):
        o, k = layout.offset[g], layout.knots[g]
        sigma = np.array([*model.bias_sigma, model.height_sigma, model.lag_sigma])
        weight = np.where(sigma > 0, 1.0 / np.maximum(sigma, 1e-9) ** 2, _HELD)
        d = np.arange(o, o + 5)
        system.corner[d, d] += weight
        system.rhs_common[d] -= weight * common[d]
        if k:
            _add_drift(system, common, o + 5, knots=k, sigma=model.drift_sigma, bend=model.drift_bend)


def position_residuals(cameras: CameraBlock, priors: Priors, layout: Layout, common: Array) -> Array:
    """Positions minus records, with drift, lag and height offset taken off, metres (N, 3)."""
    base = np.asarray(layout.offset)[priors.group]
    out = cameras.position - priors.position
    out[:, :2] -= layout.drift(common, priors.group) + common[base + 4][:, None] * priors.velocity
    out[:, 2] -= common[base + 3]
    return np.asarray(out)


def bias_axes(rotation: Array) -> Array:
    """Axes of a group's attitude bias in each camera's frame, float64 (N, 3, 3), one in each column.

    The camera's x and y (how it is mounted), and the vertical (a compass error turns the heading, however far the
    camera leans). For a camera that looks straight down the vertical is its z axis.

    Args:
        rotation: float64 (N, 3, 3), recorded attitudes, camera to ground.
    """
    axes = np.tile(np.eye(3), (len(rotation), 1, 1))
    axes[:, :, 2] = -rotation[:, 2]
    return axes


def _add_attitudes(
    system: BandedSystem,
    cameras: CameraBlock,
    priors: Priors,
    *,
    layout: Layout,
    common: Array,
    index: NDArray[np.intp],
    at: Ints,
) -> None:
    """Attitude priors: rotation vector from recorded to solved attitude, minus the bias.

    `at`: first row of each free camera.
    """
    base = np.asarray(layout.offset)[priors.group[index]]
    recorded = priors.rotation[index]
    axes = bias_axes(recorded)
    bias = np.einsum("nab,nb->na", axes, common[base[:, None] + np.arange(3)])
    r = log_rotation(np.swapaxes(recorded, 1, 2) @ cameras.rotation[index]) - bias
    w = _weights(priors.rotation_sigma[index])
    e2 = (r * r * w).sum(1)
    w = w * robust_weights(e2, _ATTITUDE_ROBUST_C)[:, None]
    for a in range(3):
        system.band[0, at + 3 + a] += w[:, a]
        system.rhs[at + 3 + a] -= w[:, a] * r[:, a]
        for b in range(3):
            system.side[at + 3 + a, base + b] -= w[:, a] * axes[:, a, b]
            np.add.at(system.rhs_common, base + b, w[:, a] * axes[:, a, b] * r[:, a])
            for d in range(3):
                np.add.at(system.corner, (base + b, base + d), w[:, a] * axes[:, a, b] * axes[:, a, d])


def _add_positions(
    system: BandedSystem, priors: Priors, layout: Layout, *, residual: Array, index: NDArray[np.intp], at: Ints
) -> None:
    """Position priors: recorded positions with lag and drift, heights with their offset."""
    base = np.asarray(layout.offset)[priors.group[index]]
    knots = np.asarray(layout.knots)[priors.group[index]]
    xy, rz = residual[:, :2], residual[:, 2]
    w = _weights(priors.position_sigma[index])
    e2 = (xy * xy * w[:, :2]).sum(1)
    robust = robust_weights(e2, priors.position_c)
    w[:, :2] *= robust[:, None]
    left = layout.knot_left[index]
    fraction = layout.knot_fraction[index]
    for a in range(2):
        wa, ra = w[:, a], xy[:, a]
        columns = [base + 4]
        factors = [-priors.velocity[index, a]]
        has = knots > 0
        columns += [base + 5 + 2 * left + a, base + 5 + 2 * (left + 1) + a]
        factors += [np.where(has, fraction - 1.0, 0.0), np.where(has, -fraction, 0.0)]
        columns = [np.where(has, c, base + 4) if n else c for n, c in enumerate(columns)]
        system.band[0, at + a] += wa
        system.rhs[at + a] -= wa * ra
        for c, f in zip(columns, factors):
            system.side[at + a, c] += wa * f
            np.add.at(system.rhs_common, c, -wa * f * ra)
            for c2, f2 in zip(columns, factors):
                np.add.at(system.corner, (c, c2), wa * f * f2)
    wz = w[:, 2]
    system.band[0, at + 2] += wz
    system.rhs[at + 2] -= wz * rz
    system.side[at + 2, base + 3] -= wz
    np.add.at(system.corner, (base + 3, base + 3), wz)
    np.add.at(system.rhs_common, base + 3, wz * rz)


def _weights(sigma: Array) -> Array:
    return np.where(np.isfinite(sigma), 1.0 / np.maximum(sigma, 1e-9) ** 2, 0.0)


def _add_drift(system: BandedSystem, common: Array, at: int, *, knots: int, sigma: float, bend: float) -> None:
    """Drift priors: knots are near zero (sigma) and their second differences small (sigma `bend`)."""
    precision = np.eye(knots) / sigma**2
    if knots > 2:
        second = np.diff(np.eye(knots), 2, axis=0)
        precision += second.T @ second / bend**2
    for a in range(2):
        c = at + 2 * np.arange(knots) + a
        system.corner[np.ix_(c, c)] += precision
        system.rhs_common[c] -= precision @ common[c]
