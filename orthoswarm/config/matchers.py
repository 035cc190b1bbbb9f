"""Matchers of pictures and of patches to the map."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchersConfig:
    """Matchers of pictures and of patches to the map."""

    device: str = "auto"
    """Where networks run: "cpu", "cuda", or "auto", a CUDA card where there is one (a match by RoMa takes a minute on
    a CPU and half a second on a card)."""

    # CFOG (Ye et al., TGRS 2019)

    cfog_directions: int = 6
    """Directions of gradients, evenly over 180 degrees (chosen; not measured)."""
    cfog_blur_px: float = 0.8
    """Sigma of the blur before and after the gradients, pixels (chosen; not measured)."""
    cfog_direction_blur: float = 0.5
    """Weight of a direction itself in the blur over directions; its two neighbours share the rest (chosen)."""
    cfog_border_px: int = 9
    """Side of the square by which the valid part is eroded: gradients at its edge are artefacts (chosen)."""
    cfog_tile_px: int = 64
    """Side of a tile, pixels; even (chosen; not measured)."""
    cfog_valid_share: float = 0.4
    """Least share of valid pixels in a tile (chosen; not measured)."""
    cfog_energy_share: float = 0.1
    """Least energy of a window as a share of the largest: without texture a correlation peak means nothing (chosen;
    not measured)."""
    cfog_least_peak: float = 0.12
    """Least correlation of a match (chosen; not measured)."""
    cfog_most_ratio: float = 0.92
    """Largest ratio of the second peak to the first (chosen; not measured)."""
    cfog_peak_distance_px: int = 4
    """Correlations within this distance belong to the same peak, pixels (chosen)."""
    cfog_search_px: int = 14
    """Search radius of tiles about the patch's common shift, pixels (chosen; not measured)."""
    cfog_least_side_px: int = 16
    """Least side of a patch at half resolution, pixels (chosen)."""

    # Dense XFeat descriptors in the prior window

    window_neighbours: int = 5
    """Side of the square of cells whose scores are averaged (chosen; not measured)."""
    window_contrast: float = 4.0
    """The best shift's score exceeds the mean of its cell's scores by so many standard deviations (chosen)."""
    window_sure_contrast: float = 10.0
    """Contrast from which on a match has the score 1 (chosen)."""
    window_least_cells: int = 4
    """Least number of cells that are averaged (chosen; not measured)."""
    window_least_side: int = 3
    """Least side of a patch in cells (chosen)."""
    window_valid_share: float = 0.8
    """Least share of valid pixels in a cell (chosen; not measured)."""
    window_part_cells: int = 96
    """Side of the square of cells that the network describes at once (chosen for memory)."""
    window_margin_cells: int = 12
    """Cells around them that it is given as well: about its receptive field (chosen)."""

    # SIFT (Lowe 2004)

    sift_keypoints: int = 1500
    """Most keypoints a picture (chosen for cost)."""
    sift_ratio: float = 0.8
    """Ratio of the nearest to the second nearest descriptor (Lowe 2004)."""
    sift_contrast: float = from_zero(0.02)
    """Contrast threshold: OpenCV's default is 0.04 (chosen; not measured)."""

    # Learned keypoints and RoMa

    learned_keypoints: int = 1024
    """Most keypoints a picture (chosen for cost)."""
    learned_detection: float = from_zero(0.05)
    """Detection threshold of XFeat (Potje et al., CVPR 2024)."""
    learned_least_keypoints: int = 4
    """Pictures with fewer keypoints are not matched (chosen)."""
    roma_samples: int = 4000
    """Matches drawn from the dense warp (chosen for cost)."""
    roma_certainty: float = 0.3
    """Least certainty of a match (chosen; not measured)."""
    roma_coarse_px: int = 560
    """Side of the picture of the coarse match, pixels (Edstedt et al., CVPR 2024)."""
    roma_fine_px: int = 864
    """Side of the picture of the refinement, pixels (Edstedt et al., CVPR 2024)."""

    # Registration of a patch

    agreement_px: float = 3.0
    """A tile agrees with a homography within this distance, pixels of the patch (chosen)."""
    coarse_agreement_px: float = 6.0
    """A tile agrees with the first homography, of the matcher's own matches, within this distance, pixels (chosen)."""
    tile_search_px: tuple[int, int] = (10, 6)
    """Search radius of tiles about the homography so far in each round, pixels (chosen; not measured)."""
    least_tiles: int = 12
    """Least number of tiles that agree (chosen; not measured)."""
    trusted_share: float = 0.35
    """Least share of tiles that agree. By chance a tile agrees in one of twelve cases; on real pairs of different dates
    half or more was never wrong."""
    least_matches: int = 8
    """Least matches of a homography or of a common shift: twice the four that determine a homography (chosen)."""
    magsac_iterations: int = 5000
    """Most iterations of MAGSAC++ (chosen for cost)."""
    magsac_confidence: float = 0.999
    """Confidence at which MAGSAC++ stops (chosen)."""
    plausible_depth: tuple[float, float] = (0.5, 2.0)
    """Range of the projective depth of a plausible homography at the patch's corners (chosen)."""
    plausible_stretch: tuple[float, float] = (0.8, 1.25)
    """Range of the scale of the patch's sides under a plausible homography (chosen)."""
    plausible_reach: float = 1.5
    """Largest shift of a corner, search radii (chosen) ..."""
    plausible_side_share: float = 0.05
    """... plus this share of the patch's longer side (chosen)."""
    shift_width_px: float = 8.0
    """Matches share a common shift within this distance, pixels (chosen; not measured)."""
    shift_share: float = 0.1
    """Least share of matches with the common shift (chosen; not measured)."""
