"""What is read and drawn: logs and videos, maps, matchers, seams, colours, the surface model, control, coverage."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class IngestConfig:
    """Tags, logs and videos: what belongs together, what cannot be right, which pictures of a video are used."""

    fastest_m_s: float = 128.6
    """No aircraft that takes pictures flies faster over ground, m/s: 250 knots, the limit below 10,000 feet (14 CFR
    91.117(a)); small drones may fly 44.7 m/s (14 CFR 107.51(a))."""
    video_height_share: float = 0.04
    """Distance between the pictures used of a video, as a share of the height (chosen: 96 % overlap at 60 degrees)."""
    video_every_s: float = 0.5
    """Time between them where no height is known, seconds (chosen)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterConfig:
    """Maps, pictures and height models that are read, and maps that are written in tiles."""

    stretch_percent: tuple[float, float] = from_zero((0.5, 99.5))
    """Percentiles of a map of more than 8 bits that become 0 and 255 (chosen; usual in GIS: 2 and 98, which clips
    roofs)."""
    grey_pictures_mb: float = from_zero(1500.0)
    """Grey pictures at the refiner's working size that take no more than this together, megabytes, are kept on disk
    during a batch run (chosen for the disk). They come from the colours then: a grey level off by rounding, a few
    where a colour is clipped."""
    picture_parts_mb: float = from_zero(2000.0)
    """Parts of pictures that are kept on disk between two drawings of a batch run take no more than this together,
    megabytes (chosen for the disk); larger ones are decoded again."""
    one_file_px: float = 4e9
    """A map of more pixels is written in tiles where the user does not say how, pixels (chosen: 40 square kilometres at
    0.1 m; as one file it has some 10 GB, which web servers, object storage and copying by radio handle badly)."""
    tile_px: int = 8192
    """Side of such a tile, pixels, a multiple of 512 (chosen: some 100 MB a file)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchersConfig:
    """Matchers of pictures and of patches to the map."""

    device: str = "auto"
    """Where networks run: "cpu", "cuda", or "auto", a CUDA card where there is one (a match by RoMa takes a minute on
    a CPU and half a second on a card)."""

    roma_samples: int = 4000
    """Matches drawn from the dense warp (chosen for cost)."""
    roma_coarse_px: int = 560
    """Side of the picture of the coarse match, pixels (Edstedt et al., CVPR 2024)."""
    roma_fine_px: int = 864
    """Side of the picture of the refinement, pixels (Edstedt et al., CVPR 2024)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MosaicConfig:
    """What is drawn of a picture, the zero of heights, and the seam lines."""

    most_off_nadir_deg: float = 75.0
    """Ground that is seen farther from straight down is not drawn, degrees: a pixel there is smeared over more than 15
    times its size at nadir."""
    feather_px: int = 3
    """Half the width of the transition at a seam, pixels of the orthoimage, for `--blend seam`. Three hide the step and
    are too few for ghosts (chosen by looking at four sets)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RadiometryConfig:
    """Radiometric balancing of the pictures."""

    reweightings: int = 3
    """Rounds of reweighting; then factors lie within 0.2 % of where 40 rounds lead (154 pictures of three vehicles of
    different tone and 1,017 of ten)."""
    solver_steps: int = 100
    """Most steps of conjugate gradients a round (4 to 15 were needed)."""
    solver_tolerance: float = 0.1
    """Preconditioned residual, as a share of the first one, at which a round ends; the next one goes on from there
    (0.01 takes 1.7 times the time and changes factors by 0.03 % at most)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoConfig:
    """The surface model (`mosaic --surface`)."""

    partners: int = 3
    """Largest number of partners of each picture; the time grows with it (chosen)."""
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
    for fewer the time saved is less than what it takes)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlConfig:
    """Ground control."""

    survey_sigma_m: float = 0.05
    """Sigma of a surveyed position, an axis, where its file states none, metres: a network receiver's (chosen). Where
    there are enough points to see how far they really scatter, that counts instead if it is more."""
    pointing_sigma_px: float = 1.0
    """Sigma of a point's place in a photo, in pixels; photos of a point count as independent (chosen)."""


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
    blurred_share: float = 0.5
    """Blurred: less than this share of their sharpness; over a wood and over a lake it differs by less (chosen)."""
    sure: float = 0.95
    """Confidence of a cause that camera events show (chosen)."""
