"""Alarms about vehicles in the air that come too close, with a proposal."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from orthoswarm.model.earth import DEGREE_M, distance_m

if TYPE_CHECKING:
    from gcs_plugin.fleet.vehicle_state import Vehicle

_FRESH_S: Final = 2.0
_OVER: Final = 1.2
_HELD_M: Final = 0.5
"""How well vehicles hold their height, metres: those that a plan puts `height_m` apart are a little less apart."""
_PAD: Final = 1.5
"""Radius about a start that vehicles share, in separation distances: there the plan keeps them apart by time alone."""


@dataclass(frozen=True, slots=True)
class Near:
    """Two vehicles that are too near each other.

    Attributes:
        one: system id. other: system id of the one that should be paused.
        metres: horizontal distance. height_m: difference in height.
    """

    one: int
    other: int
    metres: float
    height_m: float

    @property
    def pair(self) -> tuple[int, int]:
        """System ids in order."""
        return min(self.one, self.other), max(self.one, self.other)


def number_name(system: int) -> str:
    """Name of a vehicle to which the operator gave none."""
    return f"v{system}"


@dataclass(slots=True)
class SeparationWatch:
    """Compares the positions of vehicles in the air.

    Attributes:
        distance_m: horizontally, or height_m: vertically, they keep at least so far apart.
        alarms: pairs that are too near now, by their system ids in order.
    """

    distance_m: float = 10.0
    height_m: float = 5.0
    alarms: dict[tuple[int, int], Near] = field(default_factory=dict)

    def look(self, vehicles: "Iterable[Vehicle]", now: float) -> tuple[list[Near], list[tuple[int, int]]]:
        """Compare all pairs; returns new alarms, and the pairs whose alarm is over."""
        flying = [v for v in vehicles if v.flying and v.lat_deg is not None and now - v.heard < _FRESH_S]
        found: dict[tuple[int, int], Near] = {}
        if len(flying) > 1:
            shrink = math.cos(math.radians(flying[0].lat_deg or 0.0))
            places = sorted((v.system, *_metres(v, shrink), v) for v in flying)
            for index, (one, north, east, first) in enumerate(places):
                for other, north2, east2, second in places[index + 1 :]:
                    apart = math.hypot(north - north2, east - east2)
                    over = _OVER if (one, other) in self.alarms else 1.0
                    height = abs(first.height_m - second.height_m)
                    if apart >= over * self.distance_m or height >= over * (self.height_m - _HELD_M):
                        continue
                    if not self._at_start(first, second):
                        found[one, other] = Near(*_proposal(first, second), apart, height)
        new = [near for pair, near in found.items() if pair not in self.alarms]
        ended = [pair for pair in self.alarms if pair not in found]
        self.alarms = found
        return new, ended

    def text(self, system: int, name: Callable[[int], str] = number_name) -> str:
        """The alarm of a vehicle in words, empty if there is none; `name` returns the names of vehicles."""
        for near in self.alarms.values():
            if system in near.pair:
                return near_text(near, self, name)
        return ""

    def _at_start(self, one: "Vehicle", other: "Vehicle") -> bool:
        """Both are above a start that they share."""
        reach = _PAD * self.distance_m
        if one.launch is None or other.launch is None or distance_m(*one.launch, *other.launch) > reach:
            return False
        here = [((v.lat_deg or 0.0, v.lon_deg or 0.0), v.launch) for v in (one, other)]
        return all(launch is not None and distance_m(*place, *launch) < reach for place, launch in here)


def near_text(near: Near, watch: SeparationWatch, name: Callable[[int], str] = number_name) -> str:
    """An alarm in words; `name` gives the names of vehicles."""
    one, other = name(near.one), name(near.other)
    return (
        f"{one} and {other} are {near.metres:.1f} m apart and {near.height_m:.1f} m in height "
        f"(they should keep {watch.distance_m:.0f} m, or {watch.height_m:.0f} m in height): pause {other}"
    )


def apart_text(pair: tuple[int, int], name: Callable[[int], str] = number_name) -> str:
    """The end of an alarm in words."""
    return f"{name(pair[0])} and {name(pair[1])} are apart again"


def _proposal(one: "Vehicle", other: "Vehicle") -> tuple[int, int]:
    """Which vehicle should be paused: the faster of the two, as it approaches the other."""
    fast, slow = sorted((one, other), key=lambda v: -math.hypot(*v.velocity_m_s[:2]))
    return slow.system, fast.system


def _metres(vehicle: "Vehicle", shrink: float) -> tuple[float, float]:
    return (vehicle.lat_deg or 0.0) * DEGREE_M, (vehicle.lon_deg or 0.0) * DEGREE_M * shrink
