"""Polygons, circles and lines out of GeoJSON and KML text, as latitudes and longitudes in degrees.

GeoJSON has no circles; they come as points with a radius: in geozone files (EUROCAE ED-269, ED-318), or with the
property `radius_m` or `radius`. A line with `width_m` is a strip. What is none of these is named, never passed over.
Lengths are metres unless a unit is said, in their text or in a property of its own.
"""

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
import shapely
from numpy.typing import NDArray

from orthoswarm.model.earth import ring_around
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid, area_epsg

Ring = NDArray[np.float64]
MOST_CORNERS: Final = 50_000
"""Areas, zones and lines with more corners are refused. Whether an outline crosses itself can take the square of their
number: 13 s for a star of so many, four times that for one of twice as many (measured); a circle of so many is planned
in a minute."""
_ROUND_M = 0.2  # a circle's polygon lies so far outside it at most
_LEAST_M: Final = 1.0  # shorter radii and widths are in another unit, or none
_MOST_M: Final = 100_000.0
_UNITS_M: Final = {
    **dict.fromkeys(("", "m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
    **dict.fromkeys(("km", "kilometer", "kilometers", "kilometre", "kilometres"), 1000.0),
    **dict.fromkeys(("nm", "nmi", "nautical miles"), 1852.0),
}
SIZES: Final = ("radius_m", "radius", "width_m")
"""Properties with a size, by their names in lower case; in the first two a point's radius, the last a line's width."""
_UNIT_NAMES: Final = ("unit", "units", "uom", "uomdimensions", "radius_unit", "radius_units")


@dataclass(frozen=True, slots=True)
class Polygon:
    """A polygon on the globe."""

    shell: Ring  # outer ring, float64 (n, 2), latitude and longitude in degrees, not closed
    holes: tuple[Ring, ...] = ()  # inner rings of the same form


@dataclass(frozen=True, slots=True)
class Circle:
    """A circle on the globe: its centre in degrees, its radius in metres."""

    lat_deg: float
    lon_deg: float
    radius_m: float

    def polygon(self, beyond_m: float = 0.0) -> Polygon:
        """A polygon around it, `beyond_m` larger."""
        radius = self.radius_m + beyond_m
        corners = max(32, math.ceil(math.pi / math.sqrt(2.0 * _ROUND_M / radius)))
        return Polygon(np.array(ring_around(self.lat_deg, self.lon_deg, radius, corners)))


@dataclass(frozen=True, slots=True)
class Shapes:
    """What a file holds."""

    polygons: tuple[Polygon, ...] = ()  # its polygons, strips of lines with a width among them
    lines: tuple[Ring, ...] = ()  # its polylines, each float64 (n, 2), latitude and longitude in degrees
    circles: tuple[Circle, ...] = ()  # its circles
    hidden: tuple[Polygon, ...] = ()  # polygons that are switched off in the file (KML's visibility)
    _: KW_ONLY
    unused: tuple[str, ...] = ()  # what else it holds, in words ("2 points")
    doubts: tuple[str, ...] = ()  # what is uncertain about its places, a sentence each

    @property
    def areas(self) -> tuple[Polygon, ...]:
        """Polygons, and those around circles."""
        return (*self.polygons, *(circle.polygon() for circle in self.circles))

    @property
    def left(self) -> tuple[str, ...]:
        """What of the file no area or line is made of, in words."""
        hidden = len(self.hidden)
        return (*self.unused, *counted({"polygon switched off in the file": hidden} if hidden else {}))

    @classmethod
    def joined(cls, parts: Sequence["Shapes"]) -> "Shapes":
        """All shapes of several files or layers."""
        return cls(**{f.name: tuple(shape for part in parts for shape in getattr(part, f.name)) for f in fields(cls)})


def ring(points: Any, name: str, least: int = 3) -> Ring:
    """A ring or line of (latitude, longitude) degrees, checked; closing and repeated points dropped.

    Args:
        points: array-like (n, 2). name: how to call the source in an error.
        least: points that must remain: 3 for a ring (which then is not closed), 2 for a line.

    Raises:
        InputError: too few points, or values that are not degrees.
    """
    try:
        array = np.array(points, dtype=np.float64).reshape(-1, 2)
    except (TypeError, ValueError):
        raise InputError(f"{name} has coordinates that are not numbers; export it again") from None
    if not np.isfinite(array).all():
        raise InputError(f"{name} has coordinates that are not finite; export it again")
    if (np.abs(array) > [90.0, 360.0]).any():
        raise InputError(
            f"{name} has coordinates that are not longitude and latitude in degrees; export it in WGS 84 (EPSG:4326)"
        )
    if (np.abs(array[:, 1]) > 180.0).any():  # some programs go on counting across the date line
        array[:, 1] = (array[:, 1] + 180.0) % 360.0 - 180.0
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
        InputError: they have more than `MOST_CORNERS`.
    """
    rings = (ring for s in shapes for ring in ((s.shell, *s.holes) if isinstance(s, Polygon) else (s,)))
    count = sum(map(len, rings))
    if count > MOST_CORNERS:
        raise InputError(
            f"{name} has {count} corners; simplify it to at most {MOST_CORNERS}, for example with QGIS's Simplify"
        )


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
    if isinstance(document, list) and document:  # features, or zones, without the collection around them
        document = {"features": document}
    zones = isinstance(document, dict) and isinstance(document.get("features", document.get("UASZoneList")), list)
    if not isinstance(document, dict) or not (zones or "type" in document):
        raise InputError(f"{name} is JSON but no GeoJSON (it has no 'type'); export a polygon as GeoJSON")
    crs = str(((document.get("crs") or {}).get("properties") or {}).get("name", "CRS84"))
    if not crs.upper().replace("::", ":").endswith(("CRS84", "EPSG:4326")):
        raise InputError(f"{name} is in {crs}; export it in WGS 84 (EPSG:4326)")
    polygons, lines, circles, unused = list[Polygon](), list[Ring](), list[Circle](), Counter[str]()
    try:
        for kind, coordinates, said in _geometries(document, {}):
            if coordinates == [] and kind == document.get("type") and kind.startswith("Multi"):
                continue  # a bare list of none, as programs write it
            if coordinates == [] and kind in _SHAPES:
                unused["feature without a shape"] += 1
            elif kind in ("Polygon", "MultiPolygon"):
                for part in [coordinates] if kind == "Polygon" else coordinates:
                    shell, *holes = [ring(_lat_lon(r), name) for r in part]
                    polygons.append(Polygon(shell, tuple(holes)))
            elif kind in ("LineString", "MultiLineString"):
                for part in [coordinates] if kind == "LineString" else coordinates:
                    line = ring(_lat_lon(part), name, 2)
                    strip = strip_of(line, said, name)
                    polygons += strip
                    lines += [] if strip else [line]
            elif kind == "Point" and (circle := circle_of(*_lat_lon([coordinates])[0], said, name)) is not None:
                circles.append(circle)
            else:
                unused[_NOUNS.get(kind, f"shape of kind '{kind}'")] += 1
    except (TypeError, ValueError, KeyError, IndexError, AttributeError, RecursionError, OverflowError):
        raise InputError(f"{name} is GeoJSON with a broken geometry; export it again") from None
    found = Shapes(tuple(polygons), tuple(lines), tuple(circles), unused=counted(unused))
    if not any_size:
        refuse_many_corners([*found.areas, *lines], name)
    return found


_SHAPES = ("Polygon", "MultiPolygon", "LineString", "MultiLineString", "Point", "MultiPoint")
_NOUNS = {"Point": "point", "MultiPoint": "group of points", "": "feature without a shape"}


def counted(nouns: Mapping[str, int]) -> tuple[str, ...]:
    """Things and how many of them, in words; the first word of a noun is what is counted."""
    words = ((count, *noun.partition(" ")) for noun, count in nouns.items())
    return tuple(f"{n} {head}s{gap}{rest}" if n > 1 else f"a {head}{gap}{rest}" for n, head, gap, rest in words)


def circle_of(lat: float, lon: float, said: Mapping[str, Any], name: str) -> Circle | None:
    """The circle around a point, by its properties (names in lower case); None if they state no radius.

    Raises InputError: none that a zone can have, or in an unknown unit.
    """
    radius = said.get("radius_m", said.get("radius"))
    if radius is None:
        return None
    ring([(lat, lon)], name, 1)
    return Circle(lat, lon, _metres(radius, said, f"{name} has a circle with a radius"))


def strip_of(line: Ring, said: Mapping[str, Any], name: str) -> list[Polygon]:
    """The ground within half a width of a line, by its properties; nothing if they state no width.

    Raises InputError: none that a zone can have, or in an unknown unit.
    """
    if said.get("width_m") is None:
        return []
    width_m = _metres(said["width_m"], said, f"{name} has a line with a width")
    grid = LocalGrid(area_epsg(line[:, 0], line[:, 1]))
    strips = list[Polygon]()
    for part in shapely.get_parts(shapely.LineString(grid.to_grid(*line.T)).buffer(0.5 * width_m)):
        shell, *holes = [grid.to_geographic(np.array(r.coords)[:-1]) for r in (part.exterior, *part.interiors)]
        strips.append(Polygon(shell, tuple(holes)))
    return strips


def _metres(size: Any, said: Mapping[str, Any], of_what: str) -> float:
    """A radius or width in metres, with its unit in its text or in another property."""
    match = re.fullmatch(r"\s*([-+.\deE]+)\s*([A-Za-z ]*)", str(size))
    if match is None:
        raise InputError(f"{of_what} of '{str(size)[:20]}'; write a number of metres")
    unit = match[2].strip() or next((str(said[key]) for key in _UNIT_NAMES if said.get(key)), "")
    if unit.lower() not in _UNITS_M:
        raise InputError(f"{of_what} in '{unit[:20]}', which is no unit that is known; write it in metres")
    metres = float(match[1]) * _UNITS_M[unit.lower()]
    if not _LEAST_M <= metres <= _MOST_M:
        raise InputError(f"{of_what} of {metres:g} m; correct it, or its unit")
    return metres


def _geometries(node: Mapping[str, Any], said: Mapping[str, Any]) -> Iterator[tuple[str, Any, Mapping[str, Any]]]:
    """Kind, coordinates and properties (names in lower case) of each geometry; kind "" where there is none."""
    kind = node.get("type")
    zones = node.get("features", node.get("UASZoneList"))
    if isinstance(zones, list):
        for feature in zones:
            yield from _geometries(feature, {})
    elif isinstance(node.get("geometry"), list):  # a zone of ED-269: volumes
        for volume in node["geometry"]:
            flat = volume["horizontalProjection"]
            if flat["type"] == "Circle":
                yield "Point", flat["center"], {"radius": flat["radius"], "uom": volume.get("uomDimensions")}
            else:
                yield str(flat["type"]), flat["coordinates"], {}
    elif kind == "Feature":
        said = {str(key).lower(): value for key, value in (node.get("properties") or {}).items()}
        yield from _geometries(node["geometry"], said) if node["geometry"] is not None else [("", None, said)]
    elif kind == "GeometryCollection":
        for geometry in node["geometries"]:
            yield from _geometries(geometry, said)
    else:
        extent = node.get("extent") or {}  # ED-318
        if extent.get("subType") == "Circle":
            said = {str(key).lower(): value for key, value in extent.items()}
        yield str(node["type"]), node["coordinates"], said


def _lat_lon(positions: Sequence[Sequence[float]]) -> list[tuple[float, float]]:
    return [(float(p[1]), float(p[0])) for p in positions]


def parse_kml(text: str | bytes, name: str = "the KML file", *, any_size: bool = False) -> Shapes:
    """Polygons and lines of a KML text (OGC KML 2.x; any namespace); any_size: see `parse_geojson`.

    Raises InputError: no XML, no KML, or coordinates that are not longitude and latitude.
    """
    try:
        root = ElementTree.fromstring(_mended(text))
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{name} is not valid XML ({error}); export it again") from None
    if _tag(root).lower().startswith("aixm"):
        raise InputError(
            f"{name} is AIXM, which is not read; get the zones as ED-269, ED-318, GeoJSON or KML, or convert them "
            "(ogr2ogr -f GeoJSON, or QGIS) and compare their circles and arcs"
        )
    if _tag(root) not in ("kml", "Document", "Folder", "Placemark"):
        raise InputError(f"{name} is XML but no KML (its root is '{_tag(root)}'); export a polygon as KML")
    polygons, hidden, lines, unused = list[Polygon](), list[Polygon](), list[Ring](), Counter[str]()
    waiting = [(root, True)]
    while waiting:  # in the file's order, without recursion: depths are a stranger's
        node, shown = waiting.pop()
        shown = shown and not any(_tag(n) == "visibility" and (n.text or "").strip() in ("0", "false") for n in node)
        if _tag(node) == "Polygon":
            outer = _coordinates(node, "outerBoundaryIs")
            if not outer:
                raise InputError(f"{name} has a polygon without an outer boundary; export it again")
            shell = ring(_numbers(outer[0], name), name)
            holes = tuple(ring(_numbers(h, name), name) for h in _coordinates(node, "innerBoundaryIs"))
            (polygons if shown else hidden).append(Polygon(shell, holes))
        elif _tag(node) in ("LineString", "LinearRing"):
            if shown:
                lines += [ring(_numbers(c, name), name, 2) for c in _coordinates(node)]
            else:
                unused["line switched off in the file"] += 1
        elif _tag(node) in _KML_NOUNS:
            unused[_KML_NOUNS[_tag(node)]] += 1
        waiting += [(n, shown) for n in reversed(node) if _tag(node) != "Polygon" or _tag(n) == "Polygon"]
    if not any_size:
        refuse_many_corners([*polygons, *hidden, *lines], name)
    return Shapes(tuple(polygons), tuple(lines), hidden=tuple(hidden), unused=counted(unused))


_KML_NOUNS = {
    "Point": "point", "Track": "track", "MultiTrack": "track", "Model": "model",
    "GroundOverlay": "overlay of a picture", "NetworkLink": "link to another file",
}  # fmt: skip


def _mended(text: str | bytes) -> str | bytes:
    """XML as Google Earth reads it: blanks around it, a bare "&" in names, and prefixes that nobody declared."""
    if isinstance(text, bytes):
        return text
    text = re.sub(r"&(?!(#\d+|#x[0-9A-Fa-f]+|amp|lt|gt|quot|apos);)", "&amp;", text.strip(" \t\r\n\0"))
    used = set(re.findall(r"[<\s]/?([A-Za-z_][\w.-]*):[A-Za-z_]", re.sub(r">[^<]*<", "><", text))) - {"xml", "xmlns"}
    missing = sorted(prefix for prefix in used if f"xmlns:{prefix}" not in text)
    declared = "".join(f' xmlns:{prefix}="urn:undeclared:{prefix}"' for prefix in missing)
    return re.sub(r"<[A-Za-z_][\w.:-]*", lambda tag: tag[0] + declared, text, count=1) if missing else text


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
        tuples = [t.split(",") for t in re.sub(r"\s*,\s*", ",", text).split()]
        return [(float(t[1]), float(t[0])) for t in tuples]
    except (ValueError, IndexError):
        raise InputError(f"{name} has KML coordinates that are not 'lon,lat[,alt]'; export it again") from None
