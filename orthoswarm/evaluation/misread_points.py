"""Surveyed points that do not lie where their photos or the map show them, and how their table was probably meant."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.arrays import Array
from orthoswarm.model.coordinate_system import to_degrees
from orthoswarm.model.earth import distance_m
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import utm_epsg

FARTHEST_M: Final = 1000.0  # a point farther from where it is seen belongs elsewhere; neither map nor receiver errs so
_FAR_OFF_M: Final = 20.0  # more than receivers and maps err; datums of a country differ by 50 to 500 m
_STANDS_OUT: Final = 10.0  # a point off by so many times what the others usually are is a mistake
_COMMON: Final = 3.0  # all points off by so many times what they differ among each other have one cause
_SHOWN_NAMES: Final = 3
_CHECK: Final = "check their coordinates, their order (east or longitude first) and their coordinate system"


@dataclass(frozen=True, slots=True)
class Coordinates:
    """A place as a table has it: x and y (east and north, longitude and latitude) in a coordinate system."""

    x: float
    y: float
    system: str


def is_place(lon_lat: Array) -> bool:
    """Whether longitude and latitude (2,) can be those of a place."""
    return bool(np.isfinite(lon_lat).all() and abs(lon_lat[0]) <= 360.0 and abs(lon_lat[1]) <= 90.0)


def require_places(points: Iterable[tuple[str, Array]]) -> None:
    """Refuse points, each a name with longitude and latitude (2,), of which one is at no place of the Earth.

    Raises InputError: with their names.
    """
    names = [name for name, lon_lat in points if not is_place(lon_lat)]
    if names:
        raise InputError(f"the points {', '.join(names[:_SHOWN_NAMES])} are at no place of the Earth; {_CHECK}")


def away_m(surveyed: Array, seen: Array) -> float:
    """Metres between two places, each longitude and latitude (2,); infinite for what is no place."""
    if not (is_place(surveyed) and is_place(seen)):
        return float("inf")
    return distance_m(float(surveyed[1]), float(surveyed[0]), float(seen[1]), float(seen[0]))


def meaning(written: Coordinates, seen: Array) -> str:
    """What a table must have meant for its point to lie where it is seen, in words; "" if nothing fits.

    written: coordinates of a point. seen: longitude and latitude (2,) of where it is seen.
    """
    x, y = written.x, written.y
    orders = {
        (x, y): "",
        (y, x): "its two coordinates exchanged (east or longitude comes first, then north or latitude)",
        (-x, y): "a minus before its longitude",
        (x, -y): "a minus before its latitude",
    }
    for system in dict.fromkeys((written.system, "EPSG:4326", *_zones(seen))):
        for turned, order in orders.items():
            lon_lat, _ = to_degrees(system, *turned)
            if away_m(lon_lat, seen) <= FARTHEST_M:
                named = (
                    "" if system == written.system else f"the coordinate system {system} instead of {written.system}"
                )
                return " and ".join(part for part in (named, order) if part)
    return ""


def misplaced(points: Sequence[tuple[str, Coordinates | None, Array, Array]]) -> str:
    """One sentence, without its end, about points that lie elsewhere.

    points: name, coordinates as written, surveyed and seen longitude and latitude (2,) of each.
    """
    names = ", ".join(name for name, *_ in points[:_SHOWN_NAMES]) + (", ..." if len(points) > _SHOWN_NAMES else "")
    away = [away_m(surveyed, seen) for _, _, surveyed, seen in points]
    where = (
        f"{np.median(away) / 1000:,.0f} km from where the photos or the map show them"
        if np.isfinite(away).all()
        else "at no place of the Earth"
    )
    meant = {meaning(written, seen) if written is not None else "" for _, written, _, seen in points}
    mend = f"they fit with {meant.pop()}: mend that" if len(meant) == 1 and "" not in meant else _CHECK
    return f"{len(points)} surveyed points lie {where} ({names}); {mend}"


def doubts(names: Sequence[str], error: Array) -> list[str]:
    """Findings on errors that neither a map nor receivers have, in plain words.

    names: of the points. error: float64 (n, 2), map minus survey, east and north, metres.
    """
    if len(names) < 3:
        return []
    middle = np.median(error, axis=0)
    away = np.hypot(*(error - middle).T)
    usual, common = float(np.median(away)), float(np.hypot(*middle))
    said = [
        f"point {name}: it lies {off:.0f} m from where the others would put it, which usually differ by {usual:.1f} m; "
        "check its coordinates and its marks"
        for name, off in zip(names, away, strict=True)
        if off > max(_FAR_OFF_M, _STANDS_OUT * usual)
    ]
    if common > max(_FAR_OFF_M, _COMMON * usual):
        said.append(
            f"points: all lie about {common:.0f} m ({-middle[0]:+.0f} east, {-middle[1]:+.0f} north) from where the "
            "map shows them, as those of another datum do; check their coordinate system, then the map"
        )
    return said


def _zones(seen: Array) -> list[str]:
    """The UTM zones of a place and beside it."""
    lon, lat = float(seen[0]), float(seen[1])
    try:
        return [f"EPSG:{utm_epsg(lat, float(wrap_deg(lon + step)))}" for step in (0.0, -6.0, 6.0)]
    except InputError:  # beyond the grid
        return []
