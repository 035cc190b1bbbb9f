"""A common height level for vehicles solved separately: a levelling network of their differences on common ground."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from orthoswarm.model.arrays import Array, Indices
from orthoswarm.model.robust import MEDIAN_SIGMA, mad_sigma

_LEVEL_RADIUS_M: Final = 25.0  # points of two vehicles this near each other, horizontally, are common ground
_LEVEL_NEIGHBOURS: Final = 3  # points of the other vehicle within that radius whose median height is compared
_LEVEL_LEAST_POINTS: Final = 15  # common points that make a pair of vehicles
_LEVEL_MOST_POINTS: Final = 400  # points of each vehicle compared in a pair: a median of more is no better
_LEVEL_SIGMA_FLOOR_M: Final = 0.03  # least sigma of a pair's difference
_LEVEL_SPREAD_FLAT_M: Final = 0.8  # spread of the levels up to which the least corrected vehicle stays
_LEVEL_SPREAD_RELIEF_M: Final = 1.6  # spread of the levels from which their mean stays: relief
_LEVEL_QUANTILE: Final = 0.1  # of many vehicles this quantile stands for the lowest: the lowest of many is noise
_LEVEL_MANY_VEHICLES: Final = 10  # more vehicles than this are many


def level_corrections(ground: Sequence[Array]) -> Array:
    """Metres to add to the heights of each vehicle, float64 (V,): a least-squares levelling network on common ground.

    Each vehicle's datum puts the mode of its own points at the takeoff level. Rubble and bushes raise that mode above
    the ground, so a vehicle's ground can only be too low: where the levels differ little, the vehicle with the lowest
    correction stays (a low quantile if there are many, as their lowest is noise). Large differences come from relief:
    then the mean is the best guess. In between, the anchor changes gradually. Levels chained from the first vehicle
    more than doubled the map's error.

    ground: for each vehicle float64 (M, 3), its points on the ground, in a common horizontal frame; without ground in
    common with others it gets 0.
    """
    count = len(ground)
    trees = [cKDTree(g[:, :2]) if len(g) >= _LEVEL_NEIGHBOURS else None for g in ground]
    pairs: list[tuple[int, int]] = []
    difference: list[float] = []
    sigma: list[float] = []
    for i in range(count):
        for j in range(i + 1, count):
            d = _common_difference(ground[i], ground[j], trees[i], trees[j])
            if len(d) >= _LEVEL_LEAST_POINTS:
                pairs.append((i, j))
                difference.append(float(np.median(d)))
                spread = mad_sigma(d - difference[-1])
                sigma.append(float(np.hypot(MEDIAN_SIGMA * spread / np.sqrt(len(d)), _LEVEL_SIGMA_FLOOR_M)))
    edge = np.array(pairs, np.int64).reshape(-1, 2)
    return _adjust(count, edge, np.array(difference, float), np.array(sigma, float))


def _common_difference(a: Array, b: Array, tree_a: cKDTree | None, tree_b: cKDTree | None) -> Array:
    """Heights of a above b, at the points of both in their common area.

    At the border all neighbours lie on one side, where a slope would look like a difference: so the half of the points
    nearest to the centre of their neighbours is used.
    """
    if tree_a is None or tree_b is None:
        return np.empty(0)
    radius, k = _LEVEL_RADIUS_M, _LEVEL_NEIGHBOURS
    low, high = np.maximum(tree_a.mins, tree_b.mins) - radius, np.minimum(tree_a.maxes, tree_b.maxes) + radius
    if (low > high).any():
        return np.empty(0)
    difference, off_centre = [np.empty(0)], [np.empty(0)]
    for points, other, tree, sign in ((a, b, tree_b, 1.0), (b, a, tree_a, -1.0)):
        near = points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(1)]
        near = near[:: max(1, len(near) // _LEVEL_MOST_POINTS)]
        distance, index = tree.query(near[:, :2], k=k, distance_upper_bound=radius)
        ok = np.isfinite(distance).reshape(len(near), k).all(1)
        around = other[index.reshape(len(near), k)[ok]]
        difference.append(sign * (near[ok, 2] - np.median(around[..., 2], axis=1)))
        off_centre.append(np.hypot(*(around[..., :2].mean(1) - near[ok, :2]).T))
    d, away = np.concatenate(difference), np.concatenate(off_centre)
    return d[np.argsort(away, kind="stable")[: max(_LEVEL_LEAST_POINTS, len(d) // 2)]]


def _adjust(count: int, edge: Indices, difference: Array, sigma: Array) -> Array:
    """Corrections (count,) by the differences in height of pairs of vehicles, int64 (E, 2), with their sigmas."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(edge)), (edge[:, 0], edge[:, 1])), (count, count))
    component = connected_components(graph, directed=False)[1]
    normal, rhs = np.zeros((count, count)), np.zeros(count)
    weight = 1.0 / sigma**2
    for (i, j), d, w in zip(edge, difference, weight, strict=True):
        # level_i - level_j = d
        normal[[i, j], [i, j]] += w
        normal[[i, j], [j, i]] -= w
        rhs[i] += w * d
        rhs[j] -= w * d
    level = np.linalg.pinv(normal, hermitian=True) @ rhs
    correction = np.zeros(count)
    for number in np.unique(component):
        members = np.flatnonzero(component == number)
        c = -(level[members] - level[members].mean())
        correction[members] = c - _anchor(c)
    return correction


def _anchor(correction: Array) -> float:
    """The correction (relative to their mean) that becomes zero."""
    tail = _LEVEL_QUANTILE if len(correction) > _LEVEL_MANY_VEHICLES else 0.0
    lowest = float(np.quantile(correction, tail))
    spread = float(np.quantile(correction, 1.0 - tail)) - lowest
    share = (spread - _LEVEL_SPREAD_FLAT_M) / (_LEVEL_SPREAD_RELIEF_M - _LEVEL_SPREAD_FLAT_M)
    share = float(np.clip(share, 0.0, 1.0))
    return (1.0 - share) * lowest
