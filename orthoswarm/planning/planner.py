"""From an area, or given lines, to a plan for a swarm (paper III.A)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import shapely

from orthoswarm.model.arrays import Array
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.model.placement import Terrain
from orthoswarm.model.plan import Apart, Gap, OverGround, Plan, Sortie, VehiclePlan, Waypoint
from orthoswarm.planning.area.area import Area, coarser
from orthoswarm.planning.area.shape_files import Ring
from orthoswarm.planning.lines import planned_coverage
from orthoswarm.planning.lines.candidates import METHODS, Method, candidates
from orthoswarm.planning.lines.detours import Router, make_obstacles
from orthoswarm.planning.lines.line_spacing import Footprint
from orthoswarm.planning.lines.sweep_lines import Field, stretches
from orthoswarm.planning.lines.visiting_order import shorten
from orthoswarm.planning.sorties.assignment import PlanOptions, Swarm, Work
from orthoswarm.planning.sorties.deconfliction import Schedule, Separation, Slot
from orthoswarm.planning.sorties.flight_heights import BESIDE_M, FlightHeights, LevelHeights, profile_step_m
from orthoswarm.planning.sorties.flight_path import Flight
from orthoswarm.planning.sorties.flight_time import Motion

__all__ = ["METHODS", "Method", "PlanOptions", "plan_area", "plan_gaps", "plan_lines"]

Progress = Callable[[str], None]

_OUTLINE_SPACINGS: Final = 0.05  # the outline of an area with many corners is at most twice so many spacings outside it
_FAIR_ENOUGH: Final = 1.25  # from here on the plan says that it is uneven
_BETTER_SHARE: Final = 0.99  # a later candidate must be better by this factor
_CLEARANCE_M: Final = 1.0  # distance that is kept from no-fly zones where none is asked for ...
_CLEARANCE_WIDTHS: Final = 0.125  # at most so many widths of a picture from no-fly zones
_LEAST_CLEARANCE_M: Final = 0.1  # least clearance, however narrow a picture is
Geometry = Any
_EDGE_ROUNDS: Final = 12  # bisections of the highest ground between two places of a profile (to millimetres)


@dataclass(frozen=True)
class _Over:
    """What a plan's flights lie over."""

    above_m: float  # height above level ground at which `foot` was made
    foot: Footprint  # footprint of the narrowest camera
    heights: FlightHeights  # of the flights

    def missed(self, wanted: planned_coverage.Geometry, slots: list[list[Slot]]) -> planned_coverage.Geometry:
        """What of the wanted ground no picture is certain to see, a shapely geometry."""
        flights = [s.flight for row in slots for s in row]
        if self.heights.ground is None:
            flown = np.concatenate([_legs_of(flight) for flight in flights])
            return planned_coverage.missed(wanted, flown, self.foot.width_m, self.foot.reach_m)
        paths = [path for flight in flights for path in leg_paths(flight)]
        return wanted.difference(shapely.union_all(swaths(paths, self.heights.ground, self.foot, self.above_m)))

    def checked(self, slots: list[list[Slot]]) -> OverGround | None:
        """How the flights lie over the height model, None without one.

        Raises InputError: lower than `heights.least_above_m` above it.
        """
        if self.heights.ground is None:
            return None
        return over_ground([s.flight for row in slots for s in row], self.heights, self.foot, self.above_m)


def plan_area(
    area: Area,
    vehicles: int,
    altitude_m: float,
    foot: Footprint,
    *,
    method: Method = "bcd",
    options: PlanOptions | None = None,
    progress: Progress = lambda _: None,
    heights: FlightHeights | None = None,
) -> Plan:
    """Missions that cover an area.

    Args:
        area: ground and no-fly zones. vehicles: how many.
        altitude_m: height of the legs above takeoff, metres; with `heights`, that above level ground at which `foot`
            was made. foot: footprint of the narrowest camera at that height. method: how lines are laid and ordered.
        options: the rest. progress: called with what is being done.
        heights: of the flights over a height model; None for level ground at takeoff.

    Raises:
        InputError: more vehicles than lines, a start in a no-fly zone, an endurance too short for the area.
    """
    options = options or PlanOptions()
    options.check()
    over = _Over(altitude_m, foot, heights or LevelHeights(altitude_m))
    clearance_m = _clearance_m(options, foot)
    router = Router(make_obstacles(area.no_fly, clearance_m))
    swarm = Swarm(vehicles, over.heights, foot=foot, grid=area.grid, router=router, options=options)

    def incomplete(gaps: tuple[Gap, ...], missed_m2: float, seen: float) -> list[str]:
        if seen >= planned_coverage.COMPLETE_SHARE:
            return []
        return [
            f"only {100 * seen:.2f} % of the area is covered and {len(gaps)} gaps are left: this plan is not complete; "
            "reduce the clearance or the no-fly zones, or fly lower"
        ]

    progress("lines")
    best = _best_work(
        area, swarm, foot, method=method, options=options, router=router, reach_m=min(foot.reach_m, 2.0 * clearance_m),
    )  # fmt: skip
    return _plan(
        method, best, swarm, over, grid=area.grid, options=options, progress=progress, area=area, said=incomplete
    )


def _clearance_m(options: PlanOptions, foot: Footprint) -> float:
    """Distance from no-fly zones: that of the user, or a default that leaves small pictures no gaps."""
    usual = min(_CLEARANCE_M, _CLEARANCE_WIDTHS * foot.width_m)
    return options.clearance_m or max(_LEAST_CLEARANCE_M, usual)


def _best_work(
    area: Area, swarm: Swarm, foot: Footprint, *, method: Method, options: PlanOptions, router: Router, reach_m: float
) -> Work:
    """The fairest and shortest work among the method's candidates."""
    field = Field(coarser(area, _OUTLINE_SPACINGS * foot.spacing_m), router.obstacles)
    best: Work | None = None
    most = 0
    for candidate in candidates(
        field,
        swarm.vehicles,
        foot,
        method=method,
        turn_m=options.motion.turn_m,
        router=router,
        reach_m=reach_m,
        sweep_rad=_sweep_rad(area, options),
        cross=options.cross,
    ):
        most = max(most, candidate.stretches)
        if candidate.stretches >= swarm.vehicles:
            work = swarm.share(candidate.legs, method != "columns")
            best = work if best is None or work.score < _BETTER_SHARE * best.score else best
    if best is not None:
        return best
    if not most:
        raise InputError("all of the area lies within the clearance of no-fly zones; reduce the clearance")
    raise InputError(
        f"{swarm.vehicles} vehicles are more than this area has lines for; "
        f"use {most} or fewer, or fly lower so that lines lie closer"
    )


def _sweep_rad(area: Area, options: PlanOptions) -> float | None:
    """Direction of the sweep, across the lines, from grid east, counter-clockwise; None where it is free."""
    heading = options.heading
    if heading is None:
        return None
    if heading == "longest":
        corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(area.ground))
        east, north = max(np.diff(corners[:3], axis=0), key=lambda side: float(np.hypot(*side)))
        return float(np.arctan2(-east, north) % np.pi)
    azimuth = np.arctan2(*options.motion.wind_m_s) if heading == "wind" else np.radians(heading)
    middle = area.grid.to_geographic(shapely.get_coordinates(area.ground.centroid)[0])
    return float((area.grid.convergence_rad(*middle) - azimuth) % np.pi)


def plan_gaps(
    area: Area,
    vehicles: int,
    altitude_m: float,
    foot: Footprint,
    *,
    options: PlanOptions | None = None,
    progress: Progress = lambda _: None,
    heights: FlightHeights | None = None,
) -> Plan:
    """Missions that cover separate pieces of ground, each by the shortest parallel legs that see it.

    Other arguments are as of `plan_area`.

    Args:
        area: the pieces, grown by the margin that they need, and no-fly zones.
        vehicles: how many there are; fewer are used where there are fewer legs.

    Raises:
        InputError: no piece can be reached, a start in a no-fly zone, an endurance too short.
    """
    options = options or PlanOptions()
    options.check()
    over = _Over(altitude_m, foot, heights or LevelHeights(altitude_m))
    router = Router(make_obstacles(area.no_fly, _clearance_m(options, foot)))
    progress("lines")
    found = [_gap_legs(piece, router, foot) for piece in planned_coverage.pieces(area.ground)]
    legs = np.concatenate([np.empty((0, 2, 2)), *found])
    if not len(legs):
        raise InputError("all of the gaps lie within the clearance of no-fly zones; reduce the clearance")
    most = stretches(np.hypot(*(legs[:, 1] - legs[:, 0]).T), foot.spacing_m)
    swarm = Swarm(min(vehicles, most), over.heights, foot=foot, grid=area.grid, router=router, options=options)
    work = swarm.share(shorten(legs, router, None if swarm.starts is None else swarm.starts[0]), True)

    def unseen(gaps: tuple[Gap, ...], missed_m2: float, seen: float) -> list[str]:
        said = [f"{most} of the {vehicles} vehicles are enough for these gaps"] if most < vehicles else []
        if gaps:
            said.append(f"{missed_m2:.0f} square metres of the gaps cannot be seen from where flying is allowed")
        return said

    return _plan("gaps", work, swarm, over, grid=area.grid, options=options, progress=progress, area=area, said=unseen)


def _gap_legs(piece: planned_coverage.Geometry, router: Router, foot: Footprint) -> Array:
    """Legs over one gap: a single one where a picture is as wide as the gap, else with the usual overlap."""
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(piece))
    sides = np.hypot(*np.diff(corners, axis=0).T)
    apart = foot if sides.min() <= foot.width_m else replace(foot, width_m=foot.spacing_m)
    edge = corners[1] - corners[0] if sides[0] >= sides[1] else corners[2] - corners[1]
    angle = float(np.arctan2(edge[1], edge[0]) - np.pi / 2)
    return planned_coverage.legs_for(piece, router.obstacles, apart, foot.reach_m, angle)[0]


def plan_lines(
    lines: Sequence[Ring],
    vehicles: int,
    altitude_m: float,
    foot: Footprint,
    *,
    no_fly: Area | None = None,
    options: PlanOptions | None = None,
    progress: Progress = lambda _: None,
    heights: FlightHeights | None = None,
) -> Plan:
    """Missions along given lines, with pictures on their straight stretches; other arguments are as of `plan_area`.

    Args:
        lines: float64 (n, 2) each, latitude and longitude in degrees, flown in the order given. Stretches shorter
            than two trigger distances are flown without pictures: they are turns. vehicles: how many share the lines.
        no_fly: an area whose no-fly zones hold here, too.

    Raises:
        InputError: no stretch is long enough, more vehicles than stretches, or a line crosses a no-fly zone.
    """
    options = options or PlanOptions()
    options.check()
    over = _Over(altitude_m, foot, heights or LevelHeights(altitude_m))
    points = np.concatenate(lines)
    grid = no_fly.grid if no_fly else LocalGrid(area_epsg(points[:, 0], points[:, 1]))
    paths = [grid.to_grid(line[:, 0], line[:, 1]) for line in lines]
    straight = np.concatenate([np.stack([p[:-1], p[1:]], axis=1) for p in paths])
    legs = straight[np.hypot(*(straight[:, 1] - straight[:, 0]).T) >= 2.0 * foot.trigger_m]
    if not len(legs):
        raise InputError(
            f"no stretch of the line is as long as two picture distances ({2 * foot.trigger_m:.0f} m); "
            "fly lower or draw longer lines"
        )
    clearance = options.clearance_m or _CLEARANCE_M
    router = Router(make_obstacles(no_fly.no_fly, clearance) if no_fly else shapely.MultiPolygon())
    if router.blocked(legs[:, 0], legs[:, 1]).any() or router.inside(legs.reshape(-1, 2)).any():
        raise InputError("a line crosses a no-fly zone; redraw the line or the zone")
    most = stretches(np.hypot(*(legs[:, 1] - legs[:, 0]).T), foot.spacing_m)
    if most < vehicles:
        raise InputError(
            f"{vehicles} vehicles are more than the {most} straight stretches; use at most {most} vehicles"
        )
    progress("lines")
    swarm = Swarm(vehicles, over.heights, foot=foot, grid=grid, router=router, options=options)
    work = swarm.share(legs, reorder=False)
    return _plan("lines", work, swarm, over, grid=grid, options=options, progress=progress)


def _warnings(schedule: Schedule, work: Work, foot: Footprint, options: PlanOptions) -> list[str]:
    result = []
    every_s = foot.trigger_m / options.motion.speed_m_s
    if every_s < options.quickest_s:
        result.append(
            f"a picture every {every_s:.2f} s is more than cameras take that need {options.quickest_s:g} s; fly slower "
            "or higher, or with less forward overlap"
        )
    if work.balance > _FAIR_ENOUGH:
        result.append(
            f"the longest path is {work.balance:.2f} times the mean: few lines, or long ways out and home, "
            "cannot be shared more evenly"
        )
    several = [f"v{number}" for number, row in enumerate(schedule.slots, start=1) if len(row) > 1]
    if several and not options.endurances_s and not np.isfinite(options.endurance_s):
        result.append(
            f"one mission holds at most {options.most_items} items, so {', '.join(several)} must fly several sorties"
        )
    if not schedule.in_turn:
        apart = options.separation
        result.append(
            f"vehicles of one start take off and land beside each other, {apart.launch_s:g} s apart: in turn, all "
            f"would be done at least {schedule.saved_s / 60:.1f} min later; give each its own start, "
            f"{apart.distance_m:g} m or more from the next"
        )
    return result


def _legs_of(flight: Flight) -> Array:
    return np.stack([flight.points[flight.camera == 1, :2], flight.points[flight.camera == -1, :2]], axis=1)


def _gap(piece: planned_coverage.Geometry, grid: LocalGrid) -> Gap:
    point = shapely.point_on_surface(piece)
    lat, lon = grid.to_geographic([point.x, point.y])
    return Gap(round(float(lat), 7), round(float(lon), 7), round(float(piece.area), 1))


def _sortie(slot: Slot, foot: Footprint, grid: LocalGrid, motion: Motion) -> Sortie:
    flight = slot.flight
    home = grid.to_geographic(flight.home)
    marks = {1: True, -1: False, 0: None}
    places = grid.to_geographic(flight.points[:, :2])
    waypoints = tuple(
        Waypoint(
            lat_deg=float(places[k, 0]),
            lon_deg=float(places[k, 1]),
            height_m=float(flight.points[k, 2] - flight.home_z_m),
            camera=marks[int(flight.camera[k])],
            above_ground_m=None if np.isnan(flight.above_m[k]) else float(flight.above_m[k]),
            between=bool(flight.between[k]),
            wait_s=flight.wait_s if k == flight.last_leg_end else 0.0,
        )
        for k in range(len(places))
    )
    length = np.hypot(*np.diff(_legs_of(flight), axis=1)[:, 0].T)
    return Sortie(
        home_lat_deg=float(home[0]), home_lon_deg=float(home[1]), takeoff_height_m=flight.climb_m - flight.home_z_m,
        waypoints=waypoints, start_s=slot.start_s, time_s=flight.time_s(motion), length_m=flight.length_m,
        turns=flight.turns, photos=int((length / foot.trigger_m + 1e-6).astype(int).sum()) + len(length),
    )  # fmt: skip


def _plan(
    method: str,
    work: Work,
    swarm: Swarm,
    over: _Over,
    *,
    grid: LocalGrid,
    options: PlanOptions,
    progress: Progress,
    area: Area | None = None,
    said: Callable[[tuple[Gap, ...], float, float], list[str]] = lambda gaps, missed_m2, seen: [],
) -> Plan:
    """The plan of shared work: its times and layers, and how much of an area it covers.

    `said`: warnings by the gaps left, the square metres missed and the share seen.
    """
    progress("separation")
    schedule = swarm.schedule(work)
    warnings = _warnings(schedule, work, over.foot, options)
    area_m2: float | None = None
    share: float | None = None
    gaps: tuple[Gap, ...] = ()
    if area is not None:
        progress("coverage")
        left = over.missed(area.ground, schedule.slots)
        gaps = tuple(_gap(p, grid) for p in planned_coverage.pieces(left))
        area_m2, share = area.size_m2, 1.0 - float(left.area) / area.size_m2
        warnings += said(gaps, float(left.area), share)
    foot, level_m = over.foot, over.heights.above_m if over.heights.follows else over.heights.at(np.zeros(2), 0.0)
    made = tuple(
        VehiclePlan(number, tuple(_sortie(s, foot, grid, options.motion_of(number - 1)) for s in row))
        for number, row in enumerate(schedule.slots, start=1)
    )
    return Plan(
        method=method, vehicles=made, altitude_m=level_m, speed_m_s=options.motion.speed_m_s, trigger_m=foot.trigger_m,
        spacing_m=foot.spacing_m, footprint_m=(foot.width_m, foot.height_m), end=options.end, epsg=grid.epsg,
        area_m2=area_m2, covered_share=share, gaps=gaps,
        separation=_separation_text(schedule, level_m, options.separation), warnings=tuple(warnings),
        over_ground=over.checked(schedule.slots),
        apart=Apart(options.separation.distance_m, options.separation.height_m),
    )  # fmt: skip


def _separation_text(schedule: Schedule, altitude_m: float, apart: Separation) -> str:
    slots = schedule.slots
    if len(slots) == 1:
        return "a single vehicle"
    layers = [max(s.out_layer, s.home_layer) for row in slots for s in row]
    delays = [row[0].start_s for row in slots]
    text = (
        f"at any time at least {apart.distance_m:g} m apart, or {apart.height_m:g} m in height, "
        f"even {apart.slack_s:g} s off schedule"
    )
    homes = np.array([row[0].flight.home for row in slots])
    if any(np.hypot(*(homes[:k] - homes[k]).T).min() < apart.distance_m for k in range(1, len(homes))):
        after = "in turn" if schedule.in_turn else f"{apart.launch_s:g} s after each other"
        text += f"; at one start they stand some metres apart and take off and land {after}"
    if any(layers):
        top = altitude_m + max(layers) * apart.height_m
        text += f"; ways out or home higher than the lines, up to {top:g} m: {sum(map(bool, layers))}"
    if any(delays):
        text += f"; takeoffs later than the first, up to {max(delays):g} s: {sum(map(bool, delays))}"
    return text


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
        follows=heights.follows, by_vehicle=heights.by_vehicle, nominal_m=heights.above_m, least_m=float(above.min()),
        most_m=float(above.max()), way_least_m=least, top_m=top,
        side_overlap=(float(np.percentile(overlap, 5)), float(np.median(overlap))), forward_overlap=forward,
    )  # fmt: skip
