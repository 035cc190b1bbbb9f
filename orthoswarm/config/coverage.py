"""Coverage: what counts as seen, flaws of pictures, missing pictures, gaps."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class CoverageConfig:
    """Coverage: what counts as seen, flaws of pictures, missing pictures, gaps."""

    cell_m: float = 1.0
    """Side of the cells, metres (chosen)."""
    most_cells: int = 60_000_000
    """Areas with more cells are refused, or need larger ones (chosen for memory)."""
    oblique_deg: float = 45.0
    """Ground that is seen farther from straight down is seen obliquely, degrees (chosen); from
    `mosaic.most_off_nadir_deg` on it is not seen at all."""
    lens_sigmas: float = from_zero(2.0)
    """Plans over gaps take the solved field of view less so many sigmas (chosen: 98 % of the lenses are wider)."""
    smallest_gap_m2: float = from_zero(4.0)
    """Smaller gaps are only counted, square metres (chosen)."""

    # Flaws of pictures, by comparison with those before and after
    neighbours: int = 15
    """Pictures before and after with whose median one is compared (chosen)."""
    blurred_share: float = 0.5
    """Blurred: less than this share of their sharpness; over a wood and over a lake it differs by less (chosen)."""
    faint_share: float = 0.25
    """Haze: less than this share of their contrast (chosen) ..."""
    least_contrast: float = 4.0
    """... or less than this, grey levels (chosen) ..."""
    saturated_share: float = 0.5
    """... or more than this share of the pixels saturated (chosen)."""
    flat_share: float = 0.10
    """Damaged: this share of the blocks more than usual is of one single value (chosen)."""

    # Missing pictures
    hole_steps: float = 1.6
    """Usual steps between two pictures from which on one is missing (chosen)."""
    straight_deg: float = 20.0
    """Steps of one straight leg differ by less than this in direction, degrees (chosen)."""
    most_missing: int = from_zero(400)
    """Most missing pictures that are made up in one hole (chosen for its time)."""
    slack_s: float = from_zero(0.05)
    """Camera events this near in time to a picture are its own, seconds (chosen)."""
    match_share: float = 0.45
    """An event belongs to a picture within this share of the usual time between events (chosen: below a half)."""
    least_matched: float = 0.5
    """Share of a vehicle's pictures that must have an event: else its clocks disagree, and events say nothing
    (chosen)."""
    sure: float = 0.95
    """Confidence of a cause that camera events show (chosen)."""
    borrowed_lens: float = 0.6
    """Confidence in what a vehicle has seen of which no picture has arrived: its lens is not known (chosen)."""
