"""MGRS designations of a place on a UTM grid (NGA.STND.0037, "Universal Grids and Grid Reference Systems")."""

import math
from typing import Final

_BANDS: Final = "CDEFGHJKLMNPQRSTUVWX"
_COLUMNS: Final = ("ABCDEFGH", "JKLMNPQR", "STUVWXYZ")
_ROWS: Final = "ABCDEFGHJKLMNPQRSTUV"
_SQUARE_M: Final = 100_000


def utm_zone(epsg: int) -> int | None:
    """Number of the UTM zone of EPSG 32601 to 32660 and 32701 to 32760, None for another system."""
    zone = epsg % 100
    return zone if epsg // 100 in (326, 327) and 1 <= zone <= 60 else None


def grid_zone(zone: int, lat_deg: float) -> str:
    """Zone and latitude band, for example `48R`."""
    return f"{zone}{_BANDS[min(max(math.floor((lat_deg + 80.0) / 8.0), 0), 19)]}"


def square(zone: int, east_m: float, north_m: float) -> str:
    """The two letters of the square of 100 km.

    Args:
        zone: of UTM. east_m, north_m: grid metres, on the south with the false northing of 10,000 km.
    """
    column = _COLUMNS[(zone - 1) % 3][(math.floor(east_m / _SQUARE_M) - 1) % 8]
    return column + _ROWS[(math.floor(north_m / _SQUARE_M) + (0 if zone % 2 else 5)) % 20]


def mgrs(zone: int, lat_deg: float, east_m: float, north_m: float) -> str:
    """A place to the metre, for example `32T MT 65741 49460`; digits are cut, not rounded."""
    east, north = (math.floor(v) % _SQUARE_M for v in (east_m, north_m))
    return f"{grid_zone(zone, lat_deg)} {square(zone, east_m, north_m)} {east:05d} {north:05d}"
