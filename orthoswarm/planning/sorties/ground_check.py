"""Flights over a height model: how high above the ground they are, and which ground their pictures see."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from orthoswarm.model.errors import InputError
from orthoswarm.model.placement import Terrain
from orthoswarm.model.plan import OverGround
from orthoswarm.planning.lines.line_spacing import Footprint
from orthoswarm.planning.sorties.flight_heights import BESIDE_M, FlightHeights, profile_step_m
from orthoswarm.planning.sorties.flight_path import Flight

Geometry = Any
Array = NDArray[np.float64]

_EDGE_ROUNDS: Final = 12  # bisections of the highest ground between two places of a profile (to millimetres)


def leg_paths(flight: Flight) -> list[Array]:
    """The points of each leg of a flight, float64 (n, 3), those put in for their height included."""
    firsts, lasts = np.flatnonzero(flight.camera == 1), np.flatnonzero(flight.camera == -1)
    return [flight.points[a : b + 1] for a, b in zip(firsts, lasts, strict=True)]


def swaths(paths: Sequence[Array], ground: Terrain, foot: Footprint, foot_above_m: float) -> list[Geometry]:
    """The ground that pictures along legs are certain to see, a shapely polygon a leg.

    Across the leg a picture ends where the ray of its border meets the ground. A leg counts beyond its ends as far as
    its footprint there does.

    Args:
        paths: float64 (n, 3) each, straight on the map. ground: its heights. foot: footprint of the narrowest camera
            at `foot_above_m` above level ground.
    """
    return [_swath(_sampled(path, ground), ground, foot, foot_above_m) for path in paths]


def _sampled(path: Array, *grounds: Terrain) -> Array:
    """A path (n, 3) with points at most half a node of the height models apart."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
    at = np.union1d(np.linspace(0.0, along[-1], int(np.ceil(along[-1] / profile_step_m(*grounds))) + 1), along)
    return np.stack([np.interp(at, along, path[:, axis]) for axis in range(3)], axis=1)


def _half_widths(points: Array, ground: Terrain, slope: float) -> tuple[Array, Array]:
    """How far pictures reach to the left and to the right of a leg's points (n, 3), metres; and the unit vector left.

    Args:
        slope: half a footprint's width over the height above ground.
    """
    way = points[-1, :2] - points[0, :2]
    left = np.array([-way[1], way[0]]) / max(float(np.hypot(*way)), 1e-9)
    sides = np.array([1.0, -1.0])[:, None]
    above = points[:, 2] - np.asarray(ground.height(points[:, :2]))
    reach = np.repeat(slope * above[None], 2, 0)
    # Damped, as ground steeper than the ray would make plain iteration swing.
    for _ in range(_EDGE_ROUNDS):
        places = points[None, :, :2] + (sides * reach)[..., None] * left
        height = points[None, :, 2] - np.asarray(ground.height(places))
        reach = 0.5 * (reach + slope * np.maximum(height, 0.0))
    return reach, left


def _swath(points: Array, ground: Terrain, foot: Footprint, foot_above_m: float) -> Geometry:
    reach, left = _half_widths(points, ground, 0.5 * foot.width_m / foot_above_m)
    way = points[-1, :2] - points[0, :2]
    along = way / max(float(np.hypot(*way)), 1e-9)
    above = points[[0, -1], 2] - np.asarray(ground.height(points[[0, -1], :2]))
    seen = 0.5 * foot.height_m - foot.slant_m  # along the leg, before the trigger's phase
    before, behind = np.maximum(0.0, seen * above / foot_above_m - foot.trigger_m)
    line = np.concatenate([points[:1, :2] - before * along, points[:, :2], points[-1:, :2] + behind * along])
    wide = np.concatenate([reach[:, :1], reach, reach[:, -1:]], axis=1)
    ring = np.concatenate([line + wide[0][:, None] * left, (line - wide[1][:, None] * left)[::-1]])
    return shapely.make_valid(shapely.Polygon(ring))


def over_ground(flights: Sequence[Flight], heights: FlightHeights, foot: Footprint, foot_above_m: float) -> OverGround:
    """How flights lie over the ground.

    Args:
        flights: of all vehicles. heights: by which they were made, with a ground. foot, foot_above_m: see `swaths`.

    Raises:
        InputError: a leg or a way is lower than `heights.least_above_m` above the ground, or above that beside it.
    """
    ground, highest = heights.ground, heights.highest
    assert ground is not None and highest is not None
    on_legs, overlaps, on_ways = [], [], []
    for flight in flights:
        cruise = _sampled(np.concatenate([[[*flight.home, flight.climb_m]], flight.points]), ground, highest)
        on_ways.append(cruise[:, 2] - np.asarray(highest.height(cruise[:, :2])))
        for path in leg_paths(flight):
            points = _sampled(path, ground)
            on_legs.append(points[:, 2] - np.asarray(ground.height(points[:, :2])))
            width = _half_widths(points, ground, 0.5 * foot.width_m / foot_above_m)[0].sum(axis=0)
            overlaps.append(1.0 - foot.spacing_m / np.maximum(width, 1e-9))
    above, overlap = np.concatenate(on_legs), np.concatenate(overlaps)
    least = float(np.concatenate(on_ways).min())
    least_above_m = heights.least_above_m
    if least < least_above_m - 0.01:
        raise InputError(
            f"the flight would be {least:.0f} m above the highest ground within {BESIDE_M:g} m, "
            f"and {least_above_m:g} m must be kept; give --altitude "
            f"{np.ceil(heights.above_m + least_above_m - least):.0f} or more"
        )
    forward = 1.0 - foot.trigger_m / (foot.height_m * float(above.min()) / foot_above_m)
    top = max(float(flight.track()[:, 2].max()) - flight.home_z_m for flight in flights)
    return OverGround(
        follows=heights.follows,
        by_vehicle=heights.by_vehicle,
        nominal_m=heights.above_m,
        least_m=float(above.min()),
        most_m=float(above.max()),
        way_least_m=least,
        top_m=top,
        side_overlap=(float(np.percentile(overlap, 5)), float(np.median(overlap))),
        forward_overlap=forward,
    )
