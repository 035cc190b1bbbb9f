"""Subpixel position of a correlation peak."""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel

_STRAIGHT = 1e-9  # less bend than this is rounding (correlations are of order one): the sample itself is the top


@in_place_kernel
def vertex(left, middle, right):  # type: ignore[no-untyped-def]
    """Vertex of the parabola through three neighbouring samples: -0.5 to 0.5 steps from the middle one.

    left, middle, right: floats, the middle one the largest; where they do not bend down the answer is 0.
    """
    bend = left - 2.0 * middle + right
    if bend >= -_STRAIGHT:
        return 0.0
    return min(max(0.5 * (left - right) / bend, -0.5), 0.5)


@kernel
def vertices(left, middle, right):  # type: ignore[no-untyped-def]
    """`vertex` of many triples: three arrays (N,) to float64 (N,)."""
    out = np.empty(len(middle))
    for i in range(len(middle)):
        out[i] = vertex(left[i], middle[i], right[i])
    return out
