"""The ground that a gap flight must see: gaps of a coverage, merged, grown by the margin of their cause."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from orthoswarm.coverage.missing_pictures import Cause
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.planning.area.area import Area, make_area
from orthoswarm.planning.area.shape_files import Polygon, Ring, parse_geojson
from orthoswarm.planning.lines.line_spacing import Footprint

Geometry = Any
_MARGIN = {Cause.POOR: 0.08, Cause.NARROW_LENS: 0.06}
_USUAL_MARGIN = 0.04
"""Margins as shares of a picture's width, larger where positions or the lens were in doubt."""
_MERGE = 0.25
"""Gaps nearer to each other than half a picture's width (a quarter on each side) are flown as one."""
_SMALLEST = 0.001
"""Gaps smaller than this share of a picture are left out."""


@dataclass(frozen=True, slots=True)
class ReadGap:
    """A gap from a file: its polygon on the globe and why it was missed (None if the file does not say)."""

    polygon: Polygon
    cause: Cause | None


@dataclass(frozen=True, slots=True)
class GapTarget:
    """What a gap flight aims at: the area with no-fly zones, and what was left out, in words."""

    area: Area
    notes: tuple[str, ...]


def read_gaps(path: Path) -> list[ReadGap]:
    """Gaps of a GeoJSON of polygons, with the property `cause` as `orthoswarm coverage` writes it.

    Raises:
        InputError: it cannot be read or holds no polygon.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); give the gaps.geojson of a coverage") from None
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON ({error}); give the gaps.geojson of a coverage") from None
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list):
        raise InputError(f"{path} is not a GeoJSON feature collection; give the gaps.geojson of a coverage")
    if not features:
        raise InputError(f"{path} holds no gap: all of the area was seen, so there is nothing to fly")
    known = {str(cause): cause for cause in Cause}
    gaps = []
    for feature in features:
        cause = known.get(str(((feature or {}).get("properties") or {}).get("cause")))
        gaps += [ReadGap(polygon, cause) for polygon in _polygons(feature, path)]
    if not gaps:
        raise InputError(f"{path} holds no polygon; give the gaps.geojson of a coverage")
    return gaps


def gap_area(gaps: Sequence[ReadGap], no_fly: Sequence[Ring], foot: Footprint, fly_not_arrived: bool) -> GapTarget:
    """The ground to aim at.

    Args:
        gaps: of `read_gaps`. no_fly: rings (n, 2), latitude and longitude in degrees. foot: footprint of the camera.
        fly_not_arrived: also gaps whose pictures were taken, but have not arrived.

    Raises:
        InputError: nothing is left to fly.
    """
    places = np.concatenate([g.polygon.shell for g in gaps])
    grid = LocalGrid(area_epsg(places[:, 0], places[:, 1]))
    zones = [make_area([Polygon(zone)], (), grid).ground for zone in no_fly]
    forbidden = shapely.union_all(zones)
    notes: list[str] = []
    if not zones:
        notes.append(
            "no no-fly zone is known: a file of gaps does not hold those of the first plan, give them with --no-fly"
        )
    waiting = [] if fly_not_arrived else [g for g in gaps if g.cause is Cause.NOT_ARRIVED]
    if waiting:
        notes.append(
            f"{len(waiting)} gaps are not flown, since their pictures were taken and have not arrived: copy them from "
            "the card, or fly them all the same with --fly-not-arrived"
        )
    skip = set(map(id, waiting))
    grown = [_grown(gap, grid, foot) for gap in gaps if id(gap) not in skip]
    merged = shapely.union_all(grown).buffer(_MERGE * foot.width_m).buffer(-_MERGE * foot.width_m)
    hidden = float(shapely.union_all(grown).intersection(forbidden).area)
    if hidden >= 1.0:
        notes.append(f"{hidden:.0f} square metres of the gaps lie in no-fly zones and are not flown")
    parts = [p for p in shapely.get_parts(merged.difference(forbidden)) if p.geom_type == "Polygon"]
    least = _SMALLEST * foot.width_m * foot.height_m
    flown = [p for p in parts if p.area >= least]
    if len(flown) < len(parts):
        notes.append(f"{len(parts) - len(flown)} gaps smaller than {least:.1f} square metres are not flown")
    if not flown:
        raise InputError("; ".join(["no gap is left to fly", *notes]))
    return GapTarget(Area(grid, shapely.MultiPolygon(flown), shapely.MultiPolygon(_parts(forbidden))), tuple(notes))


def _parts(geometry: Geometry) -> list[Geometry]:
    return [p for p in shapely.get_parts(shapely.get_parts(geometry)) if p.geom_type == "Polygon"]


def _grown(gap: ReadGap, grid: LocalGrid, foot: Footprint) -> Geometry:
    """A gap in grid metres with its margin; steps of cells at its border are smoothed away."""
    rings = [grid.to_grid(r[:, 0], r[:, 1]) for r in (gap.polygon.shell, *gap.polygon.holes)]
    margin = foot.width_m * (_USUAL_MARGIN if gap.cause is None else _MARGIN.get(gap.cause, _USUAL_MARGIN))
    return shapely.Polygon(rings[0], rings[1:]).buffer(0).buffer(margin).simplify(0.25 * margin)


def _polygons(feature: Mapping[str, Any], path: Path) -> Sequence[Polygon]:
    """The polygons of one feature. They are made of the steps of cells, and simplified later: any number of corners."""
    return parse_geojson(json.dumps(feature), str(path), any_size=True).polygons
