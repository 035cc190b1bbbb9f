"""The planned area as it is flown: what is to be covered, which legs are finished, how long batteries last."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from gcs_plugin.daemon.vehicle_names import VehicleRow
from gcs_plugin.plans.area_files import Reach, read_shapes
from gcs_plugin.plans.plan_files import read_planned_flight
from orthoswarm.coverage.gaps import PlannedFlight
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.planning.area.area import Area, make_area
from orthoswarm.planning.area.shape_files import parse_geojson

_LEAST_DROP: Final = 0.03  # share of the battery after which its use is known
_LEAST_S: Final = 60.0  # of flight for that
_SWAPPED: Final = 0.05  # a charge that rises by this share is another battery
Array = NDArray[np.float64]
_LEAST_REACH_M: Final = 12.0
_ARRIVED_M: Final = 3.0
"""A vehicle so near the end of a leg has flown it, though it waits there."""
_IDLE_S: Final = 60.0
_MISSION_OVER: Final = ("complete", "aborted")


@dataclass(slots=True)
class _Flight:
    """A vehicle's flight: time and battery level when first seen in the air, and the present level (shares)."""

    begun_s: float
    begun_with: float
    left: float
    rate: float | None = None


class BatteryUse:
    """Tracks batteries; the rate is known once the level dropped by 3 % over at least a minute in the air."""

    def __init__(self) -> None:
        self._flights: dict[str, _Flight] = {}

    def look(self, row: VehicleRow, flies: bool, now_s: float) -> None:
        """Process a vehicle's state from its link, at a time of any clock in seconds."""
        vehicle, battery = row["id"], row.get("battery")
        if battery is None:
            return
        flight = self._flights.get(vehicle)
        if flight is None:
            self._flights[vehicle] = _Flight(now_s, battery, battery)
            return
        if battery > flight.left + _SWAPPED or not flies:
            flight.begun_s, flight.begun_with = now_s, battery  # the rate found before remains valid
        flight.left = battery
        spent, took = flight.begun_with - battery, now_s - flight.begun_s
        if spent >= _LEAST_DROP and took >= _LEAST_S:
            flight.rate = spent / took

    def left(self, vehicle: str) -> float | None:
        """Battery level of a vehicle, 0 to 1; None if it is not reported."""
        flight = self._flights.get(vehicle)
        return None if flight is None else flight.left

    def seconds(self, vehicle: str, reserve: float) -> float | None:
        """Flight time in seconds until a level is reached, at the rate so far; None if unknown."""
        flight = self._flights.get(vehicle)
        if flight is None or flight.rate is None:
            return None
        return max(0.0, flight.left - reserve) / flight.rate


@dataclass(frozen=True, slots=True)
class PlannedLegs:
    """Legs of a plan with their vehicles.

    Attributes:
        ends: float64 (n, 2, 2), first and last ground point of each, grid metres.
        vehicles: id of each leg's vehicle. sorties: number of each leg's flight, from 1.
    """

    ends: NDArray[np.float64]
    vehicles: list[str]
    sorties: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class CoveredArea:
    """An area and its plan.

    Attributes:
        area: ground and no-fly zones. plan: id of the plan, None for a drawn area.
        flight: the planned flight, None for a drawn area. legs: its legs by vehicle.
    """

    area: Area
    plan: str | None
    flight: PlannedFlight | None
    legs: PlannedLegs


@dataclass(frozen=True, slots=True)
class AreaSource:
    """The source of the area, for comparison.

    Attributes:
        plan: the plan's folder, None for a drawn area. drawn: the drawn area as GeoJSON text.
        names: the plan's vehicle and the daemon's, as the operator assigned them.
    """

    plan: Path | None
    drawn: str
    names: tuple[tuple[str, str], ...]


def area_source(console: Mapping[str, Any], plans: Path) -> AreaSource | None:
    """The source of the area to be covered, None if there is none.

    Args:
        console: the operator's plan (`ConsoleState.plan`). plans: folder of all plans. Gap flights are left out:
            they belong to the area of the plan before.
    """
    names = tuple(sorted((str(k), str(v)) for k, v in (console.get("vehicles") or {}).items() if v))
    chosen = console.get("plan")
    if isinstance(chosen, str) and (plans / chosen / "area.geojson").is_file():
        return AreaSource(plans / chosen, "", names)
    if console.get("area"):
        return AreaSource(None, json.dumps(console["area"]), ())
    found = [p.parent for p in sorted(plans.glob("plan-*/plan.json")) if (p.parent / "area.geojson").is_file()]
    return AreaSource(found[-1], "", names) if found else None


def read_covered_area(source: AreaSource, grid: LocalGrid | None) -> CoveredArea:
    """The area and its plan.

    Args:
        source: from `area_source`. grid: of the result, None for the area's own UTM zone.

    Raises:
        InputError: the area or the plan cannot be used.
    """
    if source.plan is None:
        area = make_area(parse_geojson(source.drawn, "the drawn area").areas, (), grid)
        return CoveredArea(area, None, None, PlannedLegs(np.empty((0, 2, 2)), [], np.empty(0, np.int64)))
    try:
        text = (source.plan / "area.geojson").read_text(encoding="utf-8")
        features = json.loads((source.plan / "all.geojson").read_text(encoding="utf-8"))["features"]
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{source.plan.name} cannot be read ({error}); plan again") from None
    zones = source.plan / "no-fly.geojson"
    polygons = parse_geojson(text, source.plan.name).areas
    shells = []
    if zones.is_file() and polygons:
        flown = np.concatenate([p.shell for p in polygons])
        shells = [p.shell for p in Reach(flown).near(read_shapes(zones, any_size=True).shapes).areas]
    area = make_area(polygons, shells, grid)
    flight = read_planned_flight(source.plan, area.grid)
    names = dict(source.names)
    rows = [f["properties"] for f in features if f["properties"].get("kind") == "leg"]
    vehicles = [names.get(row["vehicle"], row["vehicle"]) for row in rows]
    sorties = np.array([row["sortie"] for row in rows], np.int64)
    return CoveredArea(area, source.plan.name, flight, PlannedLegs(flight.legs, vehicles, sorties))


def zone_features(area: Area) -> dict[str, Any]:
    """An area's no-fly zones as GeoJSON."""
    features = []
    for zone in area.no_fly.geoms:
        places = area.grid.to_geographic(shapely.get_coordinates(zone.exterior))
        ring = [[round(float(lon), 8), round(float(lat), 8)] for lat, lon in places]
        features.append({
            "type": "Feature", "properties": {"kind": "no-fly zone"},
            "geometry": {"type": "Polygon", "coordinates": [ring]},
        })  # fmt: skip
    return {"type": "FeatureCollection", "features": features}


@dataclass(kw_only=True)
class FlownLegs:
    """Tracks vehicles along the legs of a plan.

    A leg is over once a vehicle has flown along it from end to end (it may wait there), or the vehicle that is to fly
    it has ended that flight. When nobody flies and no picture has come for a minute, all that was not seen is missed.

    Attributes:
        legs: of the plan. reach_m: largest cross-track distance of a vehicle on a leg.
        ahead_m: how far from a leg's ends the first and last position may be; at least a picture spacing where only
            pictures give positions.
        flown: bool (n,), legs flown from end to end.
        flights: vehicle -> number of flights begun. down: vehicles that have left their mission or are
            lost. grounded: those of them that have landed since.
    """

    legs: PlannedLegs
    reach_m: float
    ahead_m: float
    flown: NDArray[np.bool_] = field(init=False)
    flights: dict[str, int] = field(default_factory=dict)
    down: set[str] = field(default_factory=set)
    grounded: set[str] = field(default_factory=set)
    _along: dict[str, Array] = field(default_factory=dict)
    _last_picture_s: float | None = None

    def __post_init__(self) -> None:
        self.flown = np.zeros(len(self.legs.vehicles), bool)
        self._reach, self._ahead = max(_LEAST_REACH_M, self.reach_m), max(_LEAST_REACH_M, self.ahead_m)
        step = self.legs.ends[:, 1] - self.legs.ends[:, 0]
        self._length = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
        self._way = step / self._length[:, None]

    def state(self) -> dict[str, Any]:
        """The state to be stored for a restart, as JSON values."""
        return {
            "flown": np.nonzero(self.flown)[0].tolist(), "flights": dict(self.flights), "down": sorted(self.down),
            "grounded": sorted(self.grounded),
        }  # fmt: skip

    def resume(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state` of the same plan."""
        self.flown[state["flown"]] = True
        self.flights, self.down = dict(state["flights"]), set(state["down"])
        self.grounded = set(state["grounded"])

    @property
    def over(self) -> NDArray[np.bool_]:
        """Finished legs, bool (n,): flown, or part of a flight that has ended."""
        ended = [
            self.flights.get(v, 0) >= s + (v not in self.down)
            for v, s in zip(self.legs.vehicles, self.legs.sorties.tolist(), strict=True)
        ]
        return np.asarray(self.flown | np.array(ended, bool))

    def pass_by(self, vehicle: str, east: float, north: float) -> None:
        """Process a vehicle's position, grid metres; call in the order of time."""
        if not len(self.flown):
            return
        away = np.array([east, north]) - self.legs.ends[:, 0]
        along = (away * self._way).sum(1)
        across = np.abs(away[:, 0] * self._way[:, 1] - away[:, 1] * self._way[:, 0])
        on = (across < self._reach) & (along > -self._ahead) & (along < self._length + self._ahead)
        seen = self._along.setdefault(vehicle, np.stack([np.full(len(on), np.inf), np.full(len(on), -np.inf)]))
        through = (seen[0] < self._ahead) & (seen[1] > self._length - self._ahead)
        self.flown |= through & (~on | (along > self._length - _ARRIVED_M))
        seen[0] = np.where(on, np.minimum(seen[0], along), np.inf)
        seen[1] = np.where(on, np.maximum(seen[1], along), -np.inf)

    def picture_came(self, time_s: float) -> None:
        """Record the arrival of a picture, UTC epoch seconds."""
        self._last_picture_s = time_s

    def look(self, rows: list[VehicleRow]) -> None:
        """Process the vehicles' states (`VehicleLinks.rows`)."""
        for row in rows:
            vehicle = str(row["id"])
            if flies(row):
                if vehicle not in self.flights or vehicle in self.grounded:
                    self.flights[vehicle] = self.flights.get(vehicle, 0) + 1
                self.down.discard(vehicle)
                self.grounded.discard(vehicle)
            elif vehicle in self.flights:
                self.down.add(vehicle)
                if row["state"] != "lost" and not row["armed"]:
                    self.grounded.add(vehicle)
                if row["mission"]["phase"] == "complete":  # its turn into a leg may have been wide
                    begun = self.legs.sorties <= self.flights[vehicle]
                    self.flown |= begun & (np.array(self.legs.vehicles) == vehicle)

    def all_over(self, rows: list[VehicleRow], now_s: float) -> bool:
        """Whether the operation is over: nobody flies, and all legs are finished or no picture came for a minute."""
        if self._last_picture_s is None or any(flies(row) for row in rows):
            return False
        return now_s - self._last_picture_s > _IDLE_S or (len(self.flown) > 0 and bool(self.over.all()))

    def remaining(self) -> dict[str, list[int]]:
        """Vehicle that has left its mission or is lost -> its legs of begun flights that are not flown."""
        return {
            vehicle: [
                k
                for k, v in enumerate(self.legs.vehicles)
                if v == vehicle and self.legs.sorties[k] <= count and not self.flown[k]
            ]
            for vehicle, count in self.flights.items()
            if vehicle in self.down
        }


def flies(row: VehicleRow) -> bool:
    """Whether a vehicle is on a mission that continues."""
    if row["state"] == "lost" or row["mission"]["phase"] in _MISSION_OVER:
        return False
    return bool(row["armed"]) and row["flight"]["state"] not in (
        "on ground",
        "returning",
        "landing",
        "lost",
        "complete",
    )
