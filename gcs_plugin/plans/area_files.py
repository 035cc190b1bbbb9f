"""Areas, lines and no-fly zones from files.

GeoJSON, KML, KMZ, zipped shapefile, GeoPackage, QGroundControl `.plan` and `.waypoints`, routes of Pilot 2 and Litchi.
"""

import codecs
import json
import re
import warnings
import zipfile
from collections import Counter
from pathlib import Path, PurePosixPath
from typing import Any, Final, NamedTuple

import numpy as np
import shapely

from gcs_plugin.mission.makers.litchi import is_litchi
from gcs_plugin.mission.makers.maker_files import read_mission_file
from gcs_plugin.mission.mission_files import SurveySettings
from orthoswarm.model.coordinate_system import to_degrees
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import Fence
from orthoswarm.planning.area.shape_files import (
    Polygon,
    Ring,
    Shapes,
    counted,
    parse_geojson,
    parse_kml,
    refuse_many_corners,
    ring,
)

_KINDS: Final = {
    ".geojson": "GeoJSON",
    ".json": "GeoJSON",
    ".kml": "KML",
    ".kmz": "KMZ",
    ".zip": "a zipped shapefile",
    ".gpkg": "a GeoPackage",
    ".plan": "a mission",
    ".waypoints": "a mission",
    ".csv": "a mission",
}
_LARGEST_BYTES: Final = 50_000_000
_SHAPEFILE: Final = b"\x00\x00\x27\x0a"
_ROUTE: Final = "waylines.wpml"
_SQLITE: Final = b"SQLite format 3\0"


class AreaFile(NamedTuple):
    """What a file holds: its shapes; of missions rings of exclusion fences, all fences, and how a survey is flown."""

    shapes: Shapes
    no_fly: list[Ring]
    fences: tuple[Fence, ...] = ()
    survey: SurveySettings = SurveySettings()


def read_shapes(path: Path, name: str | None = None, *, any_size: bool = False) -> AreaFile:
    """The content of a file; what it is decides how it is read.

    Args:
        path: the file. name: how to call it in an error; its path unless said.
        any_size: also more corners than the configuration allows, for files of which a part is used.

    Raises:
        InputError: it cannot be read, or its name promises something else.
    """
    name = name or str(path)
    kind = _kind(path, name)
    promised = _KINDS.get(path.suffix.lower(), kind)
    if promised != kind:
        raise InputError(f"{name} is {promised} by its name but holds {kind}; rename it or give the right file")
    if kind == "a GeoPackage":
        return AreaFile(_shapes(str(path), name, any_size), [])
    if kind == "a zipped shapefile":  # in whatever folder of it
        inside = _inside(path, name, ".shp")
        return AreaFile(
            Shapes.joined([_shapes(f"/vsizip/{{{path}}}/{info.filename}", name, any_size) for info in inside]), []
        )
    if kind == "GeoJSON":
        return AreaFile(parse_geojson(_texts(path, name)[0], name, any_size=any_size), [])
    route = kind == "KMZ" and bool(_inside(path, name, _ROUTE))
    if kind in ("KML", "KMZ") and not route:
        return AreaFile(Shapes.joined([parse_kml(t, name, any_size=any_size) for t in _texts(path, name)]), [])
    mission = read_mission_file(path.read_bytes() if route else _texts(path, name)[0].encode(), name)
    polygons = tuple(Polygon(ring(survey, name)) for survey in mission.surveys)
    lines = tuple(ring(line, name, 2) for line in (mission.polylines or mission.lines()))
    for fence in mission.fences:
        if fence.radius_m is None:
            ring(fence.points, name)
    zones = [ring(zone, name) for zone in mission.no_fly]
    return AreaFile(Shapes(polygons, lines), zones, mission.fences, mission.survey)


def _kind(path: Path, name: str) -> str:
    """What a file is by its content; InputError if it cannot be read, is too large, or is nothing known."""
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise InputError(f"{name} is larger than {_LARGEST_BYTES // 1_000_000} MB; give a simpler outline")
        with path.open("rb") as file:
            head = file.read(len(_SQLITE))
    except OSError as error:
        raise InputError(f"{name} cannot be read ({error.strerror}); check the name") from None
    if head.startswith(b"PK\x03\x04"):
        if _inside(path, name, ".shp"):
            return "a zipped shapefile"
        if not _inside(path, name, (".kml", _ROUTE)):
            raise InputError(f"{name} is a ZIP without a KML or a shapefile in it; export it again")
        return "KMZ"
    if head == _SQLITE:
        return "a GeoPackage"
    if head.startswith(_SHAPEFILE):
        raise InputError(f"{name} is one file of a shapefile; put its .shp, .shx, .dbf and .prj into one ZIP")
    text = _texts(path, name)[0].lstrip()
    if text.startswith("QGC WPL") or is_litchi(text):
        return "a mission"
    if text.startswith("<"):
        return "KML"
    if text.startswith("{"):
        return "a mission" if _is_mission(text, name) else "GeoJSON"
    kinds = "GeoJSON, KML, KMZ, zipped shapefile, GeoPackage, a .plan nor a .waypoints mission"
    raise InputError(f"{name} holds neither {kinds}; export the polygon again")


def _inside(path: Path, name: str, suffix: str | tuple[str, ...]) -> list[zipfile.ZipInfo]:
    """The files in a ZIP with a suffix; InputError if it is broken, or unpacks to too much."""
    try:
        with zipfile.ZipFile(path) as archive:
            found = archive.infolist()
    except (zipfile.BadZipFile, NotImplementedError, OSError):
        raise InputError(f"{name} is a damaged ZIP; export it again") from None
    if sum(info.file_size for info in found) > _LARGEST_BYTES:
        raise InputError(f"{name} unpacks to more than {_LARGEST_BYTES // 1_000_000} MB; give a simpler outline")
    return [info for info in found if info.filename.lower().endswith(suffix) and not _left_by_macos(info.filename)]


def _left_by_macos(name: str) -> bool:
    """Whether a file in a ZIP is a twin that macOS adds to each file, with what other systems have no place for."""
    return name.startswith("__MACOSX/") or PurePosixPath(name).name.startswith("._")


def _texts(path: Path, name: str) -> list[str]:
    """The text of a file, those of a KMZ's KML files, in the encoding that it has or that its XML declares.

    Raises:
        InputError: it is not text.
    """
    try:
        data = [path.read_bytes()]
        if data[0].startswith(b"PK\x03\x04"):
            with zipfile.ZipFile(path) as archive:
                data = [archive.read(entry) for entry in _inside(path, name, ".kml")]
        return [_decoded(text) for text in data]
    except (UnicodeError, LookupError, zipfile.BadZipFile, NotImplementedError, RuntimeError):
        raise InputError(
            f"{name} is not a text file with a polygon or a line; give GeoJSON, KML, KMZ or .plan"
        ) from None


def _decoded(data: bytes) -> str:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    declared = re.match(rb"""\s*<\?xml[^>]*encoding=["']([\w.:-]+)""", data)
    encoding = declared[1].decode().lower() if declared else "utf-8"
    return data.decode("utf-8-sig" if encoding == "utf-8" else encoding)


def _is_mission(text: str, name: str) -> bool:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name} is not valid JSON ({error}); export it again") from None
    return isinstance(document, dict) and document.get("fileType") == "Plan"


def _shapes(source: str, name: str, any_size: bool) -> Shapes:
    """Polygons and lines of all layers of a file that OGR reads.

    Raises:
        InputError: it cannot, the file says no coordinate system, or its coordinates are of no use.
    """
    from pyogrio import list_layers
    from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError, GeometryError
    from pyogrio.raw import read

    polygons, lines, unused = list[Polygon](), list[Ring](), Counter[str]()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of OGR, about what it reads all the same
            layers = [read(source, layer=layer, columns=[], force_2d=True) for layer, _ in list_layers(source)]
            parts = [(m["crs"], part) for m, _, g, _ in layers for part in _parts(shapely.from_wkb(g))]
    except (DataSourceError, DataLayerError, FeatureError, FieldError, GeometryError, shapely.GEOSException):
        needs = "a shapefile's ZIP needs .shp, .shx, .dbf and .prj"
        raise InputError(f"{name} is damaged or incomplete; export it again ({needs})") from None
    for crs, part in parts:
        if part.geom_type == "Polygon" and not part.is_empty:
            shell, *holes = [_degrees(r.coords, crs, name) for r in (part.exterior, *part.interiors)]
            polygons.append(Polygon(shell, tuple(holes)))
        elif part.geom_type == "LineString" and not part.is_empty:
            lines.append(_degrees(part.coords, crs, name, 2))
        else:
            unused["feature without a shape" if part.is_empty else part.geom_type.lower()] += 1
    if not any_size:
        refuse_many_corners([*polygons, *lines], name)
    return Shapes(tuple(polygons), tuple(lines), unused=counted(unused))


def _parts(geometries: Any) -> list[Any]:
    """Single shapes of features; an empty one where a feature has none."""
    empty = shapely.Point()
    return [
        part for g in geometries for part in (shapely.get_parts(g) if g is not None and not g.is_empty else [empty])
    ]


def _degrees(points: object, crs: str | None, name: str, least: int = 3) -> Ring:
    """A ring or line in latitude and longitude of WGS 84; InputError if its coordinate system is not known."""
    if crs is None:
        raise InputError(f"{name} does not say its coordinate system; export it in WGS 84 (EPSG:4326), with its .prj")
    array = np.asarray(points, dtype=np.float64)[:, :2]
    try:
        lon_lat, _ = to_degrees(crs, array[:, 0], array[:, 1])
    except InputError as error:
        raise InputError(f"{name}: {error}; or export it in WGS 84 (EPSG:4326)") from None
    return ring(lon_lat[:, ::-1], name, least)
