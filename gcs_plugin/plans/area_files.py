"""Areas, lines and no-fly zones from files.

GeoJSON, KML, KMZ, zipped shapefile, GeoPackage, QGroundControl `.plan` and `.waypoints`, routes of Pilot 2 and Litchi.
No-fly zones near the flights become rings for the planner and fences for the vehicles: files of authorities hold all
zones of a country, so what is farther away than any flight goes is counted, and not used.
"""

import codecs
import json
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final, NamedTuple

import numpy as np
import shapely

from gcs_plugin.mission.makers.litchi import is_litchi
from gcs_plugin.mission.makers.maker_files import read_mission_file
from gcs_plugin.mission.mission_files import SurveySettings
from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.coordinate_system import to_degrees
from orthoswarm.model.earth import DEGREE_M
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import Fence, Plan
from orthoswarm.planning.area import shape_files
from orthoswarm.planning.area.shape_files import Circle, Polygon, Ring, Shapes, counted
from orthoswarm.planning.sorties.flight_heights import BESIDE_M

_KINDS: Final = {
    ".geojson": ("GeoJSON",),
    ".json": ("GeoJSON",),
    ".kml": ("KML", "KMZ"),
    ".kmz": ("KMZ", "KML"),
    ".zip": ("a zipped shapefile", "KMZ", "zipped GeoJSON"),
    ".gpkg": ("a GeoPackage",),
    ".plan": ("a mission",),
    ".waypoints": ("a mission",),
    ".csv": ("a mission",),
}
_REACH_M: Final = 5000.0  # zones farther from the area and the starts than this, and than their own extent, are far
_LARGEST_BYTES: Final = 50_000_000
_SHAPEFILE: Final = b"\x00\x00\x27\x0a"
_ROUTE: Final = "waylines.wpml"
_GEOJSON: Final = (".geojson", ".json")
_OPENAIR: Final = re.compile(r"^AC +\S", re.MULTILINE)  # the class of an airspace begins each
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
    promised = _KINDS.get(path.suffix.lower(), (kind,))
    if kind not in promised:
        raise InputError(f"{name} is {promised[0]} by its name but holds {kind}; rename it or give the right file")
    if kind == "a GeoPackage":
        return AreaFile(_shapes(str(path), name, any_size), [])
    if kind == "a zipped shapefile":  # in whatever folder of it
        inside = _inside(path, name, ".shp")
        places = [info.filename.replace("\\", "/") for info in inside]  # GDAL sees those of Windows so, too
        return AreaFile(Shapes.joined([_shapes(f"/vsizip/{{{path}}}/{place}", name, any_size) for place in places]), [])
    if kind in ("GeoJSON", "zipped GeoJSON"):
        texts = _texts(path, name, _GEOJSON)
        return AreaFile(Shapes.joined([shape_files.parse_geojson(text, name, any_size=any_size) for text in texts]), [])
    route = kind == "KMZ" and bool(_inside(path, name, _ROUTE))
    if kind in ("KML", "KMZ") and not route:
        return AreaFile(
            Shapes.joined([shape_files.parse_kml(t, name, any_size=any_size) for t in _texts(path, name)]), []
        )
    mission = read_mission_file(path.read_bytes() if route else _texts(path, name)[0].encode(), name)
    polygons = tuple(Polygon(shape_files.ring(survey, name)) for survey in mission.surveys)
    lines = tuple(shape_files.ring(line, name, 2) for line in (mission.polylines or mission.lines()))
    for fence in mission.fences:
        if fence.radius_m is None:
            shape_files.ring(fence.points, name)
    zones = [shape_files.ring(zone, name) for zone in mission.no_fly]
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
        if _inside(path, name, (".kml", _ROUTE)):
            return "KMZ"
        if _inside(path, name, _GEOJSON):
            return "zipped GeoJSON"
        raise InputError(f"{name} is a ZIP without a KML, a GeoJSON or a shapefile in it; export it again")
    if head == _SQLITE:
        return "a GeoPackage"
    if head.startswith(_SHAPEFILE):
        raise InputError(f"{name} is one file of a shapefile; put its .shp, .shx, .dbf and .prj into one ZIP")
    text = _texts(path, name)[0].lstrip()
    if text.startswith("QGC WPL") or is_litchi(text):
        return "a mission"
    if text.startswith("<"):
        return "KML"
    if text.startswith(("{", "[")):
        return "a mission" if _is_mission(text, name) else "GeoJSON"
    if _OPENAIR.search(text):
        raise InputError(f"{name} is OpenAir, which is not read; get the zones as ED-269, ED-318, GeoJSON or KML")
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


def _texts(path: Path, name: str, suffix: str | tuple[str, ...] = ".kml") -> list[str]:
    """The text of a file, or of those in a ZIP with a suffix, in the encoding that it has or that its XML declares."""
    try:
        data = [path.read_bytes()]
        if data[0].startswith(b"PK\x03\x04"):
            with zipfile.ZipFile(path) as archive:
                data = [archive.read(entry) for entry in _inside(path, name, suffix)]
        return [_decoded(text) for text in data]
    except (UnicodeError, LookupError, zipfile.BadZipFile, NotImplementedError, RuntimeError):
        raise InputError(
            f"{name} is not a text file with a polygon or a line; give GeoJSON, KML, KMZ or .plan"
        ) from None


def _decoded(data: bytes) -> str:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    if data[:4].count(b"\0") == 2:  # UTF-16 of ASCII without its mark
        return data.decode("utf-16-be" if data.startswith(b"\0") else "utf-16-le")
    declared = re.match(rb"""\s*<\?xml[^>]*encoding=["']([\w.:-]+)""", data)
    encoding = declared[1].decode().lower() if declared else "utf-8"
    try:
        return data.decode("utf-8-sig" if encoding == "utf-8" else encoding)
    except UnicodeDecodeError:
        if encoding != "utf-8" or b"\0" in data:
            raise
        return data.decode("cp1252")  # names as Windows wrote them; coordinates are the same in both


def _is_mission(text: str, name: str) -> bool:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name} is not valid JSON ({error}); export it again") from None
    return isinstance(document, dict) and document.get("fileType") == "Plan"


def _shapes(source: str, name: str, any_size: bool) -> Shapes:
    """Polygons and lines of all layers of a file that OGR reads."""
    from pyogrio import list_layers
    from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError, GeometryError

    polygons, lines, circles, unused = list[Polygon](), list[Ring](), list[Circle](), Counter[str]()
    doubts = set[str]()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of OGR, about what it reads all the same
            # A layer without a kind of geometry is a table, as QGIS keeps its styles in one.
            layers = [layer for layer, kind in list_layers(source) if kind is not None]
            parts = [part for layer in layers for part in _parts_of(source, layer)]
    except (DataSourceError, DataLayerError, FeatureError, FieldError, GeometryError, shapely.GEOSException):
        needs = "a shapefile's ZIP needs .shp, .shx, .dbf and .prj"
        raise InputError(f"{name} is damaged or incomplete; export it again ({needs})") from None
    for crs, part, said in parts:
        if part.is_empty:
            unused["feature without a shape"] += 1
        elif part.geom_type == "Polygon":
            shell, *holes = [_degrees(r.coords, crs, name, doubts) for r in (part.exterior, *part.interiors)]
            polygons.append(Polygon(shell, tuple(holes)))
        elif part.geom_type == "LineString":
            line = _degrees(part.coords, crs, name, doubts, 2)
            strip = shape_files.strip_of(line, said, name)
            polygons += strip
            lines += [] if strip else [line]
        elif part.geom_type == "Point" and (circle := _circle(part, crs, said, name, doubts)) is not None:
            circles.append(circle)
        else:
            unused[part.geom_type.lower()] += 1
    left = shape_files.counted(unused)
    found = Shapes(tuple(polygons), tuple(lines), tuple(circles), unused=left, doubts=tuple(sorted(doubts)))
    if not any_size:
        shape_files.refuse_many_corners([*found.areas, *lines], name)
    return found


def _circle(point: Any, crs: str | None, said: dict[str, Any], name: str, doubts: set[str]) -> Circle | None:
    [lat, lon] = _degrees(point.coords, crs, name, doubts, 1)[0]
    return shape_files.circle_of(float(lat), float(lon), said, name)


def _parts_of(source: str, layer: str) -> Iterator[tuple[str | None, Any, dict[str, Any]]]:
    """Coordinate system, single shape and stated size of a layer's features; an empty shape where one has none."""
    from pyogrio import read_info
    from pyogrio.raw import read

    sizes = [field for field in read_info(source, layer=layer)["fields"] if field.lower() in shape_files.SIZES]
    meta, _, geometries, values = read(source, layer=layer, columns=sizes, force_2d=True)
    said = {field.lower(): column for field, column in zip(meta["fields"], values, strict=True)}
    for k, geometry in enumerate(shapely.from_wkb(geometries)):
        stated = {field: column[k] for field, column in said.items() if column[k] == column[k]}  # not NaN
        empty = geometry is None or geometry.is_empty
        for part in [shapely.Point()] if empty else shapely.get_parts(geometry):
            yield meta["crs"], part, stated


def _degrees(points: object, crs: str | None, name: str, doubts: set[str], least: int = 3) -> Ring:
    """A ring or line in latitude and longitude of WGS 84; InputError if its coordinate system is not known."""
    if crs is None:
        raise InputError(f"{name} does not say its coordinate system; export it in WGS 84 (EPSG:4326), with its .prj")
    array = np.asarray(points, dtype=np.float64)[:, :2]
    try:
        lon_lat, doubt = to_degrees(crs, array[:, 0], array[:, 1])
    except InputError as error:
        raise InputError(f"{name}: {error}; or export it in WGS 84 (EPSG:4326)") from None
    doubts.update([doubt] if doubt else [])
    return shape_files.ring(lon_lat[:, ::-1], name, least)


class Reach:
    """A box about what is flown over, in degrees, wide enough for the ways around zones."""

    def __init__(self, flown: Ring) -> None:
        """flown: float64 (n, 2), latitude and longitude in degrees, of the area or the lines and of the starts."""
        self._lon = float(flown[0, 1])
        east = wrap_deg(flown[:, 1] - self._lon)
        low, high = np.array([flown[:, 0].min(), east.min()]), np.array([flown[:, 0].max(), east.max()])
        metres = DEGREE_M * np.array([1.0, max(np.cos(np.radians(np.abs(flown[:, 0]).max())), 0.01)])
        beyond = max(_REACH_M, float(np.linalg.norm((high - low) * metres))) / metres
        self._low, self._high, self._metres = low - beyond, high + beyond, metres

    def touches(self, ring: Ring, grown_m: float = 0.0) -> bool:
        """Whether the box about a ring (or a point), so much larger, has ground in common with this one."""
        first = wrap_deg(float(ring[0, 1]) - self._lon)
        east = first + wrap_deg(ring[:, 1] - ring[0, 1])  # a zone across the date line is no belt around the Earth
        low, high = np.array([ring[:, 0].min(), east.min()]), np.array([ring[:, 0].max(), east.max()])
        grown = grown_m / self._metres
        return bool((low - grown <= self._high).all() and (high + grown >= self._low).all())

    def touches_exchanged(self, shapes: Shapes) -> bool:
        """Whether it would touch shapes whose latitudes were their longitudes."""
        centres = [np.array([[circle.lat_deg, circle.lon_deg]]) for circle in shapes.circles]
        return any(self.touches(ring[:, ::-1]) for ring in [*(p.shell for p in shapes.polygons), *centres])

    def near(self, shapes: Shapes) -> Shapes:
        """The polygons and circles of shapes that it touches."""
        polygons = tuple(p for p in shapes.polygons if self.touches(p.shell))
        centre = {circle: np.array([[circle.lat_deg, circle.lon_deg]]) for circle in shapes.circles}
        circles = tuple(c for c in shapes.circles if self.touches(centre[c], c.radius_m))
        return replace(shapes, polygons=polygons, circles=circles)


@dataclass(frozen=True, slots=True)
class NoFly:
    """The no-fly zones of a plan.

    Attributes:
        rings: outlines of polygons, of exclusion fences, and around circles. fences: of missions, and circles.
        circles_wider_m: by how much rings lie outside their circles, 0 without a circle.
        reach: of which the zones are all of its files; notes: on what is not used.
    """

    rings: list[Ring]
    fences: list[Fence]
    circles_wider_m: float
    reach: Reach
    notes: list[str]

    def refuse_beyond(self, plan: Plan) -> None:
        """Refuse a plan that leads to where zones were not used; raises InputError: it does."""
        points = [(w.lat_deg, w.lon_deg) for v in plan.vehicles for s in v.sorties for w in s.waypoints]
        if self.notes and not all(self.reach.touches(np.array([point])) for point in points):
            raise InputError(
                "the way around no-fly zones leads farther than the zones that were used; plan from nearer starts, or "
                "give files of the zones around there only"
            )


def read_no_fly(paths: Sequence[Path], flown: Ring, clearance_m: float | None) -> NoFly:
    """The zones of no-fly files near what is flown over.

    Circles become fences of the vehicles, so rings keep the distance at which receivers do not break a fence.

    Args:
        paths: of the files. flown: see Reach. clearance_m: distance that plans keep to zones by themselves.

    Raises:
        InputError: a file cannot be read, or holds anything that no vehicle could be kept out of.
    """
    reach, rings, fences, notes, round_ = Reach(flown), list[Ring](), list[Fence](), list[str](), False
    beyond_m = max(0.0, BESIDE_M - (clearance_m or 0.0))
    for path in paths:
        file = read_zones(path)
        near = reach.near(file.shapes)
        far = len(file.shapes.polygons) + len(file.shapes.circles) - len(near.polygons) - len(near.circles)
        if far and not near.polygons and not near.circles and reach.touches_exchanged(file.shapes):
            raise InputError(
                f"{path.name} has zones at the flights if latitude and longitude are exchanged; longitude comes first"
            )
        if far:
            notes.append(f"of {path.name}, {', '.join(counted({'zone': far}))} far from the flights: not used")
        holes = sum(len(p.holes) for p in near.polygons)
        if holes:
            notes.append(f"{', '.join(counted({'hole': holes}))} in zones of {path.name}: not flown either")
        rings += [p.shell for p in near.polygons] + [c.polygon(beyond_m).shell for c in near.circles] + file.no_fly
        fences += file.fences
        fences += [Fence(inclusion=False, points=((c.lat_deg, c.lon_deg),), radius_m=c.radius_m) for c in near.circles]
        round_ = round_ or bool(near.circles)
    return NoFly(rings, fences, beyond_m if round_ else 0.0, reach, notes)


def read_zones(path: Path) -> AreaFile:
    """What vehicles are to keep out of, by a no-fly file: all of it, also what is switched off there.

    Raises:
        InputError: the file cannot be read, or holds anything that no vehicle could be kept out of.
    """
    file = read_shapes(path, any_size=True)
    shapes = file.shapes
    refuse_no_zones(shapes, str(path), mission=bool(file.no_fly))
    if shapes.doubts:
        raise InputError(f"{path}: {shapes.doubts[0]}, as it does for zones to keep out of")
    shapes = replace(shapes, polygons=shapes.polygons + shapes.hidden, hidden=())
    if not shapes.polygons and not shapes.circles and not file.no_fly:
        raise InputError(f"{path} holds no polygon to keep out of; give a polygon with --no-fly")
    return file._replace(shapes=shapes)


def refuse_no_zones(shapes: Shapes, name: str, *, mission: bool = False) -> None:
    """Refuse shapes of which a part would be passed over as no-fly zones; a mission's lines are flown.

    Raises:
        InputError: there are such shapes.
    """
    count = 0 if mission else len(shapes.lines)
    left = [*shapes.unused, *counted({"line": count} if count else {})]
    if left:
        raise InputError(
            f"{name} holds {', '.join(left)}, which no vehicle could be kept out of; draw each zone as a polygon, or "
            "give a point its radius_m and a line its width_m, in metres"
        )
