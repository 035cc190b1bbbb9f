"""Checkpoints, and the displacement of the orthoimage against the map."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationConfig:
    """Checkpoints, and the displacement of the orthoimage against the map."""

    relief_sigma_m: float = 10.0
    """How far ground may lie off the mapped area's level where rays do not tell, one sigma, metres: holds the height of
    a point that one photo shows (chosen)."""
    same_place_m: float = from_zero(0.05)
    """A checkpoint within this distance of a control point is that point, metres (chosen: as surveys differ) ..."""
    same_name_m: float = from_zero(10.0)
    """... and within this one if it has its name: tables in other systems differ by a metre or two (chosen)."""

    least_picture_px: int = 200
    """Side that pictures of the report have at least where a map's pixel is large, pixels (chosen: one of 640 m would
    leave nothing to see)."""

    # Arrows of the report: blocks of the map found in the orthoimage
    block_px: int = 64
    """Side of a block, pixels (chosen; not measured)."""
    search_px: int = 15
    """How far it is searched, pixels (chosen)."""
    apart_px: int = 6
    """Correlations within this distance, pixels, belong to the same peak (chosen)."""
    most_blocks: int = 500
    """Most blocks of a map (chosen for its time)."""
    least_cover: float = 0.9
    """Least share of a block and of its search area that is drawn (chosen)."""
    least_peak: float = 0.4
    """Least correlation: on a map of another day a chance likeness reaches 0.3 (measured on simulated disasters)."""
    band_px: int = 500_000
    """Pixels that are compared at once (chosen for memory: gradients take a hundred bytes a pixel)."""
