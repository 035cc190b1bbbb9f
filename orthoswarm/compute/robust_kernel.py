"""The robust kernel of all adjustments, Geman and McClure (1987): cost e^2 / (1 + e^2 / c), e a residual in sigmas.

The cost levels off for large residuals, so a wrong match has no more influence than an error of a few sigmas; c, in
squared sigmas, sets where. Used as iteratively reweighted least squares. e2: squared residuals; c: one for all or one
for each.
"""

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Array


@in_place_kernel
def robust_weight(e2, c, precision):  # type: ignore[no-untyped-def]
    """Weight precision / (1 + e2 / c)^2 of a squared normalised residual, for compiled code."""
    q = 1.0 + e2 / c
    return precision / (q * q)


def robust_widening(e2: Array, c: float) -> Array:
    """Factors 1 + e2 / c by which the kernel widens the sigmas: a weight is that of a residual of the wider sigma."""
    return 1.0 + e2 / c


def robust_weights(e2: Array, c: float) -> Array:
    """Weights 1 / (1 + e2 / c)^2, float64 in the shape of e2."""
    return 1.0 / robust_widening(e2, c) ** 2


def robust_costs(e2: Array, c: float) -> Array:
    """Costs e2 / (1 + e2 / c)."""
    return e2 / robust_widening(e2, c)
