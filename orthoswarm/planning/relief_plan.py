"""A plan over a height model: legs at constant height above ground, or all at one height, whichever is done sooner."""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Final, Literal

import numpy as np

from orthoswarm.config.planning import PLANNING
from orthoswarm.model.errors import InputError
from orthoswarm.model.placement import Terrain
from orthoswarm.model.plan import Plan
from orthoswarm.planning.lines.line_spacing import Footprint
from orthoswarm.planning.lines.planned_coverage import COMPLETE_SHARE
from orthoswarm.planning.sorties.flight_heights import FlightHeights, GroundHeights, LevelHeights

Relief = Literal["auto", "follow", "level"]
MakePlan = Callable[[float, Footprint, FlightHeights], Plan]
"""Plans with a footprint, the height above level ground that it belongs to, and the flights' heights."""

_BY_VEHICLE_M: Final = 1.0  # how near a vehicle that follows the terrain by itself is taken to keep its height
_CLOSER_SHARE: Final = 0.93  # on slopes lines are laid lower by this, each round, until all is covered
_CLOSER_ROUNDS: Final = 4  # most such rounds (time)


@dataclass(frozen=True, slots=True)
class GroundBelow:
    """The ground below a plan, metres over the lowest takeoff."""

    terrain: Terrain  # its heights
    highest: Terrain  # the highest ground up to `BESIDE_M` from each place
    low_m: float  # lowest ground of the area
    high_m: float  # highest
    way_m: float  # highest ground of the area, of the ways to it, and beside them
    _: KW_ONLY
    least_above_m: float = PLANNING.least_above_ground_m  # least height of a flight over the highest ground below it


def plan_over_relief(
    make: MakePlan,
    lens: Callable[[float], Footprint],
    ground: GroundBelow,
    *,
    above_m: float,
    tolerance_m: float,
    relief: Relief = "auto",
    by_vehicle: bool = False,
) -> Plan:
    """The plan that is done sooner, among those whose ground pixels are as fine as `above_m + tolerance_m` gives.

    Legs that follow the ground stay within the tolerance of `above_m` over it. Legs at one height are as high as the
    pixels of the lowest ground allow, and lie as close as the highest ground asks for; where the area is flat within
    the tolerance they are always the faster ones.

    Args:
        make: plans. lens: footprint of the narrowest camera from a height above level ground.
        ground: below the area and the ways to it. above_m: height of legs above ground. tolerance_m: of that height.
        relief: "follow" or "level" for one kind only.
        by_vehicle: the vehicle keeps its height above the ground by a model of its own; the plan counts on 1 m.

    Raises:
        InputError: lower than `ground.least_above_m` above the ground, or as `make`.
    """
    kept_above_m = ground.least_above_m
    if not 0.0 < tolerance_m <= 0.5 * above_m:
        raise InputError(
            f"the tolerance of the height above ground is {tolerance_m:g} m; give more than 0 and at most half of "
            "--altitude"
        )
    level_m = min(0.5 * (ground.low_m + ground.high_m) + above_m, ground.low_m + above_m + tolerance_m)
    level_fits = level_m - ground.way_m >= kept_above_m
    flat = ground.high_m - ground.low_m <= 2.0 * tolerance_m
    if relief == "level" and not level_fits:
        raise InputError(
            f"at one height, {level_m:.0f} m above takeoff, the flight would be {level_m - ground.way_m:.0f} m above "
            f"the highest ground, and {kept_above_m:g} m must be kept; let the legs follow the ground, or give "
            f"--altitude {np.ceil(above_m + kept_above_m - level_m + ground.way_m):.0f} or more"
        )
    plans = []
    if relief == "follow" or (relief == "auto" and not (flat and level_fits)):
        least_m = above_m - tolerance_m
        if least_m < kept_above_m:
            raise InputError(
                f"{above_m:g} m above ground, less a tolerance of {tolerance_m:g} m, are less than the "
                f"{kept_above_m:g} m that must be kept; give a larger --altitude"
            )
        kept_m = min(tolerance_m, _BY_VEHICLE_M) if by_vehicle else tolerance_m
        heights = GroundHeights(
            ground=ground.terrain, highest=ground.highest, above_m=above_m, tolerance_m=kept_m, by_vehicle=by_vehicle,
            least_above_m=kept_above_m,
        )  # fmt: skip
        plans.append(_closely_enough(make, lens, heights, least_m))
    if relief != "follow" and level_fits:
        level = LevelHeights(
            level_m,
            ground=ground.terrain,
            highest=ground.highest,
            nominal_m=above_m,
            least_above_m=kept_above_m,
        )
        plans.append(_closely_enough(make, lens, level, level_m - ground.high_m))
    return min(plans, key=lambda plan: (not _complete(plan), plan.makespan_s))


def _closely_enough(make: MakePlan, lens: Callable[[float], Footprint], heights: FlightHeights, least_m: float) -> Plan:
    """A plan with lines as close as the slopes ask for: across a slope pictures are narrower than over a level."""
    best: Plan | None = None
    for closer in _CLOSER_SHARE ** np.arange(_CLOSER_ROUNDS):
        above_m = float(closer) * least_m
        plan = make(above_m, lens(above_m), heights)
        if best is None or (plan.covered_share or 1.0) > (best.covered_share or 1.0):
            best = plan
        if _complete(plan):
            break
    assert best is not None
    return best


def _complete(plan: Plan) -> bool:
    return plan.covered_share is None or plan.covered_share >= COMPLETE_SHARE
