"""Checks before the work starts that a map can be read where it is needed, without reading all of it.

A truncated copy opens like a complete one (a TIFF's directory is often at its beginning), and blocks that
were never written are zeros. So the offsets of all blocks are compared with the file's length, and some are decoded.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError

_CHECK_SIDE: Final = 5  # windows a side of the lattice at which a map's pixels are read before the work begins (time)
_CHECK_WINDOW_PX: Final = 4.0  # side of these windows (for its time)


class UnreadableMapError(InputError):
    """A map's pixels cannot be read, although it was opened: damaged, cut short, or no longer there."""


def sample_windows(bounds: BoundingBox, gsd_m: float) -> list[BoundingBox]:
    """Small windows of some pixels spread over bounds, few enough to be read in a fraction of a second."""
    west, south, east, north = bounds
    half = 0.5 * _CHECK_WINDOW_PX * gsd_m
    share = (np.arange(_CHECK_SIDE) + 0.5) / _CHECK_SIDE
    return [
        BoundingBox(float(x), float(y), float(x), float(y)).grown(half)
        for y in north + share * (south - north)
        for x in west + share * (east - west)
    ]


def ends_early(source: Any, path: Path, window: tuple[int, int, int, int]) -> bool:
    """True if a TIFF has blocks that its file is too short for; False for other files.

    source: the open rasterio data set. path: its file. window: first row, row after the last, first column, column
    after the last, full resolution; inside the raster.
    """
    if source.driver not in ("GTiff", "COG") or not path.is_file():
        return False
    size = path.stat().st_size
    inside = not any(name.lower().endswith(".ovr") for name in source.files)
    levels = [None, *range(len(source.overviews(1)))] if inside else [None]
    factors = [1, *source.overviews(1)]
    bands = [1] if source.interleaving is None or source.interleaving.name == "pixel" else range(1, source.count + 1)
    return any(
        _last_byte(source, level, band, tuple(v // factor for v in window)) > size
        for level, factor in zip(levels, factors, strict=False)
        for band in bands
    )


def _last_byte(source: Any, level: int | None, band: int, window: tuple[int, ...]) -> int:
    """End of the last block that a window of one resolution touches; 0 if there is none."""
    high, wide = _block_shape(source, level)
    row0, row1, col0, col1 = window
    last = 0
    for r in range(row0 // high, max(row1 - 1, row0) // high + 1):
        for c in range(col0 // wide, max(col1 - 1, col0) // wide + 1):
            place = source.get_tag_item(f"BLOCK_OFFSET_{c}_{r}", "TIFF", bidx=band, ovr=level)
            length = source.get_tag_item(f"BLOCK_SIZE_{c}_{r}", "TIFF", bidx=band, ovr=level)
            if place and length:
                last = max(last, int(place) + int(length))
    return last


def _block_shape(source: Any, level: int | None) -> tuple[int, int]:
    if level is None:
        return tuple(source.block_shapes[0])
    import rasterio

    with rasterio.open(source.name, OVERVIEW_LEVEL=level) as reduced:
        return tuple(reduced.block_shapes[0])
