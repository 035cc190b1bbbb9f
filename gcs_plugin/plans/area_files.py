"""Areas, lines and no-fly zones from files: GeoJSON, KML, KMZ, QGroundControl `.plan`, `.waypoints`."""

import json
import zipfile
from pathlib import Path

from gcs_plugin.mission.mission_files import parse_mission
from orthoswarm.model.errors import InputError
from orthoswarm.planning.area.shape_files import Polygon, Ring, Shapes, parse_geojson, parse_kml, ring

_KINDS = {
    ".geojson": "GeoJSON",
    ".json": "GeoJSON",
    ".kml": "KML",
    ".kmz": "KMZ",
    ".plan": "a mission",
    ".waypoints": "a mission",
}
_LARGEST_BYTES = 50_000_000


def read_shapes(path: Path) -> tuple[Shapes, list[Ring]]:
    """Polygons and lines of a file, and rings of its exclusion fences; what the file is decides its content.

    Raises:
        InputError: it cannot be read, or its name promises something else.
    """
    text, kind = _read(path)
    promised = _KINDS.get(path.suffix.lower(), kind)
    if promised != kind:
        raise InputError(f"{path} is {promised} by its name but holds {kind}; rename it or give the right file")
    if kind == "GeoJSON":
        return parse_geojson(text, str(path)), []
    if kind in ("KML", "KMZ"):
        return parse_kml(text, str(path)), []
    mission = parse_mission(text, str(path))
    polygons = tuple(Polygon(ring(survey, str(path))) for survey in mission.surveys)
    lines = tuple(ring(line, str(path), 2) for line in (mission.polylines or mission.lines()))
    return Shapes(polygons, lines), [ring(zone, str(path)) for zone in mission.no_fly]


def _read(path: Path) -> tuple[str, str]:
    """A file's text and what it seems to be."""
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise InputError(f"{path} is larger than {_LARGEST_BYTES // 1_000_000} MB; give a simpler outline")
        data = path.read_bytes()
        kmz = data.startswith(b"PK\x03\x04")
        if kmz:
            with zipfile.ZipFile(path) as archive:
                inside = [i for i in archive.infolist() if i.filename.lower().endswith(".kml")]
                if not inside or inside[0].file_size > _LARGEST_BYTES:
                    raise InputError(f"{path} is a ZIP without a usable KML in it; export it again")
                data = archive.read(inside[0])
        text = data.decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the name") from None
    except (UnicodeDecodeError, zipfile.BadZipFile, NotImplementedError, RuntimeError):
        raise InputError(f"{path} is no text file with a polygon or a line; give GeoJSON, KML, KMZ or .plan") from None
    head = text.lstrip()
    if head.startswith("QGC WPL"):
        return text, "a mission"
    if head.startswith("<"):
        return text, "KMZ" if kmz else "KML"
    if head.startswith("{"):
        return text, "a mission" if _is_mission(text, path) else "GeoJSON"
    raise InputError(f"{path} holds neither GeoJSON, KML, a .plan nor a .waypoints mission; export the polygon again")


def _is_mission(text: str, path: Path) -> bool:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no valid JSON ({error}); export it again") from None
    return isinstance(document, dict) and document.get("fileType") == "Plan"
