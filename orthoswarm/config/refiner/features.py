"""Features, tracks and matches between pictures: following corners, SIFT pairs, overlap, the flow's focal length."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class FeaturesConfig:
    """Features, tracks and matches between pictures."""

    # Pictures at working scale
    work_width_px: int = 960
    """Longer side of the pictures on which corners are followed, pixels (chosen; not measured)."""
    small_width_px: int = 160
    """Columns of the reduced pictures that stay in memory (chosen; not measured)."""

    # Corners, followed from picture to picture
    cell_px: int = 80
    """One corner is followed in each cell of this size, pixels: about 48 in a picture of 640 x 480. Spread matters more
    than strength: the strongest corners sit on glints (over water such flights failed by 11 m)."""
    border_px: int = 9
    """Corners nearer to the picture's border are not begun, pixels: the window of the flow would leave it."""
    corner_window_px: int = 5
    """Window of the minimum-eigenvalue corner measure (Shi and Tomasi 1994), pixels (chosen; not measured)."""
    corner_floor: float = 1e-4
    """Least corner measure, as of OpenCV's cornerMinEigenVal: below it there is no texture (chosen; not measured)."""
    flow_sigma_px: float = 0.35
    """Sigma of a followed corner in working pixels: 0.05 of noise and a drift along the track (measured together on
    simulated flights; it gave the best adjustments)."""
    track_least_observations: int = 3
    """Shorter tracks are dropped: two rays cannot be checked (chosen; not measured)."""
    flow_inside_px: float = 3.0
    """Flow that ends nearer to the border is dropped, pixels (chosen; not measured)."""
    flow_median_limit_px: float = 12.0
    """Where the median flow is farther from the prediction, all is dropped, pixels (chosen; not measured)."""
    flow_gate_px: float = 5.0
    """Flow that is farther from the median of its picture is dropped, pixels (chosen; not measured)."""
    flow_least: int = 3
    """Fewer corners that agree are not a consensus (chosen; not measured)."""
    flow_chance_share: float = 0.1
    """Share of the corners that agree where pictures show different ground (textures of noise: 0.09 in the middle;
    past holes of flights in simulation 0.10 at most, where the ground is the same 0.25 or more, usually 0.6)."""
    shift_below_share: float = 0.3
    """Where a smaller share of the corners is followed, its shift is measured on the whole picture (chosen)."""
    shift_below_corners: int = 6
    """... or fewer corners than this (chosen; not measured)."""
    homography_below_share: float = 0.6
    """Where a smaller share is followed, the recorded angles are not what the pictures show (3 degrees are 17 pixels),
    and the homography is measured (chosen; not measured)."""
    anchor_photos: int = 48
    """Photos that are held so that corners are compared with their first observation (chosen for its memory)."""
    anchor_limit_px: float = 1.5
    """Largest correction by that comparison, pixels; beyond it the track begins anew there (chosen; not measured)."""

    # Lucas-Kanade windows (the size of the window is in klt.py)
    klt_least_texture: float = 2.0
    """Least eigenvalue of a window's gradient matrix a pixel, grey values squared (chosen; not measured)."""
    klt_step_px: float = 0.01
    """A smaller step ends the iterations, pixels (chosen; not measured)."""
    klt_rounds: tuple[int, int, int] = (8, 10, 8)
    """Most iterations: at half size, at full size, against the first observation (chosen; not measured)."""
    klt_mismatch: float = 0.75
    """Largest mean square error of a window from picture to picture, as a share of its variance (chosen)."""
    klt_anchor_mismatch: float = 0.4
    """Largest mean square error of a window against its first observation, as a share of its variance: stricter than
    from picture to picture, or tracks would creep (chosen; not measured)."""
    klt_noise_variance: float = 4.0
    """Noise of the picture that is added to both, grey values squared (chosen; not measured)."""

    # Homographies that pictures show by themselves
    homography_px: float = 3.0
    """Flow within this distance agrees with a homography, pixels (RANSAC; chosen; not measured)."""
    homography_share: float = 0.4
    """Least share of the flow that must agree (chosen; not measured)."""
    homography_least: int = 12
    """Fewest corners that must agree (chosen; not measured)."""
    pyramid_window_px: int = 21
    """Window of the flow over several octaves, pixels (OpenCV's default)."""
    pyramid_octaves: int = 4
    """Octaves below the full picture of that flow: it reaches some 16 windows (chosen; not measured)."""
    orb_corners: int = 1000
    """ORB corners (Rublee et al. 2011) of a turn that nobody recorded (chosen; not measured)."""
    orb_least: int = 30
    """Fewest ORB matches that must agree (chosen; not measured)."""
    orb_share: float = 0.25
    """Least share of the ORB matches that must agree (chosen; not measured)."""
    phase_reduction: int = 4
    """Phase correlation for a prediction's missing shift works on pictures reduced by this (chosen for its cost)."""
    phase_response: float = 0.05
    """Least response of that phase correlation (chosen; not measured)."""

    # Focal length and headings from the flow of whole pictures
    calibration_pairs: int = 24
    """About so many pairs of pictures of a flight, evenly over its legs (chosen for its cost)."""
    calibration_pairs_per_leg: int = 3
    """... at least so many of each leg (chosen; not measured)."""
    calibration_flow_share: float = 0.2
    """Expected flow of a pair, as a share of the picture's rows (chosen; not measured)."""
    calibration_span_photos: int = 8
    """A pair lies no more photos apart (chosen; not measured)."""
    calibration_reduced_from_px: int = 400
    """Pictures of more columns are halved first (chosen for its cost)."""
    calibration_response: float = 0.03
    """Least response of the pair's phase correlation (chosen; not measured)."""
    calibration_least_predicted_px: float = 2.0
    """A pair with less predicted flow gives no scale, pixels (chosen; not measured)."""
    calibration_least_flow_px: float = 1.0
    """A pair with less measured flow gives no scale, pixels (chosen; not measured)."""
    calibration_ratio: float = 10.0
    """Measured over predicted flow beyond this factor, either way, is a wrong peak (chosen; not measured)."""
    calibration_fov_deg: tuple[float, float] = (35.0, 135.0)
    """A focal length outside these fields of view does not exist: then the recorded height is wrong (chosen)."""
    calibration_least_height_m: float = 3.0
    """A median recorded height below this is none: the takeoff's, or a missing one (chosen; not measured)."""
    calibration_sigma: float = 0.03
    """Relative sigma of the focal length by flow: receivers drift and lag by some per cent (chosen; not measured)."""
    heading_ratio: float = 0.25
    """Pairs whose flow differs from the median by more than this share give no heading (chosen)."""
    heading_least_pairs: int = 3
    """Fewest pairs of a leg that give its heading (chosen; not measured)."""
    heading_spread_deg: float = 20.0
    """Headings are taken from the flow where its pairs agree to this, and no yaw is recorded, degrees (chosen)."""
    heading_wrong_deg: float = 40.0
    """A recorded yaw that is off by more is corrected, degrees (chosen; not measured)."""
    heading_wrong_spread_deg: float = 8.0
    """... if the pairs agree to this, degrees (chosen; not measured)."""
    heading_flip_deg: float = 150.0
    """From here on it is said to be turned by 180 degrees (words only)."""

    # Forward overlap
    dense_overlap: float = 0.8
    """Share of a picture that the next one must show for corners to be followed. Of 150 corners 106 to 127 survive at
    an overlap of 0.90, 76 to 109 at 0.81, 51 at 0.72 (measured on four cameras)."""
    dense_matched: float = 0.6
    """... and the share of the sampled pairs that must match at all (chosen; not measured)."""
    overlap_pixels: int = 240 * 180
    """Pixels of the reduced pictures on which the overlap is measured (chosen for its cost)."""
    overlap_samples: int = 12
    """Pairs that are sampled over the flight (chosen for its cost)."""

    # SIFT features
    sift_pixels: int = 480 * 360
    """Pixels of the reduced picture on which features are found, whatever its shape (measured on four real flights: 31
    to 53 ms a photo)."""
    sift_fine_pixels: int = 640 * 480
    """Pixels of the reduced picture for photos that matched too few others (measured likewise)."""
    sift_contrast: float = 0.02
    """Contrast threshold of SIFT (Lowe 2004: 0.03); lower, because ground is of little contrast (chosen on four real
    flights)."""
    sift_detected: int = 1500
    """Strongest features that are detected before they are spread (chosen; not measured)."""
    sift_cells: tuple[int, int] = (8, 6)
    """Cells of the picture, columns and rows (exchanged for portrait pictures), over which features are spread and
    tracks thinned (chosen; not measured)."""
    sift_per_cell: int = 16
    """Most features of a cell (chosen; not measured)."""
    sift_kept: int = 600
    """Most features of a photo (chosen for its cost)."""
    sift_sigma_px: float = 0.15
    """Sigma of a small feature's position in reduced pixels: residuals of the adjusted flights of four cameras are
    level up to a diameter of 3 pixels."""
    sift_sigma_share: float = 0.04
    """... beyond that it grows by this share of the diameter (measured on the same flights)."""

    # Pairs of photos
    match_ratio: float = 0.85
    """A match is clearly nearer than the next candidate: ratio test (Lowe 2004: 0.8; chosen on four real flights)."""
    match_least: int = 15
    """Fewest matches of a pair of photos (chosen on four real flights)."""
    plane_share: float = 0.03
    """Matches agree with one similarity of the plane within this share of the width: tilt and relief are none."""
    plane_scales: tuple[float, float] = (0.5, 2.0)
    """Scales of that similarity which are possible (chosen; not measured)."""
    epipolar_px: float = 1.5
    """Matches agree with one epipolar geometry within so many reduced pixels (MAGSAC; chosen on four real flights)."""
    ransac_rounds: int = 1000
    """Most rounds of both consensus searches (chosen for its cost)."""
    ransac_confidence: float = 0.999
    """Confidence at which they end earlier (chosen; not measured)."""
    pair_sectors: int = 6
    """Directions over which a photo's neighbours are spread (chosen; not measured)."""
    pair_best_distance: float = 0.4
    """Best distance of a pair as a share of its reach: nearer photos hold relief and tilt badly, farther ones share
    little ground (chosen; not measured)."""

    # Tracks of matched features
    track_longest: int = 20
    """Longest track; longer ones stay in pieces (chosen for its cost)."""
    track_per_cell: int = 2
    """Observations in a cell of a photo from which on further tracks are dropped (chosen for its cost)."""

    # Rectified patches
    peak_exclude_px: int = 4
    """The second peak of a correlation is sought farther than this from the first, pixels (chosen; not measured)."""
    search_wide_px: int = 16
    """Searches of more pixels than this to each side on the map look first at half size (from here on it saves time)
    ..."""
    search_promising_share: float = 0.6
    """... and then where that correlates with at least this share of its highest value. Of 1,030 sure first ties 3 are
    not found or lie elsewhere with 0.5, 13 with 0.65, 38 with 0.8."""
    gradient_floor: float = 1e-3
    """Least median gradient, grey values: a blank patch has no texture to compress (chosen; not measured)."""
