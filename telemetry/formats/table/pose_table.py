"""Poses in a text file beside the photos: ODM's geo.txt and a CSV with a documented header.

geo.txt: a line with the projection ("EPSG:4326", a PROJ string, "WGS84 UTM 17N"), then
`name x y [z yaw pitch roll hacc vacc]`. z is an absolute altitude. ODM's pitch is 0 at nadir in some files and
-90 in others; the file's own values decide.

CSV: a header with `image`, `lat_deg`, `lon_deg` and any of `time` (ISO 8601 or epoch seconds), `height_m`,
`altitude_m`, `yaw_deg`, `pitch_deg` (-90 looks straight down), `roll_deg`, `sigma_m`, `fov_deg`, `vehicle`.
"""

import csv
import io
import math
import re
from dataclasses import dataclass
from pathlib import Path

from orthoswarm.model.errors import InputError
from telemetry.samples.sample import is_position
from telemetry.samples.times import parse_time

_MAX_BYTES = 256 << 20


@dataclass(slots=True)
class PoseRow:
    """What a table says about one picture; None where it says nothing."""

    lat_deg: float | None = None
    lon_deg: float | None = None
    altitude_m: float | None = None
    height_m: float | None = None
    yaw_deg: float | None = None
    pitch_deg: float | None = None
    roll_deg: float | None = None
    sigma_m: float | None = None
    time_s: float | None = None
    fov_deg: float | None = None
    vehicle: str | None = None


class PoseTable(dict[str, PoseRow]):
    """Lower-case picture name (or relative path with forward slashes) -> row.

    Attributes:
        useless: lines that name a picture and give no position that can be one.
    """

    useless: int = 0


def lookup(table: PoseTable, relative: str) -> PoseRow | None:
    """The row of a picture by its path relative to the table's folder, else by its name alone."""
    relative = relative.lower()
    return table.get(relative) or table.get(relative.rsplit("/", 1)[-1])


def _read(path: Path) -> str:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise InputError(f"{path.name} is larger than {_MAX_BYTES >> 20} MB; split it")
        return path.read_bytes().decode("utf-8-sig", "replace").replace("\0", "")
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror}); check the file") from None


def is_geo_txt(path: Path) -> bool:
    """Whether a text file looks like ODM's geo.txt: by its name or by a projection in its first line."""
    if path.suffix.lower() != ".txt":
        return False
    try:
        with path.open("rb") as handle:
            first = handle.readline(512).decode("utf-8-sig", "replace").strip()
    except OSError:
        return False
    return path.name.lower() == "geo.txt" or (path.name.lower().startswith("geo") and _projection(first) is not None)


def _projection(line: str) -> str | None:
    text = line.strip()
    if re.fullmatch(r"EPSG:\d{4,6}", text, re.IGNORECASE):
        return text.upper()
    if "+proj" in text or "+init" in text:
        return text
    match = re.fullmatch(r"WGS\s*84\s*/?\s*UTM\s*(?:zone)?\s*(\d{1,2})\s*([NS])", text, re.IGNORECASE)
    if match and 1 <= int(match[1]) <= 60:
        return f"EPSG:{(32600 if match[2].upper() == 'N' else 32700) + int(match[1])}"
    return None


def read_geo_txt(path: Path) -> PoseTable:
    """Read an ODM geo.txt.

    Raises:
        InputError: no projection in its first line, or no line that can be read.
    """
    lines = [line.strip() for line in _read(path).splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    projection = _projection(lines[0]) if lines else None
    if projection is None:
        raise InputError(f"{path.name} has no projection in its first line; write EPSG:4326 or the projection there")
    table = PoseTable()
    for line in lines[1:]:
        name, numbers = _split_row(line)
        if name is None or len(numbers) < 2:
            table.useless += 1
            continue
        n = [v if math.isfinite(v) else None for v in numbers] + [None] * 8
        row = PoseRow(n[1], n[0], n[2], None, n[3], n[4], n[5], n[6])
        if row.yaw_deg == row.pitch_deg == row.roll_deg == 0.0:
            row.yaw_deg = row.pitch_deg = row.roll_deg = None  # fillers before the accuracies
        if row.sigma_m is not None and not 0.0 < row.sigma_m < 1000.0:
            row.sigma_m = None
        table[name.lower()] = row
    if not table:
        raise InputError(f"{path.name} has no line `name x y`; check its format (ODM geo.txt)")
    _to_geographic(table, projection, path)
    _pitch_by_value(table)
    return table


def _split_row(line: str) -> tuple[str | None, list[float]]:
    """Name (which may hold spaces) and the numbers after it."""
    words = line.replace("\t", " ").split()
    numbers: list[float] = []
    while len(words) > 1 and len(numbers) < 8:
        try:
            numbers.append(float(words[-1]))
        except ValueError:
            break
        words.pop()
    return (" ".join(words) if words else None), numbers[::-1]


def _to_geographic(table: PoseTable, projection: str, path: Path) -> None:
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    try:
        transformer = Transformer.from_crs(CRS.from_user_input(projection), 4326, always_xy=True)
        x_y = [[math.nan if v is None else v for v in (r.lon_deg, r.lat_deg)] for r in table.values()]
        lon, lat = transformer.transform([x for x, _ in x_y], [y for _, y in x_y])
    except ProjError as error:
        raise InputError(f"{path.name}: the projection '{projection}' is not understood ({error})") from None
    for row, x, y in zip(table.values(), lon, lat, strict=True):
        if is_position(y, x):
            row.lon_deg, row.lat_deg = float(x), float(y)
        else:
            row.lon_deg = row.lat_deg = None
            table.useless += 1


def _pitch_by_value(table: PoseTable) -> None:
    pitches = sorted(r.pitch_deg for r in table.values() if r.pitch_deg is not None)
    if pitches and pitches[len(pitches) // 2] > -45.0:
        for row in table.values():
            if row.pitch_deg is not None:
                row.pitch_deg -= 90.0


_COLUMNS = {
    "image": "image", "filename": "image", "file": "image", "name": "image", "photo": "image", "label": "image",
    "lat_deg": "lat_deg", "lat": "lat_deg", "latitude": "lat_deg",
    "lon_deg": "lon_deg", "lon": "lon_deg", "lng": "lon_deg", "long": "lon_deg", "longitude": "lon_deg",
    "height_m": "height_m", "altitude_m": "altitude_m", "alt_m": "altitude_m", "altitude": "altitude_m",
    "yaw_deg": "yaw_deg", "yaw": "yaw_deg", "pitch_deg": "pitch_deg", "pitch": "pitch_deg",
    "roll_deg": "roll_deg", "roll": "roll_deg", "sigma_m": "sigma_m", "fov_deg": "fov_deg",
    "time": "time", "time_s": "time", "timestamp": "time", "vehicle": "vehicle",
}  # fmt: skip


def read_pose_csv(path: Path) -> PoseTable | None:
    """Read a CSV of poses; None where its header is not one (some other CSV)."""
    try:
        with path.open("rb") as handle:  # most tables beside pictures are none of poses, and may be large
            first = handle.readline(1 << 14).decode("utf-8-sig", "replace")
    except OSError:
        return None
    separator = max(",;\t", key=first.count)
    if not {"image", "lat_deg", "lon_deg"} <= {_COLUMNS.get(c.strip().lower(), "") for c in first.split(separator)}:
        return None
    reader = csv.reader(io.StringIO(_read(path)), delimiter=separator)
    try:
        header = [_COLUMNS.get(column.strip().lower(), "") for column in next(reader)]
        table = PoseTable(filter(None, (_csv_row(header, cells) for cells in reader)))
        table.useless = sum(row.lat_deg is None for row in table.values())
        return table
    except (csv.Error, StopIteration):
        return None


def _csv_row(header: list[str], cells: list[str]) -> tuple[str, PoseRow] | None:
    values = {key: cell.strip() for key, cell in zip(header, cells) if key and cell.strip()}
    name = values.pop("image", "").replace("\\", "/")
    if not name:
        return None
    vehicle = "".join(c for c in values.pop("vehicle", "") if c.isprintable()).strip()
    row = PoseRow(vehicle=vehicle[:64] or None)
    written = values.pop("time", "")
    if written:
        try:
            row.time_s = float(written)
        except ValueError:
            parsed = parse_time(written)
            row.time_s = parsed[0] if parsed else None
    for key, cell in values.items():
        try:
            value = float(cell)
        except ValueError:
            continue
        if math.isfinite(value):
            setattr(row, key, value)
    if row.lat_deg is None or row.lon_deg is None or not is_position(row.lat_deg, row.lon_deg):
        row.lat_deg = row.lon_deg = None
    return name.lower(), row
