"""The first pass of a batch: each vehicle by itself, or matched together with others, then registered on the map."""

from collections.abc import Sequence
from functools import partial

from orthoswarm.model.errors import AdjustmentError
from orthoswarm.model.frame import Frame
from orthoswarm.model.task_runner import Progress, Run
from orthoswarm.refine.flight.relative_block import FlightBlock
from orthoswarm.refine.flight.sparse_block import open_sparse_flights
from orthoswarm.refine.registration.block_state import Stopwatch, VehicleState, WorkArea
from orthoswarm.refine.strategy.vehicle_passes import (
    RefinerOptions,
    learned_registration,
    refine_matched,
    refine_tracked,
    registered_by,
)


def first_passes(
    units: list[list[Frame]], area: WorkArea, *, options: RefinerOptions, run: Run, progress: Progress | None
) -> tuple[list[VehicleState], dict[int, str]]:
    """Each vehicle by itself; those whose photos must be matched are matched and adjusted together first.

    units: frames of one vehicle and one lens each. Returns the states of all units that could be adjusted, in order;
    unit -> why not, of the others.
    """
    # Learned matching is left to one process afterwards: its network takes 400 MB.
    task = partial(refine_tracked, area=area, options=options, learned=False)
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
        place = partial(refine_matched, area=area, options=options, learned=False)
        for k, state in zip([k for k in unfollowed if k not in lost], run(place, flights), strict=True):
            state.timings["tracks"] = watch.seconds["tracks"] / len(unfollowed)
            states[k] = state
    found = [state for state in states if state is not None]
    return _learned_registrations(found, area, run, progress), lost


def _sparse_flights(
    units: Sequence[list[Frame]], *, area: WorkArea, options: RefinerOptions, run: Run, progress: Progress | None
) -> list[FlightBlock | str]:
    """Flights whose photos are matched and adjusted together, each by itself where that fails; else the reason.

    A vehicle whose photos match nothing must not keep the others from being adjusted.
    """
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
