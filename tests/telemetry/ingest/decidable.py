"""Which photos of a flight the recorded times decide, found by counting, independently of the matching's probabilities.

An alignment pairs photos with events in order, under one offset and drift, each pair within the clock's resolution and
the trigger's jitter; a photo that is left without event must have room between the exposures. The times decide a
photo's event if every alignment that gives it another event, or none, has at least `LEAST_FEWER` pairs fewer than
the true one: as many photos and as many events more would have to be missing.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from tests.telemetry.ingest.exposure_grid import Exposures

Array = NDArray[np.float64]
Counts = NDArray[np.int16]

LEAST_FEWER = 3
_JITTER_S = 0.1
_STEP_S = 0.05
_MOST_DRIFT = 1.2e-3
_NO_ROOM = 5
_CHUNK = 200


def decided_by_times(flown: Exposures, interval: float, *, whole: bool) -> set[int]:
    """Photos whose exposure has an event and whose times decide it."""
    single = np.flatnonzero(np.diff(flown.of_event, prepend=-1) != 0)
    middle = 0.5 * float(flown.events[single[0]] + flown.events[single[-1]])
    e = flown.events[single] - middle
    p = flown.photos - flown.photos[0] + (0.5 if whole else 0.0)
    true = np.full(len(p), -1)
    at = {int(exposure): j for j, exposure in enumerate(flown.of_event[single])}
    for i, exposure in enumerate(flown.of_photo.tolist()):
        true[i] = at.get(exposure, -1)
    paired = true >= 0
    if not paired.any():
        return set()
    reach = (0.5 if whole else 0.0) + _JITTER_S + 0.5 * _STEP_S
    rivals = np.zeros(len(p))
    for expected in _clocks(p, e, true, interval, whole):
        rivals = np.maximum(
            rivals, _most_pairs_without_the_true(p, expected, true, reach, 0.8 * interval, paired.sum())
        )
    return set(np.flatnonzero(paired & (paired.sum() - rivals >= LEAST_FEWER)).tolist())


def _clocks(p: Array, e: Array, true: NDArray[np.int64], interval: float, whole: bool) -> Iterator[Array]:
    """(H, M) times of the events by the camera's clock, for clocks that are up to three intervals off the true one."""
    paired = true >= 0
    offset = float(np.median(p[paired] - e[true[paired]]))
    half = max(0.5 * float(np.ptp(e)), 1e-3)
    span = 3.0 * interval + 1.0 + half * _MOST_DRIFT
    offsets = offset + np.arange(-span, span, _STEP_S)
    drifts = np.linspace(-_MOST_DRIFT, _MOST_DRIFT, 2 * int(np.ceil(half * _MOST_DRIFT / _STEP_S)) + 1)
    both = np.stack(np.meshgrid(offsets, drifts, indexing="ij"), axis=-1).reshape(-1, 2)
    for start in range(0, len(both), _CHUNK):
        part = both[start : start + _CHUNK]
        yield part[:, :1] + (1.0 + part[:, 1:]) * e


def _most_pairs_without_the_true(
    p: Array, expected: Array, true: NDArray[np.int64], reach: float, least: float, count: int
) -> Array:
    """(N,) most pairs of any alignment in which a photo has another event than the true one, or none."""
    result = np.zeros(len(p))
    reached = np.array([np.searchsorted(e, p + reach, "right") > np.searchsorted(e, p - reach) for e in expected])
    expected = expected[reached.sum(axis=1) > count - LEAST_FEWER]  # no other clock can have as many pairs
    if not len(expected):
        return result
    near = np.abs(p[None, :, None] - expected[:, None, :]) <= reach
    alone = np.where(_has_room(p, expected, reach, least), 0, -_NO_ROOM).astype(np.int16)
    total = _prefixes(near, alone)[-1].max(axis=1)
    chosen = np.flatnonzero(total > count - LEAST_FEWER)
    if not len(chosen):
        return result
    near, alone = near[chosen], alone[chosen]
    ahead = _prefixes(near, alone)
    back = [part[:, ::-1] for part in _prefixes(near[:, ::-1, ::-1], alone[:, ::-1])][::-1]
    for i in range(len(p)):
        before, after = ahead[i], back[i + 1]
        unpaired = (before + after).max(axis=1) + alone[:, i]
        other = near[:, i].copy()
        if true[i] >= 0:
            other[:, true[i]] = False
        paired = np.where(other, before[:, :-1] + 1 + after[:, 1:], -1).max(axis=1)
        result[i] = max(unpaired.max(), paired.max())
    return result


def _has_room(p: Array, expected: Array, reach: float, least: float) -> NDArray[np.bool_]:
    """(H, N) whether a photo may have been taken at a distance from all events."""
    ends = np.pad(expected, ((0, 0), (1, 1)), constant_values=((0, 0), (-np.inf, np.inf)))
    begins, ends = ends[:, :-1] + least, ends[:, 1:] - least
    low = np.maximum(begins[:, None, :], p[None, :, None] - reach)
    return np.asarray((np.minimum(ends[:, None, :], p[None, :, None] + reach) >= low).any(axis=2))


def _prefixes(near: NDArray[np.bool_], alone: Counts) -> list[Counts]:
    """N + 1 arrays (H, M + 1): most pairs of the first photos with the first events, less penalties."""
    clocks, photos, events = near.shape
    found = [np.zeros((clocks, events + 1), dtype=np.int16)]
    for i in range(photos):
        last = found[-1]
        new = last + alone[:, i, None]
        np.maximum(new[:, 1:], np.where(near[:, i], last[:, :-1] + 1, -1000), out=new[:, 1:])
        found.append(np.maximum.accumulate(new, axis=1))
    return found
