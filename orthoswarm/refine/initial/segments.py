"""Segments: runs of photos over which attitude bias and altitude offset stay the same."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

GAP_S = 180.0
JUMP_M = 5.0
LEG_GAP_S = 60.0
STILL_M = 1.5
TILT_JUMP_RAD = float(np.radians(1.5))
JUMP_SIGMAS = 5.0
"""A jump must stand out of the record's own noise as well: a camera that sways is not turned at every photo."""


def split_segments(group: NDArray[np.integer], time_s: Array, height_m: Array, pitch_rad: Array) -> Ints:
    """Number of the segment of each photo, int32 (N,), from 0 in order of first appearance.

    A segment ends at a pause of more than 180 s (landing, battery), at a jump of the recorded height of more than 5 m
    and at a jump of the recorded tilt of more than 1.5 degrees (the gimbal was turned), or of more than five sigmas of
    the record's own noise if that is more. A jump that the very next photo takes back is a wrong tag and ends nothing.

    Args:
        group: integers (N,), vehicle and lens; photos of a group stand in order of time.
        time_s: float64 (N,), NaN where unknown.
        height_m: float64 (N,), height or altitude, NaN where unknown.
        pitch_rad: float64 (N,), NaN where unknown.
    """
    segment = np.zeros(len(group), np.int32)
    used = 0
    for g in dict.fromkeys(group.tolist()):
        rows = np.flatnonzero(group == g)
        cut = np.zeros(len(rows), bool)
        cut[1:] = np.diff(time_s[rows]) > GAP_S
        cut |= _jumps(height_m[rows], JUMP_M) | _jumps(pitch_rad[rows], TILT_JUMP_RAD)
        number = np.cumsum(cut)
        segment[rows] = used + number
        used += int(number[-1]) + 1
    return segment


def _jumps(value: Array, limit: float) -> NDArray[np.bool_]:
    """Where a sequence leaves its level by more than the limit and does not return at once."""
    jump = np.zeros(len(value), bool)
    known = np.flatnonzero(np.isfinite(value))
    v = value[known]
    if len(v) > 2:
        noise = 1.4826 * float(np.median(np.abs(np.diff(v)))) / np.sqrt(2.0)
        limit = max(limit, JUMP_SIGMAS * noise)
    level = 0
    for k in range(1, len(v)):
        if abs(v[k] - v[level]) <= limit:
            level = k
        elif k + 1 == len(v) or abs(v[k + 1] - v[level]) > limit:
            jump[known[k]] = True
            level = k
    return jump


def photo_legs(
    position: NDArray[np.complex128], segment: Ints, time_s: Array, turn_rad: float = float(np.radians(35.0))
) -> Ints:
    """Leg of each photo, int32 (N,), numbered in order: runs of photos flown straight on; every photo has one.

    Made for photos far apart: two photos are a leg, and the way from the last photo of one to the first of the next
    belongs to neither.

    Args:
        position: complex (N,), east + i north, in order of time.
        segment: int32 (N,); a leg lies in one segment.
        time_s: float64 (N,), NaN where unknown; a pause of more than 60 s ends a leg.
        turn_rad: a leg ends where a step leaves the mean of its steps by more than this.
    """
    leg = np.zeros(len(position), np.int32)
    way = 0j
    for k in range(1, len(position)):
        step = complex(position[k] - position[k - 1])
        still = abs(step) < STILL_M
        turned = not still and abs(way) > 0 and abs(np.angle(step * np.conj(way))) > turn_rad
        new = segment[k] != segment[k - 1] or time_s[k] - time_s[k - 1] > LEG_GAP_S or turned
        leg[k] = leg[k - 1] + int(new)
        way = 0j if new else way + (0j if still else step)
    return leg
