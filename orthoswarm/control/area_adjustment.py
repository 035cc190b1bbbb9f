"""Areas that were solved by themselves, moved onto each other: a block adjustment of independent models.

Vehicles of a halo were solved in several areas. The places that they got there tie the areas together. Each area may
shift, turn and change its scale, as far as its receivers leave that open, and shift in height. An area that the map
holds stays where it is in the plane. (Ackermann, Ebner, Klein 1970: independent models.)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.plane_similarity import Similarity, design

_HELD = 1e-6  # sigma of what does not move, metres (or radians)

_AREA_SHIFT_SIGMA_M: Final = 1.0
"""How well an area's receivers tell its place, an axis, and its level; over its extent the same of its turn and scale:
some 30 of them, 2 m each, and what they have in common (areas that no map holds are moved onto each other within
it)."""
_AREA_TIE_SIGMA_M: Final = 0.3  # how well a vehicle's place agrees in two areas that it was solved in, an axis


@dataclass(frozen=True, slots=True)
class AreaTie:
    """A vehicle that was solved in two areas.

    one, other: numbers of the areas. place: float64 (2, N, 3), some camera positions in the one and the other.
    """

    one: int
    other: int
    place: Array


@dataclass(frozen=True, slots=True)
class AreaMove:
    """How an area moves: in the plane, and in height by so many metres."""

    plane: Similarity
    up_m: float


def adjust_areas(nadirs: Sequence[Array], held: Sequence[bool], ties: Sequence[AreaTie]) -> list[AreaMove]:
    """Move areas onto each other.

    Args:
        nadirs: of the areas' pictures, float64 (N, 2) each. held: which areas the map holds in the plane.
        ties: between them.

    Returns:
        For each area its move.
    """
    count = len(nadirs)
    middles = [own.mean(0) for own in nadirs]
    shift = _AREA_SHIFT_SIGMA_M
    radius = [max(float(np.sqrt(own.var(0).sum())), 1.0) for own in nadirs]
    prior = np.array(
        [[_HELD] * 4 if on_map else [shift, shift, shift / r, shift / r] for on_map, r in zip(held, radius)]
    )
    normal, right = np.diag(1.0 / prior.ravel() ** 2), np.zeros(4 * count)
    level, rise = np.eye(count) / shift**2, np.zeros(count)
    for tie in ties:
        points = tie.place.shape[1]
        a = np.zeros((points, 2, 4 * count))
        for k, sign, place in ((tie.one, 1.0, tie.place[0]), (tie.other, -1.0, tie.place[1])):
            a[:, :, 4 * k : 4 * k + 4] = sign * design(place[:, :2] - middles[k])
        apart = tie.place[1] - tie.place[0]
        weight = 1.0 / (points * _AREA_TIE_SIGMA_M**2)
        normal += weight * np.einsum("nij,nik->jk", a, a)
        right += weight * np.einsum("nij,ni->j", a, apart[:, :2])
        pair = np.array([tie.one, tie.other])
        level[np.ix_(pair, pair)] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / _AREA_TIE_SIGMA_M**2
        rise[pair] += np.array([1.0, -1.0]) * float(np.median(apart[:, 2])) / _AREA_TIE_SIGMA_M**2
    covariance = np.linalg.inv(normal)
    values, up = (covariance @ right).reshape(count, 4), np.linalg.solve(level, rise)
    return [
        AreaMove(
            Similarity(middles[k], values[k], np.asarray(covariance[4 * k : 4 * k + 4, 4 * k : 4 * k + 4])),
            float(up[k]),
        )
        for k in range(count)
    ]
