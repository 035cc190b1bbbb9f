"""Terrain, dense ground points, height models, tall things."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SurfaceConfig:
    """Terrain, dense ground points, height models, tall things."""
