"""Pictures with too few observations (water, haze, blur), which are placed between their neighbours."""

from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Flags, Indices, Ints
from orthoswarm.refine.flight.relative_block import FlightBlock

_SPARSE_FEWEST_OBSERVATIONS: Final = 12  # photos matched in pairs with fewer observations are weakly determined
HELD_OBSERVATIONS: Final = 8  # pictures with fewer well fitting observations are placed between their neighbours
_HELD_WEIGHT: Final = 0.3  # robust weight from which on an observation fits well
_OUTLIER_M: Final = 4.0  # a record farther than this from the middle of those around it is an outlier
_OUTLIER_SIGMAS: Final = 6.0  # ... and farther than so many times the usual distance
_OUTLIER_REACH_PHOTOS: Final = 2  # photos before and after that are asked
_GAP_M: Final = 4.0  # where record and straight line differ by less, the record's shape is followed
_GAP_SHARE: Final = 0.3  # ... or by less than this share of the gap's length
_WEAK_SIGMA_M: Final = 1.0  # sigma of a picture placed between its neighbours
_WEAK_SIGMA_PER_PHOTO_M: Final = 0.1  # ... and more for each photo to the nearest held one
_WEAK_MOST_PHOTOS: Final = 40  # ... up to so many photos
_WEAK_DISAGREEMENT_SHARE: Final = 0.5  # a weak picture's sigma is at least this share of what record and line differ by


def observations_per_camera(flight: FlightBlock) -> Indices:
    """Number of inlier observations of each of the vehicle's cameras: int64 (N,)."""
    adj = flight.adjustment
    n = len(flight.frames)
    good = (adj.obs_weight > _HELD_WEIGHT) & (adj.tracks.camera < n)
    return np.bincount(adj.tracks.camera[good], minlength=n)


def weakly_held(flight: FlightBlock) -> Flags:
    """Whether too few observations hold a camera: bool (N,)."""
    fewest = _SPARSE_FEWEST_OBSERVATIONS if flight.sparse else HELD_OBSERVATIONS
    return np.asarray(observations_per_camera(flight) < fewest)


def without_outliers(recorded: Array, leg: Ints) -> Array:
    """Records (N, 3) with single outlying positions, across or along their leg's course, put back on it.

    Within a long gap a position 5 to 20 m off looks like the aircraft's way when only the gap's ends are compared.
    """
    reach = _OUTLIER_REACH_PHOTOS
    out, n = recorded.copy(), len(recorded)
    middle, known = np.zeros((n, 2)), np.zeros(n, bool)
    for i in range(reach, n - reach):
        if leg[i] < 0 or (leg[i - reach : i + reach + 1] != leg[i]).any():
            continue
        sides = [0.5 * (recorded[i - k, :2] + recorded[i + k, :2]) for k in range(1, reach + 1)]
        # the smaller distance: a neighbour may be an outlier itself
        middle[i] = min(sides, key=lambda m: float(np.hypot(*(m - recorded[i, :2]))))
        known[i] = True
    away = np.hypot(*(recorded[:, :2] - middle).T)
    if known.any():
        outlier = known & (away > max(_OUTLIER_M, _OUTLIER_SIGMAS * float(np.median(away[known]))))
        out[outlier, :2] = middle[outlier]
    return out


def interpolate_weak(flight: FlightBlock, sigma_m: Array) -> Flags:
    """Interpolate weak cameras in place from strong ones before and after; returns which were interpolated.

    Positions follow the recorded path where it agrees with the neighbours, else a straight line in time; the attitude
    is the recorded one with the bias of the neighbours. Their sigma grows with the distance, and with what both differ
    by.
    """
    adj = flight.adjustment
    n = len(flight.frames)
    weak = observations_per_camera(flight) < HELD_OBSERVATIONS
    strong = np.flatnonzero(~weak)
    if len(strong) < 2:
        return weak
    time = flight.records.time_s
    recorded = without_outliers(adj.priors.position[:n], flight.leg)
    for i in np.flatnonzero(weak):
        k = int(np.searchsorted(strong, i))
        a, b = strong[max(k - 1, 0)], strong[min(k, len(strong) - 1)]
        t = 0.5 if time[b] == time[a] else float(np.clip((time[i] - time[a]) / (time[b] - time[a]), 0.0, 1.0))
        straight = adj.cameras.position[a] * (1 - t) + adj.cameras.position[b] * t
        offset = (adj.cameras.position[a] - recorded[a]) * (1 - t) + (adj.cameras.position[b] - recorded[b]) * t
        follows = recorded[i] + offset
        gap = float(np.hypot(*(follows - straight)[:2]))
        step = float(np.hypot(*(adj.cameras.position[b] - adj.cameras.position[a])[:2]))
        turning = flight.leg[a] != flight.leg[b]  # no straight line to follow there
        follow_record = a == b or turning or gap < max(_GAP_M, _GAP_SHARE * step)  # a == b at an end
        adj.cameras.position[i] = follows if follow_record else straight
        # receivers err mostly horizontally; a height far from the others' is real
        adj.cameras.position[i, 2] = follows[2]
        near = a if i - a <= b - i else b
        turn = adj.cameras.rotation[near] @ adj.priors.rotation[near].T
        adj.cameras.rotation[i] = turn @ adj.priors.rotation[i]
        moved = float(np.hypot(*(adj.priors.position[i] - recorded[i])[:2]))
        difference = max(moved, 0.0 if follow_record else gap)
        away = min(abs(i - a), abs(b - i), _WEAK_MOST_PHOTOS)
        sigma_m[i] = max(
            sigma_m[i], _WEAK_SIGMA_M + _WEAK_SIGMA_PER_PHOTO_M * away, _WEAK_DISAGREEMENT_SHARE * difference
        )
    return weak
