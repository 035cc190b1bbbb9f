"""What is drawn of a picture, the zero of heights, and the seam lines of the orthoimage.

Costs of seams have the unit of what a cell's side of seam costs. Costs of areas are stated for a ground square whose
side is the flying height and are divided by it and by the cell's side, so that the same numbers hold for every height
and every ground pixel.
"""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class MosaicConfig:
    """What is drawn of a picture, the zero of heights, and the seam lines."""

    # Which ground of which picture
    most_off_nadir_deg: float = 75.0
    """Ground that is seen farther from straight down is not drawn, degrees: a pixel there is smeared over more than 15
    times its size at nadir."""
    most_magnification: float = 16.0
    """A picture whose ground pixel is more than so many times the map's is none of this flight: its recorded height is
    wrong (chosen)."""
    oblique_deg: float = 35.0
    """Pictures that look farther from straight down are left out of a flight that looks straight down, degrees: more
    than a fixed camera is tilted when its vehicle accelerates (28 degrees measured)."""
    nadir_deg: float = 15.0
    """A flight whose median tilt is below this looks straight down, degrees (chosen)."""
    oblique_share: float = 1.0 / 3.0
    """A vehicle with a larger share of oblique pictures took them on purpose, and they are drawn (chosen)."""
    map_cover_share: float = 0.98
    """A warning says how much of the flight a map covers where it is no more than this share of the pictures
    (chosen)."""
    completeness_cells: int = 1_000_000
    """The share of the ground that was drawn is measured on about so many cells at most, of 64 pixels at most (chosen
    for its time)."""

    # The zero of heights: the takeoff level
    recorded_height_sigma_m: float = 1.0
    """Sigma of a vehicle's recorded heights over its takeoff level, taken together, metres: a barometer's drift
    (chosen)."""
    ground_level_sigma_m: float = 0.2
    """Sigma of the solved ground's median level, without its relief, metres (chosen)."""
    takeoff_level_limit_m: float = 3.0
    """A takeoff level farther from the refiner's zero is ignored, metres (chosen) ..."""
    takeoff_level_reliefs: float = 2.0
    """... and so many sigmas of the ground's heights: the refiner holds the ground's median at its zero, and the place
    of takeoff may lie anywhere in the relief."""

    vertical_sigmas: float = 2.0
    """Sigma of a recorded altitude over that of the recorded place (an axis): satellites stand on one side of the
    receiver only (vertical dilution of precision is 1.5 to 2.5 times the horizontal one of an axis)."""

    # Surface
    wall_slope: float = 1.2
    """Steeper measured surfaces are walls (chosen: 50 degrees; roofs and rubble are flatter)."""

    # Candidates of a cell of the seam lines
    weak_cost: float = 1e6
    """Cost of a picture that is used only where no other sees (damaged, weakly determined): above all other costs."""
    candidate_tan2: float = 0.5
    """Pictures more oblique than the best by this squared tangent are not candidates for a cell (chosen for its
    time)."""

    obliqueness_cost: float = from_zero(15000.0)
    """Cost of obliqueness, times the squared tangent of the view angle. Chosen by looking at four sets: with a third of
    it crowns lean over streets and masts lie down."""
    haze_cost: float = from_zero(6000.0)
    """Cost of less local contrast than the clearest picture has on the same ground, times the logarithm of the ratio;
    chosen: half the contrast outweighs a view that is some 20 degrees more oblique."""
    haze_ignored_log: float = from_zero(0.3)
    """Log ratios of contrast up to this cost nothing: parallax, shadows, noise; chosen."""
    glare_cost: float = from_zero(3000.0)
    """Cost of ground that is burnt out (glints of water); chosen: as of a view at 25 degrees."""
    glare_level: int = 240
    """Grey levels from here on are taken for glints of water or burnt-out ground (chosen)."""
    glare_share: float = 0.05
    """A block of the preview with a larger share of glare says nothing about haze (chosen)."""
    hidden_cost: float = from_zero(10000.0)
    """Cost of a picture from which something taller hides the cell; chosen: as of a view at 39 degrees, more than
    `candidate_tan2` allows."""
    hidden_m: float = 1.0
    """What rises above the line of sight by less than this hides nothing, metres (chosen: about the error of heights
    beside walls)."""
    blur_cost: float = from_zero(6000.0)
    """Cost of a picture that is less sharp than the median of those around, times the logarithm of the ratio; chosen
    like `haze_cost`."""
    blur_ignored_log: float = from_zero(0.25)
    """Log ratios of sharpness up to this cost nothing; chosen: pictures of one scene taken well differ by less."""
    seam_cost: float = from_zero(3.0)
    """Cost of a seam where both pictures are alike: keeps seams short and few; chosen by looking at four sets."""
    difference_scale: float = 16.0
    """The squared difference of the two pictures, in levels, is divided by this: edges that do not meet (roofs, cars)
    cost far more than texture does; chosen by looking at four sets."""
    texture_level: float = 8.0
    """Local contrast, levels, at which that scale doubles (it grows with the square): a seam through a wood does not
    show although its pictures differ everywhere; chosen."""
    difference_most: float = 80.0
    """Greatest cost of a difference, so that one roof edge does not decide alone; chosen."""
    height_cost: float = from_zero(20.0)
    """Cost of a seam over what stands above the bare ground, a metre of its height; chosen."""
    height_most_m: float = 10.0
    """Greater heights cost no more, metres (chosen)."""

    # Search for the seam lines
    border_px: int = 32
    """Pixels around a tile that its seams are chosen together with, so that they go on well in the next tile; a
    multiple of 8 (chosen)."""
    cell_px: tuple[int, int] = (4, 8)
    """Least and greatest side of the cells, pixels, powers of two: finer cells cost time and do not improve seams (4
    instead of 2: a third of the time, no difference to be seen on four sets)."""
    block_sides: tuple[int, int, int, int] = (8, 4, 2, 1)
    """Sides of the blocks of cells that are moved to another picture, in cells, one sweep each: 8 cells are about a
    house (chosen)."""
    block_offsets: tuple[int, int, int, int] = (0, 2, 1, 0)
    """Where the first of these blocks begins, cells before the tile's corner (chosen: borders of sweeps differ)."""
    feather_px: int = 3
    """Half the width of the transition at a seam, pixels of the orthoimage, for `--blend seam`. Three hide the step and
    are too few for ghosts (chosen by looking at four sets)."""
