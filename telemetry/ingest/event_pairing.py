"""Photos and camera events brought together, although their clocks differ and some of either are missing.

By time: the offset of the clocks is the one under which most photos fall on events (their uneven rhythm at turns and
pauses fits one offset only); then each photo takes its event in order. Without times: by the numbers in file names and
events, else by order alone. Missing first, dropped and extra pictures are found that way and reported.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BIN_S = 0.5
_TOLERANCE_S = 1.25
_CANDIDATES = 24
_MOST_DIFFERENCES = 4_000_000


@dataclass(slots=True)
class Pairing:
    """Which photo belongs to which event.

    Attributes:
        pairs: (photo, event) indices, both increasing.
        offset_s: photo clock minus event clock, None where times were not used.
        residual_s: median distance of paired times after the offset.
        ambiguous: True where another offset fits as well. how: "time", "number" or "order".
    """

    pairs: list[tuple[int, int]] = field(default_factory=list)
    offset_s: float | None = None
    residual_s: float = 0.0
    ambiguous: bool = False
    how: str = "time"


def pair(
    photo_times: Sequence[float | None],
    event_times: Sequence[float | None],
    photo_numbers: Sequence[int | None] = (),
    event_numbers: Sequence[int | None] = (),
) -> Pairing:
    """Bring photos and events together; both are in order of time (or of name).

    Args:
        photo_times: by the camera's clock, None where unknown.
        event_times: UTC, None where unknown.
        photo_numbers: of file names.
        event_numbers: as the autopilot counts.
    """
    if not len(photo_times) or not len(event_times):
        return Pairing()
    timed = [i for i, t in enumerate(photo_times) if t is not None]
    dated = [j for j, t in enumerate(event_times) if t is not None]
    if len(timed) > 1 and len(dated) > 1:
        photos = np.array([photo_times[i] for i in timed], dtype=np.float64)
        events = np.array([event_times[j] for j in dated], dtype=np.float64)
        if np.ptp(photos) > 0.0:
            found = by_time(photos, events)
            if len(found.pairs) >= 0.5 * min(len(photos), len(events)):
                found.pairs = [(timed[i], dated[j]) for i, j in found.pairs]
                return found
    numbered = _by_number(photo_numbers, event_numbers)
    if numbered is not None:
        return numbered
    count = min(len(photo_times), len(event_times))
    return Pairing([(i, i) for i in range(count)], how="order", ambiguous=len(photo_times) != len(event_times))


def by_time(photos: Array, events: Array, tolerance_s: float = _TOLERANCE_S) -> Pairing:
    """Pair two rows of times whose clocks differ by an unknown offset."""
    order_p, order_e = np.argsort(photos, kind="stable"), np.argsort(events, kind="stable")
    p, e = photos[order_p], events[order_e]
    tried: list[tuple[int, float, float, list[tuple[int, int]]]] = []
    for offset in _offsets(p, e):
        for _ in range(3):
            pairs = _in_order(p - offset, e, tolerance_s)
            if not pairs:
                break
            better = float(np.median([p[i] - e[j] for i, j in pairs]))
            if abs(better - offset) < 1e-6:
                break
            offset = better
        if pairs:
            residual = float(np.median([abs(p[i] - offset - e[j]) for i, j in pairs]))
            tried.append((len(pairs), residual, offset, pairs))
    if not tried:
        return Pairing()
    tried.sort(key=lambda row: (-row[0], round(row[1], 2), abs(row[2])))
    count, residual, offset, pairs = tried[0]
    rivals = [row for row in tried[1:] if abs(row[2] - offset) > 2.0 * tolerance_s]
    ambiguous = bool(rivals) and rivals[0][0] == count and rivals[0][1] < residual + 0.1
    matched = [(int(order_p[i]), int(order_e[j])) for i, j in pairs]
    return Pairing(sorted(matched), offset, residual, ambiguous)


def _offsets(p: Array, e: Array) -> list[float]:
    """Likely offsets: where differences of all pairs gather."""
    step = max(1, int(np.sqrt(len(p) * len(e) / _MOST_DIFFERENCES)))
    difference = np.sort((p[:, None] - e[None, ::step]).ravel())
    # Count differences within one bin after each, without a histogram over what may be years.
    count = np.searchsorted(difference, difference + 2.0 * _BIN_S, side="right") - np.arange(len(difference))
    found: list[float] = []
    for at in np.argsort(-count, kind="stable"):
        middle = float(np.median(difference[at : at + count[at]]))
        if all(abs(middle - other) > _BIN_S for other in found):
            found.append(middle)
            if len(found) == _CANDIDATES:
                break
    return found


def _in_order(p: Array, e: Array, tolerance_s: float) -> list[tuple[int, int]]:
    """Pairs within the tolerance, each used once, in order; the nearer of two neighbours wins."""
    pairs: list[tuple[int, int]] = []
    i = j = 0
    while i < len(p) and j < len(e):
        apart = abs(p[i] - e[j])
        if i + 1 < len(p) and abs(p[i + 1] - e[j]) < apart and p[i] < e[j]:
            i += 1
        elif j + 1 < len(e) and abs(p[i] - e[j + 1]) < apart and e[j] < p[i]:
            j += 1
        elif apart <= tolerance_s:
            pairs.append((i, j))
            i, j = i + 1, j + 1
        elif p[i] < e[j]:
            i += 1
        else:
            j += 1
    return pairs


def _by_number(photos: Sequence[int | None], events: Sequence[int | None]) -> Pairing | None:
    """Pair by the numbers of files and events under the shift that most agree with; None where there are none."""
    own = {n: i for i, n in enumerate(photos) if n is not None}
    theirs = {n: j for j, n in enumerate(events) if n is not None}
    if len(own) < 2 or len(theirs) < 2 or len(own) < 0.9 * len(photos) or len(theirs) < 0.9 * len(events):
        return None
    votes: dict[int, int] = {}
    for n in own:
        for m in theirs:
            votes[n - m] = votes.get(n - m, 0) + 1
    most = max(votes.values())
    # Of equal shifts the one that brings the first pictures together.
    shift = min((s for s, v in votes.items() if v == most), key=lambda s: abs(min(own) - s - min(theirs)))
    pairs = sorted((own[m + shift], j) for m, j in theirs.items() if m + shift in own)
    return Pairing(pairs, how="number", ambiguous=sum(v == most for v in votes.values()) > 1)
