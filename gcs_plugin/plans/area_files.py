"""Areas, lines and no-fly zones from files.

GeoJSON, KML, KMZ, zipped shapefile, GeoPackage, QGroundControl `.plan` and `.waypoints`.
"""

import json
import warnings
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely

from gcs_plugin.mission.mission_files import parse_mission
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import Fence
from orthoswarm.planning.area.shape_files import (
    Polygon,
    Ring,
    Shapes,
    parse_geojson,
    parse_kml,
    refuse_many_corners,
    ring,
)

if TYPE_CHECKING:
    from pyproj import Transformer

_KINDS: Final = {
    ".geojson": "GeoJSON",
    ".json": "GeoJSON",
    ".kml": "KML",
    ".kmz": "KMZ",
    ".zip": "a zipped shapefile",
    ".gpkg": "a GeoPackage",
    ".plan": "a mission",
    ".waypoints": "a mission",
}
_LARGEST_BYTES: Final = 50_000_000
_SHAPEFILE: Final = b"\x00\x00\x27\x0a"
_SQLITE: Final = b"SQLite format 3\0"


def read_shapes(path: Path, name: str | None = None) -> tuple[Shapes, list[Ring]]:
    """Polygons and lines of a file, and rings of its exclusion fences; what the file is decides its content.

    Args:
        path: the file. name: how to call it in an error; its path unless said.

    Raises:
        InputError: it cannot be read, or its name promises something else.
    """
    name = name or str(path)
    kind = _kind(path, name)
    promised = _KINDS.get(path.suffix.lower(), kind)
    if promised != kind:
        raise InputError(f"{name} is {promised} by its name but holds {kind}; rename it or give the right file")
    if kind == "a GeoPackage":
        return _shapes(str(path), name), []
    if kind == "a zipped shapefile":  # in whatever folder of it
        found = [_shapes(f"/vsizip/{{{path}}}/{info.filename}", name) for info in _inside(path, name, ".shp")]
        return Shapes(tuple(p for s in found for p in s.polygons), tuple(line for s in found for line in s.lines)), []
    text = _text(path, name)
    if kind == "GeoJSON":
        return parse_geojson(text, name), []
    if kind in ("KML", "KMZ"):
        return parse_kml(text, name), []
    mission = parse_mission(text, name)
    polygons = tuple(Polygon(ring(survey, name)) for survey in mission.surveys)
    lines = tuple(ring(line, name, 2) for line in (mission.polylines or mission.lines()))
    return Shapes(polygons, lines), [ring(zone, name) for zone in mission.no_fly]


def read_fences(path: Path) -> tuple[Fence, ...]:
    """The geofences of a QGroundControl `.plan`; files of other kinds have none.

    Raises:
        InputError: it cannot be read, or a polygon has fewer than three corners.
    """
    name = str(path)
    if _kind(path, name) != "a mission":
        return ()
    fences = parse_mission(_text(path, name), name).fences
    for fence in fences:
        if fence.radius_m is None:
            ring(fence.points, name)
    return fences


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
        if not _inside(path, name, ".kml"):
            raise InputError(f"{name} is a ZIP without a KML or a shapefile in it; export it again")
        return "KMZ"
    if head == _SQLITE:
        return "a GeoPackage"
    if head.startswith(_SHAPEFILE):
        raise InputError(f"{name} is one file of a shapefile; put its .shp, .shx, .dbf and .prj into one ZIP")
    text = _text(path, name).lstrip()
    if text.startswith("QGC WPL"):
        return "a mission"
    if text.startswith("<"):
        return "KML"
    if text.startswith("{"):
        return "a mission" if _is_mission(text, name) else "GeoJSON"
    kinds = "GeoJSON, KML, KMZ, zipped shapefile, GeoPackage, a .plan nor a .waypoints mission"
    raise InputError(f"{name} holds neither {kinds}; export the polygon again")


def _inside(path: Path, name: str, suffix: str) -> list[zipfile.ZipInfo]:
    """The files in a ZIP with a suffix; InputError if it is broken, or unpacks to too much."""
    try:
        with zipfile.ZipFile(path) as archive:
            found = archive.infolist()
    except (zipfile.BadZipFile, NotImplementedError, OSError):
        raise InputError(f"{name} is a damaged ZIP; export it again") from None
    if sum(info.file_size for info in found) > _LARGEST_BYTES:
        raise InputError(f"{name} unpacks to more than {_LARGEST_BYTES // 1_000_000} MB; give a simpler outline")
    return [info for info in found if info.filename.lower().endswith(suffix)]


def _text(path: Path, name: str) -> str:
    """The text of a file, of a KMZ's first KML; InputError if it is not text."""
    try:
        data = path.read_bytes()
        if data.startswith(b"PK\x03\x04"):
            with zipfile.ZipFile(path) as archive:
                data = archive.read(_inside(path, name, ".kml")[0])
        return data.decode("utf-8-sig")
    except (UnicodeDecodeError, zipfile.BadZipFile, NotImplementedError, RuntimeError):
        raise InputError(
            f"{name} is not a text file with a polygon or a line; give GeoJSON, KML, KMZ or .plan"
        ) from None


def _is_mission(text: str, name: str) -> bool:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name} is not valid JSON ({error}); export it again") from None
    return isinstance(document, dict) and document.get("fileType") == "Plan"


def _shapes(source: str, name: str) -> Shapes:
    """Polygons and lines of all layers of a file that OGR reads.

    Raises:
        InputError: it cannot, the file says no coordinate system, or its coordinates are of no use.
    """
    from pyogrio import list_layers
    from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError, GeometryError
    from pyogrio.raw import read

    polygons: list[Polygon] = []
    lines: list[Ring] = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of OGR, about what it reads all the same
            layers = [read(source, layer=layer, columns=[], force_2d=True) for layer, _ in list_layers(source)]
            parts = [(m["crs"], part) for m, _, g, _ in layers for part in shapely.get_parts(shapely.from_wkb(g))]
    except (DataSourceError, DataLayerError, FeatureError, FieldError, GeometryError, shapely.GEOSException):
        needs = "a shapefile's ZIP needs .shp, .shx, .dbf and .prj"
        raise InputError(f"{name} is damaged or incomplete; export it again ({needs})") from None
    to_degrees = {crs: _transformer(crs, name) for crs, _ in parts}  # made once: it takes as long as a thousand points
    for crs, part in parts:
        if part.geom_type == "Polygon" and not part.is_empty:
            shell, *holes = [_degrees(r.coords, to_degrees[crs], name) for r in (part.exterior, *part.interiors)]
            polygons.append(Polygon(shell, tuple(holes)))
        elif part.geom_type == "LineString" and not part.is_empty:
            lines.append(_degrees(part.coords, to_degrees[crs], name, 2))
    refuse_many_corners([*polygons, *lines], name)
    return Shapes(tuple(polygons), tuple(lines))


def _transformer(crs: str | None, name: str) -> "Transformer":
    """From a coordinate system to longitude and latitude of WGS 84; InputError if it is not said, or not known."""
    from pyproj import Transformer
    from pyproj.exceptions import CRSError

    if crs is None:
        raise InputError(f"{name} does not say its coordinate system; export it in WGS 84 (EPSG:4326), with its .prj")
    try:
        return Transformer.from_crs(crs, 4326, always_xy=True)
    except CRSError:
        raise InputError(f"{name} has an unknown coordinate system; export it in WGS 84 (EPSG:4326)") from None


def _degrees(points: object, to_degrees: "Transformer", name: str, least: int = 3) -> Ring:
    """A ring or line in latitude and longitude of WGS 84."""
    array = np.asarray(points, dtype=np.float64)[:, :2]
    lon, lat = to_degrees.transform(array[:, 0], array[:, 1])
    return ring(np.column_stack([lat, lon]), name, least)
