"""A flight as the files of makers' apps say it, from and to mission items.

A route begins above its takeoff, at the height of the climb, so that it is the plan's whatever an app does until there.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from gcs_plugin.mission import mission_files
from gcs_plugin.mission.mission_files import NAV_LAND, NAV_LOITER_TIME, NAV_RTL, NAV_TAKEOFF, NAV_WAYPOINT, FileItem
from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.earth import DEGREE_M
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import End

_FASTEST_M_S: Final = 15.0  # the speeds of WPML end there, and those of Litchi
_SAME_DEG, _SAME_M = 1e-7, 0.01  # nearer points are one: apps refuse two in one place
_ENDS: Final[dict[int, End]] = {NAV_RTL: "rtl", NAV_LAND: "land"}


class RoutePoint(NamedTuple):
    """A place that is flown to, height above takeoff; pictures each `every_m` metres from there to the next, 0 none."""

    lat_deg: float
    lon_deg: float
    height_m: float
    every_m: float = 0.0
    wait_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DroneRoute:
    """A climb to `climb_m` above takeoff, then straight lines from point to point.

    Attributes:
        pitch_deg: of the gimbal, None to leave it alone. end: what follows at the last point.
    """

    points: tuple[RoutePoint, ...]
    speed_m_s: float
    climb_m: float
    pitch_deg: float | None
    end: End

    def legs(self) -> list[tuple[int, int]]:
        """First and last point of each stretch with pictures."""
        found = list[tuple[int, int]]()
        for number, point in enumerate(self.points[:-1]):
            goes_on = found and found[-1][1] == number and self.points[number - 1].every_m == point.every_m
            if point.every_m:
                found.append((found.pop()[0] if goes_on else number, number + 1))
        return found


def route_of(items: Sequence[FileItem]) -> DroneRoute:
    """The route of a mission as `sortie_items` gives it, for either autopilot.

    Raises:
        InputError: it has something that makers' apps do not know, or is faster than they fly.
    """
    points = list[RoutePoint]()
    speed_m_s, every_m, pitch_deg, end = 0.0, 0.0, None, None
    for item in mission_files.with_gimbal_items_of("ardupilot", items):
        if item.command in (NAV_TAKEOFF, NAV_WAYPOINT, NAV_LOITER_TIME):
            if item.frame != mission_files.FRAME_GLOBAL_RELATIVE:
                raise InputError("a DJI mission states heights above takeoff only; plan again without --terrain-items")
            point = RoutePoint(item.lat_deg, item.lon_deg, item.alt_m, every_m)
            if points and _same(points[-1], point):
                point = points.pop()
            points.append(point._replace(wait_s=item.params[0]) if item.command == NAV_LOITER_TIME else point)
        elif item.command == mission_files.DO_SET_CAM_TRIGG_DIST and points:
            every_m = max(item.params[0], 0.0)
            points[-1] = points[-1]._replace(every_m=every_m)
        elif item.command == mission_files.DO_CHANGE_SPEED:
            speed_m_s = item.params[1]
        elif item.command == mission_files.DO_MOUNT_CONTROL:
            pitch_deg = item.params[0]
        elif item.command in _ENDS:
            end = _ENDS[item.command]
        else:
            raise InputError(f"a DJI mission has nothing like command {item.command}; make it with: orthoswarm plan")
    if len(points) < 2:
        raise InputError("the mission has fewer than two places to fly to; plan one with: orthoswarm plan")
    if not 0.0 < speed_m_s <= _FASTEST_M_S:
        raise InputError(
            f"DJI drones fly missions at up to {_FASTEST_M_S:g} m/s, not {speed_m_s:g}; give another --speed"
        )
    climb_m = points[0].height_m
    return DroneRoute(
        points=tuple(points), speed_m_s=speed_m_s, climb_m=climb_m, pitch_deg=pitch_deg, end=end or "hover"
    )


def _same(one: RoutePoint, other: RoutePoint) -> bool:
    apart = max(abs(one.lat_deg - other.lat_deg), abs(one.lon_deg - other.lon_deg))
    return apart < _SAME_DEG and abs(one.height_m - other.height_m) < _SAME_M


def east_north_m(one: RoutePoint, other: RoutePoint) -> tuple[float, float]:
    """Metres east and north from one point to another."""
    east_deg = wrap_deg(other.lon_deg - one.lon_deg)
    return DEGREE_M * math.cos(math.radians(one.lat_deg)) * east_deg, DEGREE_M * (other.lat_deg - one.lat_deg)


def mission_of(route: DroneRoute, name: str) -> mission_files.MissionFile:
    """The mission of a route that was read, in the words of ArduPilot; an upload turns them into those of a PX4.

    Raises:
        InputError: a value means nothing; `name` is how to call the file in that case.
    """
    _check(route, name)

    def nav(command: int, point: RoutePoint, wait_s: float = 0.0) -> FileItem:
        place: dict[str, Any] = {"lat_deg": point.lat_deg, "lon_deg": point.lon_deg, "alt_m": point.height_m}
        return FileItem(
            command=command, frame=mission_files.FRAME_GLOBAL_RELATIVE, params=(wait_s, 0.0, 0.0, 0.0), **place
        )

    start, last = route.points[0], route.points[-1]
    items = [nav(NAV_TAKEOFF, start._replace(height_m=route.climb_m))]
    items.append(FileItem(command=mission_files.DO_CHANGE_SPEED, params=(1.0, route.speed_m_s, -1.0, 0.0)))
    items += [] if route.pitch_deg is None else mission_files.gimbal_items(route.pitch_deg, "ardupilot")
    every_m = 0.0
    for number, point in enumerate(route.points):
        if number or point.every_m or point.wait_s or abs(point.height_m - route.climb_m) >= _SAME_M:
            items.append(nav(NAV_WAYPOINT, point))
        if point.every_m != every_m:
            every_m, at_once = point.every_m, float(point.every_m > 0.0)
            items.append(FileItem(command=mission_files.DO_SET_CAM_TRIGG_DIST, params=(every_m, 0.0, at_once, 0.0)))
        if point.wait_s:
            items.append(nav(NAV_LOITER_TIME, point, point.wait_s))
    if route.end == "rtl":
        items.append(FileItem(command=NAV_RTL))
    else:
        items.append(nav(NAV_LAND, last._replace(height_m=0.0)) if route.end == "land" else nav(NAV_WAYPOINT, last))
    return mission_files.MissionFile(
        items=tuple(items), home=(start.lat_deg, start.lon_deg, 0.0), speed_m_s=route.speed_m_s
    )


def _check(route: DroneRoute, name: str) -> None:
    numbers = [route.speed_m_s, route.climb_m, route.pitch_deg or 0.0, *(value for p in route.points for value in p)]
    small = min(route.speed_m_s, route.climb_m, *(min(point.every_m, point.wait_s) for point in route.points))
    far = any(abs(p.lat_deg) > 90.0 or abs(p.lon_deg) > 180.0 or abs(p.height_m) > 20_000.0 for p in route.points)
    if not route.points or not all(map(math.isfinite, numbers)) or small < 0.0 or far:
        raise InputError(f"{name} has no waypoints, or values that nobody can fly; export the route again")
