"""Wild fixes: positions that no aircraft can have reached from those before and after."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Flags, Indices
from telemetry.samples.course import local_metres
from telemetry.samples.findings import Finding, metres, plural
from telemetry.samples.held_fixes import without_held_fixes
from telemetry.samples.sample import Sample

TIME_RESOLUTION_S: Final = 1.0  # times of positions may be off by this: many are written in whole seconds
FASTEST_M_S: Final = 128.6
"""No aircraft that takes pictures flies faster over ground: 250 knots, the limit below 10,000 feet (14 CFR 91.117(a));
small drones may fly 44.7 m/s (14 CFR 107.51(a))."""
_WILD_MOST_SHARE: Final = 0.1  # positions that cannot be reached are wild up to this share of all
_WILD_MOST_PIECES: Final = 10_000  # a track broken at more places has wrong times, not wild positions


@dataclass(frozen=True, slots=True)
class WildFixes:
    """The fixes of a track that no aircraft can have reached."""

    indices: list[int]  # of the wild ones, in order of time
    away_m: float = 0.0  # how far the farthest lies from its neighbours, metres
    doubtful: int = 0  # how many cannot be reached, where these are too many to be wild fixes


def wild_fixes(times_s: Sequence[float | None], places: Sequence[tuple[float, float]]) -> WildFixes:
    """The fixes that are not part of the longest track that can be flown.

    The track is cut where the next fix is farther away than an aircraft flies in between (`FASTEST_M_S`); of the pieces
    those are kept that can be flown one after the other and hold most fixes. If the others are more than a few, they
    are no wild fixes but another flight, or the times are wrong: then there are none, and their number is `doubtful`.

    times_s: of the fixes, in one clock; what has none is not judged. places: latitude and longitude in degrees.
    """
    timed = [i for i, t in enumerate(times_s) if t is not None and t == t]
    order = sorted(timed, key=lambda i: times_s[i] or 0.0)
    if len(order) < 3:
        return WildFixes([])
    times = np.array([times_s[i] for i in order], dtype=np.float64)
    ground = local_metres([places[i][0] for i in order], [places[i][1] for i in order])
    cuts = np.flatnonzero(~_flyable(times[:-1], ground[:-1], times[1:], ground[1:])) + 1
    first = np.concatenate([[0], cuts])
    last = np.concatenate([cuts, [len(order)]]) - 1
    if len(first) > _WILD_MOST_PIECES:
        return WildFixes([], doubtful=len(first) - 1)
    if len(first) == 1:
        return WildFixes([])
    kept = _longest_track(first, last, times, ground)
    if len(kept) == len(first):
        return WildFixes([])
    pieces = [np.arange(a, b + 1) for k, (a, b) in enumerate(zip(first, last, strict=True)) if k not in kept]
    wild = np.concatenate(pieces)
    if len(wild) > max(1.0, _WILD_MOST_SHARE * len(order)):
        return WildFixes([], doubtful=len(wild))
    sound = np.setdiff1d(np.arange(len(order)), wild)
    after = np.searchsorted(sound, wild).clip(0, len(sound) - 1)
    near = np.minimum(
        np.hypot(*(ground[wild] - ground[sound[after]]).T),
        np.hypot(*(ground[wild] - ground[sound[(after - 1).clip(0)]]).T),
    )
    return WildFixes([order[i] for i in wild.tolist()], float(near.max()))


def _flyable(t0: Array, a: Array, t1: Array, b: Array) -> Flags:
    """Whether an aircraft can fly from places `a` (N, 2), metres, at times `t0` to places `b` at `t1`."""
    reach = FASTEST_M_S * (t1 - t0 + TIME_RESOLUTION_S)
    return np.asarray(np.hypot(b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]) <= reach)


def _longest_track(first: Indices, last: Indices, times: Array, ground: Array) -> set[int]:
    """Pieces (from index `first` to `last`) that can be flown one after the other and hold most fixes together."""
    best = (last - first + 1).astype(np.float64)
    before = np.full(len(first), -1)
    for k in range(1, len(first)):
        ends = last[:k]
        score = np.where(_flyable(times[ends], ground[ends], times[first[k]], ground[first[k]]), best[:k], 0.0)
        i = int(np.argmax(score))
        if score[i] > 0.0:
            best[k] += score[i]
            before[k] = i
    kept, k = set(), int(np.argmax(best))
    while k >= 0:
        kept.add(k)
        k = int(before[k])
    return kept


def doubtful_finding(count: int, of_what: str) -> Finding:
    """The finding on positions that cannot be reached and are used all the same, being too many; see `wild_fixes`."""
    text = (
        f"{count} of {of_what} cannot be reached by any aircraft from those before and after "
        f"({FASTEST_M_S:.0f} m/s); so many are hardly wild, and all are used: they are of several "
        "flights, or their times are wrong; check them, and read each flight by itself"
    )
    return Finding("positions-unreachable", text)


def sound_positions(
    samples: Sequence[Sample], times_s: Sequence[float | None], source: str
) -> tuple[list[Sample], list[Finding]]:
    """One flight's samples without positions that were not measured (`held_fixes`) or are wild, and findings on them.

    times_s: of the samples, in one clock. source: name of the file, for the message.
    """
    samples, told = without_held_fixes(samples, times_s, source)
    placed = [i for i, sample in enumerate(samples) if sample.has_position]
    found = wild_fixes([times_s[i] for i in placed], [samples[i].place for i in placed])
    if found.doubtful:
        doubtful = doubtful_finding(found.doubtful, f"{plural(len(placed), 'position')} of {source}")
        return samples, [*told, doubtful]
    if not found.indices:
        return samples, told
    wild = {placed[i] for i in found.indices}
    sound = [replace(s, lat_deg=None, lon_deg=None) if i in wild else s for i, s in enumerate(samples)]
    lie, they_are = ("lie", "they are") if len(wild) > 1 else ("lies", "it is")
    text = (
        f"{plural(len(wild), 'position')} of {source} {lie} up to {metres(found.away_m)} away from those before and "
        "after, farther than any aircraft flies in that time "
        f"({FASTEST_M_S:.0f} m/s); {they_are} not used"
    )
    return sound, [*told, Finding("wild-fix", text)]
