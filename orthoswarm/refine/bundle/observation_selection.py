"""Choice of the best picture for each tie point, and of one point for each ground cell and leg."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Flags, Indices, Ints
from orthoswarm.refine.bundle.block_arrays import CameraBlock, Tracks

INLIER_WEIGHT: Final = 0.5  # an observation counts as an inlier from this robust weight on


@dataclass(frozen=True, slots=True)
class BestViews:
    """For each point the inlier observation nearest to its camera's nadir, and the quality of the point's observations.

    Attributes (P points):
        camera: int32 (P,), of that observation, -1 where there is none. count: int32 (P,), inlier observations.
        mean_weight: float64 (P,), mean robust weight.
    """

    camera: Ints
    count: Ints
    mean_weight: Array


def best_views(
    cameras: CameraBlock, tracks: Tracks, points: Array, obs_weight: Array, own: Flags | None = None
) -> BestViews:
    """Best view of each point; `own` bool (N,) limits the choice of camera."""
    n, inlier_weight = len(points), INLIER_WEIGHT
    distance = np.hypot(*(cameras.position[tracks.camera, :2] - points[tracks.point, :2]).T)
    usable = obs_weight > inlier_weight
    if own is not None:
        usable &= own[tracks.camera]
    order = np.lexsort((np.where(usable, distance, np.inf), tracks.point))
    first = np.searchsorted(tracks.point[order], np.arange(n))
    has = np.bincount(tracks.point, minlength=n) > 0
    best = order[np.minimum(first, len(order) - 1)]
    ok = has & usable[best]
    total = np.bincount(tracks.point, minlength=n)
    weight = np.bincount(tracks.point, obs_weight, minlength=n) / np.maximum(total, 1)
    count = np.bincount(tracks.point[obs_weight > inlier_weight], minlength=n)
    return BestViews(np.where(ok, tracks.camera[best], -1).astype(np.int32), count.astype(np.int32), weight)


def one_per_cell(points: Array, leg: Ints, cost: Array, cell_m: float) -> Indices:
    """The point of least cost (finite) in each ground cell of each leg: indices, sorted."""
    use = np.flatnonzero(np.isfinite(cost))
    key = np.column_stack([np.floor(points[use, :2] / cell_m).astype(np.int64), leg[use]])
    order = np.lexsort((use, cost[use]))
    _, first = np.unique(key[order], axis=0, return_index=True)
    return np.sort(use[order[first]])
