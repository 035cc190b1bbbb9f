"""The default refiner: one vehicle is the unit, a batch is a loop over it (DESIGN.md section 4, RECIPE.md).

Solo pass of each vehicle -> lean voted over all of them -> second pass with neighbours held -> one terrain.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoswarm.camera import fov_rad
from orthoswarm.errors import OrthoSwarmError
from orthoswarm.frame import Frame
from orthoswarm.geo import LocalGrid
from orthoswarm.picture import read_gray
from orthoswarm.placement import MapWindow, Solution, Terrain
from orthoswarm.swarm.adjust import Ties
from orthoswarm.swarm.flight import Flight, free_strong_lens, open_flight, weigh_records
from orthoswarm.swarm.ground import GroundModel, fit_surface, ground_points
from orthoswarm.swarm.groundwork import dense_points
from orthoswarm.swarm.levels import level_network
from orthoswarm.swarm.neighbours import held_cameras, link_to_held, release
from orthoswarm.swarm.onmap import coarse_fit, shift_cameras
from orthoswarm.swarm.rig import WIDTH, F
from orthoswarm.swarm.settle import map_gsd, resettle, settle, working_gsd
from orthoswarm.swarm.sigma import frame_sigmas
from orthoswarm.swarm.sparse_flight import open_sparse_flight
from orthoswarm.swarm.sparse_joint import open_sparse_flights
from orthoswarm.swarm.state import Stopwatch, VehicleState, to_solution
from orthoswarm.swarm.terrain import fit_terrain
from orthoswarm.swarm.ties import MapMatches, vote_lean
from orthoswarm.swarm.units import merge_units, split_units
from orthoswarm.swarm.weak import steady_weak

Array = NDArray[np.float64]
T = TypeVar("T")


TAKEOFF_LEVEL_M = 2.0
"""How well the takeoff level is known to be the level of the ground, one sigma."""
TIE_SHARE = 0.5
"""Part of the ties' scatter that neighbouring ties have in common (terrain, map content), so that no number helps."""
MAP_FLOOR_PX = 0.13
"""What no residual tells (map content that stands above the ground everywhere), in pixels of the compared map."""


@dataclass(frozen=True, slots=True)
class Options:
    """How the refiner works.

    Attributes:
        fov_start_rad: field of view to start from where the tags hint at none.
        work_width: pictures wider than this are reduced for the refinement.
    """

    fov_start_rad: float = float(np.radians(80.0))
    work_width: int = 960


class Run(Protocol):
    """How tasks are run: serially, in processes, on a cluster; results come in the order of the items."""

    def __call__(self, function: Callable[[Any], T], items: Sequence[Any], /) -> Iterable[T]:
        """Yield function(item) for each item."""


def serial(function: Callable[[Any], T], items: Sequence[Any], /) -> Iterable[T]:
    """Run tasks one after the other in this process."""
    return map(function, items)


@dataclass(frozen=True, slots=True)
class Refined:
    """Products of the refinement of a batch: the same vehicles before and after the map; state is in `fine`."""

    coarse: list[Solution]
    fine: list[Solution]
    terrain: Terrain | None


def read_frame(frame: Frame) -> NDArray[np.uint8]:
    """A frame's grey picture."""
    return read_gray(frame.path)


def local_origin(grid: LocalGrid, frames: Iterable[Frame]) -> Array:
    """Origin (2,) of the local frame: the middle of the fixes, on a multiple of 16 m so that pixel grids agree."""
    fixes = np.array([(f.fix.lat_deg, f.fix.lon_deg) for f in frames])
    return np.asarray(np.round(np.median(grid.to_grid(fixes[:, 0], fixes[:, 1]), axis=0) / 16.0) * 16.0)


def solo(
    frames: Sequence[Frame], *, epsg: int, origin: Array, basemap: MapWindow | None, options: Options
) -> VehicleState:
    """Refine one vehicle by itself: relative adjustment, then onto the map where there is one."""
    state = followed(frames, epsg=epsg, origin=origin, basemap=basemap, options=options)
    if state is None:
        watch = Stopwatch()
        flight = open_sparse_flight(frames, LocalGrid(epsg), origin, read_frame)
        watch.lap("tracks")
        state = _from_flight(flight, fit_surface(flight.adjustment, GroundModel()), origin, basemap, watch)
    return state


def followed(
    frames: Sequence[Frame], *, epsg: int, origin: Array, basemap: MapWindow | None, options: Options
) -> VehicleState | None:
    """Refine one vehicle by itself; None where its pictures cannot be followed from one to the next."""
    watch = Stopwatch()
    hints = [f.fov_hint_rad for f in frames if f.fov_hint_rad is not None]
    start = float(np.median(hints)) if hints else options.fov_start_rad
    flight = open_flight(frames, LocalGrid(epsg), origin, read_frame, start)
    watch.lap("tracks")
    return None if flight is None else _from_flight(flight, _relative(flight), origin, basemap, watch)


def matched(flight: Flight, *, origin: Array, basemap: MapWindow | None) -> VehicleState:
    """Refine one vehicle whose photos were matched and adjusted together with those of others."""
    return _from_flight(flight, fit_surface(flight.adjustment, GroundModel()), origin, basemap, Stopwatch())


def _from_flight(
    flight: Flight, surface: GroundModel, origin: Array, basemap: MapWindow | None, watch: Stopwatch
) -> VehicleState:
    """The state of a vehicle that is adjusted without a map, and its way onto the map where there is one."""
    adj = flight.adjustment
    belief = surface.belief(adj.points)
    coarse_sigma, fov_sigma = frame_sigmas(adj, 9.0, belief, None, 9.0, 0.05)
    coarse = replace(
        adj.rig, position=adj.rig.position.copy(), rotation=adj.rig.rotation.copy(), lens=adj.rig.lens.copy()
    )
    watch.lap("relative")
    none = MapMatches(*(np.zeros(0, np.int32),) * 2, np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    state = VehicleState(
        flight.frames[0].vehicle, flight, coarse, surface, Ties.none(), none, (none, np.zeros(0)),
        (np.zeros((0, 3)), np.zeros(0)), False, 0.0, coarse_sigma, coarse_sigma, fov_sigma,
    )  # fmt: skip
    if basemap is not None:
        state.had_map = True
        _onto_map(state, basemap, origin, watch)
    flight.pictures.drop()
    state.timings = watch.seconds
    return state


def _relative(flight: Flight) -> GroundModel:
    """The adjustment without a map, its ground fitted as soon as the points allow."""
    surface = GroundModel()
    schedule = [1e4, 1e4, 100.0, 100.0, 9.0, 9.0]
    for k, c in enumerate(schedule):
        first = k < 2
        flight.adjustment.step(
            c, surface.belief(flight.adjustment.points, 3.0 if first else 2.0, 1e3 if first else 1.0)
        )
        if k == 3:
            weigh_records(flight)
            if free_strong_lens(flight):
                schedule += [9.0] * 4
        if k >= 3:
            surface = fit_surface(flight.adjustment, surface)
    return surface


def _onto_map(state: VehicleState, basemap: MapWindow, origin: Array, watch: Stopwatch) -> None:
    flight = state.flight
    fit = coarse_fit(flight, basemap, origin) or coarse_fit(flight, basemap, origin, 150.0)
    watch.lap("coarse registration")
    if fit is None:
        flight.warnings.append("no part of this flight was found on the map; it lies in the GPS frame")
        return
    shift_cameras(flight, fit.correction)
    settled = settle(flight, basemap, origin, state.surface, None)
    state.surface, state.ties, state.matches, state.roofs = (
        settled.surface,
        settled.ties,
        settled.matches,
        settled.roofs,
    )
    state.on_map, state.confidence = True, fit.confidence
    watch.lap("ties and absolute")
    adj = flight.adjustment
    state.sigma_m, state.fov_sigma_deg = frame_sigmas(adj, 9.0, state.surface.belief(adj.points), state.ties, 6.0, 0.05)
    watch.lap("sigma")


def _level_sigma_deg(flight: Flight, surface: GroundModel) -> float:
    """How far the field of view may be off because the takeoff spot need not be at the ground's middle level.

    Over flat ground straight down only f / h is observable; the more relief, the less the level is known.
    """
    if not flight.calibration.trusted_height or not flight.records.has_height.any():
        return 0.0
    relief = 0.0 if surface.fit is None else surface.fit.sd_m
    rig = flight.rig()
    share = float(np.hypot(TAKEOFF_LEVEL_M, relief)) / max(float(np.median(rig.position[:, 2])), 1.0)
    half = 0.5 * fov_rad(float(rig.lens[0, F]), int(rig.lens[0, WIDTH]))
    return float(np.degrees(np.sin(2 * half))) * share


@dataclass(frozen=True, slots=True)
class SwarmRefiner:
    """One vehicle as soon as it completes (placement.Refiner): solo, then again with its neighbours held.

    Attributes:
        epsg: the area's grid. origin: (2,) of the local frame, the same for all vehicles of an area.
        options: see Options.
    """

    epsg: int
    origin: Array
    options: Options = Options()

    def refine(self, frames: Sequence[Frame], neighbours: Sequence[Solution], basemap: MapWindow | None) -> Solution:
        """Place one vehicle's frames; neighbours (earlier results of this refiner) are held as they are.

        Raises:
            OrthoSwarmError: if nothing can be made of the frames.
        """
        parts = split_units({frames[0].vehicle: frames} if frames else {})
        if not parts:
            raise OrthoSwarmError("there are no frames to refine; check the vehicle's pictures")
        own = [solo(part, epsg=self.epsg, origin=self.origin, basemap=basemap, options=self.options) for part in parts]
        others = [state for n in neighbours for state in states_of(n)]
        everyone = [*own, *others]
        network = level_network([ground_points(s.flight.adjustment)[0] for s in everyone])
        anchor = float(np.mean(network.correction_m[len(own) :])) if others else 0.0
        lean = pooled_lean(everyone)
        done = []
        for state, correction in zip(own, network.correction_m, strict=False):
            item = (state, neighbours_of(state, everyone), float(correction) - anchor)
            done.append(second_pass(item, basemap=basemap, origin=self.origin, lean=lean))
        terrain = _shifted(common_terrain([*done, *others]), self.origin)
        return merge_units([to_solution(s, self.origin, terrain) for s in done])[0]


def states_of(solution: Solution) -> list[VehicleState]:
    """The states behind a solution of this refiner (several for a vehicle with several lenses)."""
    state = solution.state
    return [] if state is None else list(state) if isinstance(state, list) else [state]


def refine_all(
    vehicles: Mapping[str, Sequence[Frame]],
    basemap: MapWindow | None,
    grid: LocalGrid,
    options: Options | None = None,
    run: Run = serial,
    progress: Callable[[str, int, int], None] | None = None,
) -> Refined:
    """Refine a batch of vehicles.

    Args:
        vehicles: id -> frames in order of time. basemap: the map on the area's grid, or None.
        grid: the area's grid. options: see Options. run: how tasks are run. progress: called with stage, done, all.

    Raises:
        OrthoSwarmError: if there is nothing to refine.
    """
    if not vehicles:
        raise OrthoSwarmError("there is no vehicle with frames to refine; check the inputs")
    origin = local_origin(grid, (f for frames in vehicles.values() for f in frames))
    states = _first_passes(split_units(vehicles), basemap, grid, origin, options or Options(), run, progress)
    coarse = [to_solution(s, origin, None, coarse=True) for s in states]
    states = _second_passes(states, basemap, origin, run, progress)
    _level(states)
    terrain = _shifted(common_terrain(states), origin)
    fine = [to_solution(s, origin, terrain) for s in states]
    return Refined(merge_units(coarse), merge_units(fine), terrain)


def _first_passes(
    units: list[list[Frame]],
    basemap: MapWindow | None,
    grid: LocalGrid,
    origin: Array,
    options: Options,
    run: Run,
    progress: Callable[[str, int, int], None] | None,
) -> list[VehicleState]:
    """Each vehicle by itself; those whose photos must be matched are matched and adjusted together first."""
    task = partial(followed, epsg=grid.epsg, origin=origin, basemap=basemap, options=options)
    states: list[VehicleState | None] = []
    for n, state in enumerate(run(task, units)):
        states.append(state)
        if progress:
            progress("solo", n + 1, len(units))
    waiting = [k for k, state in enumerate(states) if state is None]
    if waiting:
        watch = Stopwatch()
        flights = open_sparse_flights([units[k] for k in waiting], grid, origin, read_frame, run, progress)
        watch.lap("tracks")
        for k, state in zip(waiting, run(partial(matched, origin=origin, basemap=basemap), flights), strict=True):
            state.timings["tracks"] = watch.seconds["tracks"] / len(waiting)
            states[k] = state
    return [state for state in states if state is not None]


def _second_passes(
    states: list[VehicleState],
    basemap: MapWindow | None,
    origin: Array,
    run: Run,
    progress: Callable[[str, int, int], None] | None,
) -> list[VehicleState]:
    """All vehicles again, on a common level and lean, each with its neighbours held as the solo pass left them."""
    network = level_network([ground_points(s.flight.adjustment)[0] for s in states])
    lean = pooled_lean(states)
    task = partial(second_pass, basemap=basemap, origin=origin, lean=lean)
    mapped = [k for k, s in enumerate(states) if s.on_map]
    items = [(states[k], neighbours_of(states[k], states), float(network.correction_m[k])) for k in mapped]
    out = list(states)
    for done, (k, state) in enumerate(zip(mapped, run(task, items), strict=True)):
        out[k] = state
        if progress:
            progress("joint", done + 1, len(states))
    # Without a map nobody is right: each vehicle is fitted to those before it, so that seams close without a dance.
    before: list[VehicleState] = []
    for k in sorted(set(range(len(states))) - set(mapped)):
        (out[k],) = run(task, [(states[k], neighbours_of(states[k], before), float(network.correction_m[k]))])
        before.append(out[k])
        if progress:
            progress("joint", len(mapped) + len(before), len(states))
    return out


def _level(states: Sequence[VehicleState]) -> None:
    """Lift or lower whole vehicles, cameras and ground together, by what is left between their levels."""
    network = level_network([ground_points(s.flight.adjustment)[0] for s in states])
    for state, correction in zip(states, network.correction_m, strict=True):
        adj = state.flight.adjustment
        adj.rig.position[:, 2] += correction
        adj.points[:, 2] += correction
        state.dense[0][:, 2] += correction


def neighbours_of(state: VehicleState, states: Sequence[VehicleState]) -> list[VehicleState]:
    """The other vehicles whose paths come within sight of this one's."""
    own = state.flight.adjustment.rig.position
    reach = 1.5 * float(np.median(own[:, 2]))
    low, high = own[:, :2].min(0) - reach, own[:, :2].max(0) + reach
    out = []
    for other in states:
        xy = other.flight.adjustment.rig.position[:, :2]
        if other is not state and ((xy > low) & (xy < high)).all(1).any():
            out.append(other)
    return out


def pooled_lean(states: Sequence[VehicleState]) -> tuple[float, float]:
    """The map's lean by vote over the roofs of all vehicles that lie on it; zero where they do not agree."""
    mapped = [s for s in states if s.on_map]
    if not mapped:
        return (0.0, 0.0)
    shifts = [s.roofs[0].shift - s.ground_shift for s in mapped]
    roofs = [s.roofs[0] for s in mapped]
    joint = MapMatches(
        np.concatenate([r.point for r in roofs]),
        np.concatenate([r.camera for r in roofs]),
        np.concatenate(shifts),
        np.concatenate([r.peak for r in roofs]),
        np.concatenate([r.ratio for r in roofs]),
    )
    return vote_lean(joint, np.concatenate([s.roofs[1] for s in mapped]), np.zeros(2)) or (0.0, 0.0)


def second_pass(
    item: tuple[VehicleState, list[VehicleState], float],
    *,
    basemap: MapWindow | None,
    origin: Array,
    lean: tuple[float, float],
) -> VehicleState:
    """One vehicle again: common level and lean, links into held neighbours, fresh ties; then denser ground."""
    state, others, correction = item
    state = deepcopy(state)  # neighbours see this vehicle as its solo pass left it, in whatever order they are run
    watch = Stopwatch()
    flight = state.flight
    state.surface = replace(state.surface, lean=lean, level_m=state.surface.level_m + correction)
    held = held_cameras(state, others)
    if held is not None:
        link_to_held(flight, held, working_gsd(flight))
    watch.lap("links to neighbours")
    if state.on_map and basemap is not None:
        again = resettle(flight, basemap, origin, state.surface, state.ties)
        state.surface, state.ties, state.matches = again
    else:
        for _ in range(4):
            flight.adjustment.step(9.0, state.surface.belief(flight.adjustment.points))
    watch.lap("second adjustment")
    adj = flight.adjustment
    ties = state.ties if state.on_map else None
    floor = 0.05
    if basemap is not None and state.on_map:
        spread = float(np.median(state.ties.sigma_m)) if len(state.ties.sigma_m) else 0.0
        floor = max(MAP_FLOOR_PX * map_gsd(flight, basemap), TIE_SHARE * spread)
    sigma, fov_sigma = frame_sigmas(adj, 9.0, state.surface.belief(adj.points), ties, 6.0, floor)
    state.fov_sigma_deg = float(np.hypot(fov_sigma, _level_sigma_deg(flight, state.surface)))
    state.sigma_m = sigma[: len(flight.frames)]
    if not state.on_map:
        state.sigma_m = np.maximum(state.sigma_m, state.coarse_sigma_m)  # held neighbours are no better than oneself
    release(flight)
    if not flight.sparse:
        steady_weak(flight, state.sigma_m)
    watch.lap("sigma")
    state.dense = dense_points(flight, state.surface)
    watch.lap("denser terrain")
    flight.pictures.drop()
    for other in others:
        other.flight.pictures.drop()
    for name, seconds in watch.seconds.items():
        state.timings[name] = state.timings.get(name, 0.0) + seconds
    return state


def common_terrain(states: Sequence[VehicleState]) -> Terrain | None:
    """One surface over all vehicles for rendering, in the local frame; None where there are too few points."""
    if not states:
        return None
    own = [ground_points(s.flight.adjustment) for s in states]
    points = np.concatenate([p for p, _ in own] + [s.dense[0] for s in states])
    sigma = np.concatenate([q for _, q in own] + [s.dense[1] for s in states])
    if len(points) < 60:
        return states[0].surface.terrain()
    path = np.concatenate([s.flight.adjustment.rig.position for s in states])
    reach = 1.1 * float(np.median(path[:, 2]))
    low, high = path[:, :2].min(0) - reach, path[:, :2].max(0) + reach
    fit = fit_terrain(points, sigma, (float(low[0]), float(low[1]), float(high[0]), float(high[1])))
    return fit.rendering(float(np.median([s.surface.lift_m for s in states])))


def _shifted(terrain: Terrain | None, origin: Array) -> Terrain | None:
    if terrain is None:
        return None
    return replace(terrain, west=terrain.west + float(origin[0]), south=terrain.south + float(origin[1]))
