"""What runs when, and when a result is doubted."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StrategyConfig:
    """What runs when, and when a result is doubted."""
