"""Lines over the ground: turned frames, legs that cover a strip, and the direction that costs least.

In a turned frame lines run along +y and the sweep goes along +x. A leg covers its strip as a band with flat ends:
it reaches from the lowest to the highest ground in the strip, so that slanted borders leave no triangles uncovered.
"""

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import shapely

from orthoswarm.model.arrays import Array
from orthoswarm.model.errors import InputError
from orthoswarm.planning.lines.line_spacing import Footprint

Geometry = Any

MOST_LINES = 20_000

_LINE_CRUMB_M2: Final = 0.05  # smaller parts of an area get no line of their own
_STRETCH_SPACINGS: Final = 5.0  # least part of a long leg for a vehicle, in line spacings: else turns outweigh it
_EDGE_SPACINGS: Final = 0.1  # edges whose directions are tried: the outline simplified by so many spacings
_EDGE_DIRECTIONS: Final = 24  # longest edges of which the directions are tried (for its time)
_DIRECTION_STEP_DEG: Final = 15.0  # further directions are tried at this step (for its time)
_SAME_DIRECTION_DEG: Final = 1.0  # directions nearer to each other than this are tried once
_RANKED_SPACINGS: Final = 0.05  # outlines are simplified by so many line spacings before directions are ranked (time)
_SHORTEST_M: Final = 0.01  # shorter parts of lines are rounding


@dataclass(frozen=True)
class Turned:
    """A frame turned against the grid about a point."""

    angle_rad: float  # counter-clockwise from grid east to the frame's +x axis
    centre: tuple[float, float]  # grid coordinates of its origin

    @cached_property
    def _matrix(self) -> Array:
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return np.array([[c, -s], [s, c]])

    def to_frame(self, points: Array) -> Array:
        """Frame coordinates (..., 2) of grid coordinates (..., 2)."""
        return np.asarray((points - np.asarray(self.centre)) @ self._matrix)

    def to_grid(self, points: Array) -> Array:
        """Grid coordinates (..., 2) of frame coordinates (..., 2)."""
        return np.asarray(points @ self._matrix.T + np.asarray(self.centre))

    def turn(self, geometry: Geometry) -> Geometry:
        """A shapely geometry in frame coordinates."""
        return shapely.transform(geometry, self.to_frame)


@dataclass(frozen=True)
class Field:
    """Ground and obstacles in one frame."""

    ground: Geometry  # what is to be covered, shapely, metres
    obstacles: Geometry  # what no leg may cross, shapely, metres

    def turned(self, frame: Turned) -> "Field":
        """Ground and obstacles in a turned frame."""
        return Field(frame.turn(self.ground), frame.turn(self.obstacles))

    def swapped(self) -> "Field":
        """Ground and obstacles with x and y exchanged."""
        return Field(shapely.transform(self.ground, _swap), shapely.transform(self.obstacles, _swap))


def _swap(points: Array) -> Array:
    return points[:, ::-1]


def strip_legs(field: Field, box: tuple[float, float, float, float], foot: Footprint, merge_m: float) -> list[Array]:
    """Legs along the middle of an upright box that cover the ground in it, from low to high y.

    Where an obstacle lies on the line, the leg ends before it and another begins behind it.

    Args:
        field: ground and obstacles; lines run along y. box: x0, y0, x1, y1.
        foot: footprint; legs overshoot by what it needs and are at least a trigger distance long where there is room.
        merge_m: gaps between ground shorter than this are flown over with the camera on.

    Returns:
        float64 (2, 2) arrays, start and end.
    """
    piece = shapely.clip_by_rect(field.ground, *box)
    bounds = shapely.bounds([p for p in shapely.get_parts(piece) if p.area > _LINE_CRUMB_M2])
    if not len(bounds):
        return []
    x, more = 0.5 * (box[0] + box[2]), foot.overshoot_m
    reaches: list[list[float]] = []
    for low, high in sorted((b[1], b[3]) for b in bounds):
        if reaches and low - reaches[-1][1] <= merge_m:
            reaches[-1][1] = max(reaches[-1][1], high)
        else:
            reaches.append([low, high])
    legs = []
    for low, high in reaches:
        for free_low, free_high in _free_parts(field.obstacles, x, low - more, high + more):
            inside = [(max(b[1] - more, free_low), min(b[3] + more, free_high)) for b in bounds]
            seen = [(a, b) for a, b in inside if b - a > _SHORTEST_M]
            if seen:
                ends = (min(a for a, _ in seen), max(b for _, b in seen))
                legs.append(_at_least(field.obstacles, x, ends, foot.trigger_m))
    return legs


def lines_across(field: Field, foot: Footprint, multiple: int) -> list[list[Array]]:
    """The legs of each line over the whole ground, from low to high y; their number is a multiple of a number."""
    x0, y0, x1, y1 = field.ground.bounds
    edges = np.linspace(x0, x1, -(-line_count(x1 - x0, foot.spacing_m) // multiple) * multiple + 1)
    pairs = itertools.pairwise(edges)
    return [strip_legs(field, (a, y0 - 1.0, b, y1 + 1.0), foot, 0.5 * foot.spacing_m) for a, b in pairs]


def _free_parts(obstacles: Geometry, x: float, low: float, high: float) -> list[tuple[float, float]]:
    line = shapely.LineString([(x, low), (x, high)])
    free = line.difference(obstacles) if not obstacles.is_empty else line
    parts = [shapely.bounds(p) for p in shapely.get_parts(free)]
    return [(float(b[1]), float(b[3])) for b in parts if b[3] - b[1] > _SHORTEST_M]


def _at_least(obstacles: Geometry, x: float, ends: tuple[float, float], length: float) -> Array:
    """A leg of at least a length about its middle, if nothing stands in the way."""
    (low, high), slip = ends, _SHORTEST_M
    if high - low < length:
        middle = 0.5 * (low + high)
        low, high = next(
            (
                (a, b)
                for a, b in _free_parts(obstacles, x, middle - 0.5 * length, middle + 0.5 * length)
                if a <= low + slip and b >= high - slip
            ),
            ends,
        )
    return np.array([[x, low], [x, high]])


def line_count(width_m: float, spacing_m: float) -> int:
    """Lines that a width needs. Raises InputError: far more than any swarm can fly."""
    count = max(1, int(np.ceil(width_m / spacing_m - 1e-6)))
    if count > MOST_LINES:
        raise InputError(
            f"the area would need {count} lines {spacing_m:.2g} m apart; fly higher, or check area and field of view"
        )
    return count


def candidate_angles(ground: Geometry, spacing_m: float) -> Array:
    """Turning angles worth trying, radians in [0, pi): of long edges, of the tightest box, and at even steps."""
    outline = ground.simplify(_EDGE_SPACINGS * spacing_m)
    edges = [
        np.diff(shapely.get_coordinates(r), axis=0) for p in shapely.get_parts(outline) for r in shapely.get_rings(p)
    ]
    steps = np.concatenate(edges)
    length, angle = np.hypot(*steps.T), np.arctan2(steps[:, 1], steps[:, 0]) % np.pi
    found = list(angle[np.argsort(-length, kind="stable")][:_EDGE_DIRECTIONS])
    box = shapely.get_coordinates(shapely.minimum_rotated_rectangle(ground))
    found.append(float(np.arctan2(*(box[1] - box[0])[::-1]) % np.pi))
    found += list(np.radians(np.arange(0, 180, _DIRECTION_STEP_DEG)))
    # Lines run across the sweep, so a line along an edge means a sweep turned by a right angle: both are worth a try.
    both = np.array([*found, *[(a + 0.5 * np.pi) % np.pi for a in found]])
    same, distinct = np.radians(_SAME_DIRECTION_DEG), list[float]()
    for a in both:
        if all(abs((a - k + 0.5 * np.pi) % np.pi - 0.5 * np.pi) > same for k in distinct):
            distinct.append(float(a))
    return np.array(distinct)


def direction_cost(field: Field, angle_rad: float, spacing_m: float, turn_m: float) -> tuple[float, int]:
    """Rough metres to fly, turns counted as metres, and how many vehicles can share the lines of a sweep."""
    ground = Turned(angle_rad, (0.0, 0.0)).turn(field.ground)
    x0, y0, x1, y1 = ground.bounds
    count = line_count(x1 - x0, spacing_m)
    x = x0 + (x1 - x0) * (np.arange(count) + 0.5) / count
    ends = np.stack([np.stack([x, np.full(count, y0 - 1)], -1), np.stack([x, np.full(count, y1 + 1)], -1)], 1)
    cut = shapely.intersection(shapely.linestrings(ends), ground)
    lengths = shapely.length(shapely.get_parts(cut))
    cost = float(lengths.sum()) + len(lengths) * turn_m + count * spacing_m
    return cost, max(count, stretches(lengths, spacing_m))


def stretches(lengths_m: Array, spacing_m: float) -> int:
    """Among how many vehicles legs can be shared: one takes a leg, or a stretch five spacings long of a long leg."""
    return int(np.maximum(1, np.floor(lengths_m / (_STRETCH_SPACINGS * spacing_m))).sum())


def rank_directions(field: Field, foot: Footprint, turn_m: float, vehicles: int) -> list[float]:
    """Sweep angles in radians from the cheapest on; those with too few lines for the vehicles come last."""
    outline = Field(field.ground.simplify(_RANKED_SPACINGS * foot.spacing_m), field.obstacles)
    ranked = []
    for angle in candidate_angles(outline.ground, foot.spacing_m):
        cost, lines = direction_cost(outline, float(angle), foot.spacing_m, turn_m)
        ranked.append((lines < vehicles, cost, float(angle)))
    return [angle for _, _, angle in sorted(ranked)]
