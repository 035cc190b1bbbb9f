"""Directions of flight from positions alone."""

from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array

MOVED_M: Final = 1.0  # steps that are shorter have no direction and no spacing: receivers scatter by about that
_CORNER_DEG: Final = 50.0  # a change of course above this is a corner between two legs and no bend


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
