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

Array = NDArray[np.float64]

_TOLD_M: Final = 1.0  # PROJ states 1 m where datums are the same but for the drift of continents: ETRS89
_BESIDE_AREA_DEG: Final = 6.0  # systems are used so far beyond their area: the neighbouring zone of UTM
_GEOCENTRIC_AXIS_M: Final = 6378137.0  # semi-major axis of WGS 84 and GRS 80, the ellipsoids of today's datums
_SOUTH_BANDS: Final = "CDEFGHJKLMS"
"""Letters behind a UTM zone that mean the south: bands of MGRS, and S, which nearly everybody writes for south."""
_OTHER_NAMES: Final = {
    "puwg1992": 2180, "pl1992": 2180, "uklad1992": 2180, "lambert93": 2154, "nztm": 2193, "bng": 27700, "osgb": 27700,
    "osgb36": 27700, "rdnew": 28992, "rd": 28992, "itm": 2157, "lv95": 2056, "lv03": 21781, "sweref99": 3006,
    **{f"puwg2000s{zone}": 2171 + zone for zone in range(5, 9)},
    **{f"puwg2000strefa{zone}": 2171 + zone for zone in range(5, 9)},
}  # fmt: skip
"""What EPSG's own list does not have, letters and digits alone."""
_LEAST_LETTERS: Final = 4  # shorter names fit anything


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
    transformer, doubt = _transformer(system)
    lon, lat = transformer.transform(np.asarray(x, float), np.asarray(y, float))
    metres = _used_accuracy_m(transformer)
    if metres > _TOLD_M:
        doubt = (
            f"coordinates in '{system[:60]}' are turned into WGS 84 to {metres:.0f} m only (no better table of the "
            "datum is here); give them in WGS 84 where that matters"
        )
    return np.stack([np.asarray(lon, float), np.asarray(lat, float)], axis=-1), doubt


def require_map_system(epsg: int, lon: ArrayLike, lat: ArrayLike) -> str:
    """Refuse a known system that a map about points (N,), in degrees, cannot be written in.

    Returns what is uncertain about the map's places then, a sentence without its end; "" if the datums agree to 1 m.

    Raises:
        InputError: it is no system of maps, or not used there.
    """
    from pyproj import CRS

    system = f"EPSG:{epsg}"
    crs = CRS.from_user_input(system)
    degrees = crs.is_geographic and all(axis.unit_name == "degree" for axis in crs.axis_info[:2])
    if not (crs.is_projected or degrees):
        raise InputError(f"{system} ({crs.name}) is no system for maps; give one in metres or in degrees")
    transformer, doubt = _transformer(system)
    x, y = transformer.transform(np.asarray(lon, float), np.asarray(lat, float), direction="INVERSE")
    metres = _used_accuracy_m(transformer)
    if not np.isfinite([x, y]).all() or share_in_area(system, x, y) < 1.0:
        raise InputError(f"{system} ({crs.name}) is not used where this map lies; give the system of its country")
    return f"places in {system} are good to {metres:.0f} m (no better table is here)" if metres > _TOLD_M else doubt


def _used_accuracy_m(transformer: Any) -> float:
    """The accuracy of what a transformer did last, metres; negative if it is not known."""
    from pyproj.exceptions import ProjError

    try:
        return float(transformer.get_last_used_operation().accuracy)
    except ProjError:  # of degrees into the same degrees PROJ remembers none
        return float(transformer.accuracy)


def require_datum(system: str, name: str) -> None:
    """Refuse what is in a system whose datum is not known.

    Raises:
        InputError: with the name of the file.
    """
    try:
        _transformer(system)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def metres_of_heights(system: str) -> float:
    """Metres in one unit of the heights of a system with a vertical axis ("EPSG:32610+6360": feet); 1 without one."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        axes = CRS.from_user_input(projection_of(system) or system).axis_info
    except CRSError:
        return 1.0
    return float(axes[2].unit_conversion_factor) if len(axes) > 2 else 1.0


def share_in_area(system: str, x: ArrayLike, y: ArrayLike) -> float:
    """Share of points (N,) that lie about where a system is used; x, y: east and north, or longitude and latitude."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        area = CRS.from_user_input(projection_of(system) or system).area_of_use
    except CRSError:
        area = None
    lon_lat, _ = to_degrees(system, x, y)
    if area is None or not lon_lat.size:
        return 1.0
    lon, lat = np.moveaxis(np.where(np.isfinite(lon_lat), lon_lat, 1e3), -1, 0)  # no place is in no area
    half = 0.5 * ((area.east - area.west) % 360.0 or 360.0)
    near = np.abs((lon - area.west - half + 180.0) % 360.0 - 180.0) <= half + _BESIDE_AREA_DEG
    near &= (lat >= area.south - _BESIDE_AREA_DEG) & (lat <= area.north + _BESIDE_AREA_DEG) & (np.abs(lat) <= 90.0)
    return float(near.mean())


@lru_cache(maxsize=64)
def _transformer(system: str) -> tuple[Any, str]:
    """PROJ's transformer of a system to degrees, and a doubt about its datum; InputError as above."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError, ProjError

    try:
        crs = CRS.from_user_input(projection_of(system) or system)
    except CRSError:
        proposed = _proposed_code(system)
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


def _proposed_code(name: str) -> str | None:
    """The system that a name may stand for, as "EPSG:2180 (ETRF2000-PL / CS92)"; None if no or several ones fit."""
    import pyproj
    from pyproj.database import query_crs_info
    from pyproj.enums import PJType

    wanted = _plain(name)
    code = _OTHER_NAMES.get(wanted)
    if code is not None:
        return f"EPSG:{code} ({pyproj.CRS.from_epsg(code).name})"
    if len(wanted) < _LEAST_LETTERS:
        return None
    known = query_crs_info("EPSG", [PJType.PROJECTED_CRS, PJType.GEOGRAPHIC_2D_CRS])
    fit = [info for info in known if wanted in _plain(info.name)]
    exact = [info for info in fit if _plain(info.name).endswith(wanted)] if len(fit) > 1 else fit
    return f"EPSG:{exact[0].code} ({exact[0].name})" if len(exact) == 1 else None


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
