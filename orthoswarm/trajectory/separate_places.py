"""Groups of places so far apart that no picture of the one shows ground of the other."""

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.earth import MEAN_RADIUS_M

Array = NDArray[np.float64]
Ints = NDArray[np.int32]


def separate_places(lat_deg: Array, lon_deg: Array, gap_m: float) -> Ints:
    """Group of each place, int32 (N,), numbered in order of their first places.

    Places less than `gap_m` apart are of one group, directly or through others.

    Args:
        lat_deg, lon_deg: float64 (N,), in the order in which they were visited.
        gap_m: distance in a straight line, metres.
    """
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    place = MEAN_RADIUS_M * np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    step = np.linalg.norm(np.diff(place, axis=0), axis=1)
    run = np.concatenate([[0], np.cumsum(step >= gap_m)]).astype(np.int32)[: len(place)]
    if not len(run) or run[-1] == 0:
        return run
    from scipy.spatial import cKDTree  # a tenth of a second that flights in one piece do without

    trees = [cKDTree(place[run == k]) for k in range(int(run[-1]) + 1)]
    group = np.arange(len(trees))
    for k, tree in enumerate(trees):
        for earlier in range(k):
            nearest = np.min(tree.query(trees[earlier].data, distance_upper_bound=gap_m)[0])
            if nearest < gap_m:
                both = [group[earlier], group[k]]
                group[np.isin(group, both)] = min(both)
    return np.unique(group[run], return_inverse=True)[1].astype(np.int32)
