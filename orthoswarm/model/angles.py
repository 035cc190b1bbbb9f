"""Wrapping of angles to half a turn."""

import math
from typing import TYPE_CHECKING, overload

if TYPE_CHECKING:  # the simulated vehicles wrap angles, too, without numpy
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


@overload
def wrap_rad(angle: float) -> float: ...
@overload
def wrap_rad(angle: "Array") -> "Array": ...
def wrap_rad(angle: "float | Array") -> "float | Array":
    """Angles in radians wrapped to [-pi, pi); NaN stays NaN."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@overload
def wrap_deg(angle: float) -> float: ...
@overload
def wrap_deg(angle: "Array") -> "Array": ...
def wrap_deg(angle: "float | Array") -> "float | Array":
    """Angles in degrees wrapped to [-180, 180); NaN stays NaN."""
    return (angle + 180.0) % 360.0 - 180.0
