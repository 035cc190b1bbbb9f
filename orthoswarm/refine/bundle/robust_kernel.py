"""The robust kernel of all adjustments, Geman and McClure (1987): cost e^2 / (1 + e^2 / c), e a residual in sigmas.

It is flat far from 0, so that wrong matches pull no more than a few sigmas would, whatever their number of metres; c in
squared sigmas says from where on. Used as iteratively reweighted least squares.
"""

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import kernel


@kernel
def robust_weight(e2, c):  # type: ignore[no-untyped-def]
    """Weight 1 / (1 + e2 / c)^2 of a squared normalised residual, for compiled code."""
    q = 1.0 + e2 / c
    return 1.0 / (q * q)


def robust_weights(e2: NDArray[np.float64], c: float) -> NDArray[np.float64]:
    """The same of many, float64 of the shape of e2."""
    return np.asarray(1.0 / (1.0 + e2 / c) ** 2)
