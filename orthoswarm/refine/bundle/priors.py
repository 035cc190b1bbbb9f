"""Priors of the bundle adjustment and their equations: lenses, recorded poses with sigmas, biases, lag, drift."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.robust_kernel import robust_weights
from orthoswarm.model.arrays import Array, Flags, Ints
from orthoswarm.refine.bundle.banded_solver import BandedSystem
from orthoswarm.refine.bundle.block_arrays import CameraBlock, log_rotation

POSITION_ROBUST_C: Final = 9.0  # robust scale of recorded horizontal positions, squared sigmas
ATTITUDE_BIAS_SIGMA_DEG: Final = (1.0, 1.0, 3.0)
"""Sigma of a sortie's common attitude error about the camera's x, y, z axes: mounting, gimbal, compass. Biases of
made-up flights were found to 0.1 degrees with it."""
HEIGHT_OFFSET_SIGMA_M: Final = 1.0  # sigma of a sortie's common offset of recorded heights
DRIFT_SIGMA_M: Final = 15.0  # drift of a receiver without corrections (made-up flights: up to 10 m)
_DRIFT_BEND_SIGMA_M: Final = 0.5  # sigma of the second difference of the drift's knots: it changes slowly
_DRIFT_KNOT_PHOTOS: Final = 60  # photos between two knots of the piecewise linear drift
LAG_SIGMA_S: Final = 0.5  # sigma of the delay of recorded positions behind the shutter (lags of up to 0.4 s are found)
_HELD = 1e18  # weight of an unknown that is held

_ATTITUDE_ROBUST_C: Final = 25.0  # robust scale of recorded attitudes, squared sigmas: wider than that of positions


@dataclass(frozen=True, slots=True, kw_only=True)
class GroupPriors:
    """Sigmas of the errors common to all frames of a group (a vehicle's sortie); SI units and radians.

    bias_sigma: attitude bias about the camera's x, y, z axes. height_sigma: common offset of recorded heights.
    lag_sigma: delay of the recorded position; drift_sigma: size of the receiver's drift (0 switches them off).
    drift_bend: second difference of the drift's knots; knot_every: frames between knots.
    """

    bias_sigma: tuple[float, float, float] = tuple(np.radians(ATTITUDE_BIAS_SIGMA_DEG))
    height_sigma: float = HEIGHT_OFFSET_SIGMA_M
    lag_sigma: float = LAG_SIGMA_S
    drift_sigma: float = DRIFT_SIGMA_M
    drift_bend: float = _DRIFT_BEND_SIGMA_M
    knot_every: int = _DRIFT_KNOT_PHOTOS


@dataclass(frozen=True, slots=True, kw_only=True)
class Priors:
    """Records of N cameras in G groups, and of L lenses.

    Attributes:
        position: float64 (N, 3), recorded position in the block's frame (heights already shifted to its level).
        position_sigma: float64 (N, 3), infinite where unknown.
        rotation: float64 (N, 3, 3), recorded attitude. rotation_sigma: float64 (N, 3) about the camera's axes.
        velocity: float64 (N, 2), ground velocity in m/s for the lag; zeros where time is unknown.
        group: int32 (N,). models: sigmas of each group.
        lens: float64 (L, 6), start of log f, k1, k2, k3, cx, cy. lens_sigma: float64 (L, 6), 0 fixes a parameter.
    """

    position: Array
    position_sigma: Array
    rotation: Array
    rotation_sigma: Array
    velocity: Array
    group: Ints
    models: tuple[GroupPriors, ...]
    lens: Array
    lens_sigma: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Columns of the common unknowns: lenses, then for each group bias (3), height, lag, drift knots (east, north).

    lens_columns: 6 L. offset: first column of each group. knots: knots of each group. size: all columns. knot_left:
    int32 (N,), index of the knot before each camera; knot_fraction: float64 (N,) of the way to the next.
    """

    lens_columns: int
    offset: tuple[int, ...]
    knots: tuple[int, ...]
    size: int
    knot_left: Ints
    knot_fraction: Array = field(repr=False)

    @classmethod
    def of(cls, priors: Priors) -> "Layout":
        """The layout for a set of priors."""
        columns = 6 * len(priors.lens)
        offset, knots = [], []
        left = np.zeros(len(priors.group), np.int32)
        fraction = np.zeros(len(priors.group))
        at = columns
        for g, model in enumerate(priors.models):
            members = np.flatnonzero(priors.group == g)
            k = 0
            if model.drift_sigma > 0 and len(members):
                k = max(2, round(len(members) / model.knot_every) + 1)
                where = np.linspace(0.0, k - 1.0, len(members)) if len(members) > 1 else np.zeros(1)
                left[members] = np.minimum(where.astype(np.int32), k - 2)
                fraction[members] = where - left[members]
            offset.append(at)
            knots.append(k)
            at += 5 + 2 * k
        return cls(
            lens_columns=columns, offset=tuple(offset), knots=tuple(knots), size=at, knot_left=left,
            knot_fraction=fraction,
        )  # fmt: skip

    def drift(self, common: Array, group: Ints) -> Array:
        """Drift (N, 2) of each camera for the common unknowns (size,)."""
        out = np.zeros((len(group), 2))
        for g, (at, k) in enumerate(zip(self.offset, self.knots)):
            if k:
                m = np.flatnonzero(group == g)
                values = common[at + 5 : at + 5 + 2 * k].reshape(k, 2)
                t = self.knot_fraction[m, None]
                out[m] = values[self.knot_left[m]] * (1 - t) + values[self.knot_left[m] + 1] * t
        return out


def add_priors(
    system: BandedSystem, cameras: CameraBlock, priors: Priors, layout: Layout, *, common: Array, free: Flags,
    slot: Ints,
) -> None:  # fmt: skip
    """Add all priors to the normal equations of the free cameras in place; common: (layout.size,), free, slot: (N,)."""
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
    """Axes of a group's attitude bias in the frames of cameras with recorded attitudes (N, 3, 3): one in each column.

    The camera's x and y (how it is mounted), and the vertical (a compass error turns the heading, however far the
    camera leans). For a camera that looks straight down the vertical is its z axis.
    """
    axes = np.tile(np.eye(3), (len(rotation), 1, 1))
    axes[:, :, 2] = -rotation[:, 2]
    return axes


def _add_attitudes(
    system: BandedSystem, cameras: CameraBlock, priors: Priors, *, layout: Layout, common: Array,
    index: NDArray[np.intp], at: Ints,
) -> None:  # fmt: skip
    """Attitude priors: rotation from recorded to solved attitude, minus the bias; at: first row of each camera."""
    base = np.asarray(layout.offset)[priors.group[index]]
    recorded = priors.rotation[index]
    axes = bias_axes(recorded)
    bias = np.einsum("nab,nb->na", axes, common[base[:, None] + np.arange(3)])
    r = log_rotation(np.swapaxes(recorded, 1, 2) @ cameras.rotation[index]) - bias
    w = _weights(priors.rotation_sigma[index])
    w = w * robust_weights((r * r * w).sum(1), _ATTITUDE_ROBUST_C)[:, None]
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
    has = np.asarray(layout.knots)[priors.group[index]] > 0
    xy, rz = residual[:, :2], residual[:, 2]
    w = _weights(priors.position_sigma[index])
    w[:, :2] *= robust_weights((xy * xy * w[:, :2]).sum(1), POSITION_ROBUST_C)[:, None]
    left, fraction = layout.knot_left[index], layout.knot_fraction[index]
    for a in range(2):
        wa, ra = w[:, a], xy[:, a]
        knot = np.where(has, base + 5 + 2 * left + a, base + 4)  # without a drift any column, with factors of 0
        columns = [base + 4, knot, np.where(has, knot + 2, base + 4)]
        factors = [-priors.velocity[index, a], np.where(has, fraction - 1.0, 0.0), np.where(has, -fraction, 0.0)]
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
