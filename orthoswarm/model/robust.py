"""Robust statistics that several stages share."""

import numpy as np
from numpy.typing import ArrayLike

from orthoswarm.model.arrays import Array

MAD_TO_SIGMA = 1.4826  # sigma of a Gaussian over the median of its absolute values: 1 / 0.6745 (Huber 1981)
MEDIAN_LENGTH_SIGMAS = 1.1774
"""Median length of a Gaussian vector of two axes, and half the width of a Gaussian at half its maximum, in sigmas of an
axis: sqrt(2 ln 2)."""
MEDIAN_SIGMA = 1.25  # sigma of the median of n Gaussian values, times sqrt(n), over theirs: sqrt(pi / 2)


def mad_sigma(deviation: ArrayLike) -> float:
    """Robust sigma of deviations from their median: the median absolute deviation, scaled for Gaussian errors."""
    return MAD_TO_SIGMA * float(np.median(np.abs(deviation)))


def mad_sigmas(deviation: ArrayLike) -> Array:
    """Robust sigma (`mad_sigma`) of each column of deviations (N, K): float64 (K,)."""
    return np.asarray(MAD_TO_SIGMA * np.median(np.abs(deviation), axis=0), np.float64)
