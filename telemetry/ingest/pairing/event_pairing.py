"""Pairs photos with camera events, although their clocks differ and some of both are missing.

By time: both are matched as sequences (`sequence_match`). Where times decide nothing: by the numbers in file names and
events, else by order alone, unless the times contradict that. Missing first, dropped and extra pictures are found that
way and reported.

Cameras set their clock by satellites after takeoff, by hand, or begin in 1980. Before and after, photos and events
differ by another offset, so that they are matched as sequences part by part.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from telemetry.ingest.pairing.motion_chains import SAME_EXPOSURE_SHARE, PictureMotion
from telemetry.ingest.pairing.sequence_match import CERTAIN, match_sequences
from telemetry.ingest.pairing.sequence_model import MOST_DRIFT

_JUMP_WINDOWS: Final = 4  # parts of a flight compared to find whether the camera's clock was set in between
JUMP_LEAST_PHOTOS: Final = 6  # photos of a part of a flight, and those only its clock gives an event, at least
LEAST_JUMP_S: Final = 0.6  # clocks of two parts that differ by more than this and the largest drift are two settings


@dataclass(slots=True, kw_only=True)
class Pairing:
    """Which photo belongs to which event."""

    pairs: list[tuple[int, int]] = field(default_factory=list)  # (photo, event) indices, photos increasing
    # photos whose pairing the times leave open -> possible events
    doubtful: dict[int, list[int]] = field(default_factory=dict)
    # photos that have an event by the likeliest clock, and none by another one that is possible, too
    open: set[int] = field(default_factory=set)
    offset_s: float | None = None  # photo clock minus event clock, None if times were not used
    residual_s: float = 0.0  # median distance of paired times after offset and drift
    ambiguous: bool = False  # True if less than half of the pairs are decided
    how: str = "time"  # "time", "number" or "order"
    by_pictures: bool = False  # whether the pictures' motion was used, too
    # for each time that the camera's clock was set, the first photo after it and by how many seconds
    jumps: list[tuple[int, float]] = field(default_factory=list)


def pair(
    photo_times: Sequence[float | None],
    event_times: Sequence[float | None],
    photo_numbers: Sequence[int | None] = (),
    event_numbers: Sequence[int | None] = (),
    motion: PictureMotion | None = None,
) -> Pairing:
    """Pair photos with events; both are in order of time (or of name).

    Args:
        photo_times: by the camera's clock, None where unknown. event_times: UTC, None where unknown.
        photo_numbers: of file names. event_numbers: the autopilot's image counts.
        motion: the way flown as the photos show it, for photos that the times leave open.
    """
    if not len(photo_times) or not len(event_times):
        return Pairing()
    by_times: Pairing | None = None
    timed = [i for i, t in enumerate(photo_times) if t is not None]
    dated = [j for j, t in enumerate(event_times) if t is not None]
    if len(timed) > 1 and len(dated) > 1:
        photos = np.array([photo_times[i] for i in timed], dtype=np.float64)
        events = np.array([event_times[j] for j in dated], dtype=np.float64)
        if np.ptp(photos) > 0.0:
            if motion is not None:
                motion = motion.subset(timed, dated)
            by_times = by_time(photos, events, motion)
            if len(by_times.pairs) < len(photos):
                numbers = [photo_numbers[i] for i in timed] if len(photo_numbers) else []
                by_parts = _by_parts(photos, events, numbers)
                if by_parts is not None and _explains_more(by_parts, by_times):
                    by_times = by_parts
            by_times.pairs = [(timed[i], dated[j]) for i, j in by_times.pairs]
            by_times.jumps = [(timed[i], jump_s) for i, jump_s in by_times.jumps]
            by_times.open = {timed[i] for i in by_times.open}
            by_times.doubtful = {timed[i]: [dated[j] for j in at] for i, at in by_times.doubtful.items()}
            share = len(by_times.pairs) / min(len(photos), len(events))
            if by_times.jumps or share >= 0.5 or (by_times.pairs and not by_times.ambiguous):
                return by_times
    other = _by_number(photo_numbers, event_numbers)
    if other is None:
        pairs = [(i, i) for i in range(min(len(photo_times), len(event_times)))]
        other = Pairing(pairs=pairs, how="order", ambiguous=len(photo_times) != len(event_times))
    if by_times is not None and _contradicted(other.pairs, photo_times, event_times):
        return by_times
    return other


def _contradicted(
    pairs: Sequence[tuple[int, int]], photo_times: Sequence[float | None], event_times: Sequence[float | None]
) -> bool:
    """Whether the two clocks would differ by another offset for most pairs; half of the usual interval is allowed."""
    timed = [(p, e) for i, j in pairs if (p := photo_times[i]) is not None and (e := event_times[j]) is not None]
    if len(timed) < 3:
        return False
    photo, event = np.array(timed).T
    offset = photo - event
    apart = np.abs(offset - np.median(offset))
    return bool(np.mean(apart > 0.5 * np.median(np.diff(np.sort(event)))) > 0.5)


def by_time(photos: Array, events: Array, motion: PictureMotion | None = None) -> Pairing:
    """Pair two sequences of times whose clocks differ by an unknown offset and drift.

    Args:
        photos: (N,) by the camera's clock. events: (M,) by the vehicle's.
        motion: what the pictures show; its photos and events are numbered as here.
    """
    order_p, order_e = np.argsort(photos, kind="stable"), np.argsort(events, kind="stable")
    if motion is not None:
        motion = motion.subset(order_p.tolist(), order_e.tolist())
    found = match_sequences(photos[order_p], events[order_e], motion)
    if found is None:
        return Pairing()
    pairs = found.pairs()
    certain = sum(probability >= CERTAIN for _, _, probability in pairs)
    result = Pairing(offset_s=found.offset_s, ambiguous=certain < 0.5 * len(pairs), by_pictures=found.by_pictures)
    for i, j, probability in pairs:
        photo, event = int(order_p[i]), int(order_e[j])
        result.pairs.append((photo, event))
        if probability < CERTAIN or result.ambiguous:
            result.doubtful[photo] = [int(order_e[k]) for k in found.alternatives(i)]
        if found.may_have_none(i):
            result.open.add(photo)
    if pairs:
        own, theirs = photos[order_p][[i for i, _, _ in pairs]], events[order_e][[j for _, j, _ in pairs]]
        middle = 0.5 * (float(events.min()) + float(events.max()))
        apart = own + 0.5 * found.resolution_s - theirs - found.offset_s - found.drift * (theirs - middle)
        result.residual_s = float(np.median(np.abs(apart)))
    result.pairs.sort()
    return result


def _by_parts(photos: Array, events: Array, numbers: Sequence[int | None]) -> Pairing | None:
    """Pair by times where the camera's clock was set during the flight; None if it was not.

    Args:
        photos: (N,) by the camera's clock. events: (M,) by the vehicle's.
        numbers: of the photos' names, in order of exposure; none if the photos are.
    """
    order = np.arange(len(photos))
    known = [number for number in numbers if number is not None]
    if len(known) == len(photos):
        order = np.argsort(np.array(known), kind="stable")
    by_event = np.argsort(events, kind="stable")
    parts = _parts_between_jumps(photos[order], events[by_event])
    if len(parts) < 2:
        return None
    result, clocks, free = Pairing(offset_s=None), list[float](), 0
    for part in parts:
        own, theirs = order[part], by_event[free:]
        found = by_time(photos[own], events[theirs]) if len(own) and len(theirs) else Pairing()
        if found.offset_s is None or found.ambiguous:
            continue
        pairs = [(int(own[i]), int(theirs[j])) for i, j in found.pairs]
        result.doubtful |= {int(own[i]): [int(theirs[j]) for j in at] for i, at in found.doubtful.items()}
        result.pairs += pairs
        clocks.append(float(np.median([photos[i] - events[j] for i, j in pairs])))
        if len(clocks) > 1:
            result.jumps.append((int(own[0]), clocks[-1] - clocks[-2]))
        result.residual_s = max(result.residual_s, found.residual_s)
        result.offset_s = found.offset_s
        free += 1 + max(j for _, j in found.pairs)
    result.pairs.sort()
    return result if result.jumps else None


def _explains_more(parts: Pairing, whole: Pairing) -> bool:
    """Whether several clocks find events for photos that one clock leaves without any.

    Photos that no log recorded lack events as well. A clock of their own would only take events from the photos that
    these belong to: legs of one mission have one rhythm.
    """
    found, before = (sum(i not in pairing.doubtful for i, _ in pairing.pairs) for pairing in (parts, whole))
    return found >= before + JUMP_LEAST_PHOTOS


def _certain_offsets(photos: Array, events: Array) -> Array | None:
    """Offsets (photo minus event) of the certain pairs of a part of a flight; None if its times do not decide."""
    found = by_time(photos, events) if np.ptp(photos) > 0.0 else Pairing()
    sure = [(i, j) for i, j in found.pairs if i not in found.doubtful]
    if len(sure) < max(JUMP_LEAST_PHOTOS - 1, 0.5 * len(photos)):
        return None
    return np.array([photos[i] - events[j] for i, j in sure])


def _by_number(photos: Sequence[int | None], events: Sequence[int | None]) -> Pairing | None:
    """Pair by the numbers of files and events, with the shift on which most agree; None without numbers."""
    own = {n: i for i, n in enumerate(photos) if n is not None}
    theirs = {n: j for j, n in enumerate(events) if n is not None}
    if len(own) < 2 or len(theirs) < 2 or len(own) < 0.9 * len(photos) or len(theirs) < 0.9 * len(events):
        return None
    votes: dict[int, int] = {}
    for n in own:
        for m in theirs:
            votes[n - m] = votes.get(n - m, 0) + 1
    most = max(votes.values())
    # Of equally good shifts, the one that pairs the first pictures.
    shift = min((s for s, v in votes.items() if v == most), key=lambda s: abs(min(own) - s - min(theirs)))
    pairs = sorted((own[m + shift], j) for m, j in theirs.items() if m + shift in own)
    return Pairing(pairs=pairs, how="number", ambiguous=sum(v == most for v in votes.values()) > 1)


def _parts_between_jumps(photos: Array, events: Array) -> list[slice]:
    """The parts of a flight between which the camera's clock was set; one if it never was.

    Photos (N,) by the camera are in order of exposure (of the files' numbers), events (M,) by the vehicle in order.
    """
    count = len(photos)
    if count < _JUMP_WINDOWS * JUMP_LEAST_PHOTOS:
        return [slice(0, count)]
    edges = np.linspace(0, count, _JUMP_WINDOWS + 1).round().astype(int)
    allowed = MOST_DRIFT * float(np.ptp(events)) + LEAST_JUMP_S
    parts = list(pairwise(edges.tolist()))
    begin, end = (_certain_offsets(photos[a:b], events) for a, b in (parts[0], parts[-1]))
    if begin is not None and end is not None and abs(float(np.median(end) - np.median(begin))) <= allowed:
        return [slice(0, count)]  # a clock that was set stays so
    found = [begin, *(_certain_offsets(photos[a:b], events) for a, b in parts[1:-1]), end]
    clocks = [float(np.median(some)) for some in found if some is not None]
    starts = [0]
    for before, after in pairwise(clocks):
        if abs(after - before) > allowed:
            start = starts[-1]  # under the clock of their part photos are nearest to events
            far = SAME_EXPOSURE_SHARE * float(np.median(np.diff(events)))
            own, other = (np.minimum(_apart(photos[start:] - clock, events), far) for clock in (before, after))
            starts.append(start + int(np.argmin(np.concatenate([[0.0], np.cumsum(own - other)]))))
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], count], strict=True) if b > a]


def _apart(times: Array, events: Array) -> Array:
    """From each time the distance to the nearest event, seconds."""
    right = np.searchsorted(events, times).clip(1, len(events) - 1)
    return np.asarray(np.minimum(np.abs(times - events[right]), np.abs(times - events[right - 1])))
