"""The geofence that a plan's flights must keep to, and that its missions are written with."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import shapely

from gcs_plugin.mission.mission_files import Autopilot
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.plan import Fence, Plan, Sortie
from orthoswarm.planning.area.area import Area

Geometry = Any  # shapely has no type information here

_ROUNDING_M: Final = 0.5
"""A path along an edge of the fence may lie so far outside: rounding and the grid's scale."""


def zone_fences(area: Area, fences: Sequence[Fence]) -> list[Fence]:
    """The no-fly zones of an area as exclusion fences, but for what given ones of these cover already.

    Holes of a zone are closed: a fence has none, and a flight out of one would cross the zone.
    """
    known = shapely.union_all([_shape(fence, area.grid) for fence in fences if not fence.inclusion])
    zones = [shapely.Polygon(zone.exterior) for zone in area.no_fly.geoms]
    left = [zone for zone in zones if not known.buffer(_ROUNDING_M).covers(zone)]
    places = [area.grid.to_geographic(shapely.get_coordinates(zone.exterior)[:-1]) for zone in left]
    return [Fence(inclusion=False, points=tuple((float(lat), float(lon)) for lat, lon in ring)) for ring in places]


def refuse_outside(plan: Plan, fences: Sequence[Fence], autopilots: Sequence[Autopilot]) -> None:
    """Refuse a plan of which a flight leaves the inclusion fences.

    An ArduPilot must stay inside all of them (unless FENCE_OPTIONS says otherwise), a PX4 inside any.

    Args:
        plan: with flights around the exclusion fences. fences: of all kinds. autopilots: that fly it.

    Raises:
        InputError: a flight leaves them, or they have no ground in common.
    """
    grid = LocalGrid(plan.epsg)
    allowed = [_shape(fence, grid) for fence in fences if fence.inclusion]
    if not allowed:
        return
    all_of_them = "ardupilot" in autopilots
    inside = shapely.intersection_all(allowed) if all_of_them else shapely.union_all(allowed)
    if inside.is_empty:
        raise InputError("the inclusion fences have no ground in common, where ArduPilot could fly; leave one of them")
    for vehicle in plan.vehicles:
        outside_m = max(_farthest_m(_path(sortie, grid), inside) for sortie in vehicle.sorties)
        if outside_m > _ROUNDING_M:
            raise InputError(
                f"{vehicle.id} would fly up to {outside_m:.0f} m outside the inclusion fence; move the start or the "
                "area inside, give less --run-in, or draw a larger fence"
            )


def _shape(fence: Fence, grid: LocalGrid) -> Geometry:
    """A fence in grid metres."""
    points = grid.to_grid(*np.array(fence.points, float).T)
    if fence.radius_m is not None:
        return shapely.Point(points[0]).buffer(fence.radius_m, quad_segs=64)
    return shapely.make_valid(shapely.Polygon(points))


def _path(sortie: Sortie, grid: LocalGrid) -> Geometry:
    """A flight on the map, in grid metres."""
    home = (sortie.home_lat_deg, sortie.home_lon_deg)
    places = np.array([home, *((point.lat_deg, point.lon_deg) for point in sortie.waypoints)], float)
    return shapely.LineString(grid.to_grid(*places.T))


def _farthest_m(path: Geometry, inside: Geometry) -> float:
    """How far a path gets outside, metres."""
    outside = shapely.get_coordinates(path.difference(inside))
    return float(shapely.distance(shapely.points(outside), inside).max(initial=0.0))
