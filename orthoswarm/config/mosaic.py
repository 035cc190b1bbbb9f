"""Seam lines of the orthoimage.

Costs have the unit of what a cell's side of seam costs. Costs of areas are stated for a ground square whose side is the
flying height and are divided by it and by the cell's side, so that the same numbers hold for every height and every
ground pixel.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MosaicConfig:
    """Seam lines of the orthoimage."""

    obliqueness_cost: float = 15000.0
    """Cost of obliqueness, times the squared tangent of the view angle. Chosen by looking at four sets: with a
    third of it crowns lean over streets and masts lie down."""
    haze_cost: float = 6000.0
    """Cost of less local contrast than the clearest picture has on the same ground, times the logarithm of the ratio;
    chosen: half the contrast outweighs a view that is some 20 degrees more oblique."""
    haze_ignored_log: float = 0.3
    """Log ratios of contrast up to this cost nothing: parallax, shadows, noise; chosen."""
    glare_cost: float = 3000.0
    """Cost of ground that is burnt out (glints of water); chosen: as of a view at 25 degrees."""
    blur_cost: float = 6000.0
    """Cost of a picture that is less sharp than the median of those around, times the logarithm of the ratio; chosen
    like `haze_cost`."""
    blur_ignored_log: float = 0.25
    """Log ratios of sharpness up to this cost nothing; chosen: pictures of one scene taken well differ by less."""
    seam_cost: float = 3.0
    """Cost of a seam where both pictures are alike: keeps seams short and few; chosen by looking at four sets."""
    difference_scale: float = 16.0
    """The squared difference of the two pictures, in levels, is divided by this: edges that do not meet (roofs, cars)
    cost far more than texture does; chosen by looking at four sets."""
    texture_level: float = 8.0
    """Local contrast, levels, at which that scale doubles (it grows with the square): a seam through a wood does not
    show although its pictures differ everywhere; chosen."""
    difference_most: float = 80.0
    """Greatest cost of a difference, so that one roof edge does not decide alone; chosen."""
    height_cost: float = 20.0
    """Cost of a seam over what stands above the bare ground, a metre of its height (up to 10 m); chosen."""
    feather_px: int = 3
    """Half the width of the transition at a seam, pixels of the orthoimage, for `--blend seam`. Three hide the step and
    are too few for ghosts (chosen by looking at four sets)."""
