"""Flights over missed ground: planned here from the gaps of the coverage, uploaded and started by the operator."""

import json
from collections.abc import Mapping
from typing import Any, Final, TypedDict

from gcs_plugin.config import LIMITS
from gcs_plugin.daemon.flight_coverage.live_coverage import LiveCoverage
from gcs_plugin.daemon.vehicle_names import VehicleRow
from gcs_plugin.daemon.vehicles import VehicleLinks
from gcs_plugin.daemon.web_plans import Plans
from orthoswarm.model.earth import distance_m
from orthoswarm.model.errors import InputError, OrthoSwarmError

_LONGEST_MIN: Final = 600.0
_ON_ITS_WAY: Final = frozenset({"on mission", "paused", "holding", "flying"})
_HOME_M_S: Final = 5.0
"""A plan ends where a vehicle in the air began it; from there it still flies home, at least so fast."""


class GapFlyer(TypedDict):
    """A vehicle that could fly over gaps, see `GapFlights.vehicles`."""

    id: str
    battery: float | None
    minutes: float | None
    busy: str
    in_air: bool
    lat_deg: float | None
    lon_deg: float | None
    home: list[float] | None


class GapFlights:
    """Plans flights over gaps. Nothing is uploaded or started here."""

    def __init__(self, coverage: LiveCoverage, plans: Plans, links: VehicleLinks) -> None:
        self._coverage, self._plans, self._links = coverage, plans, links

    def vehicles(self) -> list[GapFlyer]:
        """Vehicles that could fly: `id`, `battery` (share left), `minutes` (None: unknown), `busy` (why not now).

        Minutes are those until the reserve, by what the vehicle's flight so far has cost. `in_air` is true for a busy
        one that may be given the gaps in the air, if the operator says so for this vehicle.
        """
        rows: list[GapFlyer] = []
        for row in self._links.rows():
            due = "in_s" in (row["takeoff"] or {})
            seconds = self._coverage.battery.seconds(str(row["id"]), LIMITS.reserve_share)
            rows.append({
                "id": row["id"], "battery": row["battery"],
                "minutes": None if seconds is None else round(seconds / 60.0, 1),
                "busy": "it is about to take off; cancel that first" if due else _busy(row),
                "in_air": self._plans.dem is None and _may_go_on(row),
                "lat_deg": row["lat_deg"], "lon_deg": row["lon_deg"], "home": row["home"],
            })  # fmt: skip
        return rows

    def plan(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Plan a flight over the gaps, with what the vehicles' pictures saw from the heights that were recorded.

        Args:
            body: `vehicles` {id: minutes that it can fly, or null for what its battery says}; `altitude_m`, that of the
                plan before unless given; `fly_not_arrived`: gaps, too, whose pictures were taken and have not arrived;
                `in_air`: vehicles that may be given the gaps in the air: to be paused, then uploaded to and started.

        Returns:
            The plan's figures with its `id`, and `names`: the plan's vehicle -> the daemon's.

        Raises:
            InputError: a value is invalid, a battery level is unknown, or there is no gap.
            OrthoSwarmError: a vehicle is still flying.
        """
        known = {row["id"]: row for row in self.vehicles()}
        chosen = _minutes(body.get("vehicles"), known, body.get("in_air", ()))
        fov_deg, altitude_m, notes = self._camera(list(chosen), body)
        ordered = sorted(chosen, key=lambda vehicle: -chosen[vehicle])
        values = {
            "vehicles": len(ordered), "altitude_m": altitude_m, "fov_min_deg": fov_deg, "gaps": True,
            "endurances_min": [chosen[vehicle] for vehicle in ordered],
            "starts": [(known[v]["lat_deg"], known[v]["lon_deg"]) for v in ordered],
            "fly_not_arrived": body.get("fly_not_arrived") is True,
            "autopilots": self._plans.autopilots_of(ordered),
        }  # fmt: skip
        made = self._plans.make_in("gaps.geojson", self._coverage.gaps, self._coverage.no_fly, values, notes)
        names = dict(zip([f"v{k}" for k in range(1, len(ordered) + 1)], ordered, strict=True))
        return made | {"names": {row["id"]: names[row["id"]] for row in made["vehicles"]}}

    def _camera(self, vehicles: list[str], body: Mapping[str, Any]) -> tuple[float, float, list[str]]:
        """Field of view in degrees, altitude in metres, and notes about them."""
        plan = self._coverage.document["plan"]
        figures = {} if plan is None else json.loads((self._plans.folder / plan / "plan.json").read_text("utf-8"))
        over = figures.get("over_ground") or {"nominal_m": figures.get("altitude_m")}
        altitude = body.get("altitude_m", over["nominal_m"])
        if isinstance(altitude, bool) or not isinstance(altitude, int | float) or not 1.0 <= altitude <= 10_000.0:
            raise InputError("altitude_m is missing or not a height; send metres above takeoff, for example 80")
        solved = self._coverage.planning_fovs_deg(heights_over_level_ground=self._plans.dem is None)
        unknown = [vehicle for vehicle in vehicles if vehicle not in solved]
        found = [solved[vehicle] for vehicle in vehicles if vehicle in solved]
        notes = []
        if unknown:
            if not figures:
                raise InputError(f"the lens of {', '.join(unknown)} is not known yet; wait until its legs are placed")
            found.append(float(figures["fov_min_deg"]))
            notes.append(f"no picture of {', '.join(unknown)} is placed: the field of view of the plan is assumed")
        return min(found), float(altitude), notes


def _busy(row: VehicleRow) -> str:
    """Why a vehicle cannot be given another flight now, empty if it can."""
    if row["state"] == "lost":
        return "its link is lost"
    if row["armed"]:
        return "it is still flying; bring it home first" + (
            ", or confirm that it gets another mission in the air" if _may_go_on(row) else ""
        )
    return "" if row["lat_deg"] is not None else "it has no position"


def _may_go_on(row: VehicleRow) -> bool:
    """Whether a vehicle is in the air in a state from which another mission can be begun."""
    ready = row["armed"] and row["state"] == "found" and row["flight"]["state"] in _ON_ITS_WAY
    return bool(ready and row["lat_deg"] is not None and row.get("home"))


def _minutes(wanted: Any, known: Mapping[str, GapFlyer], in_air: Any) -> dict[str, float]:
    """Vehicle -> minutes that it can fly; for one in the air less the way from where it is to its home."""
    if not isinstance(in_air, list | tuple) or not all(isinstance(vehicle, str) for vehicle in in_air):
        raise InputError('in_air is not a list of vehicles; send for example ["v1"], or nothing')
    if not isinstance(wanted, dict) or not wanted:
        raise InputError('vehicles is missing; send for example {"v1": null, "v2": 12}')
    chosen = {}
    for vehicle, requested_min in wanted.items():
        row = known.get(vehicle)
        if row is None:
            raise InputError(f"{vehicle} is not on the links; see /api/coverage/vehicles")
        goes_on = row["in_air"] and vehicle in in_air
        if row["busy"] and not goes_on:
            raise OrthoSwarmError(f"{vehicle} gets no other flight: {row['busy']}")
        minutes = row["minutes"] if requested_min is None else requested_min
        if minutes is None:
            raise InputError(f"how long {vehicle} can fly is not known; send its minutes, no figure is assumed")
        if isinstance(minutes, bool) or not isinstance(minutes, int | float) or not 0.0 < minutes <= _LONGEST_MIN:
            raise InputError(f"{vehicle} cannot fly for {minutes} minutes; send a number from 1 to {_LONGEST_MIN:g}")
        chosen[str(vehicle)] = float(minutes) - (_home_min(row) if goes_on else 0.0)
        if chosen[str(vehicle)] <= 0.0:
            raise InputError(f"{vehicle} cannot fly for {minutes} minutes more and come home; bring it home now")
    return chosen


def _home_min(row: GapFlyer) -> float:
    """Minutes home from where a vehicle is."""
    lat, lon, home = row["lat_deg"], row["lon_deg"], row["home"]
    assert lat is not None and lon is not None and home is not None  # of one that may go on in the air
    return distance_m(lat, lon, home[0], home[1]) / _HOME_M_S / 60.0
