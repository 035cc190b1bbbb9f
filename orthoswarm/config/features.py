"""Features, tracks and matches between pictures."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FeaturesConfig:
    """Features, tracks and matches between pictures."""
