"""Which flight paths come near enough for common ground."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array

_NEIGHBOUR_REACH_HEIGHTS: Final = 1.5  # vehicles whose paths come within so many flying heights share ground


def reach_m(path: Array) -> float:
    """How far beside a path (N, 3) its pictures may show ground that others show, metres."""
    return _NEIGHBOUR_REACH_HEIGHTS * float(np.median(path[:, 2]))


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


class NearPaths:
    """Which of many paths come near each other; of thousands of vehicles few have to be compared.

    paths: float64 (N, 3) each, camera positions above the takeoff level.
    """

    def __init__(self, paths: Sequence[Array]) -> None:
        self._paths = paths
        self._low, self._high = (np.array([end(path[:, :2], axis=0) for path in paths]) for end in (np.min, np.max))

    def of(self, k: int) -> list[int]:
        """`near_paths` of path k among all, itself included: their indices, in order."""
        reach = reach_m(self._paths[k])
        meets = ((self._low < self._high[k] + reach) & (self._high > self._low[k] - reach)).all(1)
        others = np.flatnonzero(meets).tolist()
        return [others[j] for j in near_paths(self._paths[k], [self._paths[other] for other in others])]
