"""Polygons and lines out of GeoJSON and KML text, as latitudes and longitudes in degrees."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.model.errors import InputError

Ring = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Polygon:
    """A polygon on the globe.

    Attributes:
        shell: outer ring, float64 (n, 2), latitude and longitude in degrees, not closed.
        holes: inner rings of the same form.
    """

    shell: Ring
    holes: tuple[Ring, ...] = ()


@dataclass(frozen=True, slots=True)
class Shapes:
    """What a file holds.

    Attributes:
        polygons: its polygons.
        lines: its polylines, each float64 (n, 2), latitude and longitude in degrees.
    """

    polygons: tuple[Polygon, ...] = ()
    lines: tuple[Ring, ...] = ()


def ring(points: Any, name: str, least: int = 3) -> Ring:
    """A ring or line of (latitude, longitude) degrees, checked; closing and repeated points dropped.

    Args:
        points: array-like (n, 2).
        name: how to call the source in an error.
        least: points that must remain: 3 for a ring (which then is not closed), 2 for a line.

    Raises:
        InputError: too few points, or values that are not degrees.
    """
    try:
        array = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    except (TypeError, ValueError):
        raise InputError(f"{name} has coordinates that are not numbers; export it again") from None
    if not np.isfinite(array).all():
        raise InputError(f"{name} has coordinates that are not finite; export it again")
    if (np.abs(array) > [90.0, 180.0]).any():
        raise InputError(
            f"{name} has coordinates that are not longitude and latitude in degrees; export it in WGS 84 (EPSG:4326)"
        )
    if len(array):
        array = array[np.r_[True, (np.diff(array, axis=0) != 0).any(1)]]
    if least > 2 and len(array) > 1 and (array[0] == array[-1]).all():
        array = array[:-1]
    if len(array) < least:
        raise InputError(f"{name} has a shape of {len(array)} different points; draw it with at least {least}")
    return array


def refuse_many_corners(shapes: Iterable[Polygon | Ring], name: str) -> None:
    """Refuse shapes that would take forever: whether an outline crosses itself can take the square of its corners.

    Args:
        shapes: polygons and lines that are used together. name: how to call them in an error.

    Raises:
        InputError: they have more corners than the configuration allows.
    """
    most = active().planning.most_corners
    rings = (ring for s in shapes for ring in ((s.shell, *s.holes) if isinstance(s, Polygon) else (s,)))
    count = sum(map(len, rings))
    if count > most:
        raise InputError(f"{name} has {count} corners; simplify it to at most {most}, for example with QGIS's Simplify")


def parse_geojson(text: str, name: str = "the GeoJSON file", *, any_size: bool = False) -> Shapes:
    """Polygons and lines of a GeoJSON text (RFC 7946): geometries, features and collections, nested ones too.

    Args:
        text: of the file. name: how to call it in an error.
        any_size: also more corners than the configuration allows, for what is simplified before it is used.

    Raises:
        InputError: no JSON, no GeoJSON, or coordinates that are not longitude and latitude.
    """
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name} is not valid JSON ({error}); export it again") from None
    if not isinstance(document, dict) or "type" not in document:
        raise InputError(f"{name} is JSON but no GeoJSON (it has no 'type'); export a polygon as GeoJSON")
    crs = str(((document.get("crs") or {}).get("properties") or {}).get("name", "CRS84"))
    if not crs.upper().replace("::", ":").endswith(("CRS84", "EPSG:4326")):
        raise InputError(f"{name} is in {crs}; export it in WGS 84 (EPSG:4326)")
    polygons: list[Polygon] = []
    lines: list[Ring] = []
    try:
        for kind, coordinates in _geometries(document):
            if kind in ("Polygon", "MultiPolygon"):
                for part in [coordinates] if kind == "Polygon" else coordinates:
                    shell, *holes = [ring(_lat_lon(r), name) for r in part]
                    polygons.append(Polygon(shell, tuple(holes)))
            elif kind in ("LineString", "MultiLineString"):
                for part in [coordinates] if kind == "LineString" else coordinates:
                    lines.append(ring(_lat_lon(part), name, 2))
    except (TypeError, ValueError, KeyError, IndexError, AttributeError, RecursionError, OverflowError):
        raise InputError(f"{name} is GeoJSON with a broken geometry; export it again") from None
    if not any_size:
        refuse_many_corners([*polygons, *lines], name)
    return Shapes(tuple(polygons), tuple(lines))


def _geometries(node: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    kind = node["type"]
    if kind == "FeatureCollection":
        for feature in node["features"]:
            yield from _geometries(feature)
    elif kind == "Feature":
        if node["geometry"] is not None:
            yield from _geometries(node["geometry"])
    elif kind == "GeometryCollection":
        for geometry in node["geometries"]:
            yield from _geometries(geometry)
    else:
        yield str(kind), node["coordinates"]


def _lat_lon(positions: Sequence[Sequence[float]]) -> list[tuple[float, float]]:
    return [(float(p[1]), float(p[0])) for p in positions]


def parse_kml(text: str | bytes, name: str = "the KML file") -> Shapes:
    """Polygons and lines of a KML text (OGC KML 2.x; any namespace).

    Raises:
        InputError: no XML, no KML, or coordinates that are not longitude and latitude.
    """
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{name} is not valid XML ({error}); export it again") from None
    if _tag(root) not in ("kml", "Document", "Folder", "Placemark"):
        raise InputError(f"{name} is XML but no KML (its root is '{_tag(root)}'); export a polygon as KML")
    polygons: list[Polygon] = []
    lines: list[Ring] = []
    for node in root.iter():
        if _tag(node) == "Polygon":
            outer = _coordinates(node, "outerBoundaryIs")
            if not outer:
                raise InputError(f"{name} has a polygon without an outer boundary; export it again")
            shell = ring(_numbers(outer[0], name), name)
            holes = tuple(ring(_numbers(h, name), name) for h in _coordinates(node, "innerBoundaryIs"))
            polygons.append(Polygon(shell, holes))
        elif _tag(node) == "LineString":
            lines += [ring(_numbers(c, name), name, 2) for c in _coordinates(node)]
    refuse_many_corners([*polygons, *lines], name)
    return Shapes(tuple(polygons), tuple(lines))


def _tag(node: ElementTree.Element) -> str:
    return str(node.tag).rpartition("}")[2]


def _coordinates(node: ElementTree.Element, boundary: str | None = None) -> list[str]:
    """Texts of a line's coordinates, or of those of a polygon's boundaries.

    Only children are looked at, as the standard has them: what is nested in itself would be read again at every depth.
    """
    rings = [node] if boundary is None else [r for b in node if _tag(b) == boundary for r in b]
    return [n.text or "" for r in rings for n in r if _tag(n) == "coordinates"]


def _numbers(text: str, name: str) -> list[tuple[float, float]]:
    try:
        tuples = [t.split(",") for t in text.split()]
        return [(float(t[1]), float(t[0])) for t in tuples]
    except (ValueError, IndexError):
        raise InputError(f"{name} has KML coordinates that are not 'lon,lat[,alt]'; export it again") from None
