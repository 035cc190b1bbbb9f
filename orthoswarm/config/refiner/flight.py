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

    # Priors of followed flights

    first_height_sigma_m: float = 0.5
    """Sigma of a recorded height to begin with, metres (chosen; not measured)."""
