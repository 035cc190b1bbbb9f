"""What runs when, and when a result is doubted."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class StrategyConfig:
    """What runs when, and when a result is doubted."""

    start_fov_deg: float = 80.0
    """Horizontal field of view to start from where no tag hints at one, degrees (chosen; the pictures correct it)."""

    # Without a map
    schedule: tuple[float, ...] = (100.0, 100.0, 100.0, 100.0, 9.0, 9.0)
    """Robust scales of the steps without a map, squared, of normalised residuals. Starts are near enough for 10 sigmas
    (recorded poses, focal length by optical flow); two first steps at 1e4 gave the same accuracy on 31 runs of small
    flights and on 1,017 photos, and wrong tracks could carry the focal length away (docs/method.md)."""
    full_lens_steps: int = 4
    """Steps at the last scale more where all parameters of a lens are solved (chosen; not measured)."""
    records_weighed_step: int = from_zero(3)
    """After this step, counted from 0, records are weighted by their residuals, and the ground is fitted (chosen: the
    adjustment has nearly converged by then)."""
    first_steps: int = 2
    """Steps, from the first, with the wide height prior of the next two fields (chosen) ..."""
    first_ground_sigma_m: float = 3.0
    """Sigma of points about the expected ground in these steps, metres (chosen; not measured)."""
    first_ground_robust_c: float = 1e3
    """Robust scale of that prior, squared sigmas: nearly none (chosen; not measured)."""
    ground_sigma_m: float = 2.0
    """The sigma in all later steps, metres (chosen; not measured)."""
    ground_robust_c: float = 1.0
    """The robust scale in all later steps, squared sigmas (chosen; not measured)."""
    flow_pairs: int = 6
    """Fewest pairs of pictures whose flow gives a focal length before an adjustment is compared with it (chosen; not
    measured)."""
    runaway_share: float = 0.15
    """An adjustment whose focal length differs from that of the flow by this share has found another minimum and is
    rejected, unless the flow itself is that uncertain (next field; chosen)."""
    runaway_sigmas: float = 5.0
    """... and by so many of its sigmas (chosen; not measured)."""
    solved_inliers: float = 0.7
    """Least share of a tracked flight's observations that fit its adjustment. Of 17 flights, four without heights over
    relief of 25 m ended elsewhere, with 0.00 to 0.40; the others have 0.93 to 0.98. Those four are right when matched
    in pairs."""
    narrowest_fov_deg: float = 33.0
    """Recorded heights are rejected if they lead to a horizontal field of view below this, degrees; a little below the
    narrowest that is accepted from flow (chosen)."""
    widest_fov_deg: float = 137.0
    """... or above this, degrees; a little above the widest that is accepted from flow (chosen)."""

    # Recorded heights that the pictures contradict
    rest_steps: int = 3
    """Steps after which a contradiction must still be there (chosen; not measured)."""
    free_steps: int = 6
    """Steps of a round without the recorded heights (chosen; not measured)."""
    free_rounds: int = 4
    """So many rounds at most (chosen; not measured)."""
    at_rest_share: float = 0.03
    """A focal length that still moves by this share in three steps is not at rest (chosen; not measured)."""
    agreeing_share: float = 0.08
    """Pictures that, set free, come to rest within this share of the recorded height do not contradict it (chosen)."""

    # On the map
    map_fov_sigmas: float = 6.0
    """A registration on the map that changes the field of view by more sigmas than this is rejected (chosen; not
    measured) ..."""
    map_fov_deg: float = 4.0
    """... and by more than this, degrees (chosen; not measured)."""
    coherent_sigmas: float = 2.0
    """Ties around a picture whose common offset exceeds so many sigmas show an error that the covariance does not
    contain (chosen; not measured)."""

    # Neighbours
    neighbour_reach_heights: float = 1.5
    """Vehicles whose paths come within so many flying heights share ground (chosen; not measured)."""
    area_pictures: int = 10_000
    """More pictures are solved in areas of no more than so many, each together with its neighbours (chosen for memory,
    and for the distance of nodes that `drawn_nodes` allows: 1.4 m where 32,544 pictures in one area have 1.8 m)."""
    area_shift_sigma_m: float = 1.0
    """How well an area's receivers tell its place, an axis, and its level, metres; over its extent the same of its turn
    and scale: some 30 of them, 2 m each, and what they have in common (chosen; areas that no map holds are moved onto
    each other within it)."""
    area_tie_sigma_m: float = 0.3
    """How well a vehicle's place agrees in two areas that it was solved in, an axis, metres (chosen)."""
    leg_link_steps: int = 6
    """Steps of a flight without a map once its legs are linked to each other (chosen; not measured)."""
    second_steps: int = from_zero(4)
    """Steps of the second pass without a map (chosen; not measured)."""

    # What the field of view's sigma takes in
    takeoff_level_sigma_m: float = 2.0
    """How well the takeoff spot is known to lie at the level of the ground, metres (chosen; not measured)."""
    no_height_share: float = 0.03
    """Sigma of the focal length of followed pictures without a height, a share: relief and tilt tell it (15 flights:
    2.5 % rms)."""
    one_way_fov_sigma_deg: float = 5.0
    """Sigma of the field of view of photos on one straight line, degrees: tilt, height and lens cannot be separated (11
    such legs of a suburb: 5.6 rms)."""
    decentred_share: float = 0.02
    """What tangential distortion, which is not modelled, does to the focal length of a strong lens, a share (measured:
    1.6 %)."""

    # Terrain
    terrain_reach_heights: float = 1.1
    """Terrain is made to so many flying heights beyond the cameras (chosen: a wide lens sees as far)."""
    terrain_points: int = 60
    """Fewer points make no common terrain; that of the first vehicle is taken (chosen; not measured)."""

    # A given height model
    dem_differs_m: float = 0.2
    """What is left over a given height model is said from here on, metres (chosen)."""
    dem_covers_share: float = 0.97
    """A height model that covers more than this of the area covers it (chosen)."""

    # In flight
    followed_fewest: int = 10
    """Fewer pictures are not followed from one to the next but matched in pairs (chosen; not measured)."""
    sparse_fewest: int = 4
    """Fewer photos are not placed in flight (chosen; not measured)."""
    sparse_most: int = 60
    """More photos that must be matched in pairs wait for the refinement: they cost fifty times as much as those that
    can be followed."""
    held_drift_m: float = 3.0
    """Sigma of a receiver's drift over one straight run, metres: tilt and drift cannot be separated there. Without
    this prior single legs were up to 12 m off on the map or not found; with it 2 to 4 m (simulated flights)."""
    held_drift_bend_m: float = 0.3
    """Sigma of the second difference of the drift's knots over that run, metres (measured together)."""
    held_lag_s: float = 0.2
    """Sigma of the delay of positions behind the shutter over that run, seconds (measured together)."""
    one_way_sigma_share: float = 0.025
    """Error of a leg's coarse placement on the map as a share of the height (simulated flights: 2 to 4 m)."""
    many_ways_sigma_share: float = 0.014
    """Error of the coarse placement with two or more legs in opposite directions, a share of the height (simulated
    flights: 0.5 to 2 m)."""
    odd_focal_change: float = 0.2
    """A placement whose focal length left its start by more than this, as a logarithm, is not shown (chosen)."""
    odd_height_change: float = 0.2
    """A placement whose height changed by more than this, as a logarithm, is not shown (chosen; not measured)."""
    odd_turn_deg: float = 12.0
    """A placement whose attitude turned by more than this where tilt was recorded, degrees, is not shown (chosen; not
    measured)."""
