"""The compiled predictor of written rasters: differences of neighbouring pixels, which deflate shrinks better."""

import numpy as np

from orthoswarm.compute.jit import kernel

_ALPHA = np.uint32(0xFF000000)
_NONE = np.uint32(0)
_HIGH, _LOW = np.uint32(0x80808080), np.uint32(0x7F7F7F7F)
"""The highest bit of each channel, and the others: by them all four channels are subtracted at once, without a borrow
from one to the next (Warren, Hacker's Delight, 2-18)."""


@kernel
def predict(tile, differences):  # type: ignore[no-untyped-def]
    """Each pixel's channels less those of the pixel to its left (TIFF predictor 2), transparent pixels as zeros.

    Args:
        tile: uint32 (rows, columns), R, G, B, A in memory order.
        differences: uint32 (rows, columns), is filled in the same order.

    Returns:
        Whether any pixel is drawn; if not, the differences mean nothing.
    """
    rows, columns = tile.shape
    drawn = _NONE
    clean = np.zeros(columns + 1, np.uint32)  # the first stands for what lies left of the row
    here, before = clean[1:], clean[:-1]
    for r in range(rows):
        pixels, row = tile[r], differences[r]
        for c in range(columns):
            here[c] = pixels[c] if pixels[c] & _ALPHA else _NONE
            drawn |= here[c]
        for c in range(columns):
            a, b = here[c], before[c]
            row[c] = ((a | _HIGH) - (b & _LOW)) ^ ((a ^ ~b) & _HIGH)
    return drawn != _NONE
