"""Radiometric balancing of the pictures. Sigmas are of natural logarithms of colour factors (0.05 is 5 %)."""

from dataclasses import dataclass

from orthoswarm.config.ranges import above_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class RadiometryConfig:
    """Radiometric balancing of the pictures."""

    # Observations: colour ratios of two pictures at the same ground
    ratio_sigma: float = 0.08
    """Log ratio of two thumbnails at one place of even ground: reflection by direction, shadows (two suburbs with all
    kinds of ground, once solved: half within 0.05, 90 % within 0.19; tried: 0.08 and 0.15)."""
    misplaced: float = 0.7
    """Displacement of the two thumbnails against each other, in their pixels: a ratio's sigma grows by it times the
    contrast from pixel to pixel (0.35 and 0.7 tried)."""
    robust_sigmas: float = 3.0
    """Scale of the Geman-McClure kernel on these ratios, sigmas (chosen; not measured)."""
    map_sigma: float = 0.25
    """Log ratio of a picture's block to a map: another season, light and sensor, local changes (chosen; not
    measured)."""
    map_block_px: int = 4
    """Side of such a block, pixels of a thumbnail (chosen: a picture is some metres off where it is not registered)."""
    map_block_least_m: float = 0.1
    """Least side of a block on the ground, metres."""
    map_parts: int = 7
    """Pixels of the map across a block (chosen for its time)."""
    map_covered_share: float = 0.9
    """Least share of a block that the map shows: what lies in its holes may be darker or brighter (chosen)."""
    dark_level: float = 8.0
    """Thumbnail levels from 0 to here are partly clipped and say nothing about a gain (chosen)."""
    bright_level: float = 247.0
    """Thumbnail levels from here to 255 are partly clipped and say nothing about a gain (chosen)."""
    beside_seam: float = 0.35
    """How far beside a seam, towards each picture's nadir, colours are compared as well: a share of the way to the
    nadir (chosen; not measured)."""
    ratios_per_picture: int = 48
    """Most ratios a picture at seams and beside them, those with neighbours not counted (chosen for cost)."""
    neighbours: int = 6
    """Nearest pictures, of any vehicle, with which each is compared on a grid; with 2 or 3 a lawn's steps stay."""
    neighbour_places: tuple[tuple[float, ...], tuple[float, ...]] = ((0.2, 0.5, 0.8), (0.3, 0.7))
    """That grid: shares of a picture's width, and of its height (chosen)."""
    label_cells: int = 64
    """Cells across a picture on which the seams for this comparison are found (chosen for cost)."""
    label_most_cells: int = 2_000_000
    """Most of these cells in a map; they grow beyond it (chosen for memory)."""

    # Priors of the unknowns
    vehicle_sigma: float = 0.30
    """Log gain of a vehicle's camera: another exposure or white balance (chosen; not measured)."""
    picture_sigma: float = 0.06
    """Log gain of a picture: automatic exposure within a flight (chosen; not measured)."""
    lens_sigmas: tuple[float, float, float, float, float] = (0.05, 0.05, 0.15, 0.05, 0.15)
    """x, y, x^2, xy, y^2 of a vehicle's vignetting, half the picture's width being 1; chosen: corners may be darker by
    a fifth or so."""
    view_sigmas: tuple[float, float, float, float, float] = (0.15, 0.15, 0.10, 0.10, 0.10)
    """e, n, e^2, en, n^2 of the view direction's tangents; chosen (two suburbs: 0.14 to 0.22 a tangent found)."""
    slope_sigma: float = 0.07
    """A picture's own slopes; chosen by steps on even ground of three flights, other values changed with it."""
    curve_sigma: float = 0.06
    """A picture's own curvatures, x^2, xy, y^2; chosen with the slopes."""
    hue_share: float = above_zero(0.35)
    """How much less than brightness hue may vary, but for a vehicle's white balance; chosen by looking at four sets."""
    redraw_tone: float = 0.015
    """Log factors of a flight's pictures, 95 %: if balancing all flights together changes them by more, it is drawn
    again (chosen: 1.5 grey levels of 100, less than is seen as a step)."""
    greatest_factor: float = 1.8
    """Greatest factor, and the least is its inverse: what would need more has another cause (burnt out, cloud shadow;
    chosen)."""
    held_least_factor: float = 0.1
    """Factors of pictures that keep theirs count as at least so much where their logarithm is needed."""
    flattest_descent: float = 0.2
    """Rays count as falling at least so much for their length: tangents of the view direction grow without limit."""

    # What is said of it
    limited_share: float = 0.02
    """A warning says how many photos would need more than the greatest factor if more than so many do (chosen) ..."""
    limited_log_share: float = 0.95
    """... which is taken from this share of its logarithm on."""
    tint_ratio: float = 1.15
    """A warning says that a map has another tint where its colours' factors differ by more than this (chosen)."""

    # Seam leveling: what is left at the seams of the orthoimage
    level_cells: int = 32
    """Cells across a picture in which it is corrected, about 3 m of the ground at a height of 75 m (chosen: the factor
    of a lawn must not reach the road beside it)."""
    level_most_cells: int = 300_000
    """Most of these cells in a map; they grow beyond it (chosen for memory)."""
    level_least_px: float = 8.0
    """Fewest pixels that two pictures share in a cell for their ratio to count (chosen)."""
    level_sigma: float = 0.02
    """Sigma of a log ratio in a cell of perfectly even ground (0.01 and 0.02 tried: no difference on four flights)."""
    level_correlated_px: float = 4.0
    """So many neighbouring pixels have one error of the ratio in common (chosen; 4 and 16 tried: no difference)."""
    level_rise: float = 0.05
    """Sigma of the difference of a picture's log factors in neighbouring cells (0.02 and 0.05 tried: with 0.02 seams
    keep a little more of their step)."""
    level_step: float = 0.2
    """Scale of Welsch's kernel on log ratios: 0.1 is a step of tone (weight 0.9), 0.7 is roof against ground (0.002).
    With 0.25 a roof that only one picture shows tints the lawn beside it."""
    level_reach: float = 0.5
    """How far a correction reaches from its seam before it fades, widths of a picture (0.3 and 1.0 tried: no difference
    on four flights)."""
    level_steps: int = 80
    """Most steps of conjugate gradients (12 to 70 were needed)."""
    level_tolerance: float = 0.01
    """Preconditioned residual, as a share of the first one, at which they end (chosen)."""

    # Solution
    reweightings: int = 3
    """Rounds of reweighting; then factors lie within 0.2 % of where 40 rounds lead (154 pictures of three vehicles of
    different tone and 1,017 of ten)."""
    solver_steps: int = 100
    """Most steps of conjugate gradients a round (4 to 15 were needed)."""
    solver_tolerance: float = 0.1
    """Preconditioned residual, as a share of the first one, at which a round ends; the next one goes on from there
    (0.01 takes 1.7 times the time and changes factors by 0.03 % at most)."""
    nodes: int = 7
    """Nodes along each side of a picture to which its quadratic polynomial is fitted (chosen)."""
