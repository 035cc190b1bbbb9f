"""Coverage: what counts as seen, flaws of pictures, missing pictures, gaps."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class CoverageConfig:
    """Coverage: what counts as seen, flaws of pictures, missing pictures, gaps."""

    cell_m: float = 1.0
    """Side of the cells, metres (chosen)."""
    oblique_deg: float = 45.0
    """Ground that is seen farther from straight down is seen obliquely, degrees (chosen); from
    `mosaic.most_off_nadir_deg` on it is not seen at all."""
    smallest_gap_m2: float = from_zero(4.0)
    """Smaller gaps are only counted, square metres (chosen)."""

    # Flaws of pictures, by comparison with those before and after
    blurred_share: float = 0.5
    """Blurred: less than this share of their sharpness; over a wood and over a lake it differs by less (chosen)."""

    # Missing pictures
    sure: float = 0.95
    """Confidence of a cause that camera events show (chosen)."""
