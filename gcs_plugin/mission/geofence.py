"""The geofence that a vehicle holds: zones out of the items of its fence list (MAV_MISSION_TYPE_FENCE)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.items import FRAME_GLOBAL, Mission, MissionItem

_ROUNDING_M: Final = 0.5
"""A way along the edge of a zone may lie so far on the wrong side: places are rounded."""
FENCE: Final = int(dialect.MAV_MISSION_TYPE_FENCE)
Kind = Literal["inclusion", "exclusion"]
_POLYGONS: Final[dict[int, Kind]] = {
    int(dialect.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION): "inclusion",
    int(dialect.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION): "exclusion",
}
_CIRCLES: Final[dict[int, Kind]] = {
    int(dialect.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION): "inclusion",
    int(dialect.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION): "exclusion",
}


@dataclass(frozen=True, slots=True)
class FenceZone:
    """A zone that a vehicle must stay inside (inclusion) or outside of (exclusion).

    Attributes:
        points: longitude and latitude in degrees of a polygon's corners without the closing one, or of a centre.
        radius_m: of a circle, None for a polygon.
    """

    kind: Kind
    points: tuple[tuple[float, float], ...]
    radius_m: float | None = None

    def document(self) -> dict[str, Any]:
        """JSON: `kind`, and `ring` or `center` with `radius_m`."""
        if self.radius_m is None:
            return {"kind": self.kind, "ring": [list(point) for point in self.points]}
        return {"kind": self.kind, "center": list(self.points[0]), "radius_m": self.radius_m}


_COMMANDS: Final = {(kind, False): command for command, kind in _POLYGONS.items()} | {
    (kind, True): command for command, kind in _CIRCLES.items()
}


def fence_mission(zones: "Sequence[FenceZone]", autopilot: Autopilot) -> Mission:
    """Zones as the list that is put into a vehicle."""
    items = []
    for zone in zones:
        command = _COMMANDS[zone.kind, zone.radius_m is not None]
        first = float(len(zone.points)) if zone.radius_m is None else zone.radius_m
        for lon, lat in zone.points:
            params = (first, 0.0, 0.0, 0.0)
            items.append(MissionItem.at(command, lat, lon, 0.0, params=params, frame=FRAME_GLOBAL))
    return Mission(autopilot, tuple(items), list_type=FENCE)


def breach(mission: Mission, zones: "Sequence[FenceZone]", *, in_all: bool = False) -> str:
    """Where a mission leaves the zones it must stay inside of, or enters others, in words; empty if it keeps to them.

    `in_all`: it must be in all inclusion zones, not just in any of them.
    """
    from shapely import LineString, Point, Polygon, intersection_all, union_all

    from gcs_plugin.mission.track import flight_path, home_of, metres

    origin = home_of(mission)
    if origin is None or not zones:
        return ""
    points, _, _ = flight_path(mission, origin)
    if len(points) < 2:
        return ""
    shapes = []
    for zone in zones:
        ring = [metres(lat, lon, origin) for lon, lat in zone.points]
        shapes.append(Polygon(ring).buffer(0) if zone.radius_m is None else Point(ring[0]).buffer(zone.radius_m))
    way = LineString(points[:, :2])
    inside = [shape for zone, shape in zip(zones, shapes, strict=True) if zone.kind == "inclusion"]
    allowed = intersection_all(inside) if in_all else union_all(inside)
    if inside and (far := way.difference(allowed.buffer(_ROUNDING_M))).length > 0.0:
        return f"its mission leaves its geofence for {far.length:.0f} m"
    outside = [shape for zone, shape in zip(zones, shapes, strict=True) if zone.kind == "exclusion"]
    if outside and (within := way.intersection(union_all(outside).buffer(-_ROUNDING_M))).length > 0.0:
        return f"its mission flies {within.length:.0f} m through a zone that its geofence excludes"
    return ""


def zones_of(items: Sequence[MissionItem]) -> list[FenceZone]:
    """The zones of a fence list; return points and polygons that are not complete are left out.

    A polygon is a row of vertices that each state how many it has (param1).
    """
    zones: list[FenceZone] = []
    k = 0
    while k < len(items):
        item = items[k]
        place = (item.lon_deg, item.lat_deg)
        if item.command in _CIRCLES and math.isfinite(item.params[0]):
            zones.append(FenceZone(_CIRCLES[item.command], (place,), item.params[0]))
        elif item.command in _POLYGONS:
            count = int(item.params[0]) if math.isfinite(item.params[0]) else 0
            row = [i for i in items[k : k + count] if i.command == item.command and i.params[0] == item.params[0]]
            if count >= 3 and len(row) == count:
                zones.append(FenceZone(_POLYGONS[item.command], tuple((i.lon_deg, i.lat_deg) for i in row)))
                k += count
                continue
        k += 1
    return zones
