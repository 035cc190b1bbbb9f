"""Which checkpoints are control points: what placed a map cannot test it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np

from orthoswarm.evaluation.misread_points import away_m
from orthoswarm.model.errors import InputError

_SAME_PLACE_M: Final = 0.05  # checkpoint within this distance of a control point is that point (as surveys differ) ...
_SAME_NAME_M: Final = 10.0  # ... and within this one if it has its name


class Surveyed(Protocol):
    """A point with its name and its place: longitude and latitude in degrees."""

    @property
    def name(self) -> str:
        """Name of the point."""

    @property
    def surveyed(self) -> Any:
        """Longitude and latitude (2,)."""


@dataclass(frozen=True, slots=True)
class KnownPoint:
    """A surveyed point as a report holds it."""

    name: str
    surveyed: tuple[float, float]


def control_rows(points: Iterable[Surveyed]) -> list[dict[str, Any]]:
    """`control_points` of report.json."""
    return [
        {"name": point.name, "lat_deg": float(point.surveyed[1]), "lon_deg": float(point.surveyed[0])}
        for point in points
    ]


def control_of_report(rows: Iterable[dict[str, Any]]) -> list[KnownPoint]:
    """The points of such rows."""
    return [KnownPoint(str(row["name"]), (float(row["lon_deg"]), float(row["lat_deg"]))) for row in rows]


def shared_points(checkpoints: Sequence[Surveyed], control: Sequence[Surveyed], table: str) -> list[str]:
    """Names of the checkpoints that are control points: at the same place, or near by with the same name.

    A name alone does not tell: many a table counts its points from 1.

    Args:
        checkpoints: those of a table. control: the points that placed the map. table: its name, for the message.

    Raises:
        InputError: all of them are.
    """
    shared = [point.name for point in checkpoints if any(_same(point, other) for other in control)]
    if checkpoints and len(shared) == len(checkpoints):
        raise InputError(
            f"all points of {table} are control points, which tell nothing about the map's error; keep some points out "
            "of --control and give these to --checkpoints"
        )
    return shared


def shared_warning(shared: Sequence[str], count: int) -> list[str]:
    """What a run says about checkpoints that do not count; nothing where all do."""
    if not shared:
        return []
    names = ", ".join(shared[:5]) + (", ..." if len(shared) > 5 else "")
    return [
        f"{len(shared)} of {count} checkpoints were left out, as they are control points ({names}): the map was placed "
        "on them"
    ]


def _same(point: Surveyed, other: Surveyed) -> bool:
    away = away_m(np.asarray(point.surveyed), np.asarray(other.surveyed))
    return away <= (_SAME_NAME_M if point.name == other.name else _SAME_PLACE_M)
