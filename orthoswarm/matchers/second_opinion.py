"""The second opinion: learned matching in the prior window, asked before a leg is carried by others."""

from functools import lru_cache

import numpy as np

from orthoswarm.config import active
from orthoswarm.matchers.matcher import Floats, MapMatcher, Mask
from orthoswarm.matchers.patch_registration import apply, register
from orthoswarm.matchers.registry import map_matcher
from orthoswarm.model.errors import InputError


def second_opinion(
    patch: Floats, valid: Mask, window: Floats, *, known: Mask, reach: int, matcher: MapMatcher | None = None
) -> tuple[float, float] | None:
    """Where a rectified strip of pictures lies on the map, as far as learned matching can tell.

    Args:
        patch: float32 (h, w), grey values of the strip.
        valid: bool (h, w), where it has ground.
        window: float32 (h + 2 reach, w + 2 reach), the map at the same pixel size.
        known: bool, where it has ground.
        reach: largest shift from the prior, pixels; pixels of 0.3 to 1 m suit the networks best.
        matcher: None takes the best that is available (without weights CFOG).

    Returns:
        Shift (column, row) in pixels, by which the strip's middle lies off the prior; None where it is not trusted.
    """
    if matcher is None:
        try:
            matcher = _default()
        except InputError:
            return None
    config = active().matchers
    found = register(patch, valid, window, known=known, reach=reach, matcher=matcher)
    if found is None or found.share < config.trusted_share or len(found.matches) < config.least_tiles:
        return None
    middle = np.median(found.matches.a, axis=0)[None]
    shift = (apply(found.homography, middle) - middle)[0] - reach
    if np.abs(shift).max() > reach:
        return None
    return float(shift[0]), float(shift[1])


@lru_cache(maxsize=1)
def _default() -> MapMatcher:
    return map_matcher()
