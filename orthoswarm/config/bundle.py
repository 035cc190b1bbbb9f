"""Bundle adjustment: priors, robust weights, steps, covariance."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BundleConfig:
    """Bundle adjustment: priors, robust weights, steps, covariance."""
