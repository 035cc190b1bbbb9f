"""Empty pixels of a map that nobody declared: values that stand apart, collars, and flat fill.

A map without a mask may fill what it does not show with a number that no ground has (-9999, -3.4e38, 65535), with
black or white, which JPEG makes noisy, or with one plain colour. Their edges would be false features, and the first
would take all contrast from the rest.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array, Bytes, Flags

_SPIKE_SHARE: Final = 1e-3  # pixels of one value that make it a spike
_APART: Final = 2.0  # a spike farther from the bulk of the values than so many times their spread is no ground
_BULK_PERCENT: Final = (2.0, 98.0)
_COLLAR_PX: Final = 15  # squares of at least this side that are plain are collar or fill and no ground
_NOISE: Final = 12  # JPEG leaves a black or white collar within this of it, ...
_NOISE_MEAN: Final = 2.0  # ... and within this on average over a square
_BLURRED_PX: Final = 2  # interpolation blurs a collar's edge by this; more would take the ground beside small holes
_FILL_SHARE: Final = 0.01  # of the sampled pixels: less plain ground of one colour is not worth a thought
_MOST_FILLS: Final = 3  # a map with more plain colours is drawn, and plain is what it shows
_PLAIN_SHARE: Final = 0.95  # a map that is plain nearly everywhere is what it is
_LETTERS_PX: Final = 31  # gaps in a fill that letters on it make


def range_of_ground(values: NDArray[Any]) -> tuple[float, float]:
    """Lowest and highest value that ground can have, infinite where nothing bounds it.

    values: (n,) of pixels of the map, finite.
    """
    low, high = -np.inf, np.inf
    for _ in range(4):
        inside = values[(values > low) & (values < high)].astype(np.float64)
        found, count = np.unique(inside, return_counts=True)
        spikes = found[count >= max(2.0, _SPIKE_SHARE * len(inside))]
        if not len(spikes):
            break
        least, most = spikes[0], spikes[-1]
        if (bound := _apart(inside, least)) is not None:
            low = bound
        elif (bound := _apart(-inside, -most)) is not None:
            high = -bound
        else:
            break
    return float(low), float(high)


def _apart(values: Array, spike: float) -> float | None:
    """The least value of ground if a spike below it stands apart; None if it does not."""
    rest = values[values > spike]
    if not len(rest):
        return None
    low, high = (float(v) for v in np.percentile(rest, _BULK_PERCENT))
    spread = max(high - low, 1e-6 * abs(high), 1e-12)
    if low - spike <= _APART * spread:
        return None
    return max(0.5 * low + 0.5 * spike, low - spread)  # what is between is mixed of both


def fills(windows: Iterable[NDArray[Any]]) -> list[tuple[float, ...]]:
    """Colours in which a photographed map is plain without being ground.

    windows: (bands, rows, columns) each, samples of the map at its own resolution.
    """
    plain, pixels = list[Array](), 0
    for window in windows:
        pixels += window[0].size
        flat = np.all([_least(band) == -_least(-band) for band in window.astype(np.float64)], axis=0)
        plain.append(window[:, flat].T.astype(np.float64))
    if not pixels:
        return []
    colours, count = np.unique(np.concatenate(plain), axis=0, return_counts=True)
    common = colours[count >= _FILL_SHARE * pixels]
    photographed = len(common) <= _MOST_FILLS and count.sum() < _PLAIN_SHARE * pixels
    return [tuple(colour.tolist()) for colour in common] if photographed else []


def blank(values: NDArray[Any], fills: Sequence[tuple[float, ...]] = ()) -> Flags:
    """Plain patches of a map without a mask: black or white, or of one of the fills.

    values: (bands, rows, columns). fills: colours, a value a band.
    """
    dtype = values.dtype
    noise = _NOISE if dtype == np.uint8 else 0
    ends = [0.0, float(np.iinfo(dtype).max)] if dtype.kind in "iu" else [0.0]
    out = np.zeros(values.shape[1:], bool)
    for end in ends:
        out |= _patches(values, (end,) * len(values), noise)
    for colour in fills:
        found = _patches(values, colour, 0)
        if found.any():
            out |= cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_CLOSE, _square(_LETTERS_PX)).astype(bool)
    return out


def _patches(values: NDArray[Any], colour: Sequence[float], noise: int) -> Flags:
    """Squares that keep to a colour within a noise, with what interpolation blurs of them."""
    near = np.abs(values[0].astype(np.float32) - colour[0]) <= noise if noise else values[0] == colour[0]
    if np.count_nonzero(near) < _COLLAR_PX**2:
        return np.zeros(near.shape, bool)
    off = np.max([np.abs(b.astype(np.float32) - c) for b, c in zip(values, colour, strict=True)], axis=0)
    core = cv2.erode((off <= noise).astype(np.uint8), _square(_COLLAR_PX), borderValue=1).astype(bool)
    if noise:
        core &= cv2.blur(off, (_COLLAR_PX, _COLLAR_PX), borderType=cv2.BORDER_REPLICATE) <= _NOISE_MEAN
    if not core.any():
        return np.zeros(near.shape, bool)
    return np.asarray(cv2.dilate(core.astype(np.uint8), _square(_COLLAR_PX + 2 * _BLURRED_PX), borderValue=0)) > 0


def _least(band: Array) -> Array:
    """The least value of the square around each pixel, of which nothing lies outside."""
    return np.asarray(cv2.erode(band, _square(_COLLAR_PX), borderType=cv2.BORDER_REPLICATE))


def _square(side: int) -> Bytes:
    return np.ones((side, side), np.uint8)
