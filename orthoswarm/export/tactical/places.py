"""Places on the map that others should know of, finds and vehicles: as files for other programs, and in pictures."""

import csv
import html
import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from orthoswarm.export.atomic_file import write_file
from orthoswarm.export.xml_elements import element, kml_bytes, texts, xml_bytes
from orthoswarm.model.errors import InputError
from orthoswarm.model.placement import PlacedFrame
from orthoswarm.mosaic.footprint import LEAST_DESCENT

FILE: Final = "places.geojson"
_COLUMNS: Final = (
    "uid", "kind", "name", "lat_deg", "lon_deg", "height_m", "sigma_m", "time", "note", "course_deg", "speed_m_s",
    "pictures",
)  # fmt: skip
_FORMULA: Final = ("=", "+", "-", "@", "\t", "\r")


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A find or a vehicle."""

    uid: str  # unique and lasting
    kind: Literal["find", "vehicle"]  # what it is
    name: str  # for people
    lat_deg: float  # WGS 84
    lon_deg: float  # WGS 84
    time_s: float  # when it was there, UTC epoch seconds
    height_m: float | None = None  # above the WGS 84 ellipsoid, None if unknown
    sigma_m: float | None = None  # standard deviation of each horizontal coordinate, None if unknown
    note: str = ""  # more, in words
    course_deg: float | None = None  # from true north, None if unknown
    speed_m_s: float | None = None  # over ground
    pictures: tuple[str, ...] = ()  # names of pictures that show it

    @property
    def time(self) -> str:
        """When it was there, ISO 8601 in UTC with milliseconds."""
        return utc_text(self.time_s)


def utc_text(time_s: float) -> str:
    """UTC epoch seconds as ISO 8601 with milliseconds."""
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


_MOST_CHANGES: Final = 50  # more would hide what people have marked
_OPTIONAL: Final = ("height_m", "sigma_m", "course_deg", "speed_m_s")


def feature(place: Place) -> dict[str, Any]:
    """A place as a GeoJSON feature (RFC 7946)."""
    at = [place.lon_deg, place.lat_deg, *([] if place.height_m is None else [place.height_m])]
    about: dict[str, Any] = {"kind": place.kind, "name": place.name, "note": place.note, "time": place.time}
    about |= {key: value for key in _OPTIONAL if (value := getattr(place, key)) is not None}
    if place.pictures:
        about["pictures"] = list(place.pictures)
    return {"type": "Feature", "id": place.uid, "geometry": {"type": "Point", "coordinates": at}, "properties": about}


def write_geojson(places: Iterable[Place], path: Path) -> None:
    """Write places as GeoJSON. Raises OrthoSwarmError: the disk is full."""
    document = {"type": "FeatureCollection", "features": [feature(place) for place in places]}
    write_file(path, json.dumps(document, ensure_ascii=False, indent=1) + "\n")


def read_places(folder: Path) -> list[Place]:
    """The places that `write_geojson` kept in a map's folder; none if it has no such file.

    Raises InputError: the file was changed to something else.
    """
    path = folder / FILE
    if not path.exists():
        return []
    try:
        return [_place(row) for row in json.loads(path.read_text(encoding="utf-8"))["features"]]
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{path} is not a list of places; remove it, and export again") from None


def changed_places(folder: Path) -> list[Place]:
    """The largest changes against the pre-disaster map in a map's folder, as finds; none without a change map."""
    try:
        figures = json.loads((folder / "change.json").read_text(encoding="utf-8"))
        when = datetime.fromisoformat(figures["time"]).timestamp()
        return [
            Place(
                uid=f"orthoswarm-{folder.resolve().name}-change-{number}", kind="find",
                name=f"{row['kind']}, {row['area_m2']:.0f} m2", lat_deg=row["lat_deg"], lon_deg=row["lon_deg"],
                time_s=when, note=f"changed since the map, {100 * row['probability']:.0f} % sure",
                pictures=tuple(photo["image"] for photo in row["photos"]),
            )
            for number, row in enumerate(figures["objects"][:_MOST_CHANGES], start=1)
        ]  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _place(row: Mapping[str, Any]) -> Place:
    about, (lon, lat, *_) = row["properties"], row["geometry"]["coordinates"]
    return Place(
        uid=str(row["id"]), kind=about["kind"], name=about["name"], lat_deg=float(lat), lon_deg=float(lon),
        time_s=datetime.fromisoformat(about["time"]).timestamp(), note=about.get("note", ""),
        pictures=tuple(about.get("pictures", ())), **{key: about.get(key) for key in _OPTIONAL},
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Sighting:
    """A picture that shows a place."""

    placed: PlacedFrame  # the picture
    column: float  # where in it, pixels
    row: float  # where in it, pixels
    off_centre: float  # distance from its middle in half diagonals


def sightings(placed: Iterable[PlacedFrame], point: ArrayLike) -> list[Sighting]:
    """The pictures that show a point, those that have it nearest to their middle first.

    placed: pictures with their cameras. point: (3,) east, north and height in the cameras' grid, metres.
    """
    found = []
    at = np.asarray(point, dtype=np.float64)
    for frame in placed:
        camera, lens = frame.camera, frame.camera.lens
        ray = at - camera.position
        if -ray[2] < LEAST_DESCENT * float(np.linalg.norm(ray)) or float(ray @ camera.rotation[:, 2]) <= 0.0:
            continue
        column, row = (float(v) for v in camera.project(at[None])[0])
        if 0.0 <= column < lens.width and 0.0 <= row < lens.height:
            half = 0.5 * np.hypot(lens.width, lens.height)
            off = float(np.hypot(column - 0.5 * lens.width, row - 0.5 * lens.height) / half)
            found.append(Sighting(frame, column, row, off))
    return sorted(found, key=lambda s: s.off_centre)


def write_csv(places: Iterable[Place], path: Path) -> None:
    """Write a row a place. Texts that a spreadsheet would take for a formula get an apostrophe before them.

    Raises OrthoSwarmError: the disk is full.
    """
    out = io.StringIO(newline="")
    rows = csv.writer(out)
    rows.writerow(_COLUMNS)
    for place in places:
        values = [getattr(place, key) for key in _COLUMNS[:-1]]
        rows.writerow(spreadsheet_cell(value) for value in [*values, " ".join(place.pictures)])
    write_file(path, out.getvalue().encode())


def spreadsheet_cell(value: object) -> object:
    """A value of a CSV table; a text that a spreadsheet would take for a formula gets an apostrophe before it."""
    if value is None:
        return ""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


def write_gpx(places: Iterable[Place], path: Path) -> None:
    """Write places as waypoints of GPX 1.1 (topografix.com/GPX/1/1). Raises OrthoSwarmError: the disk is full."""
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

    Raises OrthoSwarmError: the disk is full.
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
