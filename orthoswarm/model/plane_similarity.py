"""Shift, turn and scale in the plane, d(x) = t + (s I + a J)(x - m) with J the turn by 90 degrees, by least squares.

This is the linear form of the plane similarity (Helmert transformation) about a middle m, with priors on its unknowns.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Similarity:
    """A plane similarity and how well it is known."""

    middle: Array  # float64 (2,)
    values: Array  # float64 (4,), shift east and north in metres, turn (radians, counter-clockwise), scale minus one
    covariance: Array  # float64 (4, 4) of them

    @classmethod
    def between(
        cls,
        before: Array,
        after: Array,
        sigma_m: Array,
        *,
        middle: Array,
        prior_sigma: Array,
        prior: Array | None = None,
    ) -> "Similarity":
        """The similarity that moves points to where they should be.

        Args:
            before, after: float64 (n, 2), metres. sigma_m: float64 (n,), of each difference, an axis, or (n, 2), of its
                east and north.
            middle: float64 (2,). prior_sigma: float64 (4,), of shift (metres), turn (radians) and scale minus one.
            prior: float64 (4,), their values before; None: zeros.
        """
        sigma_m = sigma_m.reshape(len(before), -1)
        a = design(before - middle) / sigma_m[:, :, None]
        known = np.diag(1.0 / prior_sigma**2)
        normal = known + np.einsum("nij,nik->jk", a, a)
        right = np.einsum("nij,ni->j", a, (after - before) / sigma_m)
        right += 0.0 if prior is None else known @ prior
        covariance = np.asarray(np.linalg.inv(normal), np.float64)
        return cls(middle, np.asarray(covariance @ right, np.float64), covariance)

    @property
    def turn_rad(self) -> float:
        """Counter-clockwise, radians."""
        return float(np.arctan2(self.values[2], 1.0 + self.values[3]))

    @property
    def scale(self) -> float:
        """Factor of all distances."""
        return float(np.hypot(1.0 + self.values[3], self.values[2]))

    @property
    def about_up(self) -> Array:
        """Its turn as a rotation (3, 3) about the vertical."""
        c, s = np.cos(self.turn_rad), np.sin(self.turn_rad)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def moved(self, east_north: Array) -> Array:
        """Points (..., 2) after it."""
        p = np.asarray(east_north, float)
        return np.asarray(p + design(p - self.middle) @ self.values)

    def back(self, east_north: Array) -> Array:
        """Points (..., 2) before it."""
        _, _, turn, scale = self.values
        matrix = np.array([[1.0 + scale, -turn], [turn, 1.0 + scale]])
        away = np.asarray(east_north, float) - self.middle - self.values[:2]
        return np.asarray(self.middle + away @ np.linalg.inv(matrix).T)

    def moved_heights(self, z: ArrayLike, level_m: float) -> Array:
        """Heights scaled, too, about a level, so that no ray of a picture is bent."""
        return np.asarray(level_m + self.scale * (np.asarray(z, float) - level_m))

    def sigma_m(self, east_north: Array) -> Array:
        """Sigma per axis (...,) of moved points from the similarity's covariance; points (..., 2) before the move."""
        a = design(np.asarray(east_north, float) - self.middle)
        variance = np.einsum("...ij,jk,...ik->...i", a, self.covariance, a)
        return np.asarray(np.sqrt(variance.mean(axis=-1)))


def design(away: Array) -> Array:
    """Derivatives (..., 2, 4) of a point's move by shift east, north, turn and scale, at (..., 2) from the middle."""
    east, north = away[..., 0], away[..., 1]
    one, zero = np.ones_like(east), np.zeros_like(east)
    return np.stack([np.stack([one, zero, -north, east], -1), np.stack([zero, one, east, north], -1)], -2)
