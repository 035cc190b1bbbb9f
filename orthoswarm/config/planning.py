"""Planning: how near the ground flights come, and in what order vehicles of one start take off."""

from dataclasses import dataclass
from typing import Final

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningConfig:
    """Planning."""

    least_above_ground_m: float = 20.0
    """Least height of a flight over the highest ground below it, metres: trees, masts and errors of a height model."""
    launch_s: float = from_zero(5.0)
    """Time between takeoffs, and between landings, at one start, seconds."""
    in_turn_share: float = 0.25
    """Vehicles of one start take off and land in turn if the whole takes at most so much longer by that, a share."""
    quickest_s: float = 0.5
    """A warning says that cameras seldom release at shorter intervals, seconds."""


PLANNING: Final = PlanningConfig()
"""What is usual."""
