"""Bundle adjustment: priors, robust weights, steps, covariance.

Robust scales `_c` are those of the Geman-McClure kernel e^2 / (1 + e^2 / c), e in sigmas (see bundle/robust_kernel.py).
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleConfig:
    """Bundle adjustment: priors, robust weights, steps, covariance."""

    track_robust_c: float = 9.0
    """Robust scale of image observations once an adjustment is near its minimum, squared sigmas: 3 sigmas (chosen)."""
    tie_robust_c: float = 9.0
    """Robust scale of ties to the map, squared sigmas, where a step names no other (chosen; not measured)."""
    position_robust_c: float = 9.0
    """Robust scale of recorded horizontal positions, squared sigmas (chosen; not measured)."""
    attitude_robust_c: float = 25.0
    """Robust scale of recorded attitudes, squared sigmas: wider than that of positions (chosen; not measured)."""
    height_robust_c: float = 4.0
    """Robust scale of the points' height prior, squared sigmas, where it names no other (chosen; not measured)."""
    inlier_weight: float = 0.5
    """An observation counts as an inlier from this robust weight on (chosen; not measured)."""
    damping_share: float = 1e-6
    """Added to the diagonal of the cameras' normal equations as a share of itself (Levenberg 1944; chosen)."""
    point_step_limit_m: float = 50.0
    """Longest move of a point in one step, metres; near-parallel rays would throw it far (chosen; not measured)."""
    attitude_bias_sigma_deg: tuple[float, float, float] = (1.0, 1.0, 3.0)
    """Sigma of a sortie's common attitude error about the camera's x, y, z axes, degrees: mounting, gimbal, compass.
    Biases of made-up flights were found to 0.1 degrees with it."""
    height_offset_sigma_m: float = 1.0
    """Sigma of a sortie's common offset of recorded heights, metres (chosen; not measured)."""
    drift_sigma_m: float = 15.0
    """Sigma of the drift of a receiver without corrections, metres (chosen; made-up flights drift by up to 10 m)."""
    drift_mean_share: float = 3.0
    """Mean square of a drift for its variance about its mean, in the stated error without a map: a drift that grows
    evenly from 0 to d has a mean of d / 2 and a variance of d^2 / 12."""
    drift_bend_sigma_m: float = 0.5
    """Sigma of the second difference of the drift's knots, metres: it changes slowly (chosen; not measured)."""
    drift_knot_photos: int = 60
    """Photos between two knots of the piecewise linear drift (chosen; not measured)."""
    unknown_height_sigma_m: float = 30.0
    """Sigma of a sortie's common height offset where no height was recorded or it is not trusted, metres (chosen)."""
    contradiction_sigmas: float = 4.0
    """Recorded heights are contradicted where the offset that pictures alone give exceeds so many of its sigmas."""
    contradiction_share: float = 0.15
    """... and this share of the height: distortion and principal point of real lenses, as far as they are not modelled,
    also look like a wrong height (measured: 10 % on a lens of k1 = -0.4 that looks straight down)."""
    agreement_sigmas: float = 2.0
    """What an offset exceeds so many sigmas by enters the sigma of the field of view (chosen; not measured)."""
    covariance_every_photos: int = 24
    """Covariances are computed for every so many-th photo and interpolated between (chosen for its cost)."""
    sigma_floor_m: float = 0.05
    """Least sigma of a photo on the ground where no map tells it, metres (chosen; not measured)."""
    stated_sigma_factor: float = 1.25
    """The stated sigma is this times the sigma of an axis, to stand between both meanings of "the error" of a point on
    the ground: of Gaussian errors 79 and 98.8 % of each axis lie within one and two of it, and 54 and 95.6 % of their
    lengths."""
    tie_scatter_share: float = 0.4
    """Share of the map ties' scatter that the ties of a photo have in common (terrain, lens, what the map shows): no
    number of ties averages it away. Fitted together with the two below to 30 simulated sets of 15 to 339 photos a
    vehicle: heights of 80 to 250 m, lenses, noise, maps of 0.2 to 2 m, blurred and noisy ones."""
    map_floor_px: float = 0.058
    """Error that no residual shows, in pixels of the compared map (fitted as above)."""
    tied_covariance_share: float = 0.8
    """Factor of the covariance where map ties determine a photo: corners are tracked better than their sigma (0.05 and
    not 0.35 px, with a drift between; fitted as above)."""
    scatter_least_ties: int = 40
    """With fewer ties the adjustment follows them, and their residuals are too small: their scatter is then at least
    their sigma (chosen; not measured)."""
    systematic_least_ties: int = 4
    """With fewer ties about a photo a systematic offset of the map there is not estimated (chosen; not measured)."""
    systematic_reach_photos: int = 4
    """... which uses the ties of so many photos before and after, of the same leg (chosen; not measured)."""
    variogram_most_ties: int = 200
    """Of more ties every so many-th is used: pairs grow with their square (chosen for its cost)."""
    variogram_classes: int = 9
    """Classes of distance between ties; the first ends at ... (chosen; not measured)."""
    variogram_near_heights: float = 0.1
    """... so many flying heights (chosen; not measured) ..."""
    variogram_far_share: float = 0.85
    """... the last at this share of the largest distance: few pairs are farther apart (chosen; not measured)."""
    variogram_least_pairs: int = 30
    """A class with fewer pairs is left out (chosen; not measured)."""
    variogram_least_classes: int = 3
    """With fewer classes the map's distortion is not estimated: two variances and a length are fitted."""
    variogram_flat_share: float = 0.1
    """Classes weigh by their value, those below this share of the largest alike (chosen; not measured)."""
    correlation_lengths: int = 8
    """Correlation lengths that are tried, from ... (chosen for its cost)."""
    correlation_heights: float = 0.2
    """... so many flying heights to ... (chosen; not measured)"""
    correlation_radii: float = 1.5
    """... so many radii (root mean square) of the vehicle's ties: ties do not tell longer ones from a shift."""
    systematic_sigmas: float = 2.0
    """So many sigmas of the ties' median are taken off before it counts as a systematic offset (chosen)."""
    oblique_axis_down: float = 0.2
    """A photo whose axis points down by less (vertical component of the unit vector) has no sigma of its centre; its
    height above the ground is stated (chosen; not measured)."""
    course_reach_photos: int = 3
    """Flown steps are medians over so many photos before and after (chosen; not measured)."""
    course_turn_deg: float = 12.0
    """... of those whose heading differs by less, degrees (chosen; not measured)."""
    step_time_factor: float = 1.7
    """... and that took at most so many times longer or shorter: a missing picture doubles the step (chosen)."""
    velocity_reach_photos: int = 2
    """Velocities are differences over so many photos before and after (chosen; not measured)."""
    velocity_leap: float = 3.0
    """A velocity above so many times the median, plus 1 m/s, is a leap of the record and counts as 0 (chosen)."""
