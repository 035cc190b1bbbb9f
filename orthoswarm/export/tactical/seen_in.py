"""Which pictures show a place."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthoswarm.model.placement import PlacedFrame
from orthoswarm.mosaic.footprint import least_descent


@dataclass(frozen=True, slots=True)
class Sighting:
    """A picture that shows a place.

    Attributes:
        placed: the picture. column, row: where in it, pixels. off_centre: distance from its middle in half diagonals.
    """

    placed: PlacedFrame
    column: float
    row: float
    off_centre: float


def sightings(placed: Iterable[PlacedFrame], point: ArrayLike) -> list[Sighting]:
    """The pictures that show a point, those that have it nearest to their middle first.

    Args:
        placed: pictures with their cameras. point: (3,) east, north and height in the cameras' grid, metres.
    """
    found = []
    at = np.asarray(point, dtype=np.float64)
    for frame in placed:
        camera, lens = frame.camera, frame.camera.lens
        ray = at - camera.position
        if -ray[2] < least_descent() * float(np.linalg.norm(ray)) or float(ray @ camera.rotation[:, 2]) <= 0.0:
            continue
        column, row = (float(v) for v in camera.project(at[None])[0])
        if 0.0 <= column < lens.width and 0.0 <= row < lens.height:
            half = 0.5 * np.hypot(lens.width, lens.height)
            off = float(np.hypot(column - 0.5 * lens.width, row - 0.5 * lens.height) / half)
            found.append(Sighting(frame, column, row, off))
    return sorted(found, key=lambda s: s.off_centre)
