"""The surface model: selection of pairs, matching, and merging of the heights of all pairs."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoConfig:
    """The surface model (`mosaic --surface`)."""

    # Pairs of pictures
    best_base: float = 0.4
    """Distance of two cameras over their height above ground at which a pair is preferred. Single pairs of a simulated
    city had ground heights within (68 %) 1.4, 0.64, 0.49 and 0.21 m at 0.13, 0.25, 0.4 and 0.7 at 0.67 m a pixel; the
    higher, the more ground is hidden behind roofs."""
    least_base: float = 0.12
    """Pairs with a smaller ratio give inaccurate heights (chosen)."""
    most_base: float = 0.9
    """With a larger ratio the two views differ too much to be matched (chosen)."""
    least_overlap: float = 0.4
    """Least share of a picture's footprint that the other one also covers (chosen)."""
    most_turn_deg: float = 40.0
    """Angle between the two lines of sight at most, degrees (chosen)."""
    partners: int = 3
    """Largest number of partners of each picture; the time grows with it (chosen)."""

    # Matching
    longest_px: int = 960
    """Larger pictures are reduced by 2, 4 or 8 as long as this many pixels are left on the longer side (chosen)."""
    block_px: int = 3
    """Side of the blocks of semi-global matching, pixels. With 3, 5, 7 heights of roofs were within (68 %) 1.25, 1.42
    and 1.76 m of their median error, ground as good with each."""
    smoothness: tuple[float, float] = (8.0, 32.0)
    """Penalty of a disparity that differs by one, and by more, times the block's area: OpenCV's recommendation."""
    unique_percent: int = from_zero(10)
    """The best match costs less than the second one by this much at least, percent: OpenCV's recommendation (5-15)."""
    speckle_px: int = from_zero(60)
    """Regions of alike disparity with fewer pixels are false matches: OpenCV's recommendation (50-200)."""
    disparity_sigma_px: float = 0.25
    """One sigma of a disparity, pixels: the 68 % above are 0.24 of it at a base of 0.25 and 0.22 at 0.7."""
    depth_m: float = 10.0
    """Search range below the terrain, metres (chosen)."""
    tallest_m: float = 60.0
    """Search range above the terrain, metres (chosen: a tower block)."""
    tallest_heights: float = 0.45
    """Search range above the terrain as a share of the camera's height above it; the lower of both counts (chosen)."""
    wide_px: int = 128
    """Pairs with a search range of more disparities are matched at half size first, to find those that occur (chosen:
    for fewer the time saved is less than what it takes) ..."""
    wide_region_px: int = 400
    """... in regions of alike disparity of at least so many pixels at half size (chosen: 40 x 40 pixels) ..."""
    wide_margin: float = 0.15
    """... with this share of their range to either side, and 2 pixels at half size (chosen: smaller regions)."""

    # One surface of all pairs
    cell_pixels: float = 2.0
    """Side of a cell, ground pixels of the (reduced) pictures: fewer would hold no more detail."""
    most_cells: int = 8_000_000
    """Cells are made larger until there are so many at most, for memory and disk: 50 bytes a cell (chosen)."""
    cell_matches: int = 2
    """Matched pixels that a pair has in a cell at least (chosen)."""
    pairs_kept: int = 8
    """Heights of different pairs that are kept a cell; later ones change little (chosen)."""
    least_pairs: int = 2
    """Cells with heights of fewer pairs stay empty: a false match is seen by its disagreement only."""
    inlier_sigmas: float = 3.0
    """Heights farther from a cell's median, in sigmas of the pair and of the cell's scatter, are left out (a usual
    choice)."""
    independence: float = 0.5
    """n agreeing pairs count as n to the power of this: they share pictures and errors of matching. Fitted, with the
    next one, to two simulated cities (0.67 and 0.47 m a pixel): 74 and 73 % of all cells lie within one sigma, 94 %
    within two."""
    edge_share: float = 0.5
    """A cell's sigma gets this share of the range of heights around it (3 x 3 cells): blocks of matching reach over
    walls, and a cell's middle may lie on either side."""
    block_sigma_m: float = 0.05
    """What all pairs of a place have in common (the block's own bends), one sigma, metres: the orthoimage's error on
    the same sets, 0.04 to 0.07 m."""
