"""The datum that a photo's GPS tags name (GPSMapDatum): places in another one than WGS 84 are turned into it."""

import math
import re
from functools import lru_cache
from typing import Final

from orthoswarm.model.earth import distance_m

IN_DATUM: Final = " in another datum: "  # in the origin of such a position; what was done about it follows
_WGS84: Final = re.compile(r"((WGS|WORLD GEODETIC SYSTEM( OF)?)[ _-]*(19)?84)?", re.IGNORECASE)
_MOST_SHIFT_M: Final = 3000.0  # datums differ by less; what is farther was no system of degrees from Greenwich


def in_wgs84(place: tuple[float, float], datum: str) -> tuple[tuple[float, float], str]:
    """A latitude and longitude in degrees in WGS 84, and the end of its origin, "" where the tags' datum is that."""
    if _WGS84.fullmatch(datum):
        return place, ""
    lat, lon, said = _shift(datum, round(place[0], 2), round(place[1], 2))  # a shift varies by centimetres within that
    return (place[0] + lat, place[1] + lon), IN_DATUM + said


@lru_cache(maxsize=256)
def _shift(datum: str, lat_deg: float, lon_deg: float) -> tuple[float, float, str]:
    """Degrees to add to a latitude and longitude of a datum, 0 where it is not known, and what is said about it."""
    from orthoswarm.model.coordinate_system import to_degrees
    from orthoswarm.model.errors import InputError

    try:
        (lon, lat), doubt = to_degrees(datum, lon_deg, lat_deg)
    except InputError:
        lon, lat, doubt = math.inf, math.inf, ""
    if math.isfinite(lat + lon) and distance_m(lat_deg, lon_deg, lat, lon) < _MOST_SHIFT_M:
        return float(lat) - lat_deg, float(lon) - lon_deg, doubt or f"'{datum}', turned into WGS 84"
    return 0.0, 0.0, f"{datum[:60]!r} is not known, and WGS 84 is assumed; give a geo.txt if that is wrong"
