"""Both refiners: records, features, start values, adjustment, surface, registration, what runs when.

Robust scales are those of the Geman-McClure kernel, squared, of normalised residuals. Lengths of the surface that scale
with the flying height are stated for 150 m above ground.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordsConfig:
    """Records: defaults and trust."""

    theta_hat_deg: float = 70.0
    """Horizontal field of view where nothing is known: below that of most drones' cameras (paper III.B)."""
    default_height_m: float = 80.0
    """Height above ground where no photo records one, metres, until pictures give the scale. Measured on two flights at
    90 m with positions only, with 60, 80 and 100 m: error of the map 0.147, 0.142, 0.145 m (95 %: 0.51, 0.51, 0.48),
    heights off by 3.3, 2.8, 2.8 m."""
    usual_heights_m: tuple[float, float] = (50.0, 150.0)
    """Heights between which mapping flights are flown, metres: where the photos' spacing gives a height (chosen)."""
    usual_overlap: float = 0.75
    """Forward overlap of mapping flights as flight planners propose it, share: it makes spacing a height (chosen)."""
    position_sigma_m: float = 1.5
    """Sigma of a horizontal position, an axis, whose source states none, metres; receivers' drift has its own prior.
    Measured: 0.57 m on a real flight with a map (18 photos), whose real-time ground points lie within one stated sigma
    in 97 % of the axes (2 of 2 sigmas: all); 0.5, 1.5 and 3 m give 43 real photos without tags the same place on their
    control points (0.593, 0.593, 0.594 m rms). Drifting receivers exceed it (9 m, simulated)."""
    tagged_tilt_sigma: float = 0.03
    """Error of the ground point at a photo's centre through its recorded attitude, as a share of the height: 1.7
    degrees (chosen; not measured)."""
    leg_reach: int = 3
    """Frames before and after a frame between which the bend of the path is measured (chosen: one is noise)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FeaturesConfig:
    """Features, tracks and matches between pictures."""

    work_width_px: int = 960
    """Longer side of the pictures on which corners are followed, pixels (chosen; not measured)."""
    cell_px: int = 80
    """One corner is followed in each cell of this size, pixels: about 48 in a picture of 640 x 480. Spread matters more
    than strength: the strongest corners sit on glints (over water such flights failed by 11 m)."""
    flow_chance_share: float = 0.1
    """Share of the corners that agree where pictures show different ground (textures of noise: 0.09 in the middle;
    past holes of flights in simulation 0.10 at most, where the ground is the same 0.25 or more, usually 0.6)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialConfig:
    """Start values without a map."""

    default_fov_deg: float = 75.0
    """Field of view where no tag gives one, degrees: the middle of drones' cameras (chosen; not measured)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleConfig:
    """Bundle adjustment: priors, robust weights, steps, covariance."""

    point_step_limit_m: float = 50.0
    """Longest move of a point in one step, metres; near-parallel rays would throw it far (chosen; not measured)."""
    drift_mean_share: float = 3.0
    """Mean square of a drift for its variance about its mean, in the stated error without a map: a drift that grows
    evenly from 0 to d has a mean of d / 2 and a variance of d^2 / 12."""
    unknown_height_sigma_m: float = 30.0
    """Sigma of a sortie's common height offset where no height was recorded or it is not trusted, metres (chosen)."""
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


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightConfig:
    """One vehicle's relative block: what is solved at once, its priors, and pictures that cannot be solved."""

    longest_unit_photos: int = 600
    """Longer flights are solved in stretches that hold each other as neighbours, so that cost and memory stay bounded
    (chosen)."""
    kept_tracks: int = 8
    """Stretches whose tracks are kept for a refinement that follows, 7 MB each; older ones are removed (chosen)."""

    first_height_sigma_m: float = 0.5
    """Sigma of a recorded height to begin with, metres (chosen; not measured)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceConfig:
    """Terrain, dense ground points, height models, tall surfaces."""

    high_from_m: float = 6.0
    """From this height over the ground on cells without ground are searched for what stands high, metres."""
    high_to_share: float = 0.25
    """... up to this share of the flying height (chosen; not measured)."""

    tall_from_m: float = 1.5
    """What differs less from the ground belongs to it, metres (chosen; not measured)."""
    tall_hidden_cost: tuple[float, float] = (0.2, 0.4)
    """Least and greatest cost, in correlation, of a height at which something taller hides the cell from the picture
    compared (measured: with greater ones more roofs are whole and more of the ground behind them is raised)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationConfig:
    """Registration onto the map and onto neighbours."""

    coarse_reach_m: tuple[float, float] = (60.0, 150.0)
    """How far strips are searched, metres: first, and where that is refuted (chosen: receivers without corrections are
    within the first)."""
    first_tie_cell_m: float = 50.0
    """One tie point a leg in each cell of this size, metres, after the coarse registration (chosen for cost)."""
    tie_cell_m: float = 30.0
    """The same once the flight lies on the map (chosen for cost)."""
    false_matches: float = 1e-4
    """A flight is taken to lie on the map if a map of other ground would show an agreement of tie points as good as the
    one found so many times only (expected number of false matches); measured by benchmarks/robustness/wrong_maps.py."""
    link_cell_m: float = 40.0
    """One point a leg in each cell of this size, metres (chosen for cost)."""
    link_pictures: int = 3
    """Most other legs in which a point is observed, one picture each (chosen for cost)."""
    oblique_cell_share: float = 0.06
    """Distance of the positions, as a share of the flying height (chosen for cost)."""
    receiver_bias_sigma_m: float = 1.5
    """Bias of a receiver without corrections over a flight, an axis: multipath, satellites of its own (chosen; good
    receivers under open sky differ by 1 to 2 m)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StrategyConfig:
    """What runs when, and when a result is doubted."""

    schedule: tuple[float, ...] = (100.0, 100.0, 100.0, 100.0, 9.0, 9.0)
    """Robust scales of the steps without a map, squared, of normalised residuals. Starts are near enough for 10 sigmas
    (recorded poses, focal length by optical flow); two first steps at 1e4 gave the same accuracy on 31 runs of small
    flights and on 1,017 photos, and wrong tracks could carry the focal length away (docs/method.md)."""
    at_rest_share: float = 0.03
    """A focal length that still moves by this share in three steps is not at rest (chosen; not measured)."""
    area_pictures: int = 10_000
    """More pictures are solved in areas of no more than so many, each together with its neighbours (chosen for memory,
    and for the distance of nodes of the drawn ground: 1.4 m where 32,544 pictures in one area have 1.8 m)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperConfig:
    """The paper's refiner. It gives no numbers for most of these; docs/method.md says what is read into it."""

    scale_pairs: int = 40
    """Matched pairs a vehicle, about (chosen for cost)."""

    patch_search_m: tuple[float, float] = (30.0, 70.0)
    """Search radius of the first and the second attempt, metres (chosen; not measured)."""
