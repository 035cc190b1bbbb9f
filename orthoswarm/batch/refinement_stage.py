"""The refinement stage of a run: selection of frames, the refiner, its failures, and its results."""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from orthoswarm.batch.area_refinement import SolvedArea, divide, refine_by_area, with_frames
from orthoswarm.batch.refiners import make_refiner
from orthoswarm.batch.run_state import RunContext, RunState
from orthoswarm.compute.stage_times import Clock, Stage
from orthoswarm.compute.workers import trim_memory
from orthoswarm.control.ground_control import place_on_control
from orthoswarm.model.errors import OrthoSwarmError, RunInterruptedError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import local_origin
from orthoswarm.model.placement import PlacedFrame, Refinement, Solution
from orthoswarm.mosaic.recorded_pose import hint_lone_photos
from orthoswarm.raster.map_check import UnreadableMapError
from orthoswarm.refine.flight.unsolved_pictures import place_by_neighbours, split_refinable
from orthoswarm.refine.registration.map_offset import control_warning, measure_control_offset, measure_map_offset


def refine(run: RunContext, state: RunState) -> Refinement | None:
    """Refine all vehicles: coarse and fine cameras, without the refiner's states; None if none could be placed."""
    by_kind = split_refinable(state.recorded.placed)
    state.still, state.odd = by_kind.still, by_kind.odd
    state.warnings += by_kind.warnings
    if not by_kind.fit:
        if state.basemap is not None and run.options.until == "fine":
            state.warnings.append("the basemap was not used; the orthoimage lies where the receivers say")
        return None
    frames = hint_lone_photos(by_kind.fit)
    known: tuple[Refinement, list[Stage], bool] | None = run.space.recall("refinement")
    if known is not None:
        refinement, stages, map_unreadable = known
        run.clock.stages += stages
        state.basemap = None if map_unreadable else state.basemap
        return with_frames(refinement, frames)
    outer = Clock(run.workers.usage)
    with outer.stage("refine", len(frames)) as stage:
        try:
            refinement = _refined(run, frames, state)
        except RunInterruptedError:  # what is done is kept, and the same command goes on
            raise
        except OrthoSwarmError as error:
            state.warnings.append(f"the pictures could not be refined ({error}); the map is the real-time one")
            return None
        except Exception as error:  # in the field a rough map is better than none; the error is reported in full
            logging.getLogger(__name__).exception("the refinement failed")
            state.fault = f"the refinement failed ({type(error).__name__}: {error})"
            state.warnings.append(f"{state.fault}; the map is the real-time one")
            return None
    for solutions in (refinement.coarse, refinement.fine):
        placed = [p for s in solutions for p in s.placed]
        _append_carried(solutions, place_by_neighbours(by_kind.odd, by_kind.fit, placed))
    stages = _split_time(stage, refinement, run.options.until, state.basemap is not None)
    run.clock.stages += stages
    map_unreadable = state.basemap is None and run.options.basemap is not None
    run.space.remember("refinement", (refinement, stages, map_unreadable))
    return refinement


def onto_ground(state: RunState, refinement: Refinement) -> Refinement:
    """Compare the map with the receivers; then move all frames onto the control points, if there are any."""
    state.map_offset = measure_map_offset(state.recorded.placed, [p for s in refinement.fine for p in s.placed])
    if state.control_points:
        gsd = None if state.basemap is None else state.basemap.native_gsd_m
        refinement, state.control = place_on_control(refinement, state.control_points, state.grid, gsd)
        state.warnings += [*state.control.warnings, *_control_doubt(state, refinement)]
    if state.map_offset is not None and (state.control is None or state.control.on_map is None):
        state.warnings += state.map_offset.warning()  # control points on the map answer it
    return refinement


def _control_doubt(state: RunState, moved: Refinement) -> list[str]:
    """Compare control points with the receivers; points in a wrong datum agree with each other, and with nothing else.

    Args:
        state: the run; gets the offset. moved: all frames after the control.
    """
    assert state.control is not None
    on_map = state.control.on_map
    fit = on_map or state.control.by_receivers
    if fit is None:
        return []
    placed = [p for s in moved.fine for p in s.placed if (p.stage == "fine") == (on_map is not None)]
    sigma = float(fit.similarity.sigma_m(fit.similarity.middle))
    state.control_offset = measure_control_offset(state.recorded.placed, placed, sigma)
    if state.control_offset is None:
        return []
    shift = None if on_map is None else on_map.similarity.values[:2]
    return control_warning(state.control_offset, state.map_offset, shift)


def _refined(run: RunContext, frames: Sequence[Frame], state: RunState) -> Refinement:
    """Run the refinement; without the map if that proves unreadable after its check.

    Photos adjusted to each other are better than the real-time picture, and hours of work may be done already.
    """
    try:
        return _call_refiner(run, frames, state)
    except UnreadableMapError as error:
        lost = f"{error}: it was not used, the orthoimage is the coarse one and lies where the receivers say"
    state.basemap = None
    refinement = _call_refiner(run, frames, state)
    refinement.warnings.append(lost)
    return refinement


def _call_refiner(run: RunContext, frames: Sequence[Frame], state: RunState) -> Refinement:
    refiner = make_refiner(
        run.options.refine, state.grid.epsg, local_origin(state.grid, frames), state.dem, state.pictures,
        device=run.options.config.matchers.device,
    )  # fmt: skip
    vehicles: dict[str, list[Frame]] = {}
    for frame in frames:
        vehicles.setdefault(frame.vehicle, []).append(frame)
    basemap = state.basemap if run.options.until == "fine" else None
    # Vehicles that were refined with a map that was lost later are not the same as those without it.
    lost = state.basemap is None and run.options.basemap is not None
    label = "vehicle without map" if lost else "vehicle"
    areas = _areas(vehicles, state, run.options.config.strategy.area_pictures)
    if len(areas) > 1:
        return refine_by_area(run, refiner, vehicles, basemap, areas=areas, grid=state.grid, label=label)
    refinement = refiner.refine_batch(vehicles, basemap, run.space.remembering(label, run.workers.map), run.progress)
    # The states behind the solutions are by far the largest part and are not needed any more.
    refinement.coarse, refinement.fine = (
        [replace(s, state=None) for s in solutions] for solutions in (refinement.coarse, refinement.fine)
    )
    refinement = with_frames(refinement, frames)
    trim_memory()
    return refinement


def _areas(vehicles: Mapping[str, Sequence[Frame]], state: RunState, most_pictures: int) -> list[SolvedArea]:
    """The areas of no more than so many pictures that the vehicles are solved in."""
    at = {p.frame.image: p.camera.position for p in state.recorded.placed}
    paths = {vehicle: np.array([at[frame.image] for frame in frames]) for vehicle, frames in vehicles.items()}
    return divide(paths, most_pictures)


def _append_carried(solutions: list[Solution], carried: Sequence[PlacedFrame]) -> None:
    """Add frames to the solutions of their vehicles (to the first one if a vehicle has none)."""
    for p in carried:
        own = next((i for i, s in enumerate(solutions) if s.vehicle == p.frame.vehicle), 0)
        solutions[own] = replace(solutions[own], placed=[*solutions[own].placed, p])


def _split_time(stage: Stage, refinement: Refinement, until: str, with_map: bool) -> list[Stage]:
    """The refinement's time by stage: the part before map registration counts as coarse."""
    laps: Counter[str] = Counter()
    for solution in refinement.fine:
        laps.update(solution.timings)
    total = sum(laps.values())
    if until == "coarse" or not with_map or total <= 0:
        return [replace(stage, name="coarse: refinement")]
    share = sum(laps[name] for name in ("tracks", "relative")) / total
    return [
        Stage("coarse: refinement", share * stage.wall_s, share * stage.cpu_s, stage.items),
        Stage("fine: refinement", (1 - share) * stage.wall_s, (1 - share) * stage.cpu_s, stage.items),
    ]
