"""The areas that a large swarm is solved in: neighbouring vehicles together, and around them a halo of neighbours.

A vehicle is never divided: its flight is what is adjusted at once.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.trajectory.near_paths import NearPaths

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SolvedArea:
    """Vehicles that are solved together.

    Attributes:
        own: those whose solutions count. halo: neighbours of these that belong to other areas.
    """

    own: tuple[str, ...]
    halo: tuple[str, ...]


def divide(paths: Mapping[str, Array], most: int) -> list[SolvedArea]:
    """Divide vehicles into areas of about the same number of pictures.

    Args:
        paths: vehicle -> float64 (N, 3), its pictures' recorded positions above the takeoff level.
        most: so many pictures an area may have, or one vehicle.

    Returns:
        The areas, each with its halo; one without a halo where all pictures are few enough.
    """
    names = list(paths)
    middle = np.array([path[:, :2].mean(0) for path in paths.values()])
    count = np.array([len(path) for path in paths.values()])
    parts = _halves(np.arange(len(names)), middle, count, most)
    if len(parts) == 1:
        return [SolvedArea(tuple(names), ())]
    neighbours = NearPaths(list(paths.values()))
    areas = []
    for part in parts:
        own = set(part.tolist())
        near = {other for k in part.tolist() for other in neighbours.of(k)}
        areas.append(SolvedArea(tuple(names[k] for k in sorted(own)), tuple(names[k] for k in sorted(near - own))))
    return areas


def _halves(members: NDArray[np.intp], middle: Array, count: NDArray[np.intp], most: int) -> Sequence[NDArray[np.intp]]:
    """Members divided across the longer side of where they are, again and again, into parts of equal size."""
    parts = -(-int(count[members].sum()) // most)
    if parts <= 1 or len(members) == 1:
        return [members]
    place = middle[members]
    order = members[np.argsort(place[:, int(np.argmax(np.ptp(place, axis=0)))], kind="stable")]
    until = np.cumsum(count[order])
    cut = int(np.argmin(np.abs(until - until[-1] * (parts // 2) / parts))) + 1
    cut = min(cut, len(order) - 1)
    return [*_halves(order[:cut], middle, count, most), *_halves(order[cut:], middle, count, most)]
