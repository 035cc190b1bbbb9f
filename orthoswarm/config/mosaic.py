"""What is drawn of a picture, the zero of heights, and the seam lines of the orthoimage.

Costs of seams have the unit of what a cell's side of seam costs. Costs of areas are stated for a ground square whose
side is the flying height and are divided by it and by the cell's side, so that the same numbers hold for every height
and every ground pixel.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class MosaicConfig:
    """What is drawn of a picture, the zero of heights, and the seam lines."""

    # Which ground of which picture
    most_off_nadir_deg: float = 75.0
    """Ground that is seen farther from straight down is not drawn, degrees: a pixel there is smeared over more than 15
    times its size at nadir."""

    # Search for the seam lines
    feather_px: int = 3
    """Half the width of the transition at a seam, pixels of the orthoimage, for `--blend seam`. Three hide the step and
    are too few for ghosts (chosen by looking at four sets)."""
