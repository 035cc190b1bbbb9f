"""Planning: lines over an area, their order, sorties, and heights over ground.

Prices are shares of flying time or seconds; limits of a user's values are next to their error messages.
"""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningConfig:
    """Planning: lines over an area, their order, sorties, and heights over ground."""

    most_corners: int = 50_000
    """Areas, zones and lines with more corners are refused. Whether an outline crosses itself can take the square of
    their number: 13 s for a star of so many, four times that for one of twice as many (measured); a circle of so many
    is planned in a minute."""
    least_above_ground_m: float = 20.0
    """Least height of a flight over the highest ground below it, metres: trees, masts and errors of a height model
    (chosen)."""
    beside_m: float = 10.0
    """Ground up to so far beside a flight counts as ground below it, metres: 8 m by which receivers err (GPS SPS
    Performance Standard 2020, 95 %) and 2 m by which a vehicle may pass a waypoint (ArduCopter's WPNAV_RADIUS)."""
    by_vehicle_m: float = 1.0
    """How near a vehicle that follows the terrain by itself is taken to keep its height, metres (chosen)."""
    complete_share: float = 0.999
    """Share of an area from which on a plan covers it (chosen)."""
    target_share: float = 0.9996
    """Share up to which gaps of a plan are mended (chosen: above `complete_share` for errors of the flight)."""
    clearance_m: float = 1.0
    """Distance that is kept from no-fly zones where none is asked for, metres (chosen); an eighth of a picture's
    width if that is less."""
    quickest_s: float = 0.5
    """A warning says that cameras seldom release at shorter intervals, seconds (chosen)."""
    endurance_spare: float = 1.05
    """Where an endurance is too short, so many times what the farthest line needs is asked for (chosen)."""
    separation_m: float = 10.0
    """Least horizontal distance of vehicles, metres, if the user gives none (chosen: receivers err by 3 m) ..."""
    layer_m: float = 5.0
    """... or else their least difference in height, metres: that of the layers of ways out and home (chosen)."""
    launch_s: float = from_zero(5.0)
    """Time between takeoffs, and between landings, at one start, seconds (chosen)."""
    on_ground_m: float = 2.0
    """Up to this height over its takeoff a vehicle stands on the ground, metres (chosen)."""
    pad_distances: float = 1.5
    """Radius about a start that vehicles share, in separation distances; in it they take off and land in turn
    (chosen)."""
    in_turn_share: float = 0.25
    """Vehicles of one start take off and land in turn if the whole takes at most so much longer by that (chosen)."""
    orders_tried_share: float = 2.0 / 3.0
    """Where a smaller share of the vehicles has its turn within that, another order of them does not help (chosen)."""
