"""Headings that were not recorded, where pictures turn: measured by how corners turn from picture to picture."""

from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array
from orthoswarm.refine.bundle.block_arrays import Tracks
from orthoswarm.refine.bundle.flight_records import FlightRecords

_HEADING_REACH_PHOTOS: Final = 7  # heading that was not recorded follows from those of so many photos before and after
_HEADING_LEAST_CORNERS: Final = 10  # fewest tracked corners that tell how far a photo is turned from the one before


def with_measured_headings(records: FlightRecords, tracks: Tracks) -> FlightRecords:
    """Records whose assumed headings are those that most pictures around them agree on.

    Without a recorded heading a picture is assumed to point along the path. Where the path bends, that may be off by
    half a corner: an aircraft may turn before the picture, after it, or during several. Each picture's heading follows
    from each neighbour's assumed one and from how the pictures turned between the two; the median is taken.

    Args:
        records: in order of pictures. tracks: corners followed through them, pixels.
    """
    if records.has_yaw.all():
        return records
    turn = turns(tracks, len(records.yaw))
    broken = np.isnan(turn)
    chain, heading = np.cumsum(broken), np.cumsum(np.where(broken, 0.0, turn))
    yaw = records.yaw.copy()
    for i in np.flatnonzero(~records.has_yaw):
        near = slice(max(0, i - _HEADING_REACH_PHOTOS), i + _HEADING_REACH_PHOTOS + 1)
        from_others = records.yaw[near] + heading[i] - heading[near] - records.yaw[i]
        yaw[i] += _median_angle(from_others[chain[near] == chain[i]])
    return replace(records, yaw=wrap_rad(yaw))


def turns(tracks: Tracks, count: int) -> Array:
    """How far each picture's heading is turned from the one before, radians, clockwise; NaN where too few corners tell.

    Args:
        tracks: in pixels. count: number of pictures.

    Returns:
        float64 (count,); the first is NaN.
    """
    order = np.argsort(tracks.camera, kind="stable")
    edges = np.searchsorted(tracks.camera[order], np.arange(count + 1))
    seen = [order[a:b] for a, b in pairwise(edges)]
    out = np.full(count, np.nan)
    for i in range(1, count):
        _, before, now = np.intersect1d(tracks.point[seen[i - 1]], tracks.point[seen[i]], return_indices=True)
        if len(before) < _HEADING_LEAST_CORNERS:
            continue
        p, q = (uv - np.median(uv, axis=0) for uv in (tracks.uv[seen[i - 1]][before], tracks.uv[seen[i]][now]))
        away = np.hypot(*p.T) > np.median(np.hypot(*p.T))  # those near the middle say little
        a, b = (z[away, 0] + 1j * z[away, 1] for z in (p, q))
        out[i] = -_median_angle(np.angle(b / a))  # the ground turns the other way in the picture
    return out


def _median_angle(angle: Array) -> float:
    """The angle from which the others are least far in sum, radians."""
    far = np.abs(wrap_rad(angle[:, None] - angle)).sum(axis=1)
    first = angle[int(far.argmin())]
    return float(wrap_rad(first + np.median(wrap_rad(angle - first))))
