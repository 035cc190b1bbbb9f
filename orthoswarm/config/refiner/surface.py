"""Terrain, dense ground points, height models, tall surfaces.

Lengths that scale with the flying height are stated for `reference_height_m` above ground.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceConfig:
    """Terrain, dense ground points, height models, tall surfaces."""

    # Vertical line locus (the ASPRS manual's term): heights at free positions

    high_from_m: float = 6.0
    """From this height over the ground on cells without ground are searched for what stands high, metres."""
    high_to_share: float = 0.25
    """... up to this share of the flying height (chosen; not measured)."""

    # What stands on the ground, measured by a plane sweep on the nodes that it is drawn on

    tall_from_m: float = 1.5
    """What differs less from the ground belongs to it, metres (chosen; not measured)."""
    tall_hidden_cost: tuple[float, float] = (0.2, 0.4)
    """Least and greatest cost, in correlation, of a height at which something taller hides the cell from the picture
    compared (measured: with greater ones more roofs are whole and more of the ground behind them is raised)."""
