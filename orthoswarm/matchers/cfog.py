"""CFOG: channel features of orientated gradients, matched by FFT (Ye et al., TGRS 2019). Needs no weights.

Each pixel gets the magnitude of its gradient in a few directions, blurred and normalised. These features do not depend
on light, colour and the sign of contrast, so they match across seasons; tiles are correlated at all shifts by FFT.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.matchers.matcher import Array, Floats, Mask, Matches
from orthoswarm.raster.subpixel_peak import vertex

_CFOG_DIRECTIONS: Final = 6  # directions of gradients, evenly over 180 degrees
_CFOG_BLUR_PX: Final = 0.8  # sigma of the blur before and after the gradients
_CFOG_DIRECTION_BLUR: Final = 0.5  # weight of a direction itself in the blur over directions
_CFOG_BORDER_PX: Final = 9  # side of the square by which the valid part is eroded: gradients at its edge are artefacts
_CFOG_TILE_PX: Final = 64  # side of a tile; even
_CFOG_VALID_SHARE: Final = 0.4  # least share of valid pixels in a tile
_CFOG_ENERGY_SHARE: Final = 0.1  # least energy of a window as a share of the largest
_CFOG_LEAST_PEAK: Final = 0.12  # least correlation of a match
_CFOG_MOST_RATIO: Final = 0.92  # largest ratio of the second peak to the first
_CFOG_PEAK_DISTANCE_PX: Final = 4  # correlations within this distance belong to the same peak
_CFOG_SEARCH_PX: Final = 14  # search radius of tiles about the patch's common shift
_CFOG_LEAST_SIDE_PX: Final = 16  # least side of a patch at half resolution


def features(gray: Floats, valid: Mask) -> Floats:
    """Features float32 (directions, rows, columns), zero where not valid; their mean over directions is zero."""
    import cv2

    directions, blur, border = _CFOG_DIRECTIONS, _CFOG_BLUR_PX, _CFOG_BORDER_PX
    smooth = cv2.GaussianBlur(np.where(valid, gray, 0.0).astype(np.float32), (0, 0), blur)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    inner = cv2.erode(valid.astype(np.uint8), np.ones((border, border), np.uint8), borderValue=0) > 0
    length = np.sqrt(gx * gx + gy * gy)
    middle = float(np.median(length[inner])) if inner.any() else 1.0
    angle = np.pi * np.arange(directions) / directions
    channels = np.empty((directions, *gray.shape), np.float32)
    for k, a in enumerate(angle):
        strength = np.abs(np.float32(np.cos(a)) * gx + np.float32(np.sin(a)) * gy)
        channels[k] = cv2.GaussianBlur(strength, (0, 0), blur)
    own = _CFOG_DIRECTION_BLUR
    adjacent = 0.5 * (1.0 - own)
    channels = adjacent * np.roll(channels, 1, 0) + own * channels + adjacent * np.roll(channels, -1, 0)
    norm = np.sqrt((channels * channels).sum(0)) + 1e-3
    weight = np.where(inner, length / (length + max(middle, 1e-3)) / norm, 0.0).astype(np.float32)
    channels -= channels.mean(0)
    channels *= weight
    return np.asarray(channels, np.float32)


def correlate(tile: Floats, window: Floats) -> tuple[float, float, float, float]:
    """Best position of a tile of features (D, h, w) in a window (D, h + 2 n, w + 2 n), by normalised correlation.

    Returns its shift from the middle, column and row; the correlation there; and the second highest peak's share of it.
    """
    from scipy import fft

    rows, cols = window.shape[1] - tile.shape[1] + 1, window.shape[2] - tile.shape[2] + 1
    shape = tuple(int(fft.next_fast_len(n, real=True)) for n in window.shape[1:])
    product = (fft.rfft2(window, shape) * np.conj(fft.rfft2(tile, shape))).sum(0)
    dot = fft.irfft2(product, shape)[:rows, :cols]
    weight = (np.abs(tile).sum(0) > 0).astype(np.float32)
    energy = fft.irfft2(fft.rfft2((window * window).sum(0), shape) * np.conj(fft.rfft2(weight, shape)), shape)
    energy = energy[:rows, :cols]
    own = float((tile * tile).sum())
    score = dot / np.sqrt(np.maximum(energy, _CFOG_ENERGY_SHARE * float(energy.max()) + 1e-6) * max(own, 1e-6))
    r, c = (int(v) for v in np.unravel_index(int(score.argmax()), score.shape))
    peak = float(score[r, c])
    rest = score.copy()
    apart = _CFOG_PEAK_DISTANCE_PX
    rest[max(0, r - apart) : r + apart + 1, max(0, c - apart) : c + apart + 1] = -1.0
    ratio = float(rest.max()) / max(peak, 1e-9)
    if not (0 < r < rows - 1 and 0 < c < cols - 1):
        return c - (cols - 1) / 2, r - (rows - 1) / 2, peak, 1.0
    dc = vertex(float(score[r, c - 1]), peak, float(score[r, c + 1]))
    dr = vertex(float(score[r - 1, c]), peak, float(score[r + 1, c]))
    return c + dc - (cols - 1) / 2, r + dr - (rows - 1) / 2, peak, ratio


def match_tiles(
    patch: Floats, window: Floats, valid: Mask, *, predict: Array, centres: NDArray[np.int64], search: int
) -> Matches:
    """Match tiles of a patch's features near where they are expected in a window's features.

    Args:
        patch: (D, h, w) features. window: (D, H, W) features. valid: bool (h, w) of the patch.
        predict: float64 (N, 2), expected column and row in the window of each tile's centre.
        centres: int64 (N, 2), column and row of the tiles' centres. search: reach about the expectation, pixels.

    Returns:
        One match for each tile with a clear peak; the score is the peak.
    """
    half = _CFOG_TILE_PX // 2
    a, b, score = [], [], []
    for centre, expected in zip(centres, predict, strict=True):
        c, r = int(centre[0]), int(centre[1])
        cut = (slice(r - half, r + half), slice(c - half, c + half))
        wc, wr = round(float(expected[0])), round(float(expected[1]))
        c0, r0 = wc - half - search, wr - half - search
        size = 2 * (half + search)
        if valid[cut].mean() < _CFOG_VALID_SHARE or c0 < 0 or r0 < 0:
            continue
        area = window[:, r0 : r0 + size, c0 : c0 + size]
        if area.shape[1:] != (size, size) or not area.any():
            continue
        column, row, peak, ratio = correlate(patch[(slice(None), *cut)], area)
        if peak >= _CFOG_LEAST_PEAK and ratio <= _CFOG_MOST_RATIO:
            a.append((c, r))
            b.append((wc + column, wr + row))
            score.append(peak)
    if not a:
        return Matches.none()
    return Matches(np.array(a, float), np.array(b, float), np.array(score))


def tile_centres(valid: Mask) -> NDArray[np.int64]:
    """Centres (column, row), int64 (N, 2), of the tiles of a patch with a sufficient share of valid pixels."""
    step = _CFOG_TILE_PX
    half = step // 2
    rows, cols = valid.shape
    c, r = np.arange(half, cols - half + 1, step), np.arange(half, rows - half + 1, step)
    grid = np.stack(np.meshgrid(c, r), -1).reshape(-1, 2)
    share = [valid[r - half : r + half, c - half : c + half].mean() for c, r in grid]
    return np.asarray(grid[np.array(share) >= _CFOG_VALID_SHARE], np.int64)


@dataclass(frozen=True, slots=True)
class Cfog:
    """Patch to map without weights: first one shift of the complete patch at half resolution, then single tiles."""

    def match(self, patch: Floats, valid: Mask, window: Floats, known: Mask, reach: int) -> Matches:
        """See MapMatcher."""
        import cv2

        size = (patch.shape[1] // 2, patch.shape[0] // 2)
        if min(size) < _CFOG_LEAST_SIDE_PX or not valid.any():
            return Matches.none()
        half_reach = reach // 2
        window_size = (size[0] + 2 * half_reach, size[1] + 2 * half_reach)
        small = cv2.resize(patch, size, interpolation=cv2.INTER_AREA)
        small_valid = cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        # crop so that both halves keep the same grid
        odd = reach - 2 * half_reach
        inner = (slice(odd, odd + 2 * window_size[1]), slice(odd, odd + 2 * window_size[0]))
        coarse = cv2.resize(window[inner], window_size, interpolation=cv2.INTER_AREA)
        coarse_known = cv2.resize(known[inner].astype(np.uint8), window_size, interpolation=cv2.INTER_NEAREST) > 0
        column, row, *_ = correlate(features(small, small_valid), features(coarse, coarse_known))
        shift = np.array([reach + 2 * column, reach + 2 * row])
        centres = tile_centres(valid)
        wanted = centres + shift
        return match_tiles(
            features(patch, valid), features(window, known), valid, predict=wanted, centres=centres,
            search=_CFOG_SEARCH_PX,
        )  # fmt: skip
