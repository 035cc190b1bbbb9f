"""The area to map and the zones not to fly over, in grid metres."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.planning.area.shape_files import Polygon, Ring

Geometry = Any  # shapely has no type information here

_SMALLEST_M2 = 1.0
_NARROWEST_M = 0.5


@dataclass(frozen=True)
class Area:
    """Ground to be mapped and zones that no path may cross.

    Attributes:
        grid: UTM grid of the area.
        ground: shapely (Multi)Polygon in grid metres, no-fly zones taken out.
        no_fly: shapely (Multi)Polygon in grid metres, perhaps empty: the polygons' holes and further zones.
    """

    grid: LocalGrid
    ground: Geometry
    no_fly: Geometry

    @property
    def size_m2(self) -> float:
        """Square metres to be mapped."""
        return float(self.ground.area)


def make_area(polygons: Sequence[Polygon], no_fly: Iterable[Ring] = (), grid: LocalGrid | None = None) -> Area:
    """The area of polygons on the globe; holes are no-fly zones and win over polygons that overlap them.

    Args:
        polygons: at least one; they may overlap.
        no_fly: further zones as rings (n, 2) of latitude and longitude in degrees, inside or outside the area.
        grid: UTM grid of the result; the area's own zone if None.

    Raises:
        InputError: a polygon crosses itself or has no area, a hole lies outside, or nothing is left to map.
    """
    if not polygons:
        raise InputError("no polygon was given; draw the area as a polygon")
    if grid is None:
        shells = np.concatenate([p.shell for p in polygons])
        grid = LocalGrid(area_epsg(shells[:, 0], shells[:, 1]))
    outlines, holes = [], []
    for number, polygon in enumerate(polygons, start=1):
        name = "the polygon" if len(polygons) == 1 else f"polygon {number}"
        outline = shapely.Polygon(_to_grid(grid, polygon.shell), [_to_grid(grid, h) for h in polygon.holes])
        _check(outline, grid, name)
        outlines.append(shapely.Polygon(outline.exterior))
        holes += [shapely.Polygon(r) for r in outline.interiors]
    for zone in no_fly:
        closed = shapely.Polygon(_to_grid(grid, zone))
        _check(closed, grid, "a no-fly zone")
        holes.append(closed)
    forbidden = shapely.union_all(holes)
    ground = shapely.union_all(outlines).difference(forbidden)
    for number, outline in enumerate(outlines, start=1):
        if outline.intersection(ground).area < _SMALLEST_M2:
            raise InputError(
                f"polygon {number} lies inside a no-fly zone, where nothing may fly; remove it or the hole around it"
            )
    return Area(grid, _polygons_only(ground), _polygons_only(forbidden))


def _to_grid(grid: LocalGrid, points: Ring) -> Ring:
    return grid.to_grid(points[:, 0], points[:, 1])


def _check(polygon: Geometry, grid: LocalGrid, name: str) -> None:
    if not np.isfinite(shapely.get_coordinates(polygon)).all():
        raise InputError(f"{name} reaches too far for one UTM grid; plan a smaller area")
    outline = shapely.Polygon(polygon.exterior)
    hull = outline.convex_hull  # a crossing outline may have no net area, but its hull has
    if min(hull.area, hull.area if not outline.is_valid else outline.area) < _SMALLEST_M2:
        raise InputError(f"{name} has no area (less than {_SMALLEST_M2:g} square metre); draw a larger one")
    if 2.0 * hull.area < _NARROWEST_M * hull.length or _is_line(grid, polygon):
        raise InputError(f"{name} has no area (its points lie on a line); draw it with some width")
    if polygon.is_valid:
        return
    reason, _, place = shapely.is_valid_reason(polygon).partition("[")
    where = ""
    if place:
        lat, lon = grid.to_geographic([float(v) for v in place.rstrip("]").split()[:2]])
        where = f" at {lat:.6f}, {lon:.6f}"
    if outline.is_valid and not all(outline.covers(ring) for ring in polygon.interiors):
        raise InputError(f"{name} has a hole that is not inside it ({reason.lower()}{where}); move the hole inside")
    raise InputError(f"{name} crosses or touches itself{where} ({reason.lower()}); redraw its outline without crossing")


def _is_line(grid: LocalGrid, polygon: Geometry) -> bool:
    """True for points on one parallel: in metres it bends, so that nothing would seem to have an area."""
    lat_lon = grid.to_geographic(shapely.get_coordinates(polygon.exterior))
    hull = shapely.MultiPoint(lat_lon).convex_hull
    return bool(hull.area < 1e-7 * hull.length**2)


def _polygons_only(geometry: Geometry) -> Geometry:
    parts = [p for p in shapely.get_parts(shapely.get_parts(geometry)) if p.geom_type == "Polygon"]
    return shapely.MultiPolygon([p for p in parts if p.area > 1e-6])
