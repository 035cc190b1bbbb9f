"""From an area, or given lines, to a plan for a swarm (paper III.A)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, get_args

import numpy as np
import shapely
from numpy.typing import NDArray

from orthoswarm.errors import InputError
from orthoswarm.geo import LocalGrid, area_epsg
from orthoswarm.planning import coverage
from orthoswarm.planning.area import Area
from orthoswarm.planning.bcd import bcd_legs
from orthoswarm.planning.columns import column_legs
from orthoswarm.planning.flights import Flight, make_flight
from orthoswarm.planning.footprint import Footprint
from orthoswarm.planning.motion import Motion
from orthoswarm.planning.order import shorten
from orthoswarm.planning.routes import Router, make_obstacles
from orthoswarm.planning.schedule import Separation, Slot, separate
from orthoswarm.planning.shapes import Ring
from orthoswarm.planning.split import Limits, cut, share, sorties
from orthoswarm.planning.sweep import Field, rank_directions
from orthoswarm.planning.tmstc import tmstc_legs
from orthoswarm.planning.types import End, Gap, Plan, Sortie, VehiclePlan, Waypoint

Array = NDArray[np.float64]
Method = Literal["columns", "bcd", "tmstc"]

METHODS: tuple[str, ...] = get_args(Method)
MOST_VEHICLES = 250  # MAVLink system ids


@dataclass(frozen=True)
class Options:
    """Everything about the flights that has a good default.

    Attributes:
        motion: speeds of the vehicles.
        end: what a sortie does at last: return to launch, land at home, or hover at the end of its last leg.
        starts: takeoff points as (latitude, longitude) in degrees: none (each vehicle starts where its first leg
            begins), one for all, or several that vehicles are given in turn.
        endurance_s: longest flight on one battery; infinite without a limit.
        clearance_m: distance that paths keep from no-fly zones.
        separation: how far apart vehicles stay.
        most_items: mission items that the autopilot can hold.
    """

    motion: Motion = field(default_factory=Motion)
    end: End = "rtl"
    starts: Sequence[tuple[float, float]] = ()
    endurance_s: float = float("inf")
    clearance_m: float = 2.0
    separation: Separation = field(default_factory=Separation)
    most_items: int = 650


def plan_area(
    area: Area,
    vehicles: int,
    altitude_m: float,
    foot: Footprint,
    method: Method = "tmstc",
    options: Options | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Plan:
    """Missions that cover an area.

    Args:
        area: ground and no-fly zones.
        vehicles: how many.
        altitude_m: height of the legs above takeoff, metres.
        foot: footprint of the narrowest camera at that height.
        method: how lines are laid and ordered.
        options: the rest.
        progress: told in a word what is being done.

    Raises:
        InputError: more vehicles than lines, a start in a no-fly zone, an endurance too short for the area.
    """
    options = options or Options()
    _check(vehicles, options)
    clearance = max(0.1, min(options.clearance_m, 0.125 * foot.width_m))
    router = Router(make_obstacles(area.no_fly, clearance))
    reach = min(foot.reach_m, 2.0 * clearance)
    progress("lines")
    legs, lines = _lines(Field(area.ground, router.obstacles), vehicles, foot, method, options.motion, router, reach)
    if lines < vehicles:
        raise InputError(
            f"{vehicles} vehicles are more than the {lines} lines that this area needs; "
            f"use at most {lines}, or fly lower so that lines lie closer"
        )
    slots, warnings = _assign(
        legs, vehicles, altitude_m, foot, area.grid, options, router, progress, reorder=method != "columns"
    )
    progress("coverage")
    flown = np.concatenate([_legs_of(s.flight) for row in slots for s in row])
    left = coverage.missed(area.ground, flown, foot.width_m, foot.reach_m)
    gaps = [_gap(p, area.grid) for p in coverage.pieces(left)]
    share_seen = 1.0 - float(left.area) / area.size_m2
    if share_seen < coverage.COMPLETE:
        warnings.append(
            f"only {100 * share_seen:.2f} % of the area is covered, {len(gaps)} gaps are left beside no-fly zones: "
            "this plan is not complete"
        )
    return _plan(method, slots, altitude_m, foot, area.grid, options, warnings, area.size_m2, share_seen, tuple(gaps))


def plan_lines(
    lines: Sequence[Ring],
    vehicles: int,
    altitude_m: float,
    foot: Footprint,
    no_fly: Area | None = None,
    options: Options | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Plan:
    """Missions along given lines, with pictures on their straight stretches.

    Args:
        lines: float64 (n, 2) each, latitude and longitude in degrees, flown in the order given. Stretches shorter
            than two trigger distances are flown without pictures: they are turns.
        vehicles: how many share the lines.
        altitude_m: height of the legs above takeoff, metres.
        foot: footprint of the narrowest camera at that height.
        no_fly: an area whose no-fly zones hold here, too.
        options: the rest.
        progress: told in a word what is being done.

    Raises:
        InputError: no stretch is long enough, more vehicles than stretches, or a line crosses a no-fly zone.
    """
    options = options or Options()
    _check(vehicles, options)
    points = np.concatenate(lines)
    grid = no_fly.grid if no_fly else LocalGrid(area_epsg(points[:, 0], points[:, 1]))
    paths = [grid.to_grid(line[:, 0], line[:, 1]) for line in lines]
    stretches = np.concatenate([np.stack([p[:-1], p[1:]], axis=1) for p in paths])
    legs = stretches[np.hypot(*(stretches[:, 1] - stretches[:, 0]).T) >= 2.0 * foot.trigger_m]
    if not len(legs):
        raise InputError(
            f"no stretch of the line is as long as two picture distances ({2 * foot.trigger_m:.0f} m); "
            "fly lower or draw longer lines"
        )
    router = Router(make_obstacles(no_fly.no_fly, options.clearance_m) if no_fly else shapely.MultiPolygon())
    if router.blocked(legs[:, 0], legs[:, 1]).any() or router.inside(legs.reshape(-1, 2)).any():
        raise InputError("a line crosses a no-fly zone; redraw the line or the zone")
    if len(legs) < vehicles:
        raise InputError(
            f"{vehicles} vehicles are more than the {len(legs)} straight stretches; use at most {len(legs)}"
        )
    slots, warnings = _assign(legs, vehicles, altitude_m, foot, grid, options, router, progress, reorder=False)
    return _plan("lines", slots, altitude_m, foot, grid, options, warnings, None, None, ())


def _check(vehicles: int, options: Options) -> None:
    if not 1 <= vehicles <= MOST_VEHICLES:
        raise InputError(f"{vehicles} vehicles were asked for; give a number from 1 to {MOST_VEHICLES}")
    positive = {
        "speed": options.motion.speed_m_s,
        "endurance": options.endurance_s,
        "clearance": options.clearance_m,
        "separation": options.separation.distance_m,
        "height step": options.separation.height_m,
    }
    for name, value in positive.items():
        if not value > 0.0:
            raise InputError(f"the {name} is {value:g}; give a number larger than 0")


def _lines(
    field_: Field, vehicles: int, foot: Footprint, method: Method, motion: Motion, router: Router, reach_m: float
) -> tuple[Array, int]:
    """The method's legs in flying order for the best of several directions, gaps mended; and how many lines it laid."""
    angles = rank_directions(field_, foot, motion.turn_m, vehicles)
    if method == "tmstc":  # a grid looks the same after a right angle
        quarter = [a % (0.5 * np.pi) for a in angles]
        angles = [a for k, a in enumerate(quarter) if not any(abs(a - b) < 0.02 for b in quarter[:k])]
    best: tuple[tuple[bool, float], Array, float] | None = None
    for angle in angles[: {"columns": 3, "bcd": 5, "tmstc": 4}[method]]:
        legs = _raw_legs(field_, angle, foot, method, router)
        if len(legs):
            cost = (len(legs) < vehicles, _cost(legs, router, motion))
            if best is None or cost < best[0]:
                best = (cost, legs, angle)
    if best is None:
        raise InputError("all of the area lies within the clearance of no-fly zones; reduce the clearance")
    _, legs, angle = best
    lines = len(legs)
    legs = coverage.mend(field_, legs, foot, router, reach_m, angle)
    return legs if method == "columns" else shorten(legs, router), lines


def _raw_legs(field_: Field, angle: float, foot: Footprint, method: Method, router: Router) -> Array:
    if method == "columns":
        return column_legs(field_, angle, foot)
    if method == "bcd":
        legs = bcd_legs(field_, angle, foot, router)
    else:
        legs = _chained(tmstc_legs(field_, angle, foot))
    return shorten(coverage.prune(field_, legs, foot), router) if len(legs) else legs


def _chained(loops: list[Array]) -> Array:
    """Closed rows of legs one after the other: each opened where it comes near the one before."""
    if not loops:
        return np.empty((0, 2, 2))
    first, *rest = loops
    gaps = np.hypot(*(first[:, 0] - np.roll(first[:, 1], 1, axis=0)).T)
    rows = [np.roll(first, -int(np.argmax(gaps)), axis=0)]
    while rest:
        here = rows[-1][-1, 1]
        near = [float(np.hypot(*(loop[:, 0] - here).T).min()) for loop in rest]
        loop = rest.pop(int(np.argmin(near)))
        rows.append(np.roll(loop, -int(np.argmin(np.hypot(*(loop[:, 0] - here).T))), axis=0))
    return np.concatenate(rows)


def _cost(legs: Array, router: Router, motion: Motion) -> float:
    """Metres to fly a row of legs, turns counted as metres."""
    ways = router.each(legs[:-1, 1], legs[1:, 0]).sum()
    return float(np.hypot(*(legs[:, 1] - legs[:, 0]).T).sum() + ways + motion.turn_m * len(legs))


def _assign(
    legs: Array,
    vehicles: int,
    altitude_m: float,
    foot: Footprint,
    grid: LocalGrid,
    options: Options,
    router: Router,
    progress: Callable[[str], None],
    *,
    reorder: bool,
) -> tuple[list[list[Slot]], list[str]]:
    """Vehicles' sorties with their layers and takeoff times, and warnings."""
    motion, returns = options.motion, options.end != "hover"
    starts = _starts(options.starts, vehicles, grid, router)
    limits = _limits(altitude_m, options, returns)
    progress("shares")
    least = 4.0 * foot.trigger_m
    row = cut(legs, router, motion, vehicles, least)
    pieces = share(row, vehicles, starts, returns, router, motion, limits)
    if pieces is None:
        raise _too_short(options)
    makers: list[list[Callable[[float], Flight]]] = []
    warnings: list[str] = []
    for vehicle, (begin, end) in enumerate(pieces):
        mine = row.legs(begin, end)
        home = mine[0, 0] if starts is None else starts[vehicle]
        if reorder:
            mine = shorten(mine, router, home) if starts is not None and returns else mine
        flights = _flights(mine, home, altitude_m, foot, options, limits, router)
        if len(flights) > 1 and not np.isfinite(options.endurance_s):
            warnings.append(
                f"vehicle v{vehicle + 1} flies {len(flights)} sorties because one mission holds at most "
                f"{options.most_items} items"
            )
        makers.append([partial(_maker, f, home, altitude_m, router, returns) for f in flights])
    progress("separation")
    return separate(makers, motion, options.separation), warnings


def _maker(legs: Array, home: Array, altitude_m: float, router: Router, returns: bool, layer_m: float) -> Flight:
    return make_flight(legs, home, altitude_m, layer_m, router, returns)


def _starts(given: Sequence[tuple[float, float]], vehicles: int, grid: LocalGrid, router: Router) -> Array | None:
    if not given:
        return None
    lat_lon = np.asarray(given, np.float64)
    if not np.isfinite(lat_lon).all() or (np.abs(lat_lon) > [90.0, 180.0]).any():
        raise InputError("a start is no latitude and longitude; give it as LAT,LON in degrees")
    places = grid.to_grid(lat_lon[:, 0], lat_lon[:, 1])
    if router.inside(places).any():
        raise InputError("a start lies in a no-fly zone; move it out")
    return places[np.arange(vehicles) % len(places)]


def _limits(altitude_m: float, options: Options, returns: bool) -> Limits:
    motion, apart = options.motion, options.separation
    top = altitude_m + apart.layers * apart.height_m  # whatever layer the schedule gives
    fixed = top / motion.climb_m_s + motion.speed_m_s / motion.acceleration_m_s2
    fixed += (top / motion.descent_m_s + apart.layers * apart.height_m / motion.climb_m_s) if returns else 0.0
    return Limits(options.endurance_s, fixed, apart.swap_s, max(1, (options.most_items - 40) // 4))


def _flights(
    legs: Array, home: Array, altitude_m: float, foot: Footprint, options: Options, limits: Limits, router: Router
) -> list[Array]:
    """A vehicle's legs, cut into as many flights as endurance and mission size ask for."""
    returns, motion = options.end != "hover", options.motion
    top = options.separation.layers * options.separation.height_m
    least = 4.0 * foot.trigger_m
    for _ in range(12):
        step = least
        if np.isfinite(limits.endurance_s):
            step = min(max(limits.endurance_s * motion.speed_m_s / 40.0, foot.trigger_m), least)
        total = float(np.hypot(*(legs[:, 1] - legs[:, 0]).T).sum())
        row = cut(legs, router, motion, 1, min(least, step), max(step, total / 2000.0))
        found = sorties(row, home, returns, router, motion, limits)
        if found is None:
            raise _too_short(options)
        result = [row.legs(a, b) for a, b in found]
        made = [make_flight(f, home, altitude_m, top, router, returns) for f in result]
        longest, most = max(f.time_s(motion) for f in made), max(f.items for f in made)
        if longest <= options.endurance_s and most <= options.most_items:
            return result
        shorter = 0.995 * limits.endurance_s * min(1.0, options.endurance_s / longest)
        fewer = limits.most_legs if most <= options.most_items else limits.most_legs * options.most_items // most
        limits = Limits(shorter, limits.fixed_s, limits.swap_s, max(1, fewer))
    raise _too_short(options)


def _too_short(options: Options) -> InputError:
    return InputError(
        f"the endurance of {options.endurance_s / 60:.1f} min is too short to reach the far end and come back; "
        "start nearer, fly faster or lower, or use larger batteries"
    )


def _legs_of(flight: Flight) -> Array:
    return np.stack([flight.points[flight.camera == 1, :2], flight.points[flight.camera == -1, :2]], axis=1)


def _gap(piece: coverage.Geometry, grid: LocalGrid) -> Gap:
    point = shapely.point_on_surface(piece)
    lat, lon = grid.to_geographic([point.x, point.y])
    return Gap(round(float(lat), 7), round(float(lon), 7), round(float(piece.area), 1))


def _sortie(slot: Slot, foot: Footprint, grid: LocalGrid, motion: Motion) -> Sortie:
    flight = slot.flight
    home = grid.to_geographic(flight.home)
    places = grid.to_geographic(flight.points[:, :2])
    marks = {1: True, -1: False, 0: None}
    waypoints = tuple(
        Waypoint(float(lat), float(lon), float(height), marks[int(mark)])
        for (lat, lon), height, mark in zip(places, flight.points[:, 2], flight.camera, strict=True)
    )
    legs = _legs_of(flight)
    photos = int((np.hypot(*(legs[:, 1] - legs[:, 0]).T) / foot.trigger_m + 1e-6).astype(int).sum()) + len(legs)
    return Sortie(
        float(home[0]),
        float(home[1]),
        flight.climb_m,
        waypoints,
        slot.start_s,
        flight.time_s(motion),
        flight.length_m,
        flight.turns,
        photos,
    )


def _plan(
    method: str,
    slots: list[list[Slot]],
    altitude_m: float,
    foot: Footprint,
    grid: LocalGrid,
    options: Options,
    warnings: list[str],
    area_m2: float | None,
    covered: float | None,
    gaps: tuple[Gap, ...],
) -> Plan:
    made = tuple(
        VehiclePlan(number, tuple(_sortie(s, foot, grid, options.motion) for s in row))
        for number, row in enumerate(slots, start=1)
    )
    return Plan(
        method=method,
        vehicles=made,
        altitude_m=altitude_m,
        speed_m_s=options.motion.speed_m_s,
        trigger_m=foot.trigger_m,
        spacing_m=foot.spacing_m,
        footprint_m=(foot.width_m, foot.height_m),
        end=options.end,
        epsg=grid.epsg,
        area_m2=area_m2,
        covered_share=covered,
        gaps=gaps,
        separation=_separation_text(slots, altitude_m, options.separation),
        warnings=tuple(warnings),
    )


def _separation_text(slots: list[list[Slot]], altitude_m: float, apart: Separation) -> str:
    first = [row[0] for row in slots]
    if len(first) == 1:
        return "a single vehicle"
    layers = [s.layer for row in slots for s in row]
    delays = [s.start_s for s in first]
    text = (
        f"at any time at least {apart.distance_m:g} m apart, or {apart.height_m:g} m in height, "
        f"even {apart.slack_s:g} s off schedule"
    )
    if any(layers):
        top = altitude_m + max(layers) * apart.height_m
        text += f"; {sum(map(bool, layers))} sorties fly out and home higher than the lines, up to {top:g} m"
    if any(delays):
        text += f"; {sum(map(bool, delays))} vehicles take off later than the first, up to {max(delays):g} s"
    return text
