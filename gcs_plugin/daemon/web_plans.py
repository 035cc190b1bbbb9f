"""Plans made over HTTP: one folder each in the workspace, with the files of `orthoswarm plan`; flights over gaps, too.

Flights over missed ground are planned from the gaps of the coverage, uploaded and started by the operator.
"""

import contextlib
import io
import json
import re
import shutil
import time
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final, TypedDict

from gcs_plugin.config import LIMITS
from gcs_plugin.daemon.flight_coverage.live_coverage import LiveCoverage
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.vehicle_names import VehicleRow
from gcs_plugin.daemon.vehicles import VehicleLinks
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.geofence import FenceZone
from gcs_plugin.mission.items import Mission
from gcs_plugin.mission.makers.maker_files import MAKERS, maker_file, read_mission_file
from gcs_plugin.mission.mission_builder import build_mission, read_mission
from gcs_plugin.mission.mission_files import parse_mission
from gcs_plugin.mission.plan_folder import PlanNeeds, plan_needs
from gcs_plugin.plans.area_files import read_zones, refuse_no_zones
from gcs_plugin.plans.plan_files import write_plan
from gcs_plugin.plans.plan_request import AUTOPILOTS, ENDS, METHODS, RELIEFS, PlanRequest, make_plan
from orthoswarm.config import DEFAULT, Config
from orthoswarm.model.earth import distance_m
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.planning.area.shape_files import parse_geojson

_NAME: Final = re.compile(r"[0-9a-z][0-9a-z-]{0,63}\Z")
_NUMBERS: Final = (
    "altitude_m", "fov_min_deg", "speed_m_s", "endurance_min", "side_overlap", "forward_overlap", "separation_m",
    "clearance_m", "height_tolerance_m", "wait_min", "wind_m_s", "wind_from_deg",
    "gimbal_pitch_deg",
)  # fmt: skip
_MOST_NUMBER: Final = 1e6  # in a request
_NO_FLY_FILE: Final = "no-fly.geojson"
_CHOICES: Final = {"method": METHODS, "end": ENDS, "relief": RELIEFS}


GeographicBounds = tuple[float, float, float, float]
"""South, west, north, east in degrees."""
Place = tuple[float, float]
"""Latitude and longitude in degrees."""


class Plans:
    """The plans of a workspace.

    Args:
        folder: of all plans. dem: height model that they follow, None for level ground.
        vehicles: on the links; a plan is made for these unless its request names others. config: margins and times.
    """

    def __init__(self, folder: Path, dem: Path | None, vehicles: VehicleLinks, config: Config = DEFAULT) -> None:
        self.folder, self.dem, self._vehicles, self._config = folder, dem, vehicles, config
        self._bounds: tuple[Path, GeographicBounds] | None = None

    def make(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Make a plan; returns the figures of `orthoswarm plan --json` with the plan's `id`.

        The work runs in its own process, so that refinements and plans do not wait for each other.

        Raises:
            InputError: the area or a value is invalid.
        """
        values, notes = _values(body), list[str]()
        vehicles = [f"v{k}" for k in range(1, values["vehicles"] + 1)]
        if "autopilot" not in body:
            values["autopilots"] = self.autopilots_of(vehicles)
        if "starts" not in body:
            values["starts"], notes = self._starts(vehicles)
        area = body.get("area")
        if not isinstance(area, dict):
            raise InputError("area is missing; send a GeoJSON polygon")
        return self.make_in("area.geojson", area, _zones(body.get("no_fly")), values, notes)

    def autopilots_of(self, vehicles: Sequence[str]) -> list[str]:
        """The autopilots of vehicles; ArduPilot for those that were not heard."""
        known = self._vehicles.autopilots()
        return [known.get(vehicle, "ardupilot") for vehicle in vehicles]

    def _starts(self, vehicles: Sequence[str]) -> tuple[list[Place], list[str]]:
        """Where vehicles stand; unless that is known of all of them none of that, and a warning that names the others.

        Without vehicles on the links there is nothing to warn of: who flies the plan is not known.
        """
        known = self._vehicles.standing()
        places = [known.get(vehicle, "not on the links") for vehicle in vehicles] if known else []
        unknown: dict[str, list[str]] = {}
        for vehicle, place in zip(vehicles, places, strict=False):
            if isinstance(place, str):
                unknown.setdefault(place, []).append(vehicle)
        if not unknown:
            return [place for place in places if not isinstance(place, str)], []
        who = "; ".join(f"{', '.join(names)}: {why}" for why, names in unknown.items())
        return [], [
            f"it is not known where all vehicles stand ({who}), so each takeoff lies where its first line begins; "
            "one that stands elsewhere is not started: plan again when all of them stand there with a position"
        ]

    def make_in(
        self,
        name: str,
        area: Mapping[str, Any],
        no_fly: Mapping[str, Any] | None,
        values: Mapping[str, Any],
        notes: Sequence[str] = (),
    ) -> dict[str, Any]:
        """Plan in a new folder, with area and no-fly zones in it; returns the figures with the plan's `id`.

        Args:
            name: of the area's file. area: GeoJSON, or gaps as `orthoswarm coverage` writes them.
            no_fly: GeoJSON of zones, None if there are none. values: further fields of the PlanRequest.
            notes: to be added to the plan's warnings.

        Raises:
            InputError: there is nothing to fly, or a value is invalid.
        """
        plan = f"plan-{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}-{time.time_ns() % 10**6:06d}"
        path = self.folder / plan
        path.mkdir(parents=True)
        try:
            (path / name).write_text(json.dumps(area), encoding="utf-8")
            zones = []
            if no_fly is not None:
                zones = [path / _NO_FLY_FILE]
                zones[0].write_text(json.dumps(no_fly), encoding="utf-8")
            with closing(WorkerPool(1)) as pool:
                request = PlanRequest(area=path / name, no_fly=zones, dem=self.dem, config=self._config, **values)
                figures: dict[str, Any] = pool.run(partial(plan_into, notes=notes), request)
        except BaseException:
            shutil.rmtree(path, ignore_errors=True)
            raise
        return figures | {"id": plan}

    def all(self) -> list[dict[str, Any]]:
        """The figures of all plans, oldest first."""
        found = []
        for path in sorted(self.folder.glob("plan-*/plan.json")):
            with contextlib.suppress(ValueError):  # incomplete, so it was never reported
                found.append(json.loads(path.read_text(encoding="utf-8")) | {"id": path.parent.name})
        return found

    def geojson(self, name: str) -> bytes:
        """A plan as GeoJSON; raises InputError: there is no such plan."""
        return (self._path(name) / "all.geojson").read_bytes()

    def maker_files(self, name: str, drone: str) -> bytes:
        """A ZIP of all flights of a plan for a drone that its maker's app flies, and of when each takes off.

        Raises:
            InputError: there is no such plan or drone, or its app cannot fly it.
        """
        if drone not in MAKERS:
            raise InputError(f"drone is none of {', '.join(MAKERS)}; choose one")
        folder, rows, data = self._path(name), ["file,takeoff_s,time_s"], io.BytesIO()
        with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
            for flight in chain.from_iterable(self._flights(name).values()):
                mission = folder / flight["files"][0]
                items = parse_mission(mission.read_text(encoding="utf-8"), mission.name).items
                file = mission.stem + MAKERS[drone]
                archive.writestr(file, maker_file(items, drone, plan_needs(folder).return_height_m))
                rows.append(f"{file},{flight['start_s']},{flight['time_s']}")
            archive.writestr("takeoffs.csv", "\n".join([*rows, ""]))
        return data.getvalue()

    def mission(self, body: Mapping[str, Any], vehicle: str, autopilot: Autopilot) -> Mission:
        """The mission of an upload request: `plan` with `mission` (default: the vehicle's own), or `text`.

        Raises:
            InputError: there is none, or the text is not a mission file.
        """
        if isinstance(body.get("text"), str):
            parsed = read_mission_file(body["text"].encode(errors="replace"), "the mission")
            return build_mission(autopilot, parsed.items, parsed.home, "the mission")
        folder = self._path(body.get("plan"))
        name = body.get("mission", vehicle)
        if not isinstance(name, str) or not _NAME.match(name):
            raise InputError("mission is not the name of a mission; send for example v1")
        for path in (folder / f"{name}.waypoints", folder / f"{name}-sortie1.waypoints"):
            if path.is_file():
                return read_mission(path, autopilot)
        raise InputError(f"{folder.name} has no mission {name}; see /api/plans")

    def keep_out(self, name: Any) -> list[FenceZone]:
        """A plan's no-fly zones for the geofences of its vehicles; empty if it has none.

        Raises:
            InputError: there is no such plan.
        """
        path = self._path(name) / _NO_FLY_FILE
        if not path.is_file():
            return []
        shapes = read_zones(path).shapes
        rings = [[(float(lon), float(lat)) for lat, lon in polygon.shell] for polygon in shapes.polygons]
        zones = [FenceZone("exclusion", tuple(ring[:-1] if ring[0] == ring[-1] else ring)) for ring in rings]
        return zones + [FenceZone("exclusion", ((c.lon_deg, c.lat_deg),), c.radius_m) for c in shapes.circles]

    def starts(self, name: Any, sortie: int = 1) -> dict[str, float]:
        """Vehicle -> takeoff of a flight in seconds after the swarm's start.

        Raises:
            InputError: there is no such plan or flight.
        """
        flights = self._flights(name)
        starts = {v: float(rows[sortie - 1]["start_s"]) for v, rows in flights.items() if len(rows) >= sortie}
        if not starts:
            most = max(len(rows) for rows in flights.values())
            raise InputError(f"{name} has no sortie {sortie} (there are {most}); send another")
        return starts

    def flights(self, name: Any, sortie: int = 1) -> dict[str, dict[str, Any]]:
        """Vehicle -> `start_s`, `time_s` and `height_m` (of the takeoff) of a flight, for those that have it.

        Raises:
            InputError: there is no such plan.
        """
        rows = {v: flights[sortie - 1] for v, flights in self._flights(name).items() if len(flights) >= sortie}
        return {
            vehicle: {"start_s": row["start_s"], "time_s": row["time_s"], "height_m": row["takeoff_height_m"]}
            for vehicle, row in rows.items()
        }

    def _flights(self, name: Any) -> dict[str, list[dict[str, Any]]]:
        figures = json.loads((self._path(name) / "plan.json").read_text(encoding="utf-8"))
        return {vehicle["id"]: vehicle["flights"] for vehicle in figures["vehicles"]}

    def needs(self, name: Any) -> PlanNeeds:
        """What a plan relies on; raises InputError: there is no such plan."""
        return plan_needs(self._path(name))

    def newest_bounds(self) -> GeographicBounds | None:
        """South, west, north, east of the newest plan in degrees, None if there is none."""
        found = sorted(self.folder.glob("plan-*/all.geojson"))
        if not found:
            return None
        if self._bounds is None or self._bounds[0] != found[-1]:
            positions = list(_positions(json.loads(found[-1].read_text(encoding="utf-8"))))
            lon, lat = zip(*positions, strict=True)
            self._bounds = found[-1], (min(lat), min(lon), max(lat), max(lon))
        return self._bounds[1]

    def _path(self, name: Any) -> Path:
        if not isinstance(name, str) or not _NAME.match(name) or not (self.folder / name / "plan.json").is_file():
            raise InputError("there is no such plan; see /api/plans")
        return self.folder / name


def _zones(no_fly: Any) -> Mapping[str, Any] | None:
    """The no-fly zones of a request, None if it has none: any GeoJSON, of which nothing is left out without a word."""
    if no_fly is None:
        return None
    if not isinstance(no_fly, dict):
        raise InputError("no_fly is not GeoJSON; send the polygons of the no-fly zones, or nothing")
    shapes = parse_geojson(json.dumps(no_fly), "no_fly", any_size=True)
    refuse_no_zones(shapes, "no_fly")
    return no_fly if shapes.areas else None


def _values(body: Mapping[str, Any]) -> dict[str, Any]:
    """The request's values as fields of a PlanRequest; raises InputError: one is missing or invalid."""
    count = body.get("vehicles")
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= 250:
        raise InputError("vehicles is missing; send a number from 1 to 250")
    values: dict[str, Any] = {"vehicles": count}
    for key in _NUMBERS:
        value = body.get(key)
        if value is None and key not in ("altitude_m", "fov_min_deg"):
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _MOST_NUMBER:
            raise InputError(f"{key} is missing or not a valid number; send one")
        values[key] = float(value)
    for key, choices in _CHOICES.items():
        if key in body:
            if not isinstance(body[key], str) or body[key] not in choices:
                raise InputError(f"{key} is none of {', '.join(choices)}; choose one")
            values[key] = body[key]
    if body.get("gimbal_pitch_deg", 0.0) is None:
        values["gimbal_pitch_deg"] = None
    values["autopilots"] = _autopilots(body.get("autopilot", "ardupilot"))
    for key in ("terrain_items", "cross"):
        if key in body:
            values[key] = body[key] is True
    if (heading := body.get("heading")) is not None:
        number = isinstance(heading, int | float) and not isinstance(heading, bool) and abs(heading) <= _MOST_NUMBER
        if not number and heading not in ("wind", "longest"):
            raise InputError("heading is no number, wind or longest; send degrees clockwise from north")
        values["heading"] = float(heading) if number else heading
    starts = body.get("starts", [])
    if not isinstance(starts, list) or not all(_is_position(start) for start in starts):
        raise InputError("starts is not a list of [latitude, longitude]; send one")
    return values | {"starts": [(float(lat), float(lon)) for lat, lon in starts]}


def _autopilots(value: Any) -> list[str]:
    """One autopilot for all vehicles, or a list that they are given in turn."""
    names = value if isinstance(value, list) else [value]
    if not names or not all(isinstance(name, str) and name in AUTOPILOTS for name in names):
        raise InputError(f"autopilot is none of {', '.join(AUTOPILOTS)} and no list of these; choose one")
    return names


def _is_position(start: Any) -> bool:
    return (
        isinstance(start, list | tuple)
        and len(start) == 2
        and all(isinstance(v, int | float) and abs(v) <= 360.0 for v in start)
    )


def _positions(document: Any) -> Iterator[tuple[float, float]]:
    """All positions (longitude, latitude) of a GeoJSON document."""
    if isinstance(document, dict):
        for key in ("features", "geometry", "geometries", "coordinates"):
            if key in document:
                yield from _positions(document[key])
    elif isinstance(document, list):
        if document and isinstance(document[0], int | float):
            yield float(document[0]), float(document[1])
        else:
            for part in document:
                yield from _positions(part)


def plan_into(request: PlanRequest, notes: Sequence[str]) -> dict[str, Any]:
    """Plan in a worker and write the plan's folder; returns the figures, with notes before the plan's warnings."""
    plan, area = make_plan(request)
    return write_plan(request.area.parent, plan, area, request, notes=notes, picture=False)


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
        made = self._plans.make_in("gaps.geojson", self._coverage.result.gaps, self._coverage.no_fly, values, notes)
        names = dict(zip([f"v{k}" for k in range(1, len(ordered) + 1)], ordered, strict=True))
        return made | {"names": {row["id"]: names[row["id"]] for row in made["vehicles"]}}

    def _camera(self, vehicles: list[str], body: Mapping[str, Any]) -> tuple[float, float, list[str]]:
        """Field of view in degrees, altitude in metres, and notes about them."""
        plan = self._coverage.result.document["plan"]
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
