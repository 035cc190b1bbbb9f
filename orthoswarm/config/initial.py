"""Start values without a map."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class InitialConfig:
    """Start values without a map."""
