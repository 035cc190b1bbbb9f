"""Cells of a table of poses: coordinates, lengths and angles as programs and people write them.

A cell is read as a whole or not at all: "47 30.7 N" read as far as its first digits would be a place 57 km away.
"""

import math
import re

_MOST_CHARACTERS = 64
_UNITS = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("ft", "feet", "foot", "usft", "us ft", "'"), 0.3048),
    **dict.fromkeys(("km", "kilometer", "kilometers", "kilometre", "kilometres"), 1000.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 0.01),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 0.001),
}
_ANGLE_UNITS = {
    **dict.fromkeys(("°", "deg", "degree", "degrees"), 1.0),
    **dict.fromkeys(("rad", "radian", "radians"), 180.0 / math.pi),
}
_SAME = str.maketrans({
    "\u00a0": " ", "\u202f": " ", "\u2212": "-", "\u00ba": "°", "\u02da": "°",
    "\u2032": "'", "\u2019": "'", "\u2033": '"', "\u201d": '"',
})  # fmt: skip

_DIGITS = r"(?:\d+(?:\.\d*)?|\.\d+)"
_NUMBER = rf"[+-]?{_DIGITS}(?:[eE][+-]?\d+)?"
_DEGREES = r"(?:°|deg(?:rees?)?)"
_HEMISPHERE = r"north|south|east|west|[NSEW]"
_DECIMAL = re.compile(rf"({_NUMBER})\s*{_DEGREES}?", re.IGNORECASE)
_SEXAGESIMAL = re.compile(
    rf"([+-]?)({_DIGITS})(?:\s*(?:{_DEGREES}|:)\s*|\s+)({_DIGITS})"
    rf"(?:(?:\s*(?:'|min|:)\s*|\s+)({_DIGITS})\s*(?:\"|''|sec)?|\s*(?:'|min)?)",
    re.IGNORECASE,
)
# A letter that belongs to a word is none: "degrees" does not end in a south.
_BEFORE = re.compile(rf"({_HEMISPHERE})(?![a-z])\s*(.+)", re.IGNORECASE)
_AFTER = re.compile(rf"(.+?)\s*(?<![a-z])({_HEMISPHERE})", re.IGNORECASE)
_SEA_LEVEL = r"(above|below|positive|negative) sea level(?: \(sea-level ref\))?"  # as ExifTool prints GPSAltitudeRef
_LENGTH = re.compile(rf"({_NUMBER})\s*([a-z ]*?|')\s*(?:{_SEA_LEVEL}|a?msl|asl|agl|hae)?", re.IGNORECASE)
_ANGLE = re.compile(rf"({_NUMBER})\s*(°|[a-z]*)", re.IGNORECASE)
_BELOW = frozenset({"below", "negative"})
_ABSENT = frozenset({"", "-", "--", "n/a", "na", "nan", "none", "null", "undef"})


def is_absent(cell: str) -> bool:
    """Whether a cell says that there is no value."""
    return cell.strip().lower() in _ABSENT


def unit_of_title(title: str) -> tuple[str, float]:
    """A column's title without its unit, and metres or degrees in one unit of it: 1 where the title names none.

    The unit stands in brackets ("altitude (ft)") or is the last word ("altitude_ft"; but "altitude_m" is a name).
    """
    bare = re.sub(r"\[.*?\]|\(.*?\)", " ", title).strip()
    name, _, last = bare.replace(" ", "_").rpartition("_")
    in_brackets = re.findall(r"[a-z]+", " ".join(re.findall(r"[\[(]([^\])]*)", title.lower())))
    for word in [*in_brackets, last.lower()]:
        factor = _UNITS.get(word, _ANGLE_UNITS.get(word))
        if factor is not None:
            return (name if factor != 1.0 and word == last.lower() else bare), factor
    return bare, 1.0


def coordinate_deg(cell: str, axis: str, factor: float = 1.0) -> float | None:
    """Degrees of a latitude or longitude; None if the cell is not understood.

    Read are decimal degrees, degrees and minutes, and degrees, minutes and seconds, with marks (47 deg 30' 0.0",
    47°30.5', 47:30:00) or blanks between, with a sign, or with a hemisphere (N, south) before or after.

    axis: "NS" for a latitude, "EW" for a longitude. factor: degrees in the unit of decimal numbers.
    """
    cell = _plain(cell)
    written = _degrees(cell, factor)
    if written is not None:
        return written
    after, before = _AFTER.fullmatch(cell), _BEFORE.fullmatch(cell)
    if after is not None:
        return _in_hemisphere(_degrees(after[1], factor), after[2], axis)
    return None if before is None else _in_hemisphere(_degrees(before[2], factor), before[1], axis)


def hemisphere_sign(written: str, axis: str) -> float | None:
    """Sign of a coordinate whose hemisphere is written ("S", "South"), on "NS" or "EW"; None if not understood."""
    hemisphere = _plain(written).upper()
    letter = hemisphere[:1]
    if hemisphere not in (letter, _WORDS.get(letter)) or letter not in set(axis):
        return None
    return -1.0 if letter in "SW" else 1.0


def _in_hemisphere(degrees: float | None, written: str, axis: str) -> float | None:
    """Signed degrees of a coordinate with its hemisphere in the same cell; None where both contradict."""
    sign = hemisphere_sign(written, axis)
    if degrees is None or sign is None:
        return None
    if sign < 0.0:
        return -abs(degrees)
    return degrees if degrees >= 0.0 else None


_WORDS = {"N": "NORTH", "S": "SOUTH", "E": "EAST", "W": "WEST"}


def length_m(cell: str, factor: float = 1.0) -> float | None:
    """Metres of "512.3", "512.3 m", "1680 ft" or "12 m Below Sea Level"; None if the cell is not understood.

    A number without a unit counts `factor` metres.
    """
    match = _LENGTH.fullmatch(_plain(cell))
    unit = match[2].strip().lower() if match else ""
    if match is None or (unit and unit not in _UNITS):
        return None
    value = float(match[1]) * (_UNITS[unit] if unit else factor)
    return _finite(-abs(value) if (match[3] or "").lower() in _BELOW else value)


def below_sea(written: str) -> bool | None:
    """Whether a GPSAltitudeRef, as a number or as ExifTool prints it, says below; None if it is not understood.

    EXIF 3.0: 0 and 1 are above and below the ellipsoid, 2 and 3 above and below the sea.
    """
    number = re.fullmatch(r"([0-3])(?:\.0*)?", written)  # with a point where empty cells made a column of floats
    if number is not None:
        return number[1] in ("1", "3")
    match = re.fullmatch(rf"{_SEA_LEVEL}|(above|below)", written, re.IGNORECASE)
    return None if match is None else (match[1] or match[2]).lower() in _BELOW


def angle_deg(cell: str, factor: float = 1.0) -> float | None:
    """Degrees of "31.5", "31.5 deg" or "0.55 rad", a number without a unit `factor` degrees; None if not understood."""
    match = _ANGLE.fullmatch(_plain(cell))
    unit = match[2].lower() if match else ""
    if match is None or (unit and unit not in _ANGLE_UNITS):
        return None
    return _finite(float(match[1]) * (_ANGLE_UNITS[unit] if unit else factor))


def _degrees(text: str, factor: float) -> float | None:
    decimal = _DECIMAL.fullmatch(text)
    if decimal is not None:
        return _finite(float(decimal[1]) * factor)
    match = _SEXAGESIMAL.fullmatch(text)
    if match is None:
        return None
    degrees, minutes, seconds = float(match[2]), float(match[3]), float(match[4] or 0.0)
    whole = (degrees, minutes) if match[4] else (degrees,)
    if minutes > 60.0 or seconds > 60.0 or not all(value.is_integer() for value in whole):
        return None
    total = degrees + minutes / 60.0 + seconds / 3600.0
    return -total if match[1] == "-" else total


def _plain(cell: str) -> str:
    """The cell with one character for what typesetters write in several ways; "" if it is too long for a value."""
    cell = cell.translate(_SAME).strip()
    return cell if len(cell) <= _MOST_CHARACTERS else ""


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
