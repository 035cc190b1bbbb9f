"""Is every point of the area seen by the narrowest camera? What is missed, and legs that mend it."""

from typing import Any, Final

import numpy as np
import shapely

from orthoswarm.model.arrays import Array
from orthoswarm.planning.lines.detours import Router
from orthoswarm.planning.lines.line_spacing import Footprint
from orthoswarm.planning.lines.sweep_lines import Field, Turned, strip_legs

Geometry = Any

COMPLETE_SHARE: Final = 0.999  # share of an area from which on a plan covers it
_TARGET_SHARE: Final = 0.9996  # share up to which gaps are mended: above the other for errors of the flight
_REPAIR_ROUNDS: Final = 5  # most rounds of mending (for its time)
_REPAIR_PLACES: Final = 8  # places in the order of legs where one that mends a gap is tried (time)
_CRUMB_M2: Final = 0.5  # smaller gaps are none: rounding of outlines
_GAP_LEAST_SHARE: Final = 0.2  # a gap of which further legs would show a smaller share is left as it is
_GAP_WALLS: Final = 8  # longest edges, of the gap and of obstacles around it, along which legs for it are tried (time)
_GAP_SHIFTS: Final = 7  # places across a gap at which they are tried (for its time)
_GAP_LEG_PRICE: Final = 0.02  # price of a line spacing of flight, in shares of the gap


def bands(legs: Array, width_m: float, reach_m: float) -> Geometry:
    """The ground seen from each leg: an array of n shapely rectangles.

    legs: float64 (n, 2, 2). width_m: width across the leg. reach_m: how far a band goes on beyond the leg's ends.
    """
    step = legs[:, 1] - legs[:, 0]
    along = step / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    across = along[:, ::-1] * [-0.5 * width_m, 0.5 * width_m]
    a, b = legs[:, 0] - reach_m * along, legs[:, 1] + reach_m * along
    return shapely.polygons(np.stack([a + across, b + across, b - across, a - across], axis=1))


def missed(ground: Geometry, legs: Array, width_m: float, reach_m: float) -> Geometry:
    """What of the ground no band sees, as a shapely geometry."""
    if not len(legs):
        return ground
    return ground.difference(shapely.union_all(bands(legs, width_m, reach_m)))


def pieces(geometry: Geometry) -> list[Geometry]:
    """Polygons in a geometry, largest first, without crumbs."""
    parts = [p for p in shapely.get_parts(shapely.get_parts(geometry)) if p.geom_type == "Polygon"]
    return sorted((p for p in parts if p.area >= _CRUMB_M2), key=lambda p: -p.area)


def prune(field: Field, legs: Array, foot: Footprint) -> Array:
    """Legs without the short ones whose band the others see anyway."""
    keep = np.ones(len(legs), bool)
    length = np.hypot(*(legs[:, 1] - legs[:, 0]).T)
    boxes = bands(legs, foot.width_m, 0.0)
    tree = shapely.STRtree(boxes)
    for k in np.argsort(length, kind="stable"):
        if length[k] > 0.5 * foot.spacing_m:
            break
        near = [n for n in tree.query(boxes[k]) if n != k and keep[n]]
        own = boxes[k].intersection(field.ground)
        if own.difference(shapely.union_all(boxes[near])).area < _CRUMB_M2:
            keep[k] = False
    return legs[keep] if keep.any() else legs


def mend(field: Field, legs: Array, foot: Footprint, *, router: Router, reach_m: float, angle_rad: float) -> Array:
    """Legs with more put in, each where it costs the least detour, until hardly anything is missed.

    Gaps arise beside obstacles with slanted walls, where a line must stop although its band's edge could go on.

    Args:
        field: ground and obstacles, grid metres. legs: float64 (n, 2, 2) in flying order.
        foot: footprint of the narrowest camera. router: measures detours.
        reach_m: how far pictures count beyond a leg's ends.
        angle_rad: the sweep's direction, one of those tried for further legs.
    """
    hopeless: list[Geometry] = []
    ways = router.each(legs[:-1, 1], legs[1:, 0])
    for _ in range(_REPAIR_ROUNDS):
        left = missed(field.ground, legs, foot.width_m, reach_m)
        if left.area <= (1.0 - _TARGET_SHARE) * field.ground.area:
            break
        excess, added = left.area - (1.0 - _TARGET_SHARE) * field.ground.area, False
        for gap in pieces(left):
            if excess <= 0.0 or any(h.contains(gap.centroid) for h in hopeless):
                continue
            more, gained = legs_for(gap, field.obstacles, foot, reach_m, angle_rad)
            if gained < _GAP_LEAST_SHARE * gap.area:
                hopeless.append(gap)
                continue
            excess -= gained
            added = True
            for leg in more:
                legs, ways = insert(legs, ways, leg, router)
        if not added:
            break
    return legs


def legs_for(gap: Geometry, obstacles: Geometry, foot: Footprint, reach_m: float, angle: float) -> tuple[Array, float]:
    """The parallel legs that see most of a gap for their length, float64 (n, 2, 2), and what they see, square metres.

    Args:
        gap: shapely Polygon, grid metres. obstacles: what no leg may cross. foot: footprint of the narrowest camera,
            its width is the distance of the legs. reach_m: how far pictures count beyond a leg's ends.
        angle: a direction that is tried besides those of the gap and of the obstacles around it, radians.
    """
    around = gap.buffer(2.0 * foot.width_m)
    obstacles = shapely.MultiPolygon([p for p in shapely.get_parts(obstacles) if p.intersects(around)])
    near = obstacles.intersection(gap.buffer(foot.width_m))
    box = shapely.get_coordinates(shapely.minimum_rotated_rectangle(gap))
    edges = [np.diff(shapely.get_coordinates(r), axis=0) for p in pieces(near) for r in shapely.get_rings(p)]
    walls = np.concatenate([np.diff(box[:3], axis=0), *edges]) if len(box) > 2 else np.array([[1.0, 0.0]])
    walls = walls[np.argsort(-np.hypot(*walls.T))][:_GAP_WALLS]
    # Lines run along +y of a turned frame: a wall's direction less a right angle.
    angles = np.unique(np.round([*(np.arctan2(walls[:, 1], walls[:, 0]) - np.pi / 2) % np.pi, angle % np.pi], 3))
    best: tuple[float, Array, float] = (-np.inf, np.empty((0, 2, 2)), 0.0)
    for a in angles:
        frame = Turned(float(a), (gap.centroid.x, gap.centroid.y))
        local = Field(frame.turn(gap), frame.turn(obstacles))
        x0, y0, x1, y1 = local.ground.bounds
        count = max(1, int(np.ceil((x1 - x0) / foot.width_m - 1e-6)))
        play = max(0.0, 0.5 * (count * foot.width_m - (x1 - x0)))
        for shift in np.linspace(-play, play, _GAP_SHIFTS):
            middle = 0.5 * (x0 + x1) + shift + foot.width_m * (np.arange(count) - 0.5 * (count - 1))
            new = [
                leg
                for x in middle
                for leg in strip_legs(
                    local, (x - 0.5 * foot.width_m, y0 - 1, x + 0.5 * foot.width_m, y1 + 1), foot, foot.spacing_m
                )
            ]
            if not new:
                continue
            legs = np.array(new)
            seen = local.ground.area - missed(local.ground, legs, foot.width_m, reach_m).area
            cost = float(np.hypot(*(legs[:, 1] - legs[:, 0]).T).sum()) + 2.0 * foot.spacing_m * len(legs)
            score = seen / local.ground.area - _GAP_LEG_PRICE * cost / foot.spacing_m
            if score > best[0] and seen > 0.0:
                best = (score, frame.to_grid(legs), seen)
    return best[1], best[2]


def insert(legs: Array, ways: Array, leg: Array, router: Router) -> tuple[Array, Array]:
    """Put a further leg, in its better direction, where the row grows least.

    Args:
        legs: float64 (n, 2, 2) in flying order, at least one. ways: float64 (n - 1,), lengths of the ways between them.
        leg: float64 (2, 2). router: measures ways around obstacles.

    Returns:
        Legs and ways with the new one.
    """
    n = len(legs)
    # Straight distances never exceed the ways around: they tell the few places that are worth measuring.
    to = np.hypot(*(legs[:, 1, None] - leg[None]).transpose(2, 0, 1))
    away = np.hypot(*(leg[None] - legs[:, 0, None]).transpose(2, 0, 1))
    straight = np.full((n + 1, 2), 0.0)
    straight[1:] += to
    straight[:-1] += away[:, ::-1]
    straight[1:n] -= ways[:, None]
    best, place, turned = np.inf, 0, 0
    for k, t in sorted(np.ndindex(n + 1, 2), key=lambda kt: float(straight[kt]))[:_REPAIR_PLACES]:
        growth = float(router.distances(legs[k - 1, 1], leg[t])[0, 0]) if k > 0 else 0.0
        growth += float(router.distances(leg[1 - t], legs[k, 0])[0, 0]) if k < n else 0.0
        growth -= float(ways[k - 1]) if 0 < k < n else 0.0
        if growth < best:
            best, place, turned = growth, k, t
    new = np.insert(legs, place, leg[::-1] if turned else leg, axis=0)
    near = slice(max(0, place - 1), min(n, place + 1))
    fresh = router.each(new[:-1, 1][near], new[1:, 0][near])
    return new, np.concatenate([ways[: max(0, place - 1)], fresh, ways[place:]])
