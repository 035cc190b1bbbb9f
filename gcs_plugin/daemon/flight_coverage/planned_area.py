"""The area whose coverage is computed: of the console's plan, else the drawn one, else of the newest plan."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from gcs_plugin.plans.area_files import read_shapes
from gcs_plugin.plans.no_fly import Reach
from gcs_plugin.plans.plan_files import read_planned_flight
from orthoswarm.coverage.gaps import PlannedFlight
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.planning.area.area import Area, make_area
from orthoswarm.planning.area.shape_files import parse_geojson


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
