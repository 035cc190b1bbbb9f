"""One vehicle's relative block: what is solved at once, its priors, and pictures that cannot be solved."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightConfig:
    """One vehicle's relative block: what is solved at once, its priors, and pictures that cannot be solved."""

    # What is solved at once

    longest_unit_photos: int = 600
    """Longer flights are solved in stretches that hold each other as neighbours, so that cost and memory stay bounded
    (chosen)."""
    kept_tracks: int = 8
    """Stretches whose tracks are kept for a refinement that follows, 7 MB each; older ones are removed (chosen)."""
    own_unit_photos: int = 6
    """Fewer photos of another camera name but the same size stay with the vehicle's main camera (chosen)."""
    unit_gap_m: float = 500.0
    """Groups of photos at least so far apart are solved like different vehicles: they show no common ground, so what
    places the one says nothing about the other (chosen: more than the footprint of a photo from 200 m) ..."""
    unit_gap_steps: float = 10.0
    """... and at least so many times the usual distance of a photo to the nearest one: of high flights lines are far
    apart (chosen: with overlaps of 80 and 20 % lines are five times as far apart as photos)."""
    least_photos_of_kind: int = 3
    """Fewer photos of one camera and size are not refined but placed by their neighbours (chosen)."""
    hover_share: float = 0.05
    """A vehicle whose positions spread by less than this share of its height hovers: metres per pixel come from the
    distance flown, and the record is better than an estimate from none (chosen; not measured)."""
    wander_share: float = 0.3
    """... also if they spread by less than this share, but as a receiver's noise does (chosen; not measured)."""
    wander_steps: float = 0.9
    """Noise: steps are longer than this share of the positions' rms spread (chosen; not measured)."""
    wander_photos: int = 6
    """Least photos to tell noise from a way (chosen; not measured)."""
    unsolved_neighbours: int = 5
    """Solved neighbours by which an unsolved picture is placed (chosen; not measured)."""
    unsolved_sigma_m: float = 2.0
    """Added in squares to the largest sigma of those neighbours, metres (chosen; not measured)."""

    # Followed flights

    followed_photos: int = 10
    """Flights of fewer photos are matched in pairs instead of being followed (chosen; not measured)."""
    followed_overlap: float = 0.78
    """Flights of less forward overlap are matched in pairs: of 150 corners 106 to 127 survive at an overlap of 0.90, 76
    to 109 at 0.81, 51 at 0.72, 15 to 42 at 0.52 (measured on real and simulated sets)."""
    followed_calibration_pairs: int = 3
    """With fewer pairs for the first focal length a flight is matched in pairs (chosen; not measured)."""
    followed_survival: float = 0.5
    """Least median share of tracks that survive into the next picture (chosen; not measured)."""
    followed_tracks_factor: float = 3.0
    """Least number of tracks, times the square root of the number of photos (chosen; not measured)."""
    unbroken_survival: float = 0.3
    """Least share of tracks that survive into each picture of an unbroken chain. Photos without a height mostly have no
    angles either, and what lies behind a break is then held by positions alone."""
    few_photos: int = 100
    """Flights of fewer photos are followed at four times as many corners (chosen; not measured)."""
    predicted_step_share: float = 0.8
    """A step longer than this share of the picture's height is not predicted by the record (chosen)."""

    # Priors of followed flights

    stated_position_floor_m: float = 0.02
    """Least sigma of a position that states its own (RTK), metres (chosen; not measured)."""
    first_height_sigma_m: float = 0.5
    """Sigma of a recorded height to begin with, metres (chosen; not measured)."""
    height_leap_m: float = 5.0
    """A recorded height that leaves those around it by more than this is a spike, which is replaced by theirs, or a
    climb, metres (chosen; not measured)."""
    fastest_climb_m_s: float = 10.0
    """Greatest rate at which heights are a climb or descent and no spike, metres per second (multirotors: up to 8)."""
    height_reach_photos: int = 3
    """Photos before and after whose median is compared with a recorded height (chosen; not measured)."""
    height_sigma_range_m: tuple[float, float] = (0.1, 2.0)
    """Range of the sigma of recorded heights after a look at their noise, metres (chosen; not measured)."""
    attitude_sigma_range_deg: tuple[float, float] = (0.05, 3.0)
    """Range of the sigma of recorded attitudes after a look at their noise, degrees (chosen; not measured)."""
    tilt_sigma_deg: float = 0.2
    """First sigma of recorded pitch and roll about their common bias, degrees (chosen; not measured)."""
    free_tilt_sigma_deg: float = 3.0
    """Sigma of pitch and roll that were not recorded, degrees (chosen; not measured)."""
    yaw_sigma_deg: float = 0.2
    """First sigma of recorded headings about their common bias, degrees (chosen; not measured)."""
    free_yaw_sigma_deg: float = 5.0
    """Sigma of headings that were not recorded, degrees (chosen; not measured)."""
    heading_reach_photos: int = 7
    """A heading that was not recorded follows from those of so many photos before and after (chosen: a turn between
    legs takes fewer)."""
    heading_least_corners: int = 10
    """Fewest tracked corners that tell how far a photo is turned from the one before (chosen; not measured)."""
    untimed_lag_sigma_s: float = 0.3
    """Sigma of the lag of recorded positions where photos have no time, in steps between photos (chosen)."""
    lens_sigma: tuple[float, float, float] = (0.3, 0.1, 0.03)
    """Sigma of log f, k1, k2 of a lens (chosen; not measured)."""
    strong_k1: float = 0.12
    """A lens with a larger |k1| distorts so much that two parameters do not describe it (chosen; not measured)."""
    strong_lens_sigma: tuple[float, float, float, float] = (0.3, 0.3, 0.2, 0.3)
    """Sigma of log f, k1, k2, k3 of such a lens (chosen; not measured)."""
    principal_point_share: float = 0.012
    """Sigma of the principal point of lenses that are solved in full, as a share of the picture's width (chosen)."""

    # Sparse photos: records and their sigmas

    sparse_outlier_sigma_m: float = 5.0
    """Sigma of a position taken from the network of pairs, where the receiver is an outlier, metres (chosen)."""
    sparse_stated_floor_m: float = 0.03
    """Added in squares to the sigma of a position that states its own, metres (chosen; not measured)."""
    sparse_position_sigma_m: float = 1.0
    """Sigma of a recorded position across the way, metres; along the way a varying lag is added, so that it is less
    than that of other flights (`records.position_sigma_m`). Measured on two flights with photos 75 m apart: with 1.0
    and 1.5 ground is 0.91 and 0.97 m off under hard noise, 0.72 and 0.72 m under usual noise; on the map 0.037 m
    both."""
    sparse_stated_height_floor_m: float = 0.05
    """Least sigma of a height whose position states its sigma, metres (chosen; not measured)."""
    sparse_height_sigma_m: float = 0.3
    """Sigma of a recorded height about the common offset, metres (chosen; not measured)."""
    sparse_free_height_sigma_m: float = 1.5
    """Sigma of a height that was not recorded, about the common one, metres (chosen; not measured)."""
    sparse_stated_offset_sigma_m: float = 0.1
    """Sigma of the common offset of recorded heights where positions state their sigmas, metres (chosen)."""
    sparse_stated_lag_sigma_s: float = 0.2
    """Sigma of the lag of recorded positions where they state their sigmas, seconds (chosen; not measured)."""
    sparse_bias_sigma_deg: tuple[float, float, float] = (15.0, 15.0, 5.0)
    """Sigma of a sortie's attitude bias about the camera's x, y, z axes, degrees: tags of tilted cameras may lack the
    tilt (a camera tilted by 15 degrees without tags was found)."""
    sparse_drift_sigma_m: float = 4.0
    """Sigma of the receiver's drift, metres (chosen; not measured)."""
    sparse_drift_bend_m: float = 2.5
    """Sigma of the second difference of the drift's knots, metres (chosen; not measured)."""
    sparse_drift_knot_photos: int = 12
    """Photos between two knots of the drift (chosen; not measured)."""

    # Sparse photos: adjustment

    sparse_stage_c: tuple[float, float, float, float] = (1e4, 400.0, 50.0, 9.0)
    """Robust scale c of each stage, squared sigmas: graduated non-convexity (chosen; not measured)."""
    sparse_stage_steps: tuple[int, int, int, int] = (4, 4, 5, 10)
    """Most steps of each stage (chosen; not measured)."""
    sparse_first_damping: float = 1e-4
    """Damping of the steps of the first stage (chosen; not measured)."""
    sparse_damping: float = 1e-6
    """Damping of the steps of later stages (chosen; not measured)."""
    sparse_converged_share: float = 2e-4
    """A step that moves no camera farther than this share of its height is the last of its stage (chosen)."""
    sparse_plane_sigma_m: float = 3.0
    """Sigma of all points about level ground in the first stage, metres (chosen). Later a plane would pull the cameras
    down on flat ground seen straight down, where focal length and heights scale together unseen."""
    sparse_plane_soft_sigma_m: float = 20.0
    """Sigma of the weak prior beside it that is not robust, metres (chosen; not measured)."""
    sparse_plane_c: float = 1e3
    """Robust scale c of that plane, squared sigmas (chosen; not measured)."""
    sparse_datum_sigma_m: float = 3.0
    """Sigma of the median of all points about the takeoff level, metres (chosen; not measured)."""
    sparse_held_lens_sigma: float = 0.02
    """Sigma of log f and k1 in the first stage (chosen; not measured)."""
    sparse_lens_sigma: tuple[float, float] = (0.1, 0.05)
    """Sigma of k1 and k2 (chosen; not measured)."""
    sparse_full_lens_sigma: tuple[float, float, float] = (0.2, 0.2, 0.3)
    """Sigma of k1, k2, k3 of a lens solved in full: a tight k2 bends the focal length of a lens that distorts strongly,
    as distortion goes with powers of it."""
    sparse_full_lens_observations: int = 800
    """Least observations of a lens that is solved in full (chosen; not measured)."""
    sparse_full_lens_photos: int = 8
    """Least photos of such a lens (chosen; not measured)."""
    sparse_first_attitude_sigma_deg: float = 3.0
    """Sigma of attitudes from the pairs until the last stage, degrees (chosen; not measured)."""
    sparse_attitude_range_deg: tuple[float, float] = (1.0, 3.0)
    """Range of their sigma in the last stage, degrees. Tighter ones bend the focal length on flat ground (measured: 20
    degrees of field of view at 0.1 degrees, none from 1 degree on)."""
    sparse_attitude_scatters: float = 2.0
    """... within which it is so many times their scatter (chosen; not measured)."""
    sparse_least_sigma_px: float = 0.05
    """Least sigma of an observation after the sigmas are scaled to the residuals, pixels (chosen)."""
    sparse_scaled_observations: int = 20
    """With fewer observations the sigmas are not scaled (chosen; not measured)."""
    sparse_least_freedom: float = 0.2
    """Least redundancy (share of observations beyond the unknowns) reckoned with in that scaling (chosen)."""

    # Vehicles adjusted together

    joint_most_vehicles: int = 16
    """Of more vehicles those with the same camera name share one lens (chosen for cost)."""
    joint_lens_steps: int = 4
    """Steps with a lens for each vehicle (chosen; not measured)."""
    joint_lens_sigma: tuple[float, float, float, float] = (0.01, 0.01, 0.01, 0.05)
    """Sigma of log f, k1, k2, k3 of a vehicle's lens about the common one (chosen; not measured)."""
    joint_principal_point_share: float = 0.004
    """Sigma of its principal point about the common one, as a share of the picture's width (chosen)."""
    joint_lens_c: float = 9.0
    """Robust scale c of those steps, squared sigmas (chosen; not measured)."""
    held_position_sigma_m: float = 0.3
    """Sigma of positions found together, in the block of one vehicle, metres: it may be moved but keeps its shape."""
    held_attitude_sigma_deg: float = 0.3
    """Sigma of attitudes found together, degrees (chosen; not measured)."""
    held_lens_sigma: float = 0.003
    """Sigma of lens parameters found together (chosen; not measured)."""

    # Findings: the records compared with the pictures

    flipped_yaw_deg: float = 150.0
    """A recorded yaw that differs by more is reported as turned by 180 degrees (chosen)."""
    heading_offset_deg: float = 5.0
    """A larger common offset of recorded headings is reported, degrees (chosen)."""
    tilt_difference_deg: float = 2.0
    """A larger difference of recorded tilts is reported, degrees (chosen)."""
    tilt_difference_sigmas: float = 3.0
    """... if it exceeds so many of its sigmas (chosen)."""
    one_way_length: float = 0.9
    """Length of the mean unit vector of headings from which on a tilt cannot be told from a slope of the ground."""
    slope_deg: float = 6.0
    """Then a difference of tilts is reported only above this, degrees (chosen)."""
    oblique_deg: float = 35.0
    """A photo tilted more that matches no other is reported as oblique, degrees (chosen)."""
    height_difference_share: float = 0.15
    """A recorded height that differs by more is reported, as a share (chosen)."""
    height_difference_sigmas: float = 4.0
    """... and by more than so many sigmas of the focal length (chosen)."""
    least_height_m: float = 2.0
    """A recorded height below this cannot be meant and is reported, metres (chosen)."""
    lag_m: float = 1.0
    """A lag of recorded positions that moves them by more is reported, metres (chosen)."""
    lag_least_speed_m_s: float = 0.3
    """A lag is not estimated from slower photos, metres a second (chosen)."""
    named_most: int = 3
    """Runs of photos, or vehicles, that a message names (chosen)."""

    # Weakly held pictures

    held_observations: int = 8
    """Pictures with fewer well fitting observations are placed between their neighbours and left out of the mosaic
    while others cover the ground (chosen; not measured)."""
    held_weight: float = 0.3
    """Robust weight from which on an observation fits well (chosen; not measured)."""
    outlier_m: float = 4.0
    """A record farther than this from the middle of those around it is an outlier, metres (chosen)."""
    outlier_sigmas: float = 6.0
    """... and farther than so many times the usual distance (chosen; not measured)."""
    outlier_reach_photos: int = 2
    """Photos before and after that are asked (chosen; not measured)."""
    gap_m: float = 4.0
    """Where record and straight line differ by less, the record's shape is followed, metres (chosen)."""
    gap_share: float = 0.3
    """... or by less than this share of the gap's length (chosen; not measured)."""
    weak_sigma_m: float = 1.0
    """Sigma of a picture placed between its neighbours, metres (chosen; not measured)."""
    weak_sigma_per_photo_m: float = 0.1
    """... and more for each photo to the nearest held one, metres (chosen; not measured)."""
    weak_most_photos: int = 40
    """... up to so many photos (chosen; not measured)."""
    weak_disagreement_share: float = 0.5
    """Its sigma is at least this share of what record and line differ by (chosen; not measured)."""
