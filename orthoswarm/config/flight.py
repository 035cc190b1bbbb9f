"""One vehicle's relative block."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FlightConfig:
    """One vehicle's relative block."""
