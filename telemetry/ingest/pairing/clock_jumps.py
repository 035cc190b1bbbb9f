"""Finds where a camera's clock was set between two photos of a flight, from the camera events of its log.

Cameras set their clock by satellites after takeoff, by hand, or begin in 1980. Before and after, photos and events
differ by another offset, so that they are matched as sequences part by part.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from telemetry.ingest.pairing.motion_chains import SAME_EXPOSURE_SHARE
from telemetry.ingest.pairing.sequence_model import MOST_DRIFT

Array = NDArray[np.float64]
Matcher = Callable[[Array, Array], Array | None]
"""Offsets (photo minus event) of the certain pairs of photos (N,) and events (M,); None if the times do not decide."""

_JUMP_WINDOWS: Final = 4  # parts of a flight compared to find whether the camera's clock was set in between
JUMP_LEAST_PHOTOS: Final = 6  # photos of a part of a flight, and those only its clock gives an event, at least
LEAST_JUMP_S: Final = 0.6  # clocks of two parts that differ by more than this and the largest drift are two settings


def parts_between_jumps(photos: Array, events: Array, offsets: Matcher) -> list[slice]:
    """The parts of a flight between which the camera's clock was set; one if it never was.

    Args:
        photos: (N,) times by the camera, in order of exposure (of the files' numbers).
        events: (M,) times by the vehicle, in order.
        offsets: matches a part of the photos with the events.
    """
    count = len(photos)
    if count < _JUMP_WINDOWS * JUMP_LEAST_PHOTOS:
        return [slice(0, count)]
    edges = np.linspace(0, count, _JUMP_WINDOWS + 1).round().astype(int)
    allowed = MOST_DRIFT * float(np.ptp(events)) + LEAST_JUMP_S
    parts = list(pairwise(edges.tolist()))
    begin, end = (offsets(photos[a:b], events) for a, b in (parts[0], parts[-1]))
    if begin is not None and end is not None and abs(float(np.median(end) - np.median(begin))) <= allowed:
        return [slice(0, count)]  # a clock that was set stays so
    found = [begin, *(offsets(photos[a:b], events) for a, b in parts[1:-1]), end]
    clocks = [float(np.median(some)) for some in found if some is not None]
    starts = [0]
    for before, after in pairwise(clocks):
        if abs(after - before) > allowed:
            starts.append(_first_after(photos, events, before, after, starts[-1]))
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], count], strict=True) if b > a]


def _first_after(photos: Array, events: Array, before: float, after: float, start: int) -> int:
    """Index of the first photo of the later clock: under the clock of their part photos are nearest to events."""
    far = SAME_EXPOSURE_SHARE * float(np.median(np.diff(events)))
    own, other = (np.minimum(_apart(photos[start:] - clock, events), far) for clock in (before, after))
    return start + int(np.argmin(np.concatenate([[0.0], np.cumsum(own - other)])))


def _apart(times: Array, events: Array) -> Array:
    """From each time the distance to the nearest event, seconds."""
    right = np.searchsorted(events, times).clip(1, len(events) - 1)
    return np.asarray(np.minimum(np.abs(times - events[right]), np.abs(times - events[right - 1])))
