"""Features, tracks and matches between pictures: following corners, SIFT pairs, overlap, the flow's focal length."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class FeaturesConfig:
    """Features, tracks and matches between pictures."""

    # Pictures at working scale
    work_width_px: int = 960
    """Longer side of the pictures on which corners are followed, pixels (chosen; not measured)."""

    # Corners, followed from picture to picture
    cell_px: int = 80
    """One corner is followed in each cell of this size, pixels: about 48 in a picture of 640 x 480. Spread matters more
    than strength: the strongest corners sit on glints (over water such flights failed by 11 m)."""
    flow_chance_share: float = 0.1
    """Share of the corners that agree where pictures show different ground (textures of noise: 0.09 in the middle;
    past holes of flights in simulation 0.10 at most, where the ground is the same 0.25 or more, usually 0.6)."""
