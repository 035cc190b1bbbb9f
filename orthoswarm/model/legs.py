"""Straight runs of a flight, from the path flown (paper III.C groups frames into legs by heading and path)."""

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.angles import wrap_rad

Array = NDArray[np.float64]
Ints = NDArray[np.int32]


REACH = 3
"""Frames before and after between which a bend is measured."""
ONE_WAY_COS = float(np.cos(np.radians(35.0)))
OTHER_WAY_SHARE = 0.3
"""Ways in other directions, as a share of the longest leg, from which on drift and tilt can be told apart."""


def split_legs(
    position: Array, time_s: Array | None = None, turn_rad: float = np.radians(35.0), shortest: int = 3
) -> Ints:
    """Leg of each frame, -1 for frames in turns and strays: int32 (N,), numbered in order.

    Legs end at corners of the path (where it bends most, over a few frames), at jumps and at pauses.

    Args:
        position: float64 (N, 2) or (N, 3), smoothed or recorded positions in flying order, metres.
        time_s: float64 (N,) or None; a gap over 60 s ends a leg.
        turn_rad: least bend of a corner.
        shortest: fewer frames are no leg.
    """
    n = len(position)
    leg = np.full(n, -1, np.int32)
    if n < 2:
        return np.zeros(n, np.int32)
    bend = _bend(position)
    breaks = _breaks(position, time_s)
    corner = np.zeros(n, bool)
    for i in range(n):
        near = slice(max(0, i - REACH + 1), i + REACH)
        corner[i] = bend[i] > turn_rad and bend[i] == bend[near].max()
    first, number = 0, 0
    for i in range(n + 1):
        if i == n or corner[i] or breaks[i]:
            if i - first >= shortest:
                leg[first:i] = number
                number += 1
            first = i + 1 if i < n and corner[i] else i
    return leg


def _bend(position: Array) -> Array:
    """Angle between the way to a frame and the way from it, over REACH frames; 0 at the ends and where it hovers."""
    n = len(position)
    i = np.arange(n)
    ahead = position[np.minimum(i + REACH, n - 1), :2] - position[:, :2]
    behind = position[:, :2] - position[np.maximum(i - REACH, 0), :2]
    moving = (np.hypot(*ahead.T) > 1e-6) & (np.hypot(*behind.T) > 1e-6)
    turn = wrap_rad(np.arctan2(ahead[:, 0], ahead[:, 1]) - np.arctan2(behind[:, 0], behind[:, 1]))
    return np.where(moving, np.abs(turn), 0.0)


def _breaks(position: Array, time_s: Array | None) -> NDArray[np.bool_]:
    """Frames before which the flight was interrupted: a pause of a minute, or a jump of many steps."""
    n = len(position)
    out = np.zeros(n, bool)
    step = np.hypot(*np.diff(position[:, :2], axis=0).T)
    usual = float(np.median(step))
    out[1:] = step > 6.0 * usual + 30.0
    if time_s is not None and np.isfinite(time_s).all():
        out[1:] |= np.diff(time_s) > 60.0
    return out


def leads_one_way(position: Array, leg: Ints) -> bool:
    """Whether the legs lead in one direction, but for short ways between them.

    Args:
        position: float64 (N, 2) or (N, 3) in flying order, metres. leg: int32 (N,), -1 outside legs.
    """
    ways = []
    for k in range(int(leg.max()) + 1 if len(leg) else 0):
        members = np.flatnonzero(leg == k)
        ways.append(position[members[-1], :2] - position[members[0], :2])
    length = np.hypot(*np.array(ways).T) if ways else np.zeros(1)
    if length.max() < 1e-6:
        return True
    longest = ways[int(length.argmax())] / length.max()
    other = np.array(ways) @ longest < ONE_WAY_COS * length
    return float(length[other].sum()) < OTHER_WAY_SHARE * float(length.max())
