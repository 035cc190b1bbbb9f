"""Pictures that too few observations hold (water, haze, blur): placed between their neighbours (RECIPE.md step 10)."""

import numpy as np
from numpy.typing import NDArray

from orthoswarm.refine.flight.relative_block import Flight

Array = NDArray[np.float64]

ENOUGH = 8
FARTHEST = 40
LEAP_M, LEAP_SIGMAS, LEAP_REACH = 4.0, 6.0, 2
"""A record farther than this from the middle of those around it (and so many sigmas of how far records usually are)
has leapt; so many before and after it are asked."""


def observations_per_camera(flight: Flight) -> NDArray[np.int64]:
    """Well fitting observations of each of the vehicle's cameras: int64 (N,)."""
    adj = flight.adjustment
    n = len(flight.frames)
    good = (adj.obs_weight > 0.3) & (adj.tracks.camera < n)
    return np.bincount(adj.tracks.camera[good], minlength=n)


def without_outliers(recorded: Array, leg: NDArray[np.int32]) -> Array:
    """Records (N, 3) with single positions that leave their leg's own course sideways or along it put back (2 of 3).

    Within a long gap a position 5 to 20 m off looks like the aircraft's own way when only the gap's ends are asked.
    """
    out, n = recorded.copy(), len(recorded)
    middle, known = np.zeros((n, 2)), np.zeros(n, bool)
    for i in range(LEAP_REACH, n - LEAP_REACH):
        if leg[i] < 0 or (leg[i - LEAP_REACH : i + LEAP_REACH + 1] != leg[i]).any():
            continue
        sides = [0.5 * (recorded[i - k, :2] + recorded[i + k, :2]) for k in range(1, LEAP_REACH + 1)]
        # the nearer of them: one of the four may have leapt itself
        middle[i] = min(sides, key=lambda m: float(np.hypot(*(m - recorded[i, :2]))))
        known[i] = True
    away = np.hypot(*(recorded[:, :2] - middle).T)
    if known.any():
        leapt = known & (away > max(LEAP_M, LEAP_SIGMAS * float(np.median(away[known]))))
        out[leapt, :2] = middle[leapt]
    return out


def interpolate_weak(flight: Flight, sigma_m: Array) -> NDArray[np.bool_]:
    """Interpolate weakly held cameras from strong ones before and after, in place; returns which they are.

    Positions follow the record's own shape where it agrees with its neighbours, else a straight line in time; the
    attitude is the recorded one with the bias of the neighbours. Their sigma grows with the distance, and with what
    the record and the line disagree by.
    """
    adj = flight.adjustment
    n = len(flight.frames)
    weak = observations_per_camera(flight) < ENOUGH
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
        turning = flight.leg[a] != flight.leg[b]  # a straight line means nothing there
        believed = a == b or turning or gap < max(4.0, 0.3 * step)  # a == b: at an end
        adj.cameras.position[i] = follows if believed else straight
        adj.cameras.position[i, 2] = follows[2]  # receivers err sideways; a height far from the others' is meant
        near = a if i - a <= b - i else b
        turn = adj.cameras.rotation[near] @ adj.priors.rotation[near].T
        adj.cameras.rotation[i] = turn @ adj.priors.rotation[i]
        leapt = float(np.hypot(*(adj.priors.position[i] - recorded[i])[:2]))
        told = max(leapt, 0.0 if believed else gap)
        sigma_m[i] = max(sigma_m[i], 1.0 + 0.1 * min(abs(i - a), abs(b - i), FARTHEST), 0.5 * told)
    return weak
