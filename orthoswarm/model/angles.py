"""Angles brought within half a turn, the one way for all."""

import math
from typing import TYPE_CHECKING, overload

if TYPE_CHECKING:  # the simulated vehicles turn angles, too, and need no numpy for it
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


@overload
def wrap_rad(angle: float) -> float: ...
@overload
def wrap_rad(angle: "Array") -> "Array": ...
def wrap_rad(angle: "float | Array") -> "float | Array":
    """Angles in radians brought to [-pi, pi); NaN stays."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@overload
def wrap_deg(angle: float) -> float: ...
@overload
def wrap_deg(angle: "Array") -> "Array": ...
def wrap_deg(angle: "float | Array") -> "float | Array":
    """Angles in degrees brought to [-180, 180); NaN stays."""
    return (angle + 180.0) % 360.0 - 180.0
