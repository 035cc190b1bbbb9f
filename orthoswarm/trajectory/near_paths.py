"""Which flight paths come near enough for common ground."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active

Array = NDArray[np.float64]


def reach_m(path: Array) -> float:
    """How far beside a path (N, 3) its pictures may show ground that others show, metres."""
    return active().strategy.neighbour_reach_heights * float(np.median(path[:, 2]))


def near_paths(path: Array, others: Sequence[Array]) -> list[int]:
    """Those of other paths that lead through the surroundings of a path.

    Args:
        path: float64 (N, 3), camera positions above the takeoff level. others: the same, (M, 3) each.

    Returns:
        Their indices, in order.
    """
    reach = reach_m(path)
    low, high = path[:, :2].min(0) - reach, path[:, :2].max(0) + reach
    return [k for k, other in enumerate(others) if ((other[:, :2] > low) & (other[:, :2] < high)).all(1).any()]
