"""Start values without a map: headings, tilt and lens, ground scale, network of positions, segments and legs.

Robust schedules are scales c (squared sigmas) of successive solutions, from far off to near.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialConfig:
    """Start values without a map."""

    # Which pairs are tried
    pair_reach_share: float = 0.68
    """Photos nearer than this share of the footprint's diagonal may overlap (chosen on four real flights)."""
    weak_reach_share: float = 0.8
    """Photos with few matches are tried with others within this share of the diagonal (chosen; not measured)."""
    pairs_first: int = 3
    """Neighbours that each photo tries first, before the tilt is known (chosen; not measured)."""
    pairs_usual: int = 6
    """... and then (chosen; not measured)."""
    pairs_more: int = 12
    """... and for photos with few pairs (chosen; not measured)."""
    enough_pairs: int = 5
    """Photos with fewer pairs try more neighbours (chosen; not measured)."""
    weak_pairs: int = 2
    """Photos with fewer pairs get finer features (chosen on four real flights)."""
    weak_matches: int = 40
    """... and those with fewer matches in all (chosen on four real flights)."""
    pairs_per_task: int = 64
    """Pairs that a worker matches at a time (for speed alone)."""
    header_size_share: float = 0.02
    """A picture's shape may differ from its header's by so much: rounding of a reduced decode (chosen)."""

    # Headings
    course_sigma_deg: float = 2.0
    """Sigma of the course between two photos, besides that of their positions, degrees (chosen; not measured)."""
    course_sigma_limit_rad: float = 1.0
    """A course known no better than this is dropped, radians (chosen; not measured)."""
    course_shift_share: float = 0.3
    """... and one whose pair shows less than this share of the recorded way (chosen; not measured)."""
    turn_sigma_deg: float = 1.0
    """Sigma of the turn between two photos by relief and tilt, degrees (chosen; not measured)."""
    turn_misfit_sigmas: float = 3.0
    """... and so many times the misfit of the pair's matches over their spread, by the root of their number: they are
    not independent (chosen; not measured)."""
    heading_schedule: tuple[float, ...] = (400.0, 100.0, 36.0, 9.0, 9.0)
    """Robust schedule of the headings (chosen; not measured)."""
    heading_candidates: int = 360
    """Angles that are tried for the one that most courses support (chosen for its cost)."""
    heading_agree_deg: float = 20.0
    """Angles within this of each other agree, degrees (chosen; not measured)."""
    heading_rounds: int = 5
    """Rounds of the robust mean of those that agree (chosen; not measured)."""
    tag_least_photos: int = 3
    """Fewest photos with a yaw tag for it to be compared with the pictures (chosen; not measured)."""
    tag_better_share: float = 0.1
    """A second kind of yaw tag must agree on so many more of the photos (chosen; not measured)."""
    tag_agree_share: float = 0.5
    """Share of the photos whose tag must follow the pictures (chosen; not measured)."""

    # Tilt and lens from the shapes of matches
    shape_iterations: int = 12
    """Most Gauss-Newton iterations (chosen; they end earlier)."""
    shape_settled: float = 1e-3
    """A largest step below this, radians or relative, ends them (chosen; not measured)."""
    shape_most_matches: int = 64
    """Matches of a pair that are used, evenly picked (chosen for its cost)."""
    shape_independent_share: float = 0.05
    """Share of the matches that are independent: relief moves neighbouring points together (chosen; not measured)."""
    shape_floor_share: float = 1e-3
    """Least misfit of a pair, as a share of the picture's width (chosen; not measured)."""
    shape_tilt_step_rad: float = 0.15
    """Largest change of a tilt in one iteration, radians (chosen; not measured)."""
    shape_bend_limit: float = 0.3
    """Largest radial distortion at the picture's corner, as a share of the radius (chosen; not measured)."""
    shape_bend_sigma: float = 0.06
    """Prior sigma of that distortion (chosen; not measured)."""
    shape_rounds: int = 4
    """Reweightings of a pair's similarity (chosen; not measured)."""
    shape_robust_scale: float = 2.0
    """A match's weight falls to a quarter at so many median misfits (chosen; not measured)."""
    tag_tilt_sigma_deg: float = 3.0
    """Sigma of a segment's recorded tilt, degrees (chosen; not measured)."""
    free_tilt_sigma_deg: float = 9.0
    """Sigma of the tilt about straight down where most photos record none, degrees (chosen; not measured)."""
    tag_tilt_share: float = 0.5
    """Share of a segment's photos that must record a tilt (chosen; not measured)."""
    tag_tilt_limit_deg: float = 45.0
    """A recorded tilt beyond this is not a start: such a photo could not be matched anyway, degrees (chosen)."""
    tilt_floor_deg: float = 0.7
    """Least sigma of a tilt for the nadir's prior, degrees (chosen; not measured)."""
    tilt_sigma_factor: float = 2.0
    """The nadir's prior is so many times looser than the shapes' own sigma (chosen; not measured)."""

    # Focal length
    hint_fov_deg: tuple[float, float] = (30.0, 120.0)
    """Fields of view of lenses that exist, degrees: a tag or a height that implies another is dropped (chosen)."""
    default_fov_deg: float = 75.0
    """Field of view where no tag gives one, degrees: the middle of drones' cameras (chosen; not measured)."""
    hint_sigma: float = 0.06
    """Relative sigma of a focal length by tags (chosen; not measured)."""
    default_fov_sigma: float = 0.35
    """Relative sigma of the default focal length (chosen; not measured)."""
    height_focal_sigma: float = 0.12
    """Relative sigma of a focal length by recorded height: the takeoff level is not the ground's (chosen)."""
    focal_change: float = 0.03
    """A focal length by height that differs from the last by more than this share is solved for again (chosen)."""
    rounds: int = 2
    """Rounds of shapes, headings, scales and network (chosen; a third changed nothing)."""

    # One name, several lenses
    unlike_sigmas: float = 2.5
    """Vehicles' focal lengths that differ by more sigmas are of two lenses (chosen; not measured)."""
    unlike_share: float = 0.06
    """... and by more than this share (chosen; not measured)."""
    one_way_concentration: float = 0.9
    """Length of the mean of the headings' unit vectors from which on the shapes of matches do not give the focal
    length: the photos look one way (chosen; not measured)."""

    # Ground scale
    scale_least_way_m: float = 3.0
    """A pair whose positions are nearer gives no scale, metres (chosen; not measured)."""
    scale_least_shift_share: float = 0.02
    """... nor one whose pictures shift by less than this share of the width (chosen; not measured)."""
    scale_turn_cosine: float = 0.9
    """Cosine of the turn up to which a pair's shift hardly depends on the tilt (chosen; not measured)."""
    scale_lens_pairs: int = 3
    """With fewer such pairs of a lens, all its pairs count (chosen; not measured)."""
    scale_segment_pairs: int = 5
    """From so many such pairs on a segment has a scale of its own (chosen; not measured)."""
    scale_schedule: tuple[float, ...] = (100.0, 25.0, 9.0, 9.0)
    """Robust schedule of the photos' relative scales (chosen; not measured)."""
    zoom_sigma: float = 0.02
    """Relative sigma of the zoom between two photos by relief (chosen; not measured)."""
    zoom_misfit_sigmas: float = 3.0
    """... and so many times the misfit of their matches over the spread, by the root of their number (chosen)."""
    relative_height_sigma: float = 0.03
    """Relative sigma of a recorded height within its segment (chosen; not measured)."""
    relative_level_sigma: float = 0.15
    """Relative sigma of the height of a photo without a recorded one: about as level as its segment (chosen; not
    measured)."""
    height_known_share: float = 0.5
    """Share of a segment's photos that must record a height (chosen; not measured)."""
    height_least_m: float = 2.0
    """A median recorded height below this is that of a takeoff or none, metres (chosen; not measured)."""
    height_ratio: float = 5.0
    """A height beyond this factor of its segment's, either way, is dropped (chosen; not measured)."""

    # Network of positions
    network_schedule: tuple[float, ...] = (400.0, 400.0, 36.0, 9.0, 9.0)
    """Robust schedule of pairs and recorded positions (chosen on four real flights)."""
    network_gate_sigmas: float = 5.0
    """Pairs and recorded positions farther off the network are wrong (chosen on four real flights)."""
    pair_sigma_m: float = 0.6
    """Sigma of a pair's vector, metres (chosen on four real flights)."""
    pair_sigma_share: float = 0.05
    """... and this share of the distance of its matches from the nadirs (chosen on four real flights)."""
    lag_spread_s: float = 0.3
    """Scatter of the delay of recorded positions along the way, seconds (chosen on four real flights)."""
    stated_sigma_floor_m: float = 0.1
    """Least sigma of a position whose source states one: an antenna is not a camera, metres (chosen; not measured)."""
    network_still_m_s: float = 0.1
    """A slower vehicle has no direction along the way (chosen; not measured)."""
    link_sigma: float = 0.15
    """Relative sigma of a segment's ground scale about its lens's (chosen; not measured)."""
    link_height_sigma: float = 0.03
    """Relative sigma of a segment's ground scale where recorded heights scale it (chosen; not measured)."""
    lens_scale_sigma: float = 0.5
    """Relative sigma of a lens's ground scale (chosen; not measured)."""

    # Velocities between photos
    velocity_least_s: float = 0.05
    """Photos nearer in time give no velocity, seconds (chosen; not measured)."""
    velocity_limit_m_s: float = 40.0
    """Faster is a leap of the record (chosen: faster than small drones fly)."""
    velocity_turn_share: float = 0.5
    """Where the velocities before and after differ by more than this share, the vehicle turned (chosen)."""
    course_least_m_s: float = 0.3
    """Slower photos have no course for a heading (chosen; not measured)."""

    # Segments and legs
    segment_gap_s: float = 180.0
    """A longer pause ends a segment: landing, battery (chosen on four real flights)."""
    segment_climb_m: float = 5.0
    """A larger jump of the recorded height ends a segment (chosen on four real flights)."""
    segment_tilt_deg: float = 1.5
    """A larger jump of the recorded tilt ends it: the gimbal was turned (chosen on four real flights)."""
    segment_jump_sigmas: float = 5.0
    """A jump must exceed so many sigmas of the record's own noise as well: a camera that sways is not turned at every
    photo (chosen; not measured)."""
    leg_still_m: float = 1.5
    """Shorter steps have no direction (chosen; not measured)."""
    leg_turn_deg: float = 35.0
    """A leg ends where a step leaves the mean of its steps by more than this (chosen; not measured)."""

    # Photos without recorded positions, placed by surveyed points
    free_pair_share: float = 0.02
    """Two level photos put the centre of their matches so far apart, sigma as a share of the picture's width: tilts of
    two or three degrees and relief (chosen)."""
    free_scale_sigma: float = 0.02
    """... and their scales and turns differ from those of the similarity by so much, sigma, radians or relative (chosen
    for tilts of two or three degrees)."""
    free_schedule: tuple[float, ...] = (400.0, 400.0, 100.0, 100.0, 36.0, 9.0, 9.0, 9.0)
    """Robust schedule of that network (as that of the headings)."""
    anchor_apart_sigmas: float = 10.0
    """Two surveyed points turn and scale such photos if they lie so many sigmas apart (chosen)."""
    anchor_most: int = 60
    """So many observations of the ground take part in the search for their common similarity (chosen for its cost)."""
    free_nadir_share: float = 0.05
    """The ground straight below such a photo lies so far from where its level picture has it, sigma as a share of its
    width: tilts of three degrees at a field of view of 60 (chosen)."""
    free_most_pairs: int = 40_000
    """Most pairs that are tried where nothing tells which photos overlap: 280 photos, some two minutes of CPU (chosen
    for its cost)."""
