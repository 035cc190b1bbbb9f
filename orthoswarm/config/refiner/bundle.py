"""Bundle adjustment: priors, robust weights, steps, covariance.

Robust scales `_c` are those of the Geman-McClure kernel e^2 / (1 + e^2 / c), e in sigmas (see bundle/robust_kernel.py).
"""

from dataclasses import dataclass


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
