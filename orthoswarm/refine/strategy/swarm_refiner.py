"""The default refiner: one vehicle is the unit, a batch is a loop over vehicles.

First pass of each vehicle by itself -> vehicles that were not found on the map are registered on neighbours that were
-> second pass on a common level with neighbours held -> one terrain.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.errors import AdjustmentError
from orthoswarm.model.frame import Frame
from orthoswarm.model.placement import MapWindow, Refinement, Solution, Terrain
from orthoswarm.model.task_runner import Continued, Progress, Run, serial, whole
from orthoswarm.refine.flight.relative_block import FlightBlock
from orthoswarm.refine.flight.sparse_block import open_sparse_flights
from orthoswarm.refine.flight.unsolved_pictures import move_with_neighbours
from orthoswarm.refine.flight.vehicle_refinement import UnitRefiner, merge_units, unit_states, units_of_area, unrefined
from orthoswarm.refine.registration.block_state import (
    Stopwatch,
    VehicleState,
    WorkArea,
    findings,
    lies_on_map,
    to_solution,
)
from orthoswarm.refine.registration.neighbour_registration import register_to_neighbours
from orthoswarm.refine.strategy.joined_vehicles import join_unmapped
from orthoswarm.refine.strategy.second_pass import second_pass
from orthoswarm.refine.strategy.vehicle_group import (
    coarse_terrain,
    common_terrain,
    map_distortion_sigma,
    mapped_level,
    neighbours_of,
    pooled_lean,
)
from orthoswarm.refine.strategy.vehicle_passes import (
    RefinerOptions,
    learned_registration,
    refine_alone,
    refine_matched,
    refine_tracked,
    registered_by,
    tracked_flight,
)
from orthoswarm.refine.surface.height_levels import level_corrections
from orthoswarm.refine.surface.vehicle_ground import ground_points

__all__ = ["RefinerOptions", "SwarmRefiner", "refine_alone"]

Task = Callable[..., VehicleState | Continued[VehicleState]]


@dataclass(frozen=True, slots=True)
class SwarmRefiner(UnitRefiner):
    """The default refiner (placement.Refiner): each vehicle by itself, then again with its neighbours held."""

    options: RefinerOptions = field(default_factory=RefinerOptions)

    def solve(self, units: list[list[Frame]], neighbours: Sequence[Solution], basemap: MapWindow | None) -> Solution:
        """Each unit by itself, then their second pass with the neighbours held."""
        others = [state for n in neighbours for state in unit_states(n)]
        place = partial(refine_alone, area=self._area(basemap), options=self.options)
        return self._beside_held_others([place(unit) for unit in units], others, basemap)

    def _area(self, basemap: MapWindow | None) -> WorkArea:
        return WorkArea(self.epsg, self.origin, basemap, self.options.device)

    def follow(self, frames: Sequence[Frame]) -> None:
        """Track a vehicle's pictures and keep that (`RefinerOptions.kept`), for `refine` of the same frames."""
        for unit in self.units(frames):
            tracked_flight(unit, self._area(None), self.options)

    def again(self, solution: Solution, neighbours: Sequence[Solution], basemap: MapWindow | None) -> Solution:
        """Refine a vehicle again with neighbours that were not refined, or refined without a map, when it was.

        Its other pictures (late ones, those of another camera) move with the refined ones. The earlier solution stays
        as it is, and is returned where the vehicle has no neighbours.
        """
        own = deepcopy(unit_states(solution))
        others = [state for n in neighbours for state in unit_states(n)]
        if not own or not any(neighbours_of(state, others) for state in own):
            return solution
        outdated = {warning for state in own for warning in findings(state)}
        now = self._beside_held_others(own, others, basemap)
        refined = {p.frame.image for p in now.placed}
        extra = [p for p in solution.placed if p.frame.image not in refined]
        own_frames = [p for p in now.placed if p.frame.image not in solution.dropped]
        return replace(
            now,
            placed=[*own_frames, *move_with_neighbours(extra, solution.placed, now.placed)],
            dropped=dict(solution.dropped),
            warnings=list(dict.fromkeys([*now.warnings, *(w for w in solution.warnings if w not in outdated)])),
        )

    def _beside_held_others(
        self, own: list[VehicleState], others: Sequence[VehicleState], basemap: MapWindow | None
    ) -> Solution:
        """The second pass of one vehicle's units, others held as they are."""
        area = self._area(basemap)
        own = register_unfound(own, others, area, serial)
        own = join_unmapped(own, others, area, serial)[0]
        everyone = [*own, *others]
        correction = level_corrections([ground_points(s.flight.adjustment)[0] for s in everyone])
        anchor = float(np.mean(correction[len(own) :])) if others else 0.0
        done = list(own)
        task: Task = partial(second_pass, area=area)
        for k in sorted(range(len(own)), key=lambda k: not own[k].on_map):  # carried blocks last
            neighbours = neighbours_of(own[k], everyone if own[k].on_map else [*done, *others])
            item = (own[k], neighbours, float(correction[k]) - anchor)
            done[k] = whole(task, item)
        distortion = map_distortion_sigma([*done, *others])
        for state in done:
            if state.on_map:  # what neighbours carry has it with their sigma
                state.sigma_m = np.hypot(state.sigma_m, distortion)
        terrain = common_terrain(done, others, dem=self.options.ground(self.origin).dem)[0]
        level = mapped_level(done, terrain)
        terrain = _shifted(terrain, self.origin)
        lean = pooled_lean(everyone)
        return merge_units([to_solution(s, self.origin, terrain, map_lean=lean, ground_z_m=level) for s in done])[0]

    def refined_frames(self, solution: Solution) -> list[Frame]:
        """The frames of the vehicle's blocks (placement.Refiner)."""
        return [frame for state in unit_states(solution) for frame in state.flight.frames]

    def refine_batch(
        self,
        vehicles: Mapping[str, Sequence[Frame]],
        basemap: MapWindow | None,
        run: Run = serial,
        progress: Progress | None = None,
        *,
        halo: Collection[str] = (),
    ) -> Refinement:
        """Place all vehicles of an area (placement.Refiner)."""
        area, origin, units = self._area(basemap), self.origin, units_of_area(vehicles)
        states, lost = first_passes(units, area, options=self.options, run=run, progress=progress)
        if not states:
            raise AdjustmentError(lost[0])
        below = _shifted(coarse_terrain(states), origin)
        coarse = [to_solution(s, origin, below, coarse=True) for s in states]
        states = _all_together(states, area, halo=halo, run=run, progress=progress)
        _level(states)
        distortion = map_distortion_sigma(states)
        for state in states:
            if lies_on_map(state):
                state.sigma_m = np.hypot(state.sigma_m, distortion)
        own = [s for s in states if s.vehicle not in halo] or states  # none of them may have been adjusted
        beside = [s for s in states if s.vehicle in halo] if len(own) < len(states) else []
        dem = self.options.ground(origin).dem
        terrain, warnings = common_terrain(own, beside, near_own=True, dem=dem, run=run)
        level = mapped_level(own, terrain)
        terrain = _shifted(terrain, origin)
        lean = pooled_lean(states)
        fine = [to_solution(s, origin, terrain, map_lean=lean, ground_z_m=level) for s in states]
        left = [unrefined(units[k], why, area.grid) for k, why in lost.items()]
        return Refinement(merge_units([*coarse, *left]), merge_units([*fine, *left]), terrain, warnings)


def register_unfound(
    states: list[VehicleState], others: Sequence[VehicleState], area: WorkArea, run: Run
) -> list[VehicleState]:
    """Register vehicles that were not found on the map on neighbours that were; then others on these, and so on.

    others: more that may carry them, as they are. Returns the states in order; the registered ones are `carried`.
    """
    out = list(states)
    lost = [k for k, s in enumerate(out) if s.had_map and not s.on_map]
    task = partial(register_to_neighbours, area=area)
    while lost:
        anchors = [s for s in [*out, *others] if lies_on_map(s)]
        items = [(k, neighbours_of(out[k], anchors)) for k in lost]
        items = [(k, near) for k, near in items if near]
        for (k, _), state in zip(items, run(task, [(out[k], near) for k, near in items]), strict=True):
            out[k] = state
        still = [k for k in lost if not out[k].carried]
        if len(still) == len(lost):
            break
        lost = still
    return out


def _all_together(
    states: list[VehicleState], area: WorkArea, *, halo: Collection[str], run: Run, progress: Progress | None
) -> list[VehicleState]:
    """All vehicles again on a common level with neighbours held; mapped ones of the halo have done their part."""
    states = register_unfound(states, [], area, run)
    states, unmapped = join_unmapped(states, [], area, run)
    correction = level_corrections([ground_points(s.flight.adjustment)[0] for s in states])
    task: Task = partial(second_pass, area=area)
    out, count = list(states), 0

    def again(which: Sequence[int], beside: Sequence[VehicleState]) -> None:
        nonlocal count
        items = [(states[k], neighbours_of(states[k], beside), float(correction[k])) for k in which]
        for k, state in zip(which, run(task, items), strict=True):
            out[k], count = state, count + 1
            if progress:
                progress("joint", count, len(states))

    again([k for k, s in enumerate(states) if s.on_map and s.vehicle not in halo], states)
    # After the mapped ones: their refined pictures hold it, and its accuracy is theirs at best.
    again([k for k, s in enumerate(states) if s.carried and not s.on_map], out)
    # Without a map no vehicle is the reference: each is tied to those before it, or all would move at each pass.
    before: list[VehicleState] = []
    for k in (k for block in unmapped for k in block):
        again([k], before)
        before.append(out[k])
    return out


def _level(states: Sequence[VehicleState]) -> None:
    """Shift cameras and ground of each vehicle in height so that the vehicles' levels agree."""
    corrections = level_corrections([ground_points(s.flight.adjustment)[0] for s in states])
    for state, correction in zip(states, corrections, strict=True):
        adj = state.flight.adjustment
        adj.cameras.position[:, 2] += correction
        adj.points[:, 2] += correction
        state.dense[0][:, 2] += correction
        state.high[:, 2] += correction


def _shifted(terrain: Terrain | None, origin: Array) -> Terrain | None:
    if terrain is None:
        return None
    return replace(terrain, west=terrain.west + float(origin[0]), south=terrain.south + float(origin[1]))


def first_passes(
    units: list[list[Frame]], area: WorkArea, *, options: RefinerOptions, run: Run, progress: Progress | None
) -> tuple[list[VehicleState], dict[int, str]]:
    """Each vehicle by itself; those whose photos must be matched are matched and adjusted together first.

    units: frames of one vehicle and one lens each. Returns the states of all units that could be adjusted, in order,
    and unit -> why not, of the others.
    """
    # Learned matching is left to one process afterwards: its network takes 400 MB.
    task = partial(refine_tracked, area=area, options=options)
    states: list[VehicleState | None] = []
    for n, state in enumerate(run(task, units)):
        states.append(state)
        if progress:
            progress("solo", n + 1, len(units))
    unfollowed = [k for k, state in enumerate(states) if state is None]
    lost: dict[int, str] = {}
    if unfollowed:
        watch = Stopwatch()
        together = [units[k] for k in unfollowed]
        opened = _sparse_flights(together, area=area, options=options, run=run, progress=progress)
        watch.lap("tracks")
        lost = {k: flight for k, flight in zip(unfollowed, opened, strict=True) if isinstance(flight, str)}
        flights = [flight for flight in opened if not isinstance(flight, str)]
        place = partial(refine_matched, area=area, options=options)
        for k, state in zip([k for k in unfollowed if k not in lost], run(place, flights), strict=True):
            state.timings["tracks"] = watch.seconds["tracks"] / len(unfollowed)
            states[k] = state
    found = [state for state in states if state is not None]
    return _learned_registrations(found, area, run, progress), lost


def _sparse_flights(
    units: Sequence[list[Frame]], *, area: WorkArea, options: RefinerOptions, run: Run, progress: Progress | None
) -> list[FlightBlock | str]:
    """Flights of photos matched and adjusted together, each by itself where that fails; else the reason why not."""
    try:
        return list(open_sparse_flights(units, area.grid, area.origin, options.read, run=run, progress=progress))
    except AdjustmentError as error:
        if len(units) == 1:
            return [str(error)]
    alone = partial(_sparse_flights, area=area, options=options, run=run, progress=progress)
    return [flight for unit in units for flight in alone([unit])]


def _learned_registrations(
    states: list[VehicleState], area: WorkArea, run: Run, progress: Progress | None
) -> list[VehicleState]:
    """Learned matching, in this process, of flights that correlation did not find, then registration."""
    lost = [k for k, state in enumerate(states) if state.unfound]
    found = []
    for n, k in enumerate(lost):
        found.append(learned_registration(states[k], area))
        if progress:
            progress("learned registration", n + 1, len(lost))
    items = [(states[k], fit) for k, fit in zip(lost, found, strict=True)]
    out = list(states)
    for k, state in zip(lost, run(partial(registered_by, area=area), items), strict=True):
        out[k] = state
    return out
