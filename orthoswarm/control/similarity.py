"""Shift, turn and scale in the plane by control points, as a least-squares adjustment with priors.

Four unknowns: shift (2), turn and scale about the middle of the photos, d(x) = t + (s I + a J)(x - m) with J the turn
by 90 degrees (the linear form of the plane similarity). Priors on turn and scale let one or two points shift the block,
and more of them turn and scale it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.control.control_observations import ControlObservation

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Similarity:
    """A plane similarity and how well it is known.

    Attributes:
        middle: float64 (2,). values: float64 (4,), shift east and north in metres, turn (radians, counter-clockwise),
            scale minus one. covariance: float64 (4, 4) of them.
    """

    middle: Array
    values: Array
    covariance: Array

    @property
    def turn_rad(self) -> float:
        """Counter-clockwise, radians."""
        return float(np.arctan2(self.values[2], 1.0 + self.values[3]))

    @property
    def scale(self) -> float:
        """Factor of all distances."""
        return float(np.hypot(1.0 + self.values[3], self.values[2]))

    def moved(self, east_north: Array) -> Array:
        """Points (..., 2) after it."""
        p = np.asarray(east_north, float)
        return np.asarray(p + _design(p - self.middle) @ self.values)

    def back(self, east_north: Array) -> Array:
        """Points (..., 2) before it."""
        _, _, turn, scale = self.values
        matrix = np.array([[1.0 + scale, -turn], [turn, 1.0 + scale]])
        away = np.asarray(east_north, float) - self.middle - self.values[:2]
        return np.asarray(self.middle + away @ np.linalg.inv(matrix).T)

    def sigma_m(self, east_north: Array) -> Array:
        """Sigma per axis (...,) of moved points from the similarity's covariance; points (..., 2) before the move."""
        a = _design(np.asarray(east_north, float) - self.middle)
        variance = np.einsum("...ij,jk,...ik->...i", a, self.covariance, a)
        return np.asarray(np.sqrt(variance.mean(axis=-1)))


@dataclass(frozen=True, slots=True)
class ControlFit:
    """A similarity and the residuals of the control points.

    Attributes:
        similarity: from the block to the ground.
        used: the observations used. residual: float64 (n, 2), of each of them, block minus survey.
        left_out: observations rejected as outliers.
        contradiction: True where the observations disagree, but are too few to find the outlier.
    """

    similarity: Similarity
    used: list[ControlObservation]
    residual: Array
    left_out: list[ControlObservation]
    contradiction: bool


def fit_similarity(observations: Sequence[ControlObservation], nadirs: Array, border_m: float) -> ControlFit:
    """The similarity that moves a block onto its control points.

    Outliers are rejected, the worst first, as long as three other observations remain.

    Args:
        observations: at least one. nadirs: float64 (N, 2), nadir points of the photos, for their centre and extent.
        border_m: prior sigma of rotation and scale, as the displacement at the photos' rms radius, metres.
    """
    middle = np.asarray(nadirs.mean(axis=0))
    radius = max(float(np.sqrt(((nadirs - middle) ** 2).sum(axis=1).mean())), 1.0)
    shift = active().control.shift_sigma_m
    prior = 1.0 / np.array([shift, shift, border_m / radius, border_m / radius]) ** 2
    limit = -2.0 * np.log(active().control.mistake_probability)
    used, left_out = list(observations), []
    while True:
        chi2 = _left_out_chi2(used, middle, prior)
        worst = int(np.argmax(chi2))
        if chi2[worst] <= limit or len(used) <= 3:
            break
        left_out.append(used.pop(worst))
    return ControlFit(*_adjusted(used, middle, prior), left_out, bool(chi2[worst] > limit))


def _adjusted(
    used: list[ControlObservation], middle: Array, prior: Array
) -> tuple[Similarity, list[ControlObservation], Array]:
    """The adjustment; its covariance grows where residuals are larger than the observations' sigmas (Birge ratio)."""
    similarity = _solved(used, middle, prior)
    residual = np.array([similarity.moved(o.placed) - o.surveyed for o in used])
    weight = 1.0 / np.array([o.sigma_m for o in used]) ** 2
    left = float((weight[:, None] * residual**2).sum() + (prior * similarity.values**2).sum())
    variance = left / (2 * len(used))  # four observations more, the priors, stand against four unknowns
    factor = max(1.0, variance)
    return Similarity(middle, similarity.values, np.asarray(similarity.covariance * factor, np.float64)), used, residual


def _solved(used: Sequence[ControlObservation], middle: Array, prior: Array) -> Similarity:
    normal, right = np.diag(prior), np.zeros(4)
    for o in used:
        a = _design(o.placed - middle) / o.sigma_m
        normal = normal + a.T @ a
        right = right + a.T @ ((o.surveyed - o.placed) / o.sigma_m)
    covariance = np.asarray(np.linalg.inv(normal), np.float64)
    return Similarity(middle, np.asarray(covariance @ right, np.float64), covariance)


def _left_out_chi2(used: Sequence[ControlObservation], middle: Array, prior: Array) -> Array:
    """Squared Mahalanobis distance (n,) of each observation from its prediction by the others (two axes)."""
    if len(used) < 2:
        return np.zeros(1)
    out = []
    for k, o in enumerate(used):
        others = _solved([*used[:k], *used[k + 1 :]], middle, prior)
        away = others.moved(o.placed) - o.surveyed
        variance = o.sigma_m**2 + float(others.sigma_m(o.placed)) ** 2
        out.append(float((away**2).sum()) / variance)
    return np.array(out)


def _design(away: Array) -> Array:
    """Derivatives (..., 2, 4) of a point's move by shift east, north, turn and scale, at (..., 2) from the middle."""
    east, north = away[..., 0], away[..., 1]
    one, zero = np.ones_like(east), np.zeros_like(east)
    return np.stack([np.stack([one, zero, -north, east], -1), np.stack([zero, one, east, north], -1)], -2)
