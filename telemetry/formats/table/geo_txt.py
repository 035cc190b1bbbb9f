"""OpenDroneMap's geo.txt.

A line with the projection ("EPSG:4326", a PROJ string, "WGS84 UTM 17N"), then, with blanks between,

    name x y [z] [yaw] [pitch] [roll] [horizontal accuracy] [vertical accuracy] [anything else]

z is an absolute altitude. Pitch is 0 at nadir in some files and -90 in others, which is decided by the file's values.
Angles of 0 0 0 stand for unknown ones. Source: OpenDroneMap's documentation, "Image Geolocation Files".
"""

import math
from pathlib import Path

from orthoswarm.model.coordinate_system import metres_of_heights, projection_of, share_in_area, to_degrees
from orthoswarm.model.errors import InputError
from telemetry.formats.table.pose_table import PoseTable, as_path, decoded, pitch_by_value, read_text, words_of_name
from telemetry.samples.sample import Sample, is_position

_MOST_NUMBERS = 8


def is_geo_txt(path: Path) -> bool:
    """Whether a text file is ODM's geo.txt, by its name or by a projection in its first line."""
    if path.suffix.lower() != ".txt":
        return False
    try:
        with path.open("rb") as handle:
            first = decoded(handle.read(512)).partition("\n")[0].strip()
    except OSError:
        return False
    return path.name.lower() == "geo.txt" or (path.name.lower().startswith("geo") and projection_of(first) is not None)


def read_geo_txt(path: Path) -> PoseTable:
    """Read an ODM geo.txt. Raises InputError: no projection in its first line, or no line that can be read."""
    lines = [line.strip() for line in read_text(path).splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    projection = projection_of(lines[0]) if lines else None
    if projection is None:
        raise InputError(f"{path.name} has no projection in its first line; write EPSG:4326 or the projection there")
    table = PoseTable()
    for line in lines[1:]:
        name, numbers = _fields(line)
        if name is None or len(numbers) < 2:
            table.useless += 1
            continue
        n: list[float | None] = [v if math.isfinite(v) else None for v in numbers] + [None] * 8
        row = Sample(lat_deg=n[1], lon_deg=n[0], altitude_m=n[2], yaw_deg=n[3], pitch_deg=n[4], roll_deg=n[5])
        row.sigma_m = n[6]
        if row.yaw_deg == row.pitch_deg == row.roll_deg == 0.0:
            row.yaw_deg = row.pitch_deg = row.roll_deg = None  # fillers before the accuracies
        if row.sigma_m is not None and not 0.0 < row.sigma_m < 1000.0:
            row.sigma_m = None
        table[as_path(name)] = row
    if not table:
        raise InputError(f"{path.name} has no line `name x y`; check its format (ODM geo.txt)")
    to_geographic(table, projection, path)
    pitch_by_value(table)
    return table


def to_geographic(table: PoseTable, projection: str, path: Path) -> None:
    """Turn coordinates of a projection (x in lon_deg, y in lat_deg) into degrees; impossible ones become None.

    Raises InputError: the projection is not understood or has no datum, or the coordinates are exchanged.
    """
    x_y = [[math.nan if v is None else v for v in (r.lon_deg, r.lat_deg)] for r in table.values()]
    x, y = [x for x, _ in x_y], [y for _, y in x_y]
    try:
        places, table.doubt = to_degrees(projection, x, y)
        there = share_in_area(projection, x, y) > 0.0
        exchanged = not there and share_in_area(projection, y, x) > 0.5
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None
    if exchanged:
        raise InputError(
            f"{path.name} has its two coordinates exchanged; in '{projection[:60]}' east or longitude comes first"
        )
    if not there:
        table.doubt = f"its places lie far from where '{projection[:60]}' is used; check the coordinate system"
    height = metres_of_heights(projection)
    for row in table.values():
        row.altitude_m = None if row.altitude_m is None else height * row.altitude_m
    for row, (x, y) in zip(table.values(), places, strict=True):
        if is_position(y, x):
            row.lon_deg, row.lat_deg = float(x), float(y)
        else:
            row.lon_deg = row.lat_deg = None
            table.useless += 1


def _fields(line: str) -> tuple[str | None, list[float]]:
    """Name and the numbers after it; a name with blanks ends with its suffix."""
    words = line.split()
    first = words_of_name(words)
    numbers: list[float] = []
    for word in words[first : first + _MOST_NUMBERS]:
        try:
            numbers.append(float(word))
        except ValueError:
            break
    return " ".join(words[:first]) or None, numbers
