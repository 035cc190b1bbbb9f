"""The robust kernel of all adjustments, Geman and McClure (1987): cost e^2 / (1 + e^2 / c), e a residual in sigmas.

The cost levels off for large residuals, so a wrong match has no more influence than an error of a few sigmas; c, in
squared sigmas, sets where. Used as iteratively reweighted least squares.
"""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Array


@in_place_kernel
def robust_weight(e2, c):  # type: ignore[no-untyped-def]
    """Weight 1 / (1 + e2 / c)^2 of a squared normalised residual, for compiled code."""
    q = 1.0 + e2 / c
    return 1.0 / (q * q)


def robust_weights(e2: Array, c: float) -> Array:
    """The weights of an array of squared residuals, float64 in the shape of e2."""
    return np.asarray(1.0 / (1.0 + e2 / c) ** 2)
