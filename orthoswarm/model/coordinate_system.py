"""Coordinates of any system that a file may name, as longitude and latitude of WGS 84.

Between two datums PROJ takes, where it knows no better, the degrees of the one for those of the other ("ballpark"): a
hundred metres in many countries. That is never done here, but where the ellipsoid is that of WGS 84 itself.
"""

import re
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthoswarm.model.errors import InputError
from orthoswarm.model.system_names import proposed_code

Array = NDArray[np.float64]

_TOLD_M: Final = 1.0  # PROJ states 1 m where datums are the same but for the drift of continents: ETRS89
_GEOCENTRIC_AXIS_M: Final = 6378137.0  # semi-major axis of WGS 84 and GRS 80, the ellipsoids of today's datums
_SOUTH_BANDS: Final = "CDEFGHJKLMS"
"""Letters behind a UTM zone that mean the south: bands of MGRS, and S, which nearly everybody writes for south."""


def to_degrees(system: str, x: ArrayLike, y: ArrayLike) -> tuple[Array, str]:
    """Longitude and latitude of points of a system, and what is uncertain about them.

    Args:
        system: its EPSG code, a PROJ string, WKT, or "WGS84 UTM 32N". x, y: (...,), east and north.

    Returns:
        Degrees, float64 (..., 2), not finite where there is no such place; one sentence without its end, "" if the
        datums differ by no more than 1 m from what is known.

    Raises:
        InputError: the system is not known, or only its ellipsoid is.
    """
    from pyproj.exceptions import ProjError

    transformer, doubt = _transformer(system)
    lon, lat = transformer.transform(np.asarray(x, float), np.asarray(y, float))
    try:
        used = transformer.get_last_used_operation()
    except ProjError:  # of degrees into the same degrees PROJ remembers none
        used = transformer
    if used.accuracy > _TOLD_M:
        doubt = (
            f"coordinates in '{system[:60]}' are turned into WGS 84 to {used.accuracy:.0f} m only (no better table of "
            "the datum is here); give them in WGS 84 where that matters"
        )
    return np.stack([np.asarray(lon, float), np.asarray(lat, float)], axis=-1), doubt


def require_datum(system: str, name: str) -> None:
    """Refuse what is in a system whose datum is not known.

    Raises:
        InputError: with the name of the file.
    """
    try:
        _transformer(system)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


@lru_cache(maxsize=64)
def _transformer(system: str) -> tuple[Any, str]:
    """PROJ's transformer of a system to degrees, and a doubt about its datum; InputError as above."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError, ProjError

    try:
        crs = CRS.from_user_input(projection_of(system) or system)
    except CRSError:
        proposed = proposed_code(system)
        wanted = f"if it is {proposed}, write that code" if proposed else "write EPSG:32617 or a PROJ string"
        raise InputError(f"'{system[:60]}' is not a coordinate system; {wanted}") from None
    crs = crs.sub_crs_list[0] if crs.is_compound else crs
    try:
        return Transformer.from_crs(crs, 4326, always_xy=True, allow_ballpark=False), ""
    except ProjError:
        ellipsoid = crs.ellipsoid
    if ellipsoid is None or ellipsoid.semi_major_metre != _GEOCENTRIC_AXIS_M:
        shape = "no ellipsoid" if ellipsoid is None else f"the ellipsoid {ellipsoid.name}"
        raise InputError(
            f"'{system[:60]}' names {shape} but no datum, which leaves its places open by some 100 m; write the EPSG "
            "code, or +datum or +towgs84 in the PROJ string"
        )
    return Transformer.from_crs(crs, 4326, always_xy=True), f"'{system[:60]}' names no datum; WGS 84 is assumed"


def projection_of(line: str) -> str | None:
    """The coordinate system that a line of a text file names, as text for PROJ; None where it names none.

    "EPSG:32632", also with a vertical one ("EPSG:32632+5773"), a PROJ string, or "WGS84 UTM 32N" as OpenDroneMap
    writes it.
    """
    text = line.strip()
    if re.fullmatch(r"EPSG:\d{4,6}(\+\d{4,6})?", text, re.IGNORECASE):
        return text.upper()
    if match := re.search(r"\+init=(epsg:\d+)", text, re.IGNORECASE):
        return match[1].upper()
    if "+proj" in text:
        return text
    if re.fullmatch(r"WGS\s*84(\s+longlat)?", text, re.IGNORECASE):
        return "EPSG:4326"
    match = re.fullmatch(r"WGS\s*84\s*/?\s*UTM\s*(?:zone)?\s*(\d{1,2})\s*([C-HJ-NP-X])", text, re.IGNORECASE)
    if match and 1 <= int(match[1]) <= 60:
        return f"EPSG:{(32700 if match[2].upper() in _SOUTH_BANDS else 32600) + int(match[1])}"
    return None
