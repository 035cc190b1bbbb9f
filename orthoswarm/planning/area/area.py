"""The area to map and the zones not to fly over, in grid metres."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import shapely

from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.planning.area.shape_files import Polygon, Ring, refuse_many_corners

Geometry = Any  # shapely has no type information here

_SMALLEST_M2 = 1.0
_NARROWEST_M = 0.5

_OUTLINE_CORNERS: Final = 2_000
"""An area with more corners is given a coarser outline before lines are laid (outlines that are drawn or simplified for
a map have fewer, and 4,000 cost no second)."""


@dataclass(frozen=True)
class Area:
    """Ground to be mapped and zones that no path may cross."""

    grid: LocalGrid  # UTM grid of the area
    ground: Geometry  # shapely (Multi)Polygon in grid metres, no-fly zones taken out
    no_fly: Geometry  # shapely (Multi)Polygon in grid metres, perhaps empty: the polygons' holes and further zones
    circles_wider_m: float = 0.0  # so much outside a circle that its polygon in `no_fly` is drawn around lies that

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
    zones = [Polygon(zone) for zone in no_fly]
    refuse_many_corners([*polygons, *zones], "the area with its no-fly zones" if zones else "the area")
    if grid is None:
        shells = np.concatenate([p.shell for p in polygons])
        grid = LocalGrid(area_epsg(shells[:, 0], shells[:, 1]))
    single = len(polygons) == 1
    names = ["the polygon" if single else f"polygon {number}" for number, _ in enumerate(polygons, start=1)]
    closed = _in_grid([*polygons, *zones], grid)
    for shape, polygon, name in zip(
        [*polygons, *zones], closed, [*names, *["a no-fly zone"] * len(zones)], strict=True
    ):
        _check(polygon, shape.shell, grid, name)
    outlines = [shapely.Polygon(polygon.exterior) for polygon in closed[: len(polygons)]]
    holes = [shapely.Polygon(hole) for polygon in closed[: len(polygons)] for hole in polygon.interiors]
    holes += closed[len(polygons) :]
    ground, forbidden = shapely.union_all(outlines), shapely.union_all(holes)
    if holes:
        ground = ground.difference(forbidden)
        _refuse_inside(outlines, forbidden)
    return Area(grid, _polygons_only(ground), _polygons_only(forbidden))


def coarser(area: Area, tolerance_m: float) -> Geometry:
    """The ground with an outline no finer than lines need; no smaller than it is, and still without no-fly zones.

    Args:
        area: returned as it is where it has no more corners than usual. tolerance_m: the outline moves out by at most
            twice as much.
    """
    if int(shapely.get_num_coordinates(area.ground)) <= _OUTLINE_CORNERS:
        return area.ground
    grown = shapely.buffer(area.ground, tolerance_m, quad_segs=2)
    # the grown outline lies at least cos(22.5 degrees) of the tolerance outside: it may come back by so much
    outline = shapely.simplify(grown, 0.9 * tolerance_m)
    return _polygons_only(outline.difference(area.no_fly))


def _in_grid(shapes: Sequence[Polygon], grid: LocalGrid) -> list[Geometry]:
    """Polygons in grid metres; all their points are transformed at once, since each call has its price."""
    rings = [ring for shape in shapes for ring in (shape.shell, *shape.holes)]
    points = np.concatenate(rings)
    parts = iter(np.split(grid.to_grid(points[:, 0], points[:, 1]), np.cumsum([len(ring) for ring in rings])[:-1]))
    return [shapely.Polygon(next(parts), [next(parts) for _ in shape.holes]) for shape in shapes]


def _refuse_inside(outlines: Sequence[Geometry], forbidden: Geometry) -> None:
    """Refuse an outline of which no-fly zones leave nothing; each is compared with the zones near it only.

    Raises InputError: there is such an outline.
    """
    zones = shapely.get_parts(forbidden)  # which do not overlap
    outline, zone = shapely.STRtree(zones).query(outlines, predicate="intersects")
    taken = shapely.area(shapely.intersection(np.asarray(outlines)[outline], zones[zone]))
    left = shapely.area(outlines) - np.bincount(outline, taken, len(outlines))
    for number in np.flatnonzero(left < _SMALLEST_M2) + 1:
        raise InputError(
            f"polygon {number} lies inside a no-fly zone, where nothing may fly; remove it or the hole around it"
        )


def _check(polygon: Geometry, shell: Ring, grid: LocalGrid, name: str) -> None:
    """Refuse a polygon in grid metres that is none; `shell` is its outline in degrees.

    Raises InputError: it says what is wrong.
    """
    if not np.isfinite(shapely.get_coordinates(polygon)).all():
        raise InputError(f"{name} reaches too far for one UTM grid; plan a smaller area")
    outline = shapely.Polygon(polygon.exterior)
    hull = outline.convex_hull  # a crossing outline may have no net area, but its hull has
    valid = bool(polygon.is_valid)  # asked once: of an outline that crosses itself it takes the square of its corners
    if min(hull.area, outline.area if valid else hull.area) < _SMALLEST_M2:
        raise InputError(f"{name} has no area (less than {_SMALLEST_M2:g} square metre); draw a larger one")
    if 2.0 * hull.area < _NARROWEST_M * hull.length or _is_line(shell):
        raise InputError(f"{name} has no area (its points lie on a line); draw it with some width")
    if valid:
        return
    reason, _, place = shapely.is_valid_reason(polygon).partition("[")
    where = ""
    if place:
        lat, lon = grid.to_geographic([float(v) for v in place.rstrip("]").split()[:2]])
        where = f" at {lat:.6f}, {lon:.6f}"
    if polygon.interiors and outline.is_valid and not shapely.covers(outline, list(polygon.interiors)).all():
        raise InputError(f"{name} has a hole that is not inside it ({reason.lower()}{where}); move the hole inside")
    raise InputError(f"{name} crosses or touches itself{where} ({reason.lower()}); redraw its outline without crossing")


def _is_line(shell: Ring) -> bool:
    """True for points on one parallel: in metres it bends, so that nothing would seem to have an area."""
    hull = shapely.MultiPoint(shell).convex_hull
    return bool(hull.area < 1e-7 * hull.length**2)


def _polygons_only(geometry: Geometry) -> Geometry:
    parts = [p for p in shapely.get_parts(shapely.get_parts(geometry)) if p.geom_type == "Polygon"]
    return shapely.MultiPolygon([p for p in parts if p.area > 1e-6])
