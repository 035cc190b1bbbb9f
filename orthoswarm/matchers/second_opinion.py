"""Second attempt at a leg that correlation did not find on the map: learned matching in the prior window."""

from functools import lru_cache
from typing import Final

import numpy as np

from orthoswarm.matchers.matcher import Floats, MapMatcher, Mask
from orthoswarm.matchers.patch_registration import apply, register
from orthoswarm.matchers.registry import map_matcher
from orthoswarm.model.errors import InputError

LEAST_TILES: Final = 12  # least number of tiles that agree
TRUSTED_SHARE: Final = 0.35  # least share of tiles that agree. By chance a tile agrees in one of twelve cases


def second_opinion(
    patch: Floats,
    valid: Mask,
    window: Floats,
    *,
    known: Mask,
    reach: int,
    matcher: MapMatcher | None = None,
    device: str = "auto",
) -> tuple[float, float] | None:
    """Position of a rectified strip of pictures on the map by learned matching.

    Args:
        patch: float32 (h, w), grey values of the strip.
        valid: bool (h, w), where it has ground.
        window: float32 (h + 2 reach, w + 2 reach), the map at the same pixel size.
        known: bool, where the map has ground.
        reach: largest shift from the prior, pixels; the networks work best at 0.3 to 1 m per pixel.
        matcher: None for the first available (CFOG without weights). device: where that runs, see `network_device`.

    Returns:
        Shift (column, row) of the strip's middle from the prior, pixels; None where too few tiles agree.
    """
    if matcher is None:
        try:
            matcher = _default(device)
        except InputError:
            return None
    found = register(patch, valid, window, known=known, reach=reach, matcher=matcher)
    if found is None or found.share < TRUSTED_SHARE or len(found.matches) < LEAST_TILES:
        return None
    middle = np.median(found.matches.a, axis=0)[None]
    shift = (apply(found.homography, middle) - middle)[0] - reach
    if np.abs(shift).max() > reach:
        return None
    return float(shift[0]), float(shift[1])


@lru_cache(maxsize=1)
def _default(device: str) -> MapMatcher:
    return map_matcher(device=device)
