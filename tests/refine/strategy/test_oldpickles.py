"""What an earlier version kept can be read: fields that it did not have get their defaults."""

import pickle
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from orthoswarm.model.placement import Solution, Terrain
from orthoswarm.oldpickles import set_fields


@dataclass(frozen=True, slots=True)
class Frozen:
    first: int
    second: str = "new"
    third: list[int] = field(default_factory=list)

    def __setstate__(self, state: Any) -> None:
        set_fields(self, state)


@dataclass(slots=True)
class Open:
    first: int
    second: str = "new"
    third: list[int] = field(default_factory=list)

    def __setstate__(self, state: Any) -> None:
        set_fields(self, state)


def test_values_that_are_there_are_kept():
    for kind in (Frozen, Open):
        assert pickle.loads(pickle.dumps(kind(1, "two", [3]))) == kind(1, "two", [3])


def test_fields_that_are_missing_get_their_defaults():
    for kind, state in ((Frozen, [7]), (Open, (None, {"first": 7}))):
        old = kind.__new__(kind)
        old.__setstate__(state)
        assert old == kind(7)
        assert replace(old, first=8) == kind(8)


def test_a_terrain_and_a_solution_of_an_earlier_version_can_be_used():
    flat = Terrain.flat(3.0)
    terrain = Terrain.__new__(Terrain)
    terrain.__setstate__([flat.west, flat.south, flat.step_m, flat.z])
    assert terrain.bare_ground() is terrain
    assert float(replace(terrain, west=10.0).height(np.zeros(2))) == 3.0
    known = Solution("v", [], {}, [], 80.0, 0.1, None)
    solution = Solution.__new__(Solution)
    solution.__setstate__([getattr(known, name) for name in list(Solution.__slots__)[:-1]])
    assert np.isnan(replace(solution, vehicle="w").gsd_m)
