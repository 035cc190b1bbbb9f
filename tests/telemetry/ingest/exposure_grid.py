"""Flights whose photos and camera events are known to belong together, recorded with losses by two clocks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telemetry.ingest.event_pairing import by_time

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Exposures:
    """Times of photos and events, and the exposure (N,), (M,) that each is of."""

    photos: Array
    events: Array
    of_photo: NDArray[np.int64]
    of_event: NDArray[np.int64]


def exposures(
    rng: np.random.Generator, interval: float, *, whole: bool, missing: float, count: int = 0, jitter_s: float = 0.02
) -> Exposures:
    """A flight with straight runs and turns; up to the given share of photos and of events missing anywhere.

    A tenth of the events is recorded twice; the camera's clock is off by up to a year and up to 1,000 ppm fast or slow.
    """
    count = count or int(rng.integers(40, 160))
    gaps = interval + rng.normal(0.0, jitter_s, count)
    at = int(rng.integers(6, 18))
    while at < count:
        gaps[at] = interval + rng.uniform(2.0, 9.0)
        at += int(rng.integers(6, 18))
    taken = np.cumsum(np.maximum(gaps, 0.5 * interval))
    own = np.flatnonzero(rng.random(count) >= missing * rng.random())
    logged = np.flatnonzero(rng.random(count) >= missing * rng.random())
    twice = logged[rng.random(len(logged)) < 0.1]
    logged = np.concatenate([logged, twice])
    events = 1.7e9 + taken[logged]
    events[len(logged) - len(twice) :] += rng.uniform(0.0, 0.05, len(twice))
    order = np.argsort(events, kind="stable")
    offset = float(rng.choice([0.3, 15.2, -7200.4, 3.1e7, -3.0e7 + 0.7]))
    seen = (taken[own] + rng.normal(0.0, jitter_s, len(own))) * (1.0 + rng.uniform(-1e-3, 1e-3)) + 1.7e9 + offset
    seen = np.maximum.accumulate(seen)
    return Exposures(np.floor(seen) if whole else np.round(seen, 2), events[order], own, logged[order])


@dataclass(frozen=True, slots=True)
class Score:
    """Photos whose exposure has an event too; those paired without a mark, and how many of these wrongly."""

    both: int
    decided: int
    wrong_unmarked: int
    marked: int
    wrong_marked: int


def scored(flown: Exposures) -> Score:
    """Pair the photos of a flight and compare with the truth."""
    found = by_time(flown.photos, flown.events)
    decided = [(i, j) for i, j in found.pairs if i not in found.doubtful]
    marked = [(i, j) for i, j in found.pairs if i in found.doubtful]
    both = len(np.intersect1d(flown.of_photo, flown.of_event))
    wrong, uncertain = (sum(flown.of_photo[i] != flown.of_event[j] for i, j in some) for some in (decided, marked))
    return Score(both, len(decided), int(wrong), len(marked), int(uncertain))
