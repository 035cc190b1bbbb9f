"""A plan from the values that a user gives, on the command line or over HTTP, with the ground below and its fences."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from gcs_plugin.mission.makers.litchi import MOST_POINTS
from gcs_plugin.mission.makers.maker_files import LITCHI, MAKERS
from gcs_plugin.plans.area_files import NoFly, read_no_fly, read_shapes
from orthoswarm.config import DEFAULT, Config
from orthoswarm.coverage.missing_pictures import Cause
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.model.placement import Terrain
from orthoswarm.model.plan import APART, End, Fence, Plan, Sortie, VehiclePlan
from orthoswarm.planning.area.area import Area, make_area
from orthoswarm.planning.area.shape_files import Polygon, Ring, Shapes, counted, parse_geojson
from orthoswarm.planning.lines.candidates import Method
from orthoswarm.planning.lines.line_spacing import Footprint, footprint
from orthoswarm.planning.planner import plan_area, plan_gaps, plan_lines
from orthoswarm.planning.relief_plan import GroundBelow, Relief, plan_over_relief
from orthoswarm.planning.sorties.assignment import Heading, PlanOptions
from orthoswarm.planning.sorties.deconfliction import Separation
from orthoswarm.planning.sorties.flight_heights import BESIDE_M, FlightHeights
from orthoswarm.planning.sorties.flight_time import Motion
from orthoswarm.raster.height_model import DEM_MOST_NODES, HeightModel

AUTOPILOTS: Final = ("ardupilot", "px4", *MAKERS)
METHODS: Final = ("columns", "bcd", "tmstc")
WITH_TERRAIN: Final = frozenset({"ardupilot"})
"""Autopilots whose missions can state heights above the ground (MAV_FRAME_GLOBAL_TERRAIN_ALT)."""
RELIEFS: Final = ("auto", "follow", "level")
ENDS: Final = ("rtl", "land", "hover")
_MOST_LAYERS: Final = 12.0  # of ways out and home
_STILL_DOWN_DEG: Final = 5.0  # a picture shifts by less than a tenth of the height
_TOLERANCE: Final = 0.1
"""Of the height above ground, as a share of it."""
Geometry = Any  # shapely has no type information here
_BESIDE_STEPS: Final = 2.0
"""The highest ground is read at so many steps within that distance at least, where the number of nodes allows it."""
DEM_MARGIN_M: Final = 50.0  # a height model is read so far beyond the places that are asked for (some of its nodes)
_ROUNDING_M: Final = 0.5
"""A path along an edge of the fence may lie so far outside: rounding and the grid's scale."""
_MARGIN = {Cause.POOR: 0.08, Cause.NARROW_LENS: 0.06}
_USUAL_MARGIN = 0.04
"""Margins as shares of a picture's width, larger where positions or the lens were in doubt."""
_MERGE = 0.25
"""Gaps nearer to each other than half a picture's width (a quarter on each side) are flown as one."""
_SMALLEST = 0.001
"""Gaps smaller than this share of a picture are left out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanRequest:
    """What a plan is made of; the defaults are those of `orthoswarm plan`.

    Attributes:
        area: file of a polygon to cover, or of a line to follow. no_fly: files of further no-fly zones.
        vehicles: how many. altitude_m: height of the lines above takeoff, with a `dem` above the ground.
        fov_min_deg: theta-hat, the smallest horizontal field of view in the swarm.
        method: how lines are laid. end: what follows the last line.
        autopilots: of `AUTOPILOTS`, whose dialect and times of flight; several are given to the vehicles in turn.
        starts: takeoff points (latitude, longitude) in degrees; none: where each vehicle's first line begins.
        speed_m_s: ground speed, None for the default. run_in_m: straight flight before a leg's first picture.
        endurance_min: longest flight, None without a limit. endurances_min: of each vehicle, where they differ.
            swap_min: time to change a battery.
        side_overlap, forward_overlap: shares of a picture. aspect: a picture's width over its height.
        wait_min: how long a vehicle stays at the end of its last leg, as far as its endurance allows.
        clearance_m: distance to no-fly zones, None for the default. separation_m: between vehicles.
        height_step_m: between the heights of ways out and home. ceiling_m: the highest of them, None for four steps
            above the lines.
        follow: follow the lines of a file that has polygons, too.
        gaps: the area is a file of gaps as `orthoswarm coverage` writes it. fly_not_arrived: fly gaps, too, whose
            pictures were taken but have not arrived.
        dem: height model of the ground, None for level ground at takeoff. relief: legs follow the ground, lie at one
            level, or whichever is done sooner. height_tolerance_m: of the height above ground, None for a tenth of it.
            terrain_items: mission items state heights above the ground where the autopilot knows such (ArduPilot).
        wind_m_s, wind_from_deg: wind and where it comes from, clockwise from north; the speed is that through the air.
        heading: direction of the lines over an area, as in PlanOptions. cross: cover it again by lines across these.
        gimbal_pitch_deg: to which missions turn the camera's gimbal, -90 straight down; None to leave it alone.
        quickest_s: shortest time between two pictures of its cameras, None for the configuration's.
        config: margins, and times of flight of the autopilots.
    """

    area: Path
    vehicles: int
    altitude_m: float
    fov_min_deg: float
    no_fly: Sequence[Path] = ()
    method: Method = "bcd"
    autopilots: Sequence[str] = ("ardupilot",)
    end: End = "rtl"
    starts: Sequence[tuple[float, float]] = ()
    speed_m_s: float | None = None
    run_in_m: float = 0.0
    endurance_min: float | None = None
    endurances_min: Sequence[float] = ()
    swap_min: float = 2.0
    wait_min: float = 0.0
    side_overlap: float = 0.4
    forward_overlap: float = 0.8
    aspect: float = 4.0 / 3.0
    clearance_m: float | None = None
    separation_m: float = APART.distance_m
    height_step_m: float = APART.height_m
    ceiling_m: float | None = None
    follow: bool = False
    gaps: bool = False
    fly_not_arrived: bool = False
    dem: Path | None = None
    relief: Relief = "auto"
    height_tolerance_m: float | None = None
    terrain_items: bool = False
    wind_m_s: float = 0.0
    wind_from_deg: float = 0.0
    heading: Heading | None = None
    cross: bool = False
    gimbal_pitch_deg: float | None = -90.0
    quickest_s: float | None = None
    config: Config = DEFAULT

    def _motion(self) -> Motion:
        if not 0.0 <= self.wind_m_s < math.inf or not math.isfinite(self.wind_from_deg):
            raise InputError(
                f"a wind of {self.wind_m_s:g} m/s from {self.wind_from_deg:g} degrees is not valid; give both"
            )
        to = math.radians(self.wind_from_deg + 180.0)
        wind = (self.wind_m_s * math.sin(to), self.wind_m_s * math.cos(to)) if self.wind_m_s else (0.0, 0.0)
        autopilot = min(map(self.config.times, self.autopilots), key=lambda times: times.acceleration_m_s2)
        if self.speed_m_s is None:
            return Motion(wind_m_s=wind, autopilot=autopilot)
        return Motion(self.speed_m_s, wind_m_s=wind, autopilot=autopilot)

    def flight_options(self) -> PlanOptions:
        """How the flights are to be; raises InputError: a value means nothing."""
        if unknown := [name for name in self.autopilots if name not in AUTOPILOTS]:
            raise InputError(f"'{unknown[0]}' flies no mission of ours; choose one of {', '.join(AUTOPILOTS)}")
        if not 0.0 <= self.swap_min < math.inf:
            raise InputError(f"the time to change a battery is {self.swap_min:g} min; give 0 or more")
        ceiling = self.altitude_m + 4 * self.height_step_m if self.ceiling_m is None else self.ceiling_m
        if not ceiling >= self.altitude_m:
            raise InputError(f"the ceiling of {ceiling:g} m is below the altitude of {self.altitude_m:g} m; raise it")
        step = self.height_step_m
        layers = int(min(_MOST_LAYERS, (ceiling - self.altitude_m) / step + 1e-9)) if step > 0 else 0
        return PlanOptions(
            motion=self._motion(),
            autopilots=[self.config.times(name) for name in self.autopilots],
            end=self.end,
            starts=list(self.starts),
            endurance_s=math.inf if self.endurance_min is None else 60.0 * self.endurance_min,
            endurances_s=[60.0 * minutes for minutes in self.endurances_min],
            clearance_m=self.clearance_m,
            separation=Separation(
                distance_m=self.separation_m,
                height_m=step,
                layers=layers,
                swap_s=60.0 * self.swap_min,
                slack_s=max(self.config.times(name).schedule_slack_s for name in self.autopilots),
                launch_s=self.config.planning.launch_s,
                in_turn_share=self.config.planning.in_turn_share,
            ),
            most_items=min(
                MOST_POINTS if name == LITCHI else self.config.times(name).most_items for name in self.autopilots
            ),
            run_in_m=self.run_in_m,
            wait_s=60.0 * self.wait_min,
            heading=self.heading,
            cross=self.cross,
            quickest_s=self.config.planning.quickest_s if self.quickest_s is None else self.quickest_s,
        )


def flown_by(vehicle: VehiclePlan, autopilots: Sequence[str]) -> str:
    """The autopilot of a vehicle of those that are given in turn."""
    return autopilots[(vehicle.number - 1) % len(autopilots)]


def make_plan(request: PlanRequest, progress: Callable[[str], None] = lambda _: None) -> tuple[Plan, Area | None]:
    """The plan that a request asks for, and its area (None along lines without no-fly zones).

    `progress` is called with what is being done.

    Raises:
        InputError: a file or a value is of no use, or a flight would leave an inclusion fence.
    """
    pitch_deg = request.gimbal_pitch_deg
    if pitch_deg is not None and not -90.0 <= pitch_deg <= 0.0:
        raise InputError(f"the gimbal's pitch is {pitch_deg:g} degrees; give -90 (straight down) to 0 (the horizon)")
    plan, area, no_fly = _made(request, progress)
    fences = no_fly.fences
    no_fly.refuse_beyond(plan)
    refuse_outside(plan, fences, request.autopilots)
    # Nearer to a zone a vehicle would break its fence by the errors of its receiver alone, and turn back or stop.
    if area is not None and (request.clearance_m or 0.0) >= BESIDE_M:
        fences += zone_fences(area, fences)
    if area is not None:
        area = replace(area, circles_wider_m=no_fly.circles_wider_m)
    notes = [*no_fly.notes]
    if by_hand := [vehicle.id for vehicle in plan.vehicles if flown_by(vehicle, request.autopilots) in MAKERS]:
        fenced = ", which holds no geofence" if fences else ""
        notes.append(f"{', '.join(by_hand)}: started by hand at its takeoff time, in the app of its maker{fenced}")
    if pitch_deg is not None and pitch_deg + 90.0 > _STILL_DOWN_DEG:
        notes.append(f"what is covered is reckoned for a camera that looks straight down, not {pitch_deg:g} degrees")
    plan = replace(plan, fences=tuple(fences), gimbal_pitch_deg=pitch_deg, warnings=(*notes, *plan.warnings))
    return plan, area


def _made(request: PlanRequest, progress: Callable[[str], None]) -> tuple[Plan, Area | None, NoFly]:
    """The plan without fences, its area, and its no-fly zones and fences; see `make_plan`."""
    options = request.flight_options()
    options.check()
    progress("area")
    directed = request.heading is not None or request.cross
    if directed and request.method == "tmstc":
        raise InputError("tmstc lays lines in two directions; use columns or bcd with --heading or --cross")
    if request.gaps:
        if directed:
            raise InputError("gaps are flown in the direction that suits each; leave out --heading and --cross")
        return _gap_plan(request, options, progress)
    shapes, rings, fences, _ = read_shapes(request.area)
    covers = bool(shapes.areas) and not request.follow
    if directed and not covers:
        raise InputError("lines that are followed have their own direction; leave out --heading and --cross")
    if not covers and not shapes.lines:
        left = ", ".join(shapes.left)
        what = "line" if shapes.areas else f"polygon and no line, only {left}" if left else "polygon and no line"
        raise InputError(f"{request.area} holds no {what}; draw one in it")
    no_fly = _no_fly(request, [polygon.shell for polygon in shapes.areas] if covers else shapes.lines)
    rings += no_fly.rings
    no_fly = replace(no_fly, fences=[*fences, *no_fly.fences])
    if covers:
        area = make_area(shapes.areas, rings)
        cover = partial(plan_area, area, request.vehicles, method=request.method, options=options, progress=progress)
        plan = _over_ground(request, cover, area.ground, area.grid)
        return replace(plan, warnings=(*_not_flown(request.area, shapes), *plan.warnings)), area, no_fly
    zones: Area | None = _zones_only(shapes.lines, rings) if rings else None
    points = np.concatenate(shapes.lines)
    grid = LocalGrid(area_epsg(points[:, 0], points[:, 1])) if zones is None else zones.grid
    paths = shapely.MultiLineString([grid.to_grid(line[:, 0], line[:, 1]) for line in shapes.lines])
    follow = partial(plan_lines, shapes.lines, request.vehicles, no_fly=zones, options=options, progress=progress)
    plan = _over_ground(request, follow, paths, grid)
    return replace(plan, warnings=(*_not_flown(request.area, shapes, lines=True), *plan.warnings)), zones, no_fly


def _not_flown(path: Path, shapes: Shapes, *, lines: bool = False) -> list[str]:
    """Warnings on what a plan makes nothing of, or something else of than was perhaps meant.

    Args:
        path: of the area. shapes: its own. lines: whether its lines are followed, else its polygons covered.
    """
    beside = counted({"polygon": len(shapes.areas)} if lines and shapes.areas else {})
    beside += counted({"line": len(shapes.lines)} if shapes.lines and not lines else {})
    left = [*shapes.left, *beside]
    notes = [f"{path.name}: {doubt}" for doubt in dict.fromkeys(shapes.doubts)]
    notes += [f"of {path.name} this is not flown: {', '.join(left)}"] if left else []
    if lines and any(map(_closed, shapes.lines)):
        notes.append(
            f"{path.name} has a closed path, which is flown as a line; draw a polygon to cover what it surrounds"
        )
    return notes


def _closed(line: Ring) -> bool:
    """Whether a line ends where it began, but for a hundredth of its way: an outline drawn by hand."""
    steps = np.hypot(*(np.diff(np.r_[line, line[:1]], axis=0) * [1.0, np.cos(np.radians(line[0, 0]))]).T)
    return len(line) > 3 and bool(steps[-1] <= 0.01 * steps.sum())


def _over_ground(request: PlanRequest, cover: Callable[..., Plan], wanted: shapely.Geometry, grid: LocalGrid) -> Plan:
    """The plan over the height model of a request, or over level ground without one.

    Args:
        request: as given. cover: plans at a height above ground, with its footprint and the `heights` of the flights.
        wanted: what is to be flown over, metres of the grid.
    """

    def make(above_m: float, foot: Footprint, heights: FlightHeights | None) -> Plan:
        return cover(above_m, foot, heights=heights)

    if request.dem is None:
        return make(request.altitude_m, _footprint(request, request.altitude_m), None)
    _footprint(request, request.altitude_m)  # refuses what means nothing before the model is read
    if not request.starts:
        raise InputError("give --start with --dem: heights of a mission count from the takeoff point")
    starts = np.array(request.starts, float)
    ground = read_ground(request.dem, wanted, grid, grid.to_grid(starts[:, 0], starts[:, 1]))
    ground = replace(ground, least_above_m=request.config.planning.least_above_ground_m)
    usual_m = _TOLERANCE * request.altitude_m
    tolerance_m = usual_m if request.height_tolerance_m is None else request.height_tolerance_m
    without = sorted(set(request.autopilots) - WITH_TERRAIN)
    by_vehicle = request.terrain_items and not without
    plan = plan_over_relief(
        make,
        lambda above_m: _footprint(request, above_m),
        ground,
        above_m=request.altitude_m,
        tolerance_m=tolerance_m,
        relief=request.relief,
        by_vehicle=by_vehicle,
    )
    assert plan.over_ground is not None
    plan = replace(plan, over_ground=replace(plan.over_ground, return_height_m=return_height_m(ground)))
    notes = relief_notes(plan, ground)
    if request.terrain_items and not by_vehicle:
        notes.append(f"{without[0]} has no items with heights above the ground: heights count from takeoff")
    return replace(plan, warnings=(*plan.warnings, *notes))


def _footprint(request: PlanRequest, above_m: float) -> Footprint:
    """Footprint of theta-hat at a height above level ground, turned by the wind's crab angle."""
    fov = math.radians(request.fov_min_deg)
    foot = footprint(above_m, fov, request.aspect, request.side_overlap, request.forward_overlap)
    return foot.turned(request.flight_options().motion.crab_rad)


def _gap_plan(request: PlanRequest, options: PlanOptions, progress: Callable[[str], None]) -> tuple[Plan, Area, NoFly]:
    """A plan over the gaps of a coverage, the ground that it aims at, and its no-fly zones."""
    if request.endurance_min is None and not request.endurances_min:
        raise InputError("say with --endurance how many minutes the batteries last: a gap flight must not guess it")
    gaps = read_gaps(request.area)
    no_fly = _no_fly(request, [gap.polygon.shell for gap in gaps])
    nominal = _footprint(request, request.altitude_m)
    target = gap_area(gaps, no_fly.rings, nominal, request.fly_not_arrived)
    cover = partial(plan_gaps, target.area, request.vehicles, options=options, progress=progress)
    plan = _over_ground(request, cover, target.area.ground, target.area.grid)
    return replace(plan, warnings=(*target.notes, *plan.warnings)), target.area, no_fly


def _no_fly(request: PlanRequest, flown: Sequence[Ring]) -> NoFly:
    """The no-fly zones of a request near the rings or lines that are flown over, and near its starts."""
    starts = np.array(request.starts, float).reshape(-1, 2)
    return read_no_fly(request.no_fly, np.concatenate([*flown, starts]), request.clearance_m)


def _zones_only(lines: tuple[Ring, ...], no_fly: list[Ring]) -> Area:
    """An area without ground that carries the no-fly zones."""
    points = np.concatenate(lines)
    grid = LocalGrid(area_epsg(points[:, 0], points[:, 1]))
    checked = [make_area([Polygon(zone)]) for zone in no_fly]  # says what is wrong with a zone
    zones = [shapely.transform(c.ground, lambda p, c=c: grid.to_grid(*c.grid.to_geographic(p).T)) for c in checked]
    return Area(grid, shapely.MultiPolygon(), shapely.MultiPolygon(list(shapely.get_parts(shapely.union_all(zones)))))


def read_ground(dem: Path, wanted: shapely.Geometry, grid: LocalGrid, starts: NDArray[np.float64]) -> GroundBelow:
    """The ground below what is to be flown, over that of the lowest start.

    Args:
        dem: a GeoTIFF with a CRS. wanted: area or lines, grid metres. grid: of it. starts: takeoff points (n, 2), grid
            metres, at least one.

    Raises:
        InputError: the model cannot be read, or has no heights there.
    """
    points = np.concatenate([shapely.get_coordinates(wanted), starts])
    bounds = BoundingBox.around_points(points, DEM_MARGIN_M)
    model = HeightModel.open(dem, grid.epsg, bounds, np.empty((0, 3)))
    found = model.window(bounds, DEM_MOST_NODES)
    terrain = found.terrain
    # One step around the outline, too: a small area may lie between nodes.
    within = _nodes_in(wanted.buffer(terrain.step_m), terrain)
    hull = shapely.MultiPoint(points).convex_hull.buffer(terrain.step_m)
    if not found.known[within | _nodes_in(hull, terrain)].all():
        raise InputError(
            f"{dem} has no heights on a part of the area or of the ways to it; give a height model without holes there"
        )
    zero = np.float32(terrain.height(starts).min())
    highest = model.highest(bounds, BESIDE_M, _BESIDE_STEPS, DEM_MOST_NODES)
    highest = replace(highest, z=highest.z - zero)
    way_m = float(highest.z[_nodes_in(hull, highest)].max())
    z = terrain.z - zero
    ground = replace(terrain, z=z)
    return GroundBelow(ground, highest, float(z[within].min()), float(z[within].max()), way_m)


def _nodes_in(outline: shapely.Geometry, terrain: Terrain) -> NDArray[np.bool_]:
    """Which nodes (rows, columns) lie within an outline, grid metres."""
    rows, columns = terrain.z.shape
    east = terrain.west + terrain.step_m * np.arange(columns)
    north = terrain.south + terrain.step_m * np.arange(rows)
    shapely.prepare(outline)
    return np.asarray(shapely.contains_xy(outline, *np.meshgrid(east, north)))


def return_height_m(ground: GroundBelow) -> float:
    """Height above takeoff, whole metres, at which a straight way home passes over all ground and what stands on it."""
    return float(math.ceil(ground.way_m + ground.least_above_m))


def relief_notes(plan: Plan, ground: GroundBelow) -> list[str]:
    """What to know about a plan over a height model, in words."""
    over = plan.over_ground
    if over is None:
        return []
    how = (
        f"legs follow the ground at {over.nominal_m:g} m"
        if over.follows
        else f"all legs are flown {plan.altitude_m:.0f} m above the lowest takeoff"
    )
    if over.by_vehicle:
        how += ", by the terrain data of the vehicles: the ground station must send it to them, or their card hold it"
    return [
        f"the ground of the area lies {ground.low_m:.0f} to {ground.high_m:.0f} m over takeoff: {how}, "
        f"{over.least_m:.0f} to {over.most_m:.0f} m above ground, {over.way_least_m:.0f} m or more above the highest "
        f"within {BESIDE_M:g} m; side overlap {100 * over.side_overlap[0]:.0f} % or "
        f"more on 95 % of the legs, forward overlap at least {100 * over.forward_overlap:.0f} %",
        f"a vehicle that turns home by itself flies straight back: set its return height (ArduPilot RTL_ALT, "
        f"RTL_ALT_M from 4.7 on; PX4 RTL_RETURN_ALT) to {return_height_m(ground):.0f} m or more",
    ]


def zone_fences(area: Area, fences: Sequence[Fence]) -> list[Fence]:
    """The no-fly zones of an area as exclusion fences, but for what given ones of these cover already.

    Holes of a zone are closed: a fence has none, and a flight out of one would cross the zone.
    """
    known = shapely.union_all([_shape(fence, area.grid) for fence in fences if not fence.inclusion])
    zones = [shapely.Polygon(zone.exterior) for zone in area.no_fly.geoms]
    left = [zone for zone in zones if not known.buffer(_ROUNDING_M).covers(zone)]
    places = [area.grid.to_geographic(shapely.get_coordinates(zone.exterior)[:-1]) for zone in left]
    return [Fence(inclusion=False, points=tuple((float(lat), float(lon)) for lat, lon in ring)) for ring in places]


def refuse_outside(plan: Plan, fences: Sequence[Fence], autopilots: Sequence[str]) -> None:
    """Refuse a plan of which a flight leaves the inclusion fences.

    An ArduPilot must stay inside all of them (unless FENCE_OPTIONS says otherwise), a PX4 inside any; others in all.

    Raises:
        InputError: a flight leaves them, or they have no ground in common.
    """
    grid = LocalGrid(plan.epsg)
    allowed = [_shape(fence, grid) for fence in fences if fence.inclusion]
    if not allowed:
        return
    all_of_them = any(name != "px4" for name in autopilots)
    inside = shapely.intersection_all(allowed) if all_of_them else shapely.union_all(allowed)
    if inside.is_empty:
        raise InputError("the inclusion fences have no ground in common, where ArduPilot could fly; leave one of them")
    for vehicle in plan.vehicles:
        outside_m = max(_farthest_m(sortie_path(sortie, grid), inside) for sortie in vehicle.sorties)
        if outside_m > _ROUNDING_M:
            raise InputError(
                f"{vehicle.id} would fly up to {outside_m:.0f} m outside the inclusion fence; move the start or the "
                "area inside, give less --run-in, or draw a larger fence"
            )


def _shape(fence: Fence, grid: LocalGrid) -> Geometry:
    """A fence in grid metres."""
    points = grid.to_grid(*np.array(fence.points, float).T)
    if fence.radius_m is not None:
        return shapely.Point(points[0]).buffer(fence.radius_m, quad_segs=64)
    return shapely.make_valid(shapely.Polygon(points))


def sortie_path(sortie: Sortie, grid: LocalGrid) -> NDArray[np.float64]:
    """A flight on the map, home first: east and north (n, 2) in grid metres."""
    home = (sortie.home_lat_deg, sortie.home_lon_deg)
    places = np.array([home, *((point.lat_deg, point.lon_deg) for point in sortie.waypoints)], float)
    return grid.to_grid(*places.T)


def _farthest_m(path: NDArray[np.float64], inside: Geometry) -> float:
    """How far a path gets outside, metres."""
    outside = shapely.get_coordinates(shapely.LineString(path).difference(inside))
    return float(shapely.distance(shapely.points(outside), inside).max(initial=0.0))


@dataclass(frozen=True, slots=True)
class ReadGap:
    """A gap from a file: its polygon on the globe and why it was missed (None if the file does not say)."""

    polygon: Polygon
    cause: Cause | None


@dataclass(frozen=True, slots=True)
class GapTarget:
    """What a gap flight aims at: the area with no-fly zones, and what was left out, in words."""

    area: Area
    notes: tuple[str, ...]


def read_gaps(path: Path) -> list[ReadGap]:
    """Gaps of a GeoJSON of polygons, with the property `cause` as `orthoswarm coverage` writes it.

    Raises:
        InputError: it cannot be read or holds no polygon.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); give the gaps.geojson of a coverage") from None
    except ValueError as error:
        raise InputError(f"{path} is not valid JSON ({error}); give the gaps.geojson of a coverage") from None
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list):
        raise InputError(f"{path} is not a GeoJSON feature collection; give the gaps.geojson of a coverage")
    if not features:
        raise InputError(f"{path} holds no gap: all of the area was seen, so there is nothing to fly")
    known = {str(cause): cause for cause in Cause}
    gaps = []
    for feature in features:
        cause = known.get(str(((feature or {}).get("properties") or {}).get("cause")))
        gaps += [ReadGap(polygon, cause) for polygon in _polygons(feature, path)]
    if not gaps:
        raise InputError(f"{path} holds no polygon; give the gaps.geojson of a coverage")
    return gaps


def gap_area(gaps: Sequence[ReadGap], no_fly: Sequence[Ring], foot: Footprint, fly_not_arrived: bool) -> GapTarget:
    """The ground that a gap flight must see: gaps merged, and grown by the margin of their cause.

    Args:
        no_fly: rings (n, 2), latitude and longitude in degrees. foot: footprint of the camera.
        fly_not_arrived: also gaps whose pictures were taken, but have not arrived.

    Raises:
        InputError: nothing is left to fly.
    """
    places = np.concatenate([g.polygon.shell for g in gaps])
    grid = LocalGrid(area_epsg(places[:, 0], places[:, 1]))
    zones = [make_area([Polygon(zone)], (), grid).ground for zone in no_fly]
    forbidden = shapely.union_all(zones)
    notes: list[str] = []
    if not zones:
        notes.append(
            "no no-fly zone is known: a file of gaps does not hold those of the first plan, give them with --no-fly"
        )
    waiting = [] if fly_not_arrived else [g for g in gaps if g.cause is Cause.NOT_ARRIVED]
    if waiting:
        notes.append(
            f"{len(waiting)} gaps are not flown, since their pictures were taken and have not arrived: copy them from "
            "the card, or fly them all the same with --fly-not-arrived"
        )
    skip = set(map(id, waiting))
    grown = [_grown(gap, grid, foot) for gap in gaps if id(gap) not in skip]
    merged = shapely.union_all(grown).buffer(_MERGE * foot.width_m).buffer(-_MERGE * foot.width_m)
    hidden = float(shapely.union_all(grown).intersection(forbidden).area)
    if hidden >= 1.0:
        notes.append(f"{hidden:.0f} square metres of the gaps lie in no-fly zones and are not flown")
    parts = [p for p in shapely.get_parts(merged.difference(forbidden)) if p.geom_type == "Polygon"]
    least = _SMALLEST * foot.width_m * foot.height_m
    flown = [p for p in parts if p.area >= least]
    if len(flown) < len(parts):
        notes.append(f"{len(parts) - len(flown)} gaps smaller than {least:.1f} square metres are not flown")
    if not flown:
        raise InputError("; ".join(["no gap is left to fly", *notes]))
    return GapTarget(Area(grid, shapely.MultiPolygon(flown), shapely.MultiPolygon(_parts(forbidden))), tuple(notes))


def _parts(geometry: Geometry) -> list[Geometry]:
    return [p for p in shapely.get_parts(shapely.get_parts(geometry)) if p.geom_type == "Polygon"]


def _grown(gap: ReadGap, grid: LocalGrid, foot: Footprint) -> Geometry:
    """A gap in grid metres with its margin; steps of cells at its border are smoothed away."""
    rings = [grid.to_grid(r[:, 0], r[:, 1]) for r in (gap.polygon.shell, *gap.polygon.holes)]
    margin = foot.width_m * (_USUAL_MARGIN if gap.cause is None else _MARGIN.get(gap.cause, _USUAL_MARGIN))
    return shapely.Polygon(rings[0], rings[1:]).buffer(0).buffer(margin).simplify(0.25 * margin)


def _polygons(feature: Mapping[str, Any], path: Path) -> Sequence[Polygon]:
    """The polygons of one feature. They are made of the steps of cells, and simplified later: any number of corners."""
    return parse_geojson(json.dumps(feature), str(path), any_size=True).polygons
