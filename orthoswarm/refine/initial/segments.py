"""Segments: runs of photos with constant attitude bias and altitude offset."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array, Complex, Flags, Ints
from orthoswarm.model.robust import mad_sigma
from orthoswarm.trajectory.legs import PAUSE_S

_SEGMENT_GAP_S: Final = 180.0  # a longer pause ends a segment: landing, battery (chosen on four real flights)
_SEGMENT_CLIMB_M: Final = 5.0  # a larger jump of the recorded height ends a segment (chosen on four real flights)
_SEGMENT_TILT_DEG: Final = 1.5
"""A larger jump of the recorded tilt ends it: the gimbal was turned (chosen on four real flights)."""
_SEGMENT_JUMP_SIGMAS: Final = 5.0  # a jump must exceed so many sigmas of the record's own noise as well
_LEG_STILL_M: Final = 1.5  # shorter steps have no direction
_LEG_TURN_DEG: Final = 35.0  # a leg ends where a step leaves the mean of its steps by more than this


def split_segments(group: NDArray[np.integer], time_s: Array, height_m: Array, pitch_rad: Array) -> Ints:
    """Number of the segment of each photo, int32 (N,), from 0 in order of first appearance.

    A segment ends at a long pause (landing, battery), at a jump of the recorded height and at a jump of the recorded
    tilt (the gimbal was moved) that exceeds the record's own noise. A jump that the next photo reverses is a
    wrong tag and does not end a segment.

    Args:
        group: integers (N,), vehicle and lens; photos of a group are in order of time.
        time_s: float64 (N,), NaN where unknown.
        height_m: float64 (N,), height or altitude, NaN where unknown.
        pitch_rad: float64 (N,), NaN where unknown.
    """
    tilt_rad = float(np.radians(_SEGMENT_TILT_DEG))
    segment = np.zeros(len(group), np.int32)
    used = 0
    for g in dict.fromkeys(group.tolist()):
        rows = np.flatnonzero(group == g)
        cut = np.zeros(len(rows), bool)
        cut[1:] = np.diff(time_s[rows]) > _SEGMENT_GAP_S
        cut |= _jumps(height_m[rows], _SEGMENT_CLIMB_M) | _jumps(pitch_rad[rows], tilt_rad)
        number = np.cumsum(cut)
        segment[rows] = used + number
        used += int(number[-1]) + 1
    return segment


def _jumps(value: Array, limit: float) -> Flags:
    """Where a sequence jumps by more than the limit and does not return with the next value."""
    jump = np.zeros(len(value), bool)
    known = np.flatnonzero(np.isfinite(value))
    v = value[known]
    if len(v) > 2:
        noise = mad_sigma(np.diff(v)) / np.sqrt(2.0)
        limit = max(limit, _SEGMENT_JUMP_SIGMAS * noise)
    level = 0
    for k in range(1, len(v)):
        if abs(v[k] - v[level]) <= limit:
            level = k
        elif k + 1 == len(v) or abs(v[k + 1] - v[level]) > limit:
            jump[known[k]] = True
            level = k
    return jump


def photo_legs(position: Complex, segment: Ints, time_s: Array) -> Ints:
    """Leg of each photo, int32 (N,), numbered in order: runs of photos along a straight course; every photo has one.

    For photos far apart: two photos make a leg, and the path from the last photo of one to the first of the next
    belongs to neither.

    Args:
        position: complex (N,), east + i north, in order of time.
        segment: int32 (N,); a leg lies in one segment.
        time_s: float64 (N,), NaN where unknown; a pause ends a leg.
    """
    pause_s = PAUSE_S
    turn_rad = float(np.radians(_LEG_TURN_DEG))
    leg = np.zeros(len(position), np.int32)
    way = 0j
    for k in range(1, len(position)):
        step = complex(position[k] - position[k - 1])
        still = abs(step) < _LEG_STILL_M
        turned = not still and abs(way) > 0 and abs(np.angle(step * np.conj(way))) > turn_rad
        new = segment[k] != segment[k - 1] or time_s[k] - time_s[k - 1] > pause_s or turned
        leg[k] = leg[k - 1] + int(new)
        way = 0j if new else way + (0j if still else step)
    return leg
