"""Robust statistics that several stages share."""

import numpy as np
from numpy.typing import ArrayLike

_MAD_TO_SIGMA = 1.4826
"""Sigma of a Gaussian over the median of its absolute values: 1 / 0.6745 (Huber 1981)."""


def mad_sigma(deviation: ArrayLike) -> float:
    """One sigma of deviations from their middle by the median of their absolute values, whatever a minority does."""
    return _MAD_TO_SIGMA * float(np.median(np.abs(deviation)))
