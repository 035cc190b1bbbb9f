"""What a refiner made of a batch, as the batch keeps it: without the states behind it, with what is carried along."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from orthoswarm.compute.stage_times import Stage
from orthoswarm.model.placement import PlacedFrame, Solution, Terrain


@dataclass(slots=True)
class Refinement:
    """What the refiner made: cameras before and after the map, the ground, and what concerns all vehicles.

    Attributes:
        coarse, fine: by vehicle. terrain: of the fine ones. warnings: what concerns all.
        map_lost: the map that was asked for turned out to be unreadable, so that it was not used.
    """

    coarse: list[Solution]
    fine: list[Solution]
    terrain: Terrain | None
    warnings: list[str] = field(default_factory=list)
    map_lost: bool = False


def append_carried(solutions: list[Solution], carried: Sequence[PlacedFrame]) -> None:
    """Add frames to the solutions of their vehicles (to the first one if a vehicle has none)."""
    for p in carried:
        own = next((i for i, s in enumerate(solutions) if s.vehicle == p.frame.vehicle), 0)
        solutions[own] = replace(solutions[own], placed=[*solutions[own].placed, p])


def shared_terrain(solutions: Sequence[Solution]) -> Terrain | None:
    """The ground that coarse solutions share, None where there is none."""
    return next((s.terrain for s in solutions if s.terrain is not None), None)


def split_time(stage: Stage, refinement: Refinement, until: str, with_map: bool) -> list[Stage]:
    """The refinement's time by stage: what was done before the map counts as coarse."""
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


def named(vehicle: str, warning: str) -> str:
    """A warning that begins with whom it is about."""
    return warning if warning.startswith(vehicle) else f"{vehicle}: {warning}"
