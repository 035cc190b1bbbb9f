"""Tables of poses with a header, of this and other programs; and Pix4D's, which has no header.

| program | recognised by | coordinates | angles |
|---|---|---|---|
| this one | `lat_deg`, `lon_deg` | degrees | pitch -90 at nadir |
| Metashape, reference | `X/Longitude` or `X/Easting` | degrees, or metres with `#CoordinateSystem` | pitch 0 at nadir |
| Metashape and Pix4D, calibrated cameras | `Omega`, `Phi`, `Kappa` | as above; `.prj` next to it | x, y, z axes |
| | (Metashape: `PhotoID` without a suffix, commas in the header, tabs below) | | |
| Mission Planner, location.txt | `latitude/Y` | degrees | the airframe's, camera fixed under it |
| ExifTool -csv | `SourceFile` | degrees, also as text | the gimbal's |
| WingtraHub and others | image, latitude, longitude | degrees | by value |
| Pix4D, image geolocation | no header | latitude, longitude, altitude | yaw, pitch, roll; pitch 0 at nadir |

Heights are absolute altitudes wherever the header does not say otherwise. How a cell may be written: `cell_values`. A
cell that is not understood is left out and counted. Cells beyond the header's titles are ignored, except where they
show that cells stand under wrong titles: 47,5,8,25 with commas between the cells and in the numbers, 47 30 8 15 with
blanks.
"""

import contextlib
import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from orthoswarm.model.errors import InputError
from orthoswarm.raster.picture_file import PICTURE_SUFFIXES
from telemetry.formats.table import cell_values
from telemetry.formats.table.geo_txt import to_geographic
from telemetry.formats.table.pose_table import PoseTable, as_path, decoded, pitch_by_value, read_text, words_of_name
from telemetry.samples.rotations import camera_angles_from_opk_deg
from telemetry.samples.sample import Sample, is_position
from telemetry.samples.times import epoch_of, epoch_seconds
from telemetry.samples.unreadable import beginning

_HEAD_BYTES = 1 << 14
_NAMES = {
    "image": "image imagename image_name filename file_name file name photo photo_name label sourcefile photoid "
    "bild bildname foto datei dateiname fichier nom_fichier imagen archivo",
    "lat_deg": "lat_deg lat latitude y/latitude latitude/y gpslatitude breite breitengrad latitud",
    "lon_deg": "lon_deg lon lng long longitude x/longitude longitude/x gpslongitude "
    "l\u00e4nge laenge l\u00e4ngengrad laengengrad longitud",
    "x": "x x/easting x/east easting rechtswert ostwert",
    "y": "y y/northing y/north northing hochwert nordwert",
    "altitude_m": "altitude_m alt_m altitude alt z z/altitude height/z gpsaltitude ellipsoidal_height "
    "h\u00f6he hoehe altitud elevation",
    "height_m": "height_m relativealtitude height_agl agl",
    "yaw_deg": "yaw_deg yaw gimbalyawdegree heading",
    "pitch_deg": "pitch_deg pitch gimbalpitchdegree",
    "roll_deg": "roll_deg roll gimbalrolldegree",
    "omega": "omega",
    "phi": "phi",
    "kappa": "kappa",
    "sigma_m": "sigma_m accuracy_horz accuracy_horizontal horz_accuracy horizontal_accuracy accuracy_x/y gpsxyaccuracy "
    "accuracy_xy xy_accuracy",
    "fov_deg": "fov_deg",
    "time": "time time_s timestamp datetimeoriginal",
    "vehicle": "vehicle",
    "lat_ref": "gpslatituderef latituderef lat_ref latitude_ref",
    "lon_ref": "gpslongituderef longituderef lon_ref longitude_ref",
    "altitude_ref": "gpsaltituderef altituderef alt_ref altitude_ref",
}
_COLUMNS = {name: key for key, names in _NAMES.items() for name in names.split()}
_COORDINATE_SYSTEM = re.compile(r"#\s*CoordinateSystem:\s*(.+)", re.IGNORECASE)
_PIX4D_COLUMNS = {
    3: "lat_deg lon_deg altitude_m",
    5: "lat_deg lon_deg altitude_m sigma_m vertical",
    6: "lat_deg lon_deg altitude_m yaw_deg pitch_deg roll_deg",
    8: "lat_deg lon_deg altitude_m yaw_deg pitch_deg roll_deg sigma_m vertical",
}


@dataclass(frozen=True, slots=True)
class _Layout:
    """How the lines of a table are written."""

    separator: str  # between cells; a blank stands for any number of blanks
    keys: Sequence[str]  # field of each column, "" for one that is not used
    factors: Sequence[float]  # metres or degrees in one unit of each column


@dataclass(frozen=True, slots=True)
class _Line:
    """What one line says of a picture: cells by field, and metres or degrees in one unit of each."""

    name: str
    cells: Mapping[str, str]
    factors: Mapping[str, float]


def read_pose_csv(path: Path) -> PoseTable | None:
    """Read a table of poses; None if the file is some other text.

    Raises InputError: it is a table of poses that cannot be read: no projection, too large.
    """
    # Most tables next to pictures are not tables of poses, and may be large.
    head = decoded(beginning(path, _HEAD_BYTES)).splitlines()
    for at, line in enumerate(head[:5]):
        separator = _separator(line)
        columns = [_column(cell) for cell in _cells(line, separator)]
        keys = [key for key, _ in columns]
        if "image" in keys and ({"lat_deg", "lon_deg"} <= set(keys) or {"x", "y"} <= set(keys)):
            factors = [factor for _, factor in columns]
            return _read(path, at, _Layout(_row_separator(head[at + 1 :], separator, keys), keys, factors), line)
    known = _pix4d_columns(head[0]) if head else None
    return None if known is None else _read(path, -1, _Layout(_separator(head[0]), known, [1.0] * len(known)), "")


def _separator(line: str) -> str:
    best = max(";\t,", key=line.count)  # a comma last: it may be the decimal mark of cells between semicolons
    return best if line.count(best) >= 2 else " "


def _row_separator(lines: Sequence[str], separator: str, header: Sequence[str]) -> str:
    """What separates the cells of the rows: Metashape's OPK export has commas in its header and tabs below."""
    row = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    own = _separator(row)
    return own if own != "," and len(_cells(row, separator)) < len(header) == len(_cells(row, own)) else separator


def _cells(line: str, separator: str) -> list[str]:
    return line.split() if separator == " " else next(csv.reader([line], delimiter=separator), [])


def _column(cell: str) -> tuple[str, float]:
    """The field that a column's title names, "" if unknown, and its unit; comment marks and capitals are ignored."""
    text, factor = cell_values.unit_of_title(cell.strip().lstrip("#"))
    return _COLUMNS.get(re.sub(r"[\s_]+", "_", text.lower()).strip("_"), ""), factor


def _pix4d_columns(line: str) -> list[str] | None:
    """Fields of a line `image.jpg,47.1,8.2,500 ...` without a header before it; None for any other line."""
    separator = _separator(line)
    cells = [cell.strip() for cell in line.split(separator)]
    if Path(cells[0]).suffix.lower() not in PICTURE_SUFFIXES:
        return None
    try:
        numbers = [float(cell if separator == "," else cell.replace(",", ".")) for cell in cells[1:]]
    except ValueError:
        return None
    columns = _PIX4D_COLUMNS.get(len(numbers))
    if columns is None:
        return None
    if abs(numbers[0]) > 180.0 or abs(numbers[1]) > 180.0:
        columns = columns.replace("lat_deg lon_deg", "x y")
    elif abs(numbers[0]) > 90.0:
        columns = columns.replace("lat_deg lon_deg", "lon_deg lat_deg")
    return ["image", *columns.split()]


def _read(path: Path, header_at: int, layout: _Layout, title: str) -> PoseTable:
    lines = read_text(path).splitlines()
    body = [line for line in lines[header_at + 1 :] if line.strip() and not line.startswith("#")]
    commas = csv.reader(io.StringIO("\n".join(body)), delimiter=layout.separator)
    rows = (_words(line, len(layout.keys)) for line in body) if layout.separator == " " else commas
    table, found = PoseTable(), list[_Line | None]()
    with contextlib.suppress(csv.Error):  # an unterminated quoted cell: nothing after it can be separated
        for cells in rows:
            found.append(_line(table, layout, cells))
    named = [line for line in found if line is not None]
    numbers = (cell for line in named for key, cell in line.cells.items() if key in _NUMBERS)
    # The point in 1.047,5 divides thousands.
    marks = layout.separator != "," and not any(_POINT.search(cell) and not _COMMA.search(cell) for cell in numbers)
    for line in named:
        replaced = _NUMBERS if marks else frozenset()
        if layout.separator != ",":  # the comma before fractions of a second says nothing about other numbers
            replaced = replaced | {"time"}
        pointed = {key: _COMMA.sub(".", cell) if key in replaced else cell for key, cell in line.cells.items()}
        _add_row(table, _Line(line.name, pointed, line.factors))
    unclear = table.useless
    if "lat_deg" not in layout.keys:
        to_geographic(table, _projection(path, lines[: header_at + 1], table), path)
    for row in table.values():
        if row.lat_deg is None or row.lon_deg is None or not is_position(row.lat_deg, row.lon_deg):
            row.lat_deg = row.lon_deg = None
    table.useless = unclear + sum(row.lat_deg is None for row in table.values())
    if "lat_deg" not in title.lower() and "sourcefile" not in title.lower() and "omega" not in layout.keys:
        pitch_by_value(table)
    return table


def _words(line: str, most: int) -> list[str]:
    """Cells between blanks; where there are more than titles, those that hold blanks themselves are put together.

    A first one with blanks ends with a picture's suffix; a date, a time and a zone are one.
    """
    words = line.split()
    if len(words) <= most:
        return words
    first = words_of_name(words)
    words = [" ".join(words[:first]), *words[first:]]
    for at in range(len(words) - 1):
        if _DATE.fullmatch(words[at]) and _CLOCK.fullmatch(words[at + 1]) and len(words) > most:
            zone = len(words) > most + 1 and at + 2 < len(words) and _ZONE.fullmatch(words[at + 2])
            end = at + (3 if zone else 2)
            return [*words[:at], " ".join(words[at:end]), *words[end:]]
    return words


def _projection(path: Path, before: Sequence[str], table: PoseTable) -> str:
    """Of coordinates x and y: named in the table, in a .prj next to it, or degrees by their range."""
    for line in before:
        match = _COORDINATE_SYSTEM.match(line)
        if match:
            return match[1].strip().rstrip(",")
    files = sorted(path.parent.glob("*.prj"))
    if len(files) == 1:
        return read_text(files[0]).strip()
    places = [(row.lon_deg or 0.0, row.lat_deg or 0.0) for row in table.values()]
    if places and all(abs(x) <= 180.0 and abs(y) <= 90.0 for x, y in places):
        return "EPSG:4326"
    raise InputError(
        f"{path.name} does not name the projection of its coordinates; put its .prj next to it, or write a geo.txt"
    )


def _line(table: PoseTable, layout: _Layout, cells: Sequence[str]) -> _Line | None:
    """The cells of a line by their fields; None, and counted where it names a picture, if it cannot be used.

    Of two columns for one field that are both filled in, the one in metres or degrees is taken.
    """
    found: dict[str, str] = {}
    factors: dict[str, float] = {}
    for key, factor, cell in zip(layout.keys, layout.factors, map(str.strip, cells)):
        empty = not cell or (key in _VALUES and cell_values.is_absent(cell))
        if key and not empty and (key not in found or factor == 1.0 or factors[key] != 1.0):
            found[key], factors[key] = cell, factor
    name = as_path(found.pop("image", ""))
    if not name:
        return None
    if _is_shifted(layout.separator, found, cells[len(layout.keys) :]):
        table.useless += 1
        return None
    return _Line(name, found, factors)


def _is_shifted(separator: str, found: Mapping[str, str], extra: Sequence[str]) -> bool:
    """Whether a line's cells stand under wrong titles, by those that it has beyond the titles.

    With commas, the decimal places of another cell become cells; with blanks, the minutes of whole degrees do.
    """
    more = any(_NUMBER.fullmatch(cell.strip()) for cell in extra)
    if separator == " ":
        return more and any(_WHOLE.fullmatch(found.get(key, "")) for key in ("lat_deg", "lon_deg"))
    return more and separator == ","


def _add_row(table: PoseTable, line: _Line) -> None:
    """Put the values of one line into the table."""
    values = dict(line.cells)
    vehicle = "".join(c for c in values.pop("vehicle", "") if c.isprintable()).strip()
    row = Sample(vehicle=vehicle[:64] or None)
    values = {key: cell for key, cell in values.items() if not cell_values.is_absent(cell)}
    if not values.get("time", "").strip("0:-/T. "):  # cameras without a clock write zeros
        values.pop("time", None)
    numbers: dict[str, float] = {}
    for key in filter(_VALUES.__contains__, values):
        value = _VALUES[key](values[key], line.factors[key])
        if value is None:
            table.refuse(values[key])
        else:
            numbers[key] = _with_ref(value, values, key, table)
    if {"omega", "phi", "kappa"} <= numbers.keys():
        angles = camera_angles_from_opk_deg(numbers["omega"], numbers["phi"], numbers["kappa"])
        row.yaw_deg, row.pitch_deg, row.roll_deg = angles
    for key, value in numbers.items():
        if key not in ("omega", "phi", "kappa"):
            setattr(row, {"x": "lon_deg", "y": "lat_deg", "time": "time_s"}.get(key, key), value)
    if row.sigma_m is not None and not 0.0 < row.sigma_m < 1000.0:
        row.sigma_m = None
    table[line.name] = row


def _with_ref(value: float, values: Mapping[str, str], key: str, table: PoseTable) -> float:
    """A value with the sign that the column of its reference states.

    A reference that is not understood counts as absent; beside a negative value, north and east do, too: some programs
    write signed values beside a constant reference, none writes a sign that it does not mean. Both are counted.
    """
    ref_key, axis = _REFS.get(key, ("", ""))
    if ref_key not in values:
        return value
    ref = values[ref_key]
    if axis:
        sign = cell_values.hemisphere_sign(ref, axis)
    else:
        below = cell_values.below_sea(ref)
        sign = None if below is None else -1.0 if below else 1.0
    if sign is None:
        table.refuse(ref)
        return value
    if sign > 0.0 > value and axis:
        table.refuse(f"{ref} beside {values[key]}")
    return -abs(value) if sign < 0.0 else value


def _sigma(cell: str, factor: float) -> float | None:
    """The largest of "0.02/0.05", accuracies in x and y."""
    parts = [cell_values.length_m(part, factor) for part in cell.split("/")[:3]]
    known = [part for part in parts if part is not None]
    return max(known) if len(known) == len(parts) else None


def _time(written: str, _factor: float) -> float | None:
    """Epoch seconds; None if it is not a time."""
    try:
        value = epoch_seconds(float(written))
    except ValueError:
        value = epoch_of(written)
    return value if value is not None and 0.0 < value < 7.3e9 else None


_POINT, _COMMA = re.compile(r"\d\.\d"), re.compile(r"(?<=\d),(?=\d)")
_NUMBER, _WHOLE = re.compile(r"[+-]?\d[\d.]*(?:[eE][+-]?\d+)?\s*\D{0,3}"), re.compile(r"[+-]?\d{1,3}\s*°?")
_DATE, _CLOCK = re.compile(r"\d{4}[:/-]\d{1,2}[:/-]\d{1,2}"), re.compile(r"\d{1,2}:\d{2}(?::\d{2}(?:[.,]\d+)?)?\S{0,6}")
_ZONE = re.compile(r"Z|UTC|GMT|[+-]\d{2}(?::?\d{2})?", re.IGNORECASE)
_VALUES: Mapping[str, Callable[[str, float], float | None]] = {
    "lat_deg": lambda cell, factor: cell_values.coordinate_deg(cell, "NS", factor),
    "lon_deg": lambda cell, factor: cell_values.coordinate_deg(cell, "EW", factor),
    "x": lambda cell, _: cell_values.length_m(cell),  # in the unit of the projection, whatever the title says
    "y": lambda cell, _: cell_values.length_m(cell),
    **dict.fromkeys(("altitude_m", "height_m"), cell_values.length_m),
    **dict.fromkeys(("yaw_deg", "pitch_deg", "roll_deg", "fov_deg", "omega", "phi", "kappa"), cell_values.angle_deg),
    "sigma_m": _sigma,
    "time": _time,
}
_NUMBERS = frozenset(_VALUES) - {"time"}
_REFS = {"lat_deg": ("lat_ref", "NS"), "lon_deg": ("lon_ref", "EW"), "altitude_m": ("altitude_ref", "")}
"""Column of a field's sign, and the letters of its axis."""


def names_pictures(path: Path) -> bool:
    """Whether the first lines of a text name picture files, so that it is probably meant for them."""
    words = re.split(r"[\s,;\"']+", decoded(beginning(path, _HEAD_BYTES)))
    return any(Path(word).suffix.lower() in PICTURE_SUFFIXES for word in words[:2000])
