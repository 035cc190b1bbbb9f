"""Courses and straight runs of a flight, from the path flown (paper III.C: legs by heading and path)."""

from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Flags, Ints

PAUSE_S: Final = 60.0  # photos farther apart in time do not follow each other: the vehicle did something else between
LEG_REACH: Final = 3  # frames before and after a frame between which the bend of the path is measured: one is noise
_LEG_TURN_DEG: Final = 35.0  # least bend of the path at the corner between two legs
_LEG_FEWEST: Final = 3  # fewer frames are not a leg
_LEG_JUMP_STEPS: Final = 6.0  # a step of more than so many median steps and the next field ends a leg ...
_LEG_JUMP_M: Final = 30.0  # ... metres (receivers' outliers are below)
_ONE_WAY_DEG: Final = 35.0  # legs within this angle of the longest lead in its direction; not the opposite one
_OTHER_WAY_SHARE: Final = 0.3  # ways in other directions over the longest leg that tell drift from tilt
MOVED_M: Final = 1.0  # steps that are shorter have no direction and no spacing: receivers scatter by about that
_CORNER_DEG: Final = 50.0  # a change of course above this is a corner between two legs and no bend


def split_legs(position: Array, time_s: Array | None = None) -> Ints:
    """Leg of each frame, -1 for frames in turns and strays: int32 (N,), numbered in order.

    Legs end at corners of the path (where it bends most, over a few frames), at jumps and at pauses.

    position: float64 (N, 2) or (N, 3), smoothed or recorded positions in flying order, metres. time_s: float64 (N,) or
    None; a longer gap than `PAUSE_S` ends a leg.
    """
    turn_rad = float(np.radians(_LEG_TURN_DEG))
    n = len(position)
    leg = np.full(n, -1, np.int32)
    if n < 2:
        return np.zeros(n, np.int32)
    bend = _bend(position)
    breaks = _breaks(position, time_s)
    corner = np.zeros(n, bool)
    for i in range(n):
        near = slice(max(0, i - LEG_REACH + 1), i + LEG_REACH)
        corner[i] = bend[i] > turn_rad and bend[i] == bend[near].max()
    first, number = 0, 0
    for i in range(n + 1):
        if i == n or corner[i] or breaks[i]:
            if i - first >= _LEG_FEWEST:
                leg[first:i] = number
                number += 1
            first = i + 1 if i < n and corner[i] else i
    return leg


def _bend(position: Array) -> Array:
    """Angle between the way to a frame and the way from it, over some frames; 0 at the ends and where it hovers."""
    n = len(position)
    i = np.arange(n)
    ahead = position[np.minimum(i + LEG_REACH, n - 1), :2] - position[:, :2]
    behind = position[:, :2] - position[np.maximum(i - LEG_REACH, 0), :2]
    moving = (np.hypot(*ahead.T) > 1e-6) & (np.hypot(*behind.T) > 1e-6)
    turn = wrap_rad(np.arctan2(ahead[:, 0], ahead[:, 1]) - np.arctan2(behind[:, 0], behind[:, 1]))
    return np.where(moving, np.abs(turn), 0.0)


def _breaks(position: Array, time_s: Array | None) -> Flags:
    """Frames before which the flight was interrupted: a pause, or a jump of many steps."""
    n = len(position)
    out = np.zeros(n, bool)
    step = np.hypot(*np.diff(position[:, :2], axis=0).T)
    usual = float(np.median(step))
    out[1:] = step > _LEG_JUMP_STEPS * usual + _LEG_JUMP_M
    if time_s is not None and np.isfinite(time_s).all():
        out[1:] |= np.diff(time_s) > PAUSE_S
    return out


def leads_one_way(position: Array, leg: Ints) -> bool:
    """Whether the legs lead in one direction, but for short ways between them.

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
    other = np.array(ways) @ longest < np.cos(np.radians(_ONE_WAY_DEG)) * length
    return float(length[other].sum()) < _OTHER_WAY_SHARE * float(length.max())


def ended_legs(position: Array, time_s: Array | None = None, *, over: bool = False) -> list[tuple[int, int]]:
    """First and last frame (inclusive) of each finished leg, in order.

    position: float64 (N, 2) or (N, 3), recorded positions in flying order so far, metres. over: True if no more frames
    are expected, so that the last leg is finished, too.
    """
    n = len(position)
    if n < 2:
        return []
    # so many frames after a leg's end neither its corner nor its frames can change any more, see `split_legs`
    settled = 2 * LEG_REACH
    leg = split_legs(position, time_s)
    ends = []
    for k in range(int(leg.max()) + 1):
        members = np.flatnonzero(leg == k)
        last = int(members[-1])
        if over or last + settled < n:
            ends.append((int(members[0]), last))
    return ends


def course(ground: Array) -> Array:
    """Grid azimuth of flight at each of a vehicle's positions (N, 2), radians; at a corner that of the leg it ends.

    Steps under `MOVED_M` have no direction and take that of the nearest step that has; 0 where nothing moved.
    """
    corner_rad = np.radians(_CORNER_DEG)
    n = len(ground)
    steps = np.diff(ground, axis=0)
    moved = np.nonzero(np.hypot(*steps.T) > MOVED_M)[0] if n > 1 else np.empty(0, np.intp)
    if len(moved) == 0:
        return np.zeros(n)
    azimuth = np.arctan2(steps[moved, 0], steps[moved, 1])
    after = np.searchsorted(moved, np.arange(n))  # the first step that begins here or later
    into, out = azimuth[np.maximum(after - 1, 0)], azimuth[np.minimum(after, len(moved) - 1)]
    before = azimuth[np.maximum(after - 2, 0)]
    corner = np.abs(wrap_rad(out - into)) > corner_rad
    straight_in = np.abs(wrap_rad(into - before)) < corner_rad
    middle = into + 0.5 * wrap_rad(out - into)
    return np.asarray(np.where(corner, np.where(straight_in, into, out), middle))
