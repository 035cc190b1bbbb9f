"""Registration of a patch on the map: matches in the prior window, MAGSAC, then rounds of CFOG tiles (paper III.D).

The share of tiles that agree with the final homography measures its reliability: on real pairs of different dates no
result with a share of a half or more was wrong.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from orthoswarm.matchers import cfog
from orthoswarm.matchers.matcher import Array, Floats, MapMatcher, Mask, Matches
from orthoswarm.matchers.registry import map_matcher
from orthoswarm.model.errors import InputError

_AGREEMENT_PX: Final = 3.0  # a tile agrees with a homography within this distance, pixels of the patch
_COARSE_AGREEMENT_PX: Final = 6.0  # the same for the first homography, from the matcher's own matches
_TILE_SEARCH_PX: Final = (10, 6)  # search radius of tiles about the homography so far in each round
_LEAST_MATCHES: Final = 8  # least matches of a homography or of a common shift
_MAGSAC_ITERATIONS: Final = 5000  # most iterations of MAGSAC++ (cost)
_MAGSAC_CONFIDENCE: Final = 0.999  # confidence at which MAGSAC++ stops
_PLAUSIBLE_DEPTH: Final = (0.5, 2.0)  # range of the projective depth of a plausible homography at the patch's corners
_PLAUSIBLE_STRETCH: Final = (0.8, 1.25)  # range of the scale of the patch's sides under a plausible homography
_PLAUSIBLE_REACH: Final = 1.5  # largest shift of a corner, search radii ...
_PLAUSIBLE_SIDE_SHARE: Final = 0.05  # ... plus this share of the patch's longer side
_SHIFT_WIDTH_PX: Final = 8.0  # matches share a common shift within this distance
_SHIFT_SHARE: Final = 0.1  # least share of matches with the common shift
LEAST_TILES: Final = 12  # least number of tiles that agree
TRUSTED_SHARE: Final = 0.35  # least share of tiles that agree. By chance a tile agrees in one of twelve cases


@dataclass(frozen=True, slots=True)
class Registration:
    """Registration of a patch in a window of the map."""

    homography: Array  # float64 (3, 3), patch pixel to window pixel, last element 1
    matches: Matches  # tiles that agree
    share: float  # of all tiles with ground on both sides, those that agree
    rms_px: float  # root mean square of their residuals per axis
    tiles: int  # how many tiles were tried


Keep = Callable[[Matches, Array], Mask]
"""Inlier mask of matches under the current homography (rejects inconsistent heights, for instance)."""


def register(
    patch: Floats,
    valid: Mask,
    window: Floats,
    *,
    known: Mask,
    reach: int,
    matcher: MapMatcher,
    keep: Keep | None = None,
) -> Registration | None:
    """Find a patch in a window of the map (see MapMatcher for the frames).

    Returns None where no homography is found; else the result, whose `share` may still be too low to trust it.
    """
    first = matcher.match(patch, valid, window, known, reach)
    fit = magsac(first, _COARSE_AGREEMENT_PX)
    if fit is None or not plausible(fit, patch.shape, reach):
        shift = robust_shift(first)
        if shift is None:
            return None
        fit = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]], [0.0, 0.0, 1.0]])
    own, other = cfog.features(patch, valid), cfog.features(window, known)
    centres = cfog.tile_centres(valid)
    inside = known_below(known, apply(fit, centres.astype(float)))
    tried = centres[inside]
    found = Matches.none()
    for search in _TILE_SEARCH_PX:
        found = cfog.match_tiles(
            own, other, valid, predict=apply(fit, tried.astype(float)), centres=tried, search=search
        )
        chosen = found if keep is None else found.take(keep(found, fit))
        better = magsac(chosen, _AGREEMENT_PX)
        if better is None or not plausible(better, patch.shape, reach):
            return Registration(fit, Matches.none(), 0.0, float("nan"), len(tried))
        fit = better
    error = found.b - apply(fit, found.a)
    agrees = np.hypot(*error.T) < _AGREEMENT_PX
    if keep is not None:
        agrees &= keep(found, fit)
    share = float(agrees.sum()) / max(len(tried), 1)
    rms = float(np.sqrt((error[agrees] ** 2).mean())) if agrees.any() else float("nan")
    return Registration(fit, found.take(agrees), share, rms, len(tried))


def magsac(matches: Matches, threshold_px: float) -> Array | None:
    """Homography from a to b by MAGSAC++; None where there is none (OpenCV 5 raises an error in that case)."""
    import cv2

    if len(matches) < _LEAST_MATCHES:
        return None
    cv2.setRNGSeed(1)
    try:
        found, _ = cv2.findHomography(
            matches.a, matches.b, cv2.USAC_MAGSAC, threshold_px, None,
            _MAGSAC_ITERATIONS, _MAGSAC_CONFIDENCE,
        )  # fmt: skip
    except cv2.error:
        return None
    if found is None or not np.isfinite(found).all() or abs(found[2, 2]) < 1e-12:
        return None
    return np.asarray(found / found[2, 2], np.float64)


def apply(homography: Array, points: Array) -> Array:
    """Points (N, 2) through a homography."""
    moved = np.c_[points, np.ones(len(points))] @ homography.T
    return np.asarray(moved[:, :2] / moved[:, 2:])


def plausible(homography: Array, shape: tuple[int, ...], reach: int) -> bool:
    """Whether a homography can be a correction of poses: moderate scale and perspective, corners within the reach."""
    rows, cols = shape
    corners = np.array([[0, 0], [cols, 0], [cols, rows], [0, rows]], float)
    depth = np.c_[corners, np.ones(4)] @ homography[2]
    if (depth < _PLAUSIBLE_DEPTH[0]).any() or (depth > _PLAUSIBLE_DEPTH[1]).any():
        return False
    moved = apply(homography, corners)
    most = _PLAUSIBLE_REACH * reach + _PLAUSIBLE_SIDE_SHARE * max(rows, cols)
    if np.abs(moved - corners - reach).max() > most:
        return False
    sides = np.linalg.norm(np.roll(moved, -1, 0) - moved, axis=1) / np.linalg.norm(
        np.roll(corners, -1, 0) - corners, axis=1
    )
    return bool((sides > _PLAUSIBLE_STRETCH[0]).all() and (sides < _PLAUSIBLE_STRETCH[1]).all())


def robust_shift(matches: Matches) -> Array | None:
    """The shift (2,) in pixels that most matches share, None where too few do."""
    width_px, least = _SHIFT_WIDTH_PX, _LEAST_MATCHES
    if len(matches) < least:
        return None
    shift = matches.b - matches.a
    best = shift[np.argmax([np.count_nonzero(np.abs(shift - s).max(1) < width_px) for s in shift])]
    near = np.abs(shift - best).max(1) < width_px
    if near.sum() < max(least, _SHIFT_SHARE * len(shift)):
        return None
    return np.asarray(np.median(shift[near], axis=0))


def known_below(known: Mask, points: Array) -> Mask:
    """Whether the map has ground at points (column, row)."""
    c, r = np.round(points).astype(np.int64).T
    inside = (c >= 0) & (r >= 0) & (c < known.shape[1]) & (r < known.shape[0])
    out = np.zeros(len(points), bool)
    out[inside] = known[r[inside], c[inside]]
    return out


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
        patch: float32 (h, w), grey values of the strip. valid: bool (h, w), where it has ground.
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
