"""Alarms about vehicles in the air that come too close, with a proposal."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Final

from gcs_plugin.config import ALARM, HEARING, LIMITS
from gcs_plugin.fleet.vehicle_state import Vehicle
from orthoswarm.model.earth import DEGREE_M, distance_m
from orthoswarm.model.plan import APART, PAD_DISTANCES

_LOOK_S: Final = 0.5
"""Step in which the next seconds are looked at."""


@dataclass(frozen=True, slots=True)
class Near:
    """Two vehicles that are too near each other, or will be.

    Attributes:
        other: the one that should be paused.
        metres: horizontal distance. height_m: difference in height.
        ahead_s: in how many seconds, if both fly straight on; 0 for now.
        silent: vehicles of the two that do not report where they are, so that it is not known whether they are near.
    """

    one: int
    other: int
    metres: float
    height_m: float
    ahead_s: float = 0.0
    _: KW_ONLY
    silent: tuple[int, ...] = ()

    @property
    def pair(self) -> tuple[int, int]:
        """System ids in order."""
        return min(self.one, self.other), max(self.one, self.other)


@dataclass(frozen=True, slots=True)
class VehicleNames:
    """What vehicles are called: by the operator, else v and their MAVLink system id.

    Attributes:
        systems: id of a vehicle by its MAVLink system id. titles: what people call it, by its id.
    """

    systems: Mapping[int, str] = field(default_factory=dict)
    titles: Mapping[str, str] = field(default_factory=dict)

    def name_of(self, system: int) -> str:
        """The id of a vehicle with a MAVLink system id; no two have the same."""
        name = f"v{system}"
        if system not in self.systems and name in self.systems.values():  # the name of another system id
            return f"system-{system}"
        return self.systems.get(system, name)

    def title_of(self, vehicle: str) -> str:
        """What people call a vehicle, empty if nothing else than its id."""
        return self.titles.get(vehicle, "")


NUMBERED: Final = VehicleNames()


@dataclass(slots=True)
class SeparationWatch:
    """Compares the positions of vehicles in the air, now and in the next seconds.

    Attributes:
        distance_m: horizontally, or height_m: vertically, they keep at least so far apart.
        alarms: pairs that are too near now or soon, by their system ids in order. names: of the vehicles.
    """

    distance_m: float = APART.distance_m
    height_m: float = APART.height_m
    alarms: dict[tuple[int, int], Near] = field(default_factory=dict)
    names: VehicleNames = NUMBERED

    def look(self, vehicles: Iterable[Vehicle], now: float) -> tuple[list[Near], list[tuple[int, int]]]:
        """Compare all pairs; returns new or newly unknown alarms, and the pairs whose alarm is over.

        The alarm of a pair stays while one of the two that flew does not report its place (it is not heard, or its
        filter has lost it): nobody knows that they are apart.
        """
        aloft = {v.system: v for v in vehicles if v.flying}
        silent = {s for s, v in aloft.items() if v.lat_deg is None or v.place_age_s(now) >= HEARING.fresh_s}
        flying = [v for s, v in aloft.items() if s not in silent]
        found: dict[tuple[int, int], Near] = {}
        if len(flying) > 1:
            shrink = math.cos(math.radians(flying[0].lat_deg or 0.0))
            places = sorted((v.system, *_metres(v, shrink), self._reach(v), v) for v in flying)
            for index, (one, north, east, reach, first) in enumerate(places):
                for other, north2, east2, reach2, second in places[index + 1 :]:
                    if abs(north2 - north) >= reach + reach2 or abs(east2 - east) >= reach + reach2:
                        continue  # most pairs: they cannot meet
                    over = ALARM.over_share if (one, other) in self.alarms else 1.0
                    meetings = [
                        self._meeting((north2 - north, east2 - east, down), first, second, over)
                        for down in _height_differences(first, second)
                    ]
                    met = min((meeting for meeting in meetings if meeting is not None), default=None)
                    if met is not None:
                        found[one, other] = Near(*_proposal(first, second), *met)
        for pair, near in self.alarms.items():
            if silent.intersection(pair) and aloft.keys() >= {*pair}:
                found[pair] = replace(near, silent=tuple(sorted(silent.intersection(pair))))
        new = [n for p, n in found.items() if p not in self.alarms or (n.silent and not self.alarms[p].silent)]
        ended = [pair for pair in self.alarms if pair not in found]
        self.alarms = found
        return new, ended

    def text(self, system: int) -> str:
        """The alarm of a vehicle in words, empty if there is none."""
        for near in self.alarms.values():
            if system in near.pair:
                return near_text(near, self)
        return ""

    def _reach(self, vehicle: Vehicle) -> float:
        """Half the distance from which two vehicles can come too near in the time that is looked ahead, metres."""
        return 0.5 * ALARM.over_share * self.distance_m + ALARM.ahead_s * math.hypot(*vehicle.velocity_m_s[:2])

    def _meeting(
        self, apart: tuple[float, float, float], one: Vehicle, other: Vehicle, over: float
    ) -> tuple[float, float, float] | None:
        """Distance, difference in height and when, where they are nearest while too near; None if they never are.

        `apart` is from one to the other: north, east, down.
        """
        closing = [b - a for a, b in zip(one.velocity_m_s, other.velocity_m_s, strict=True)]
        reach, step = over * self.distance_m, over * (self.height_m - ALARM.height_kept_m)
        met = []
        for look in range(1 + round(ALARM.ahead_s / _LOOK_S)):
            ahead = look * _LOOK_S
            north, east, down = (a + ahead * v for a, v in zip(apart, closing, strict=True))
            metres, height, share = math.hypot(north, east), abs(down), 1.0 - ALARM.less_a_second * ahead
            if metres < share * reach and height < share * step and not self._at_start(one, other, ahead):
                met.append((metres, height, ahead))
        return min(met, default=None)

    def _at_start(self, one: Vehicle, other: Vehicle, ahead_s: float) -> bool:
        """Both are above a start that they share, so many seconds ahead."""
        reach = PAD_DISTANCES * self.distance_m
        if one.launch is None or other.launch is None or distance_m(*one.launch, *other.launch) > reach:
            return False
        return all(distance_m(*_place(v, ahead_s), *(v.launch or (0.0, 0.0))) < reach for v in (one, other))


def near_text(near: Near, watch: SeparationWatch) -> str:
    """An alarm in words."""
    name = watch.names.name_of
    one, other = name(near.one), name(near.other)
    if near.silent:
        lost = " and ".join(name(system) for system in near.silent)
        return (
            f"{one} and {other} were {near.metres:.1f} m apart and {near.height_m:.1f} m in height; where they are now "
            f"is not known, as {lost} last said so over {HEARING.fresh_s:.0f} s ago: pause {other}"
        )
    when = f"will be in {near.ahead_s:.0f} s" if near.ahead_s >= 1.0 else "are"
    return (
        f"{one} and {other} {when} {near.metres:.1f} m apart and {near.height_m:.1f} m in height "
        f"(they should keep {watch.distance_m:.0f} m, or {watch.height_m:.0f} m in height): pause {other}"
    )


def apart_text(pair: tuple[int, int], names: VehicleNames) -> str:
    """The end of an alarm in words."""
    return f"{names.name_of(pair[0])} and {names.name_of(pair[1])} are apart again"


def _proposal(one: Vehicle, other: Vehicle) -> tuple[int, int]:
    """Which vehicle should be paused: the faster of the two, as it approaches the other."""
    fast, slow = sorted((one, other), key=lambda v: -math.hypot(*v.velocity_m_s[:2]))
    return slow.system, fast.system


def _height_differences(one: Vehicle, other: Vehicle) -> list[float]:
    """How much higher `one` is, metres: above the two takeoffs, and above the sea where these seem to differ in height.

    Heights above one takeoff are by barometer and good to a metre; altitudes err by several metres, more than lies
    between the layers of a plan. So where both took off from the same level within that, altitudes would raise alarms
    for nothing.
    """
    differences = [one.height_m - other.height_m]
    if one.alt_m is not None and other.alt_m is not None:
        above_sea = one.alt_m - other.alt_m
        if abs(above_sea - differences[0]) > LIMITS.level_m:
            differences.append(above_sea)
    return differences


def _place(vehicle: Vehicle, ahead_s: float) -> tuple[float, float]:
    """Latitude and longitude so many seconds ahead, degrees."""
    lat, lon, (north, east, _) = vehicle.lat_deg or 0.0, vehicle.lon_deg or 0.0, vehicle.velocity_m_s
    return lat + ahead_s * north / DEGREE_M, lon + ahead_s * east / (DEGREE_M * math.cos(math.radians(lat)))


def _metres(vehicle: Vehicle, shrink: float) -> tuple[float, float]:
    return (vehicle.lat_deg or 0.0) * DEGREE_M, (vehicle.lon_deg or 0.0) * DEGREE_M * shrink
