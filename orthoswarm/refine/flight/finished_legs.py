"""Legs that are complete while the vehicle still flies; later pictures do not change them."""

import numpy as np

from orthoswarm.config import active
from orthoswarm.model.arrays import Array
from orthoswarm.trajectory.legs import split_legs


def ended_legs(position: Array, time_s: Array | None = None, *, over: bool = False) -> list[tuple[int, int]]:
    """First and last frame (inclusive) of each finished leg, in order.

    Args:
        position: float64 (N, 2) or (N, 3), recorded positions in flying order so far, metres.
        time_s: float64 (N,) or None; see split_legs.
        over: True if no more frames are expected, so that the last leg is finished, too.
    """
    n = len(position)
    if n < 2:
        return []
    # so many frames after a leg's end neither its corner nor its frames can change any more, see `split_legs`
    settled = 2 * active().records.leg_reach
    leg = split_legs(position, time_s)
    ends = []
    for k in range(int(leg.max()) + 1):
        members = np.flatnonzero(leg == k)
        last = int(members[-1])
        if over or last + settled < n:
            ends.append((int(members[0]), last))
    return ends
