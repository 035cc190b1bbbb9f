"""The surface model: selection of pairs, matching, and merging of the heights of all pairs."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoConfig:
    """The surface model (`mosaic --surface`)."""

    # Pairs of pictures
    partners: int = 3
    """Largest number of partners of each picture; the time grows with it (chosen)."""

    # Matching
    longest_px: int = 960
    """Larger pictures are reduced by 2, 4 or 8 as long as this many pixels are left on the longer side (chosen)."""
    smoothness: tuple[float, float] = (8.0, 32.0)
    """Penalty of a disparity that differs by one, and by more, times the block's area: OpenCV's recommendation."""
    depth_m: float = 10.0
    """Search range below the terrain, metres (chosen)."""
    tallest_m: float = 60.0
    """Search range above the terrain, metres (chosen: a tower block)."""
    wide_px: int = 128
    """Pairs with a search range of more disparities are matched at half size first, to find those that occur (chosen:
    for fewer the time saved is less than what it takes) ..."""
