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

Heights are absolute altitudes wherever the header does not say otherwise.
"""

import csv
import io
import math
import re
from collections.abc import Sequence
from pathlib import Path

from orthoswarm.model.errors import InputError
from orthoswarm.raster.picture_file import PICTURE_SUFFIXES
from telemetry.formats.table.geo_txt import to_geographic
from telemetry.formats.table.pose_row import PoseRow, PoseTable, pitch_by_value, read_text
from telemetry.samples.rotations import camera_angles_from_opk_deg
from telemetry.samples.sample import is_position
from telemetry.samples.times import parse_time

_HEAD_BYTES = 1 << 14
_NAMES = {
    "image": "image imagename image_name filename file_name file name photo photo_name label sourcefile photoid",
    "lat_deg": "lat_deg lat latitude y/latitude latitude/y gpslatitude",
    "lon_deg": "lon_deg lon lng long longitude x/longitude longitude/x gpslongitude",
    "x": "x x/easting x/east easting",
    "y": "y y/northing y/north northing",
    "altitude_m": "altitude_m alt_m altitude alt z z/altitude height/z gpsaltitude ellipsoidal_height",
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
}
_COLUMNS = {name: key for key, names in _NAMES.items() for name in names.split()}
_SEXAGESIMAL = re.compile(r"\s*([\d.]+)\s*deg\s*([\d.]+)'\s*([\d.]+)\"\s*([NSEW]?)")
_NUMBER = re.compile(r"\s*([+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)")
_COORDINATE_SYSTEM = re.compile(r"#\s*CoordinateSystem:\s*(.+)", re.IGNORECASE)
_PIX4D_COLUMNS = {
    3: "lat_deg lon_deg altitude_m",
    5: "lat_deg lon_deg altitude_m sigma_m vertical",
    6: "lat_deg lon_deg altitude_m yaw_deg pitch_deg roll_deg",
    8: "lat_deg lon_deg altitude_m yaw_deg pitch_deg roll_deg sigma_m vertical",
}


def read_pose_csv(path: Path) -> PoseTable | None:
    """Read a table of poses; None if the file is some other text.

    Raises:
        InputError: it is a table of poses that cannot be read: no projection, too large.
    """
    try:
        with path.open("rb") as handle:  # most tables next to pictures are not tables of poses, and may be large
            head = handle.read(_HEAD_BYTES).decode("utf-8-sig", "replace").replace("\0", "").splitlines()
    except OSError:
        return None
    for at, line in enumerate(head[:5]):
        separator = _separator(line)
        header = [_column(cell) for cell in _cells(line, separator)]
        if "image" in header and ({"lat_deg", "lon_deg"} <= set(header) or {"x", "y"} <= set(header)):
            return _read(path, at, _row_separator(head[at + 1 :], separator, header), header, line)
    columns = _pix4d_header(head[0]) if head else None
    if columns is not None:
        return _read(path, -1, _separator(head[0]), columns, "")
    return None


def _separator(line: str) -> str:
    best = max(",;\t", key=line.count)
    return best if line.count(best) >= 2 else " "


def _row_separator(lines: Sequence[str], separator: str, header: Sequence[str]) -> str:
    """What separates the cells of the rows: Metashape's OPK export has commas in its header and tabs below."""
    row = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    own = _separator(row)
    return own if len(_cells(row, separator)) < len(header) == len(_cells(row, own)) else separator


def _cells(line: str, separator: str) -> list[str]:
    return line.split() if separator == " " else next(csv.reader([line], delimiter=separator), [])


def _column(cell: str) -> str:
    """The field that a column's title names, "" if unknown; units, comment marks and capitals are ignored."""
    text = re.sub(r"\[.*?\]|\(.*?\)", "", cell).strip().lstrip("#").strip().lower()
    return _COLUMNS.get(re.sub(r"[\s_]+", "_", text).strip("_"), "")


def _pix4d_header(line: str) -> list[str] | None:
    """Columns of a line `image.jpg,47.1,8.2,500 ...` without a header before it; None for any other line."""
    cells = [cell.strip() for cell in line.split(_separator(line))]
    if Path(cells[0]).suffix.lower() not in PICTURE_SUFFIXES:
        return None
    try:
        numbers = [float(cell) for cell in cells[1:]]
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


def _read(path: Path, header_at: int, separator: str, header: Sequence[str], title: str) -> PoseTable:
    lines = read_text(path).splitlines()
    body = [line for line in lines[header_at + 1 :] if line.strip() and not line.startswith("#")]
    commas = csv.reader(io.StringIO("\n".join(body)), delimiter=separator)
    rows = (line.split() for line in body) if separator == " " else commas
    table = PoseTable()
    try:
        for cells in rows:
            named = _row(header, cells)
            if named is not None:
                table[named[0]] = named[1]
    except csv.Error:  # an unterminated quoted cell: nothing after it can be separated
        pass
    if "lat_deg" not in header:
        to_geographic(table, _projection(path, lines[: header_at + 1], table), path)
    for row in table.values():
        if row.lat_deg is None or row.lon_deg is None or not is_position(row.lat_deg, row.lon_deg):
            row.lat_deg = row.lon_deg = None
    table.useless = sum(row.lat_deg is None for row in table.values())
    if "lat_deg" not in title.lower() and "sourcefile" not in title.lower() and "omega" not in header:
        pitch_by_value(table)
    return table


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


def _row(header: Sequence[str], cells: Sequence[str]) -> tuple[str, PoseRow] | None:
    values = {key: cell.strip() for key, cell in zip(header, cells) if key and cell.strip()}
    name = values.pop("image", "").replace("\\", "/").removeprefix("./")
    if not name:
        return None
    vehicle = "".join(c for c in values.pop("vehicle", "") if c.isprintable()).strip()
    row = PoseRow(vehicle=vehicle[:64] or None)
    row.time_s = _time(values.pop("time", ""))
    numbers = {key: value for key, cell in values.items() if (value := _number(cell)) is not None}
    if {"omega", "phi", "kappa"} <= numbers.keys():
        angles = camera_angles_from_opk_deg(numbers["omega"], numbers["phi"], numbers["kappa"])
        row.yaw_deg, row.pitch_deg, row.roll_deg = angles
    for key, value in numbers.items():
        if key in ("x", "y"):
            setattr(row, "lon_deg" if key == "x" else "lat_deg", value)
        elif key in _FIELDS:
            setattr(row, key, value)
    if row.sigma_m is not None and not 0.0 < row.sigma_m < 1000.0:
        row.sigma_m = None
    return name.lower(), row


_FIELDS = frozenset(
    {"lat_deg", "lon_deg", "altitude_m", "height_m", "yaw_deg", "pitch_deg", "roll_deg", "sigma_m", "fov_deg"}
)


def _number(cell: str) -> float | None:
    """A number, also with a unit after it ("512.3 m") or as ExifTool writes angles (47 deg 30' 0.00" N)."""
    match = _SEXAGESIMAL.match(cell)
    if match:
        value = float(match[1]) + float(match[2]) / 60.0 + float(match[3]) / 3600.0
        return -value if match[4] in ("S", "W") and match[4] else value
    match = _NUMBER.match(cell)
    value = float(match[1]) if match else math.nan
    if cell.rstrip().endswith("Below Sea Level"):
        value = -value
    return value if math.isfinite(value) else None


def _time(written: str) -> float | None:
    """Epoch seconds; None if it is not a time."""
    try:
        value = float(written)
    except ValueError:
        parsed = parse_time(written)
        return None if parsed is None else parsed[0]
    return value if math.isfinite(value) and 0.0 < value < 7.3e9 else None


def names_pictures(path: Path) -> bool:
    """Whether the first lines of a text name picture files, so that it is probably meant for them."""
    try:
        with path.open("rb") as handle:
            words = re.split(r"[\s,;\"']+", handle.read(_HEAD_BYTES).decode("utf-8", "replace"))
    except OSError:
        return False
    return sum(Path(word).suffix.lower() in PICTURE_SUFFIXES for word in words[:2000] if "." in word) >= 1
