"""What a map is made with: matchers, seams, the surface model, what is kept on disk and in memory."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputeConfig:
    """Memory. It changes how long a run takes, never its products."""

    canvas_mb: float = 48.0
    """Memory that a canvas keeps of its tiles, megabytes; tiles beyond it are on disk."""
    live_canvas_mb: float = 512.0
    """Memory that the live map's real-time canvas keeps of its tiles, megabytes: with the tiles of all vehicles mapped
    a picture of 96 vehicles in turn is drawn in 0.6 instead of 0.9 ms (measured; 128 megabytes hold a third of them).
    The system can take these pages back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterConfig:
    """What is kept on disk during a run. It changes how long a run takes, never its products."""

    grey_pictures_mb: float = from_zero(1500.0)
    """Grey pictures at the refiner's working size that take no more than this together, megabytes, are kept on disk
    during a batch run. They come from the colours then: a grey level off by rounding, a few where a colour is
    clipped."""
    picture_parts_mb: float = from_zero(2000.0)
    """Parts of pictures that are kept on disk between two drawings of a batch run take no more than this together,
    megabytes; larger ones are decoded again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StrategyConfig:
    """How a large swarm is refined."""

    area_pictures: int = 10_000
    """More pictures are solved in areas of no more than so many, each together with its neighbours: for memory, and for
    the distance of nodes of the drawn ground (1.4 m where 32,544 pictures in one area have 1.8 m)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchersConfig:
    """Learned matchers of pictures and of patches to the map."""

    device: str = "auto"
    """Where networks run: "cpu", "cuda", or "auto", a CUDA card where there is one (a match by RoMa takes a minute on
    a CPU and half a second on a card)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MosaicConfig:
    """The seam lines."""

    feather_px: int = 3
    """Half the width of the transition at a seam, pixels of the orthoimage, for `--blend seam`. Three hide the step and
    are too few for ghosts (by looking at four sets)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoConfig:
    """The surface model (`mosaic --surface`)."""

    partners: int = 3
    """Largest number of partners of each picture; the time grows with it."""
    longest_px: int = 960
    """Larger pictures are reduced by 2, 4 or 8 as long as this many pixels are left on the longer side."""
    depth_m: float = 10.0
    """Search range below the terrain, metres."""
    tallest_m: float = 60.0
    """Search range above the terrain, metres: a tower block."""
