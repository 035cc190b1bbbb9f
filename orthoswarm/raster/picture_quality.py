"""Sharpness, contrast and damage of a decoded picture from a sample of small blocks (well under 0.3 ms)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Bytes

_BLOCK_PX = 16
_COLUMNS, _ROWS = 12, 9
LEAST_SIDE_PX = _BLOCK_PX + 8  # smaller pictures cannot be judged


@dataclass(frozen=True, slots=True)
class PictureQuality:
    """Quality measures of a picture's pixels; they are only meaningful compared with pictures of the same scene.

    Attributes:
        sharpness: energy of differences over 1 pixel divided by that over 4 pixels, 0 to about 1; it hardly depends on
            contrast and falls with every kind of blur. contrast: standard deviation of the sample, grey levels.
        flat_share: share of blocks in which all pixels are equal: what a truncated JPEG or a lost slice leaves.
        saturated_share: share of pixels at 250 or above: glare, sky.
    """

    sharpness: float
    contrast: float
    flat_share: float
    saturated_share: float


def picture_quality(picture: Bytes) -> PictureQuality:
    """Measure a picture, uint8 (rows, columns) or (rows, columns, 3 or 4), of which the second channel is used.

    Raises:
        ValueError: if it is smaller than LEAST_SIDE_PX on a side.
    """
    plane: NDArray[Any] = picture if picture.ndim == 2 else picture[..., 1]
    if min(plane.shape) < LEAST_SIDE_PX:
        raise ValueError(f"a picture of {plane.shape[1]} x {plane.shape[0]} pixels is too small to be judged")
    fine, coarse, mean, square, flat, bright = _sample(plane)
    return PictureQuality(
        sharpness=float(fine / coarse) if coarse > 0.0 else 0.0,
        contrast=float(np.sqrt(max(0.0, square - mean * mean))),
        flat_share=float(flat),
        saturated_share=float(bright),
    )


@in_place_kernel
def _sample(plane):  # type: ignore[no-untyped-def]
    """Sums over the blocks of a lattice: difference energies over 1 and 4 pixels, mean, mean square, shares."""
    rows, columns = plane.shape
    fine = coarse = np.int64(0)
    total = square = flat = bright = np.int64(0)
    blocks = _ROWS * _COLUMNS
    for j in range(_ROWS):
        top = (rows - _BLOCK_PX - 4) * j // (_ROWS - 1)
        for i in range(_COLUMNS):
            left = (columns - _BLOCK_PX - 4) * i // (_COLUMNS - 1)
            low, high = np.int64(255), np.int64(0)
            for r in range(top, top + _BLOCK_PX):
                for c in range(left, left + _BLOCK_PX):
                    value = np.int64(plane[r, c])
                    a = value - np.int64(plane[r, c + 1])
                    b = value - np.int64(plane[r + 1, c])
                    d = value - np.int64(plane[r, c + 4])
                    e = value - np.int64(plane[r + 4, c])
                    fine += a * a + b * b
                    coarse += d * d + e * e
                    total += value
                    square += value * value
                    low, high = min(low, value), max(high, value)
                    if value >= 250:
                        bright += 1
            if low == high and low < 250:
                flat += 1
    pixels = blocks * _BLOCK_PX * _BLOCK_PX
    return fine * 1.0, coarse * 1.0, total / pixels, square / pixels, flat / blocks, bright / pixels
