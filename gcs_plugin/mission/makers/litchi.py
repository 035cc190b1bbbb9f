"""The CSV of Litchi's Mission Hub: one row a waypoint. What holds for a whole mission is set in Litchi itself."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Final

from gcs_plugin.mission.makers.drone_route import DroneRoute, RoutePoint, east_north_m
from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.errors import InputError

MOST_POINTS: Final = 99  # of DJI's Mobile SDK 4, by which Litchi flies
_FARTHEST_M: Final = 1999.0  # ... which takes no two waypoints that are 2 km apart
_ACTIONS: Final = range(1, 16)  # that a waypoint has columns for
_STAY_FOR, _NONE = 0, -1  # kinds of actions
_INTERPOLATE: Final = 2  # gimbalmode: the pitch of each waypoint
_START: Final = "latitude,longitude,altitude("
_COLUMNS: Final = (
    *("latitude", "longitude", "altitude(m)", "heading(deg)", "curvesize(m)", "rotationdir", "gimbalmode"),
    *("gimbalpitchangle", *(f"action{what}{k}" for k in _ACTIONS for what in ("type", "param")), "altitudemode"),
    *("speed(m/s)", "poi_latitude", "poi_longitude", "poi_altitude(m)", "poi_altitudemode", "photo_timeinterval"),
    "photo_distinterval",
)


def is_litchi(text: str) -> bool:
    """Whether a text is a mission of Litchi's."""
    return text.startswith(_START)


def litchi_text(route: DroneRoute) -> str:
    """The CSV of a route; raises InputError: it has more waypoints than Litchi takes."""
    points = _within_reach(route.points)
    if len(points) > MOST_POINTS:
        raise InputError(f"Litchi takes {MOST_POINTS} waypoints, not {len(points)}; give a shorter --endurance")
    text = io.StringIO()
    table = csv.DictWriter(text, _COLUMNS, restval=0, lineterminator="\n")
    table.writeheader()
    idle = {f"actiontype{k}": _NONE for k in _ACTIONS} | {"photo_timeinterval": -1, "photo_distinterval": -1}
    for number, point in enumerate(points):
        east, north = east_north_m(*points[min(number, len(points) - 2) :][:2])
        row = idle | {"latitude": f"{point.lat_deg:.9f}", "longitude": f"{point.lon_deg:.9f}"}
        row |= {
            "altitude(m)": f"{point.height_m:.3f}",
            "heading(deg)": f"{round(math.degrees(math.atan2(east, north)), 2) % 360.0:g}",
        }
        row["speed(m/s)"] = f"{route.speed_m_s:g}"
        if point.every_m:
            row["photo_distinterval"] = f"{point.every_m:.3f}"
        if route.pitch_deg is not None:
            row |= {"gimbalmode": _INTERPOLATE, "gimbalpitchangle": f"{route.pitch_deg:g}"}
        if point.wait_s:
            row |= {"actiontype1": _STAY_FOR, "actionparam1": round(1000.0 * point.wait_s)}
        table.writerow(row)
    return text.getvalue()


def _within_reach(points: Sequence[RoutePoint]) -> list[RoutePoint]:
    """The points of a route, with others between those that are too far apart."""
    near = list(points[:1])
    for last, point in pairwise(points):
        parts = math.ceil(math.hypot(*east_north_m(last, point)) / _FARTHEST_M)
        for share in (k / parts for k in range(1, parts)):
            lon = wrap_deg(last.lon_deg + share * wrap_deg(point.lon_deg - last.lon_deg))
            lat, height = ((1.0 - share) * a + share * b for a, b in zip(last[:3:2], point[:3:2], strict=True))
            near.append(RoutePoint(lat, lon, height, last.every_m))
        near.append(point)
    return near


def parse_litchi(text: str, name: str) -> DroneRoute:
    """The route of a mission of Litchi's. The file does not say what follows its last waypoint: nothing does.

    Raises:
        InputError: a number is missing, or it is in feet or above the ground.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(text, newline="")))
        if rows and "altitude(m)" not in rows[0]:
            raise InputError(f"{name} is in feet; set Litchi's units to metric and export it again")
        if any(float(row.get("altitudemode") or 0) for row in rows):
            raise InputError(
                f"{name} has heights above the ground; switch off 'Above Ground' in Litchi, export it again"
            )
        speeds = [float(row.get("speed(m/s)") or 0.0) for row in rows]
        speed_m_s = next((speed for speed in speeds if speed), 0.0)
        points = tuple(_point(row, speed_m_s) for row in rows)
        pitches = [float(row["gimbalpitchangle"]) for row in rows if row.get("gimbalmode") == str(_INTERPOLATE)]
    except (ValueError, TypeError, KeyError, csv.Error) as error:
        raise InputError(f"{name} has a row without its numbers ({error}); export it again in Litchi") from None
    climb_m, pitch_deg = (points[0].height_m if points else 0.0), (pitches[0] if pitches else None)
    return DroneRoute(points=points, speed_m_s=speed_m_s, climb_m=climb_m, pitch_deg=pitch_deg, end="hover")


def _point(row: Mapping[str, str], speed_m_s: float) -> RoutePoint:
    every_m = float(row.get("photo_distinterval") or 0.0)
    if every_m <= 0.0:
        every_m = max(0.0, float(row.get("photo_timeinterval") or 0.0)) * speed_m_s
    actions = [(row.get(f"actiontype{k}"), row.get(f"actionparam{k}")) for k in _ACTIONS]
    wait_s = sum(float(said or 0.0) for kind, said in actions if kind == str(_STAY_FOR)) / 1000.0
    lat, lon, height_m = (float(row[column]) for column in _COLUMNS[:3])
    return RoutePoint(lat, lon, height_m, every_m, wait_s)
