"""Priors of the bundle adjustment: recorded positions and attitudes with sigmas, biases, lag, drift, lens."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Ints

POSITION_ROBUST_C: Final = 9.0  # robust scale of recorded horizontal positions, squared sigmas
ATTITUDE_BIAS_SIGMA_DEG: Final = (1.0, 1.0, 3.0)
"""Sigma of a sortie's common attitude error about the camera's x, y, z axes: mounting, gimbal, compass. Biases of
made-up flights were found to 0.1 degrees with it."""
HEIGHT_OFFSET_SIGMA_M: Final = 1.0  # sigma of a sortie's common offset of recorded heights
DRIFT_SIGMA_M: Final = 15.0  # drift of a receiver without corrections (made-up flights: up to 10 m)
_DRIFT_BEND_SIGMA_M: Final = 0.5  # sigma of the second difference of the drift's knots: it changes slowly
_DRIFT_KNOT_PHOTOS: Final = 60  # photos between two knots of the piecewise linear drift
LAG_SIGMA_S: Final = 0.5  # sigma of the delay of recorded positions behind the shutter (lags of up to 0.4 s are found)


@dataclass(frozen=True, slots=True, kw_only=True)
class GroupPriors:
    """Sigmas of the errors common to all frames of a group (a vehicle's sortie); SI units and radians.

    Attributes:
        bias_sigma: attitude bias about the camera's x, y, z axes, radians.
        height_sigma: common offset of recorded heights, metres.
        lag_sigma: delay of the recorded position, seconds (0 switches it off).
        drift_sigma: size of the receiver's drift, metres (0 switches it off); drift_bend: second difference of its
            knots, metres; knot_every: frames between knots.
    """

    bias_sigma: tuple[float, float, float] = field(default_factory=lambda: tuple(np.radians(ATTITUDE_BIAS_SIGMA_DEG)))
    height_sigma: float = field(default_factory=lambda: HEIGHT_OFFSET_SIGMA_M)
    lag_sigma: float = field(default_factory=lambda: LAG_SIGMA_S)
    drift_sigma: float = field(default_factory=lambda: DRIFT_SIGMA_M)
    drift_bend: float = field(default_factory=lambda: _DRIFT_BEND_SIGMA_M)
    knot_every: int = field(default_factory=lambda: _DRIFT_KNOT_PHOTOS)


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
        position_c: robust scale (squared sigmas) of the horizontal positions.
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
    position_c: float = field(default_factory=lambda: POSITION_ROBUST_C)


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Columns of the common unknowns: lenses, then for each group bias (3), height, lag, drift knots (east, north).

    Attributes:
        lens_columns: 6 L. offset: first column of each group. knots: knots of each group. size: all columns.
        knot_left: int32 (N,), index of the knot before each camera; knot_fraction: float64 (N,) of the way to the next.
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
            lens_columns=columns,
            offset=tuple(offset),
            knots=tuple(knots),
            size=at,
            knot_left=left,
            knot_fraction=fraction,
        )

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
