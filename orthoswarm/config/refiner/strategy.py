"""What runs when, and when a result is doubted."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class StrategyConfig:
    """What runs when, and when a result is doubted."""

    # Without a map
    schedule: tuple[float, ...] = (100.0, 100.0, 100.0, 100.0, 9.0, 9.0)
    """Robust scales of the steps without a map, squared, of normalised residuals. Starts are near enough for 10 sigmas
    (recorded poses, focal length by optical flow); two first steps at 1e4 gave the same accuracy on 31 runs of small
    flights and on 1,017 photos, and wrong tracks could carry the focal length away (docs/method.md)."""

    # Recorded heights that the pictures contradict
    at_rest_share: float = 0.03
    """A focal length that still moves by this share in three steps is not at rest (chosen; not measured)."""

    # Neighbours
    area_pictures: int = 10_000
    """More pictures are solved in areas of no more than so many, each together with its neighbours (chosen for memory,
    and for the distance of nodes that `drawn_nodes` allows: 1.4 m where 32,544 pictures in one area have 1.8 m)."""
