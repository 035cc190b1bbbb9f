"""Planning: lines over an area, their order, sorties, and heights over ground.

Prices are shares of flying time or seconds; limits of a user's values are next to their error messages.
"""

from dataclasses import dataclass

from orthoswarm.config.ranges import above_zero, from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningConfig:
    """Planning: lines over an area, their order, sorties, and heights over ground."""

    # Area
    most_corners: int = 50_000
    """Areas, zones and lines with more corners are refused. Whether an outline crosses itself can take the square of
    their number: 13 s for a star of so many, four times that for one of twice as many (measured); a circle of so many
    is planned in a minute."""

    # Heights over ground
    least_above_ground_m: float = 20.0
    """Least height of a flight over the highest ground below it, metres: trees, masts and errors of a height model
    (chosen)."""
    beside_m: float = 10.0
    """Ground up to so far beside a flight counts as ground below it, metres: 8 m by which receivers err (GPS SPS
    Performance Standard 2020, 95 %) and 2 m by which a vehicle may pass a waypoint (ArduCopter's WPNAV_RADIUS)."""
    beside_steps: float = 2.0
    """The highest ground is read at so many steps within that distance at least, where the number of nodes allows it
    (chosen: a coarser step would count ground that lies farther away)."""
    profile_finest_m: float = 1.0
    """Least distance of the places at which the ground below a flight is read, metres (chosen for its time)."""
    profile_coarsest_m: float = 10.0
    """Greatest distance of them, metres (chosen: slopes of up to 45 degrees)."""
    edge_rounds: int = 12
    """Bisections by which the highest ground between two such places is found (chosen: to millimetres)."""
    closer_share: float = above_zero(0.93)
    """Lines on slopes are laid for a lower flight, by this factor each round, until the ground is covered (chosen)."""
    closer_rounds: int = 4
    """Most such rounds (chosen for its time)."""
    by_vehicle_m: float = 1.0
    """How near a vehicle that follows the terrain by itself is taken to keep its height, metres (chosen)."""

    # Lines
    complete_share: float = 0.999
    """Share of an area from which on a plan covers it (chosen)."""
    target_share: float = 0.9996
    """Share up to which gaps of a plan are mended (chosen: above `complete_share` for errors of the flight)."""
    repair_rounds: int = from_zero(5)
    """Most rounds of mending (chosen for its time)."""
    repair_places: int = 8
    """Places in the order of the legs at which a leg that mends a gap is tried, nearest first (chosen for its time)."""
    crumb_m2: float = from_zero(0.5)
    """Smaller gaps are none, square metres: rounding of outlines (chosen)."""
    line_crumb_m2: float = from_zero(0.05)
    """Smaller parts of an area get no line of their own, square metres (chosen)."""
    stretch_spacings: float = 5.0
    """A vehicle's share of a long leg is at least so many line spacings long, or turns outweigh it (chosen)."""
    tmstc_crumb_share: float = 0.02
    """A cell of the spanning tree that holds a smaller share of the area is left out (chosen)."""
    tooth_spacings: float = 0.1
    """Outlines are simplified by so many line spacings before they are cut into cells: a ragged coast has a critical
    point at every tooth (chosen)."""
    outline_corners: int = 2_000
    """An area with more corners is given a coarser outline before lines are laid (chosen: outlines that are drawn or
    simplified for a map have fewer, and 4,000 cost no second)."""
    outline_spacings: float = 0.05
    """That outline lies outside the drawn one by at most twice so many line spacings (chosen: a twentieth is finer than
    vehicles and receivers place a line)."""
    edge_spacings: float = 0.1
    """Edges of an area whose directions are tried are those of its outline simplified by so many line spacings
    (chosen)."""
    edge_directions: int = 24
    """Longest edges of which the directions are tried (chosen for its time)."""
    direction_step_deg: float = 15.0
    """Further directions are tried at this step, degrees (chosen for its time)."""
    same_direction_deg: float = 1.0
    """Directions nearer to each other than this are tried once, degrees (chosen)."""
    same_grid_rad: float = 0.02
    """Directions of the spanning tree's grid nearer to each other than this are tried once, radians (chosen)."""
    ranked_spacings: float = 0.05
    """Outlines are simplified by so many line spacings before directions are ranked (chosen for its time)."""
    shortest_m: float = 0.01
    """Shorter parts of lines are rounding, metres."""
    gap_least_share: float = 0.2
    """A gap of which further legs would show a smaller share is left as it is (chosen)."""
    gap_walls: int = 8
    """Longest edges, of the gap and of obstacles around it, along which legs for it are tried (chosen for its time)."""
    gap_shifts: int = 7
    """Places across a gap at which they are tried (chosen for its time)."""
    gap_leg_price: float = from_zero(0.02)
    """Price of a line spacing of flight, in shares of the gap (chosen)."""
    exact_cells: int = 8
    """So many cells are put in the shortest order exactly (0.02 s)."""
    row_starts: int = 60
    """More cells are put in order from so many of them at most (chosen for its time) ..."""
    row_many: int = 80
    """... and up to this number of cells the order is improved ..."""
    row_rounds: tuple[int, int] = (20, 2)
    """... in so many rounds at most, with more cells in so many (chosen for its time)."""
    ordered_most_legs: int = from_zero(500)
    """Orders of more legs are not improved: cost grows with the square (chosen for its time)."""
    tries_if_few: int = 12
    """Directions that are tried where there are few lines, which are cheap to lay and hard to share (chosen)."""
    many_legs: int = 400
    """From so many legs on no further directions are tried: they hardly differ (chosen for its time)."""
    denser: float = 1.25
    """Closer lines are tried, too, up to so many times their number, where they can be shared more evenly (chosen)."""
    hopeless: float = 1.08
    """Gaps are not filled for a direction whose path is so many times as long as the best (chosen)."""
    detour_inside_m: float = from_zero(0.02)
    """How far a detour may pass inside an obstacle, metres: its corners touch it (chosen: rounding)."""
    obstacle_tolerance: float = 0.1
    """Obstacles are simplified outwards by this share of the clearance (chosen) ..."""
    obstacle_tolerance_m: float = 50.0
    """... doubled until they have few corners, up to this, metres (chosen)."""
    detour_most_corners: int = 300
    """Obstacles are simplified to so many corners: cost grows with their square (chosen for its time)."""

    # Sorties
    fair_balance: float = 1.15
    """The longest sortie over the mean up to which a division is fair (chosen)."""
    unfair_balance: float = 1.22
    """... and from which on it is priced steeply (chosen)."""
    balance_prices: tuple[float, float] = from_zero((2.0, 6.0))
    """Prices of what the balance is above either, in shares of the longest sortie (chosen)."""
    fair_enough: float = 1.25
    """From here on the plan says that it is uneven (chosen)."""
    better_share: float = 0.99
    """A later candidate must be better by this factor: the first ones are in the method's own, tidier order
    (chosen)."""
    clearance_m: float = 1.0
    """Distance that is kept from no-fly zones where none is asked for, metres (chosen), but at most ..."""
    clearance_widths: float = 0.125
    """... so many widths of a picture, so that no gap is left at a zone, and at least ..."""
    least_clearance_m: float = 0.1
    """... so many metres (chosen)."""
    quickest_s: float = 0.5
    """A warning says that cameras seldom release at shorter intervals, seconds (chosen)."""
    straight_cos: float = 0.985
    """Cosine of the angle up to which a vehicle comes straight into a leg and needs no run-in: 10 degrees (chosen)."""
    items_a_leg: int = 4
    """Mission items that a leg takes (two ends, camera on and off), to keep within an autopilot's limit."""
    spare_items: int = from_zero(40)
    """Mission items kept for ways, takeoff and landing (chosen)."""
    least_leg_triggers: float = 4.0
    """Legs are not cut shorter than so many distances of pictures (chosen), if the endurance allows it."""
    sortie_parts: float = 40.0
    """A leg's parts are at most this fraction of a sortie long, so that a sortie's limit is met closely (chosen)."""
    row_parts: float = 2000.0
    """Most parts of a vehicle's legs (chosen for its time)."""
    sortie_tries: int = 12
    """Most times that legs are cut again because a sortie is longer than was estimated (chosen) ..."""
    sortie_shorter: float = 0.005
    """... each time shorter by this share (chosen) ..."""
    sortie_shorter_growth: float = 1.6
    """... times this with each further one (chosen)."""
    endurance_spare: float = 1.05
    """Where an endurance is too short, so many times what the farthest line needs is asked for (chosen)."""
    first_cap: float = 1.3
    """Divisions are searched up to so many times the mean share first, which keeps the search narrow (chosen) ..."""
    cap_growth: float = 1.5
    """... then up to so many times more ..."""
    caps: int = 8
    """... so often, and at last without a limit (chosen)."""
    cut_price: float = from_zero(0.25)
    """Price of a cut within a leg, in the unit of what is divided, so that legs stay whole where that costs little
    (chosen)."""
    leeway: float = 1.04
    """How much longer than it must be the longest share may get so that legs stay whole (chosen)."""
    cuts_per_share: int = 24
    """Possible cuts in a share (chosen for its time)."""

    # Deconfliction
    separation_m: float = 10.0
    """Least horizontal distance of vehicles, metres, if the user gives none (chosen: receivers err by 3 m) ..."""
    layer_m: float = 5.0
    """... or else their least difference in height, metres: that of the layers of ways out and home (chosen)."""
    launch_s: float = from_zero(5.0)
    """Time between takeoffs, and between landings, at one start, seconds (chosen)."""
    step_s: float = 0.5
    """Time step in which flights are compared, seconds (chosen for its time)."""
    on_ground_m: float = 2.0
    """Up to this height over its takeoff a vehicle stands on the ground, metres (chosen)."""
    layer_price_s: float = from_zero(3.0)
    """Price of each further height layer, in seconds of delay (chosen)."""
    pad_distances: float = 1.5
    """Radius about a start that vehicles share, in separation distances; in it they take off and land in turn
    (chosen)."""
    in_turn_share: float = 0.25
    """Vehicles of one start take off and land in turn if the whole takes at most so much longer by that (chosen)."""
    orders_tried_share: float = 2.0 / 3.0
    """Where a smaller share of the vehicles has its turn within that, another order of them does not help (chosen)."""
