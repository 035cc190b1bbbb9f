"""Places as KML (Google Earth), CSV (spreadsheets) and GPX (CalTopo, handheld receivers)."""

import csv
import html
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from orthoswarm.export.atomic_file import write_file
from orthoswarm.export.tactical.places import Place, write_geojson
from orthoswarm.export.xml_elements import element, kml_bytes, texts, xml_bytes

_COLUMNS: Final = (
    "uid", "kind", "name", "lat_deg", "lon_deg", "height_m", "sigma_m", "time", "note", "course_deg", "speed_m_s",
    "pictures",
)  # fmt: skip
_FORMULA: Final = ("=", "+", "-", "@", "\t", "\r")


def write_csv(places: Iterable[Place], path: Path) -> None:
    """Write a row a place. Texts that a spreadsheet would take for a formula get an apostrophe before them.

    Raises:
        OrthoSwarmError: the disk is full.
    """
    out = io.StringIO(newline="")
    rows = csv.writer(out)
    rows.writerow(_COLUMNS)
    for place in places:
        values = [getattr(place, key) for key in _COLUMNS[:-1]]
        rows.writerow(_cell(value) for value in [*values, " ".join(place.pictures)])
    write_file(path, out.getvalue().encode())


def _cell(value: object) -> object:
    if value is None:
        return ""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


def write_gpx(places: Iterable[Place], path: Path) -> None:
    """Write places as waypoints of GPX 1.1 (topografix.com/GPX/1/1).

    Raises:
        OrthoSwarmError: the disk is full.
    """
    points = [
        element(
            "wpt",
            *texts(
                ele=None if place.height_m is None else f"{place.height_m:.1f}", time=place.time, name=place.name,
                desc=_words(place), type=place.kind,
            ),
            lat=f"{place.lat_deg:.7f}", lon=f"{place.lon_deg:.7f}",
        )
        for place in places
    ]  # fmt: skip
    space = "http://www.topografix.com/GPX/1/1"
    write_file(path, xml_bytes(element("gpx", *points, version="1.1", creator="OrthoSwarm", xmlns=space)))


def write_kml(places: Iterable[Place], path: Path) -> None:
    """Write places as KML 2.2 placemarks (OGC 12-007r2).

    Descriptions and balloons are HTML, in which Google Earth would run what a note holds; so texts are escaped as such.
    A name is plain text, but the usual balloon repeats it as HTML: each place has its own.

    Raises:
        OrthoSwarmError: the disk is full.
    """
    marks = []
    for place in places:
        name, words = _html(place.name), _html(_words(place))
        balloon = element("BalloonStyle", *texts(text=f"<b>{name}</b><br>\n{words}"))
        at = texts(coordinates=f"{place.lon_deg:.7f},{place.lat_deg:.7f}")
        marks.append(
            element(
                "Placemark", *texts(name=place.name, description=words), element("TimeStamp", *texts(when=place.time)),
                element("Style", balloon), element("Point", *at),
            )
        )  # fmt: skip
    write_file(path, kml_bytes(*texts(name="OrthoSwarm"), *marks))


def _html(text: str) -> str:
    """A text as HTML that shows it as it is; KML's own `$[...]`, which stands for another text, is escaped as well."""
    return html.escape(text, quote=False).replace("$[", "&#36;[").replace("\n", "<br>\n")


def _words(place: Place) -> str:
    parts = [place.note, "" if place.sigma_m is None else f"standard deviation {place.sigma_m:.2f} m"]
    parts += [f"pictures: {', '.join(place.pictures)}"] if place.pictures else []
    return "; ".join(part for part in parts if part)


PLACE_FILES: Final = {
    "places.geojson": write_geojson, "places.kml": write_kml, "places.gpx": write_gpx, "places.csv": write_csv,
}  # fmt: skip
"""Writers by the name of their file."""
