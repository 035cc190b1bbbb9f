"""A map that is displaced from place to place, as its ties' residuals show it.

Matching noise is independent from tie to tie, a displacement of the map is alike for neighbours: so the semivariogram
of the residuals rises with distance (Cressie 1993, Statistics for Spatial Data, chapter 2). A block of pictures is
nearly rigid: it follows a displaced map as a whole, by a shift, a turn and a scale, and leaves the rest in the
residuals. What it followed is its error.
"""

from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array

_LN2 = float(np.log(2.0))
"""Median of the squared length of a Gaussian vector of two axes, for one of its mean."""

_VARIOGRAM_MOST_TIES: Final = 200  # of more ties every so many-th is used: pairs grow with their square (its cost)
_VARIOGRAM_CLASSES: Final = 9  # classes of distance between ties; the first ends at ....
_VARIOGRAM_NEAR_HEIGHTS: Final = 0.1  # ... so many flying heights ...
_VARIOGRAM_FAR_SHARE: Final = 0.85  # ... the last at this share of the largest distance: few pairs are farther apart
_VARIOGRAM_LEAST_PAIRS: Final = 30  # a class with fewer pairs is left out
_VARIOGRAM_LEAST_CLASSES: Final = 3  # fewer classes do not tell the map's distortion
_VARIOGRAM_FLAT_SHARE: Final = 0.1  # classes weigh by their value, those below this share of the largest alike
_CORRELATION_LENGTHS: Final = 8  # correlation lengths that are tried, from ... (its cost)
_CORRELATION_HEIGHTS: Final = 0.2  # ... so many flying heights to ...
_CORRELATION_RADII: Final = 1.5  # ... so many radii (root mean square) of the vehicle's ties


def map_distortion_variance(place: Array, residual: Array, height_m: float) -> float:
    """Variance per axis of what a block is displaced by on a map displaced from place to place, metres squared.

    Noise and a displacement with a Gaussian correlation are fitted to the semivariogram of the residuals: their
    variances by least squares, the correlation's length by trial. For each length it is known what a similarity fitted
    to the ties follows of such a displacement, and what semivariogram the rest has. Medians instead of means of the
    squared differences are used, as ties may be wrong.

    Args:
        place: float64 (Q, 2), positions of the ties, metres. residual: float64 (Q, 2), their residuals, metres.
        height_m: flying height.

    Returns:
        The variance; 0 where there are too few pairs of ties to estimate it.
    """
    step = max(1, -(-len(place) // _VARIOGRAM_MOST_TIES))
    place, residual = place[::step], residual[::step]
    i, j = np.triu_indices(len(place), 1)
    apart = np.hypot(*(place[i] - place[j]).T)
    if len(i) < _VARIOGRAM_LEAST_PAIRS or not apart.max() > 0.0:
        return 0.0
    half = ((residual[i] - residual[j]) ** 2).sum(1) / 4.0
    near, far = _VARIOGRAM_NEAR_HEIGHTS * height_m, _VARIOGRAM_FAR_SHARE * float(apart.max())
    edges = np.r_[0.0, np.geomspace(min(near, far), far, _VARIOGRAM_CLASSES)]
    number = np.digitize(apart, edges) - 1
    classes = [np.flatnonzero(number == k) for k in range(_VARIOGRAM_CLASSES)]
    classes = [pairs for pairs in classes if len(pairs) >= _VARIOGRAM_LEAST_PAIRS]
    if len(classes) < _VARIOGRAM_LEAST_CLASSES:
        return 0.0
    found = np.array([np.median(half[pairs]) / _LN2 for pairs in classes])
    radius = float(np.sqrt(((place - place.mean(axis=0)) ** 2).sum(axis=1).mean()))
    shortest, longest = _CORRELATION_HEIGHTS * height_m, _CORRELATION_RADII * radius
    best = (np.inf, 0.0)
    for length_m in np.geomspace(min(shortest, longest), longest, _CORRELATION_LENGTHS):
        left, followed = _followed(place, length_m)
        level = np.diag(left)
        expected = 0.5 * (level[i] + level[j]) - left[i, j]
        variance, misfit = _fit(found, np.array([expected[pairs].mean() for pairs in classes]))
        best = min(best, (misfit, variance * followed))
    return best[1]


def _followed(place: Array, length_m: float) -> tuple[Array, float]:
    """What a similarity, fitted to ties on a map displaced by unit variance, leaves and follows.

    Returns:
        Covariance (Q, Q) of the residuals of an axis, mean of both; variance of an axis of the fitted values, mean over
        the ties.
    """
    n = len(place)
    apart2 = ((place[:, None] - place[None]) ** 2).sum(axis=2)
    covariance = np.exp(-0.5 * apart2 / length_m**2)
    x, y = (place - place.mean(axis=0)).T
    radius = max(float(np.sqrt((x**2 + y**2).sum())), 1e-9)
    one, zero = np.full(n, 1.0 / np.sqrt(n)), np.zeros(n)
    east = np.column_stack([one, zero, x / radius, -y / radius])  # orthonormal together with north
    north = np.column_stack([zero, one, y / radius, x / radius])
    inner = east.T @ covariance @ east + north.T @ covariance @ north
    left = covariance.copy()
    for axis in (east, north):
        cross = (covariance @ axis) @ axis.T
        left += 0.5 * (axis @ inner @ axis.T - cross - cross.T)
    return left, float(np.trace(inner)) / (2 * n)


def _fit(found: Array, expected: Array) -> tuple[float, float]:
    """Variance of the displacement and misfit of found = noise + variance x expected, both at least 0."""
    weight = 1.0 / np.maximum(found, _VARIOGRAM_FLAT_SHARE * found.max() + 1e-12)
    one, shape, value = weight, weight * expected, weight * found
    a, b, c = one @ one, one @ shape, shape @ shape
    p, q = one @ value, shape @ value
    determinant = a * c - b * b
    noise, variance = (
        ((c * p - b * q) / determinant, (a * q - b * p) / determinant) if determinant > 0 else (p / a, 0.0)
    )
    if variance < 0.0:
        noise, variance = p / a, 0.0
    elif noise < 0.0:
        noise, variance = 0.0, q / c
    return float(variance), float(np.sum((value - noise * one - variance * shape) ** 2))
