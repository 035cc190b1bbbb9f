"""Straight runs of a flight, from the path flown (paper III.C groups frames into legs by heading and path)."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int32]


def split_legs(
    position: Array, time_s: Array | None = None, turn_rad: float = np.radians(30.0), shortest: int = 3
) -> Ints:
    """Leg of each frame, -1 for frames in turns and strays: int32 (N,), numbered in order.

    Args:
        position: float64 (N, 2) or (N, 3), smoothed or recorded positions in flying order, metres.
        time_s: float64 (N,) or None; a gap over 60 s ends a leg.
        turn_rad: a leg ends where the course leaves its own mean by more than this.
        shortest: fewer frames are no leg.
    """
    n = len(position)
    leg = np.full(n, -1, np.int32)
    if n < 2:
        return np.zeros(n, np.int32) if n else leg
    span = min(4, n - 1)
    ahead = np.minimum(np.arange(n) + span, n - 1)
    behind = np.maximum(np.arange(n) - span, 0)
    forward = position[ahead, :2] - position[:, :2]
    backward = position[:, :2] - position[behind, :2]
    course = np.where((np.arange(n) == n - 1)[:, None] | (np.hypot(*forward.T) < 1e-6)[:, None], backward, forward)
    angle = np.arctan2(course[:, 0], course[:, 1])
    bend = np.abs(_wrap(np.arctan2(forward[:, 0], forward[:, 1]) - np.arctan2(backward[:, 0], backward[:, 1])))
    bend[[0, n - 1]] = 0.0
    gap = np.zeros(n, bool)
    if time_s is not None and np.isfinite(time_s).all():
        gap[1:] = np.diff(time_s) > 60.0
    first, number = 0, 0
    for i in range(1, n + 1):
        inside = slice(first, i)
        mean = np.angle(np.exp(1j * angle[inside]).sum())
        ends = i == n or gap[i] or abs(_wrap(angle[i] - mean)) > turn_rad
        if ends:
            members = np.arange(first, i)
            members = members[bend[members] < 2 * turn_rad] if len(members) > 2 * span else members
            if len(members) >= shortest:
                leg[members] = number
                number += 1
            first = i
    return leg


def _wrap(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
