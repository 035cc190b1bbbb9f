"""Which flight paths, and which places, come near enough for common ground."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Ints
from orthoswarm.model.earth import on_sphere

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


def separate_places(lat_deg: Array, lon_deg: Array, gap_m: float, gap_steps: float = 0.0) -> Ints:
    """Group of each place, int32 (N,), numbered in order of their first places.

    Places less than a gap apart are of one group, directly or through others.

    Args:
        lat_deg, lon_deg: float64 (N,), in the order in which they were visited.
        gap_m: least gap in a straight line, metres. gap_steps: least gap in distances from a place to the nearest
            other one, their median: high flights have few pictures far apart.
    """
    place = on_sphere(lat_deg, lon_deg)
    if (np.linalg.norm(np.diff(place, axis=0), axis=1) < gap_m).all():
        return np.zeros(len(place), np.int32)
    from scipy.spatial import cKDTree  # a tenth of a second that flights in one piece do without

    if gap_steps:
        nearest = np.asarray(cKDTree(place).query(place, k=2)[0])[:, 1]
        gap_m = max(gap_m, gap_steps * float(np.median(nearest)))
    # Places of one cell, whose diagonal is the gap, are linked; of two cells the nearest places decide.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    cells, cell = np.unique(np.floor(place * (np.sqrt(3.0) / gap_m)), axis=0, return_inverse=True)
    order = np.argsort(cell.ravel(), kind="stable")
    members = np.split(place[order], np.cumsum(np.bincount(cell.ravel()))[:-1])
    trees = [cKDTree(own) for own in members]
    # Places nearer than the gap lie at most two cells apart along each axis.
    near = cKDTree(cells).query_pairs(2.0 * np.sqrt(3.0) + 1e-6, output_type="ndarray")
    linked = [
        (a, b) for a, b in near.tolist() if np.min(trees[a].query(members[b], distance_upper_bound=gap_m)[0]) < gap_m
    ]
    rows, columns = np.array(linked, np.intp).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(cells), len(cells)))
    label = np.asarray(connected_components(graph, directed=False)[1], np.int32)[cell.ravel()]
    _, first, number = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first)).astype(np.int32)[number]
