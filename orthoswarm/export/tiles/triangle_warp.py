"""Pixels of one map system drawn on the pixels of another, with a triangle filter as wide as the larger of the two.

The filter is bilinear interpolation where pixels grow, and its scaled form where they shrink (Turkowski, "Filters for
Common Resampling Tasks", in Graphics Gems, 1990), as GDAL's warper has it.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel

Bytes = NDArray[np.uint8]
Array = NDArray[np.float64]
_LEAST_WEIGHT: Final = 1e-5
_FAR: Final = -1e9
"""A place outside every raster, for points that the source's system does not have."""


def warp(raster: Any, nodes: Array, step: int) -> Bytes | None:
    """Draw a raster on a target whose pixels are known at every `step`-th one.

    Args:
        raster: open dataset with red, green, blue and alpha of 8 bits.
        nodes: coordinates in the raster's system of the target's pixel corners, float64 (rows / step + 1, columns /
            step + 1, 2): a corner for every `step` pixels; between them the map is taken as bilinear.
        step: pixels between nodes.

    Returns:
        The target, uint8 (rows, columns, 4); None if nothing is there. A pixel is drawn where any source pixel below
        its filter is.
    """
    from rasterio.windows import Window

    columns, rows = ~raster.transform * (nodes[..., 0], nodes[..., 1])
    places = np.nan_to_num(np.stack([columns, rows], -1), nan=_FAR, posinf=_FAR, neginf=_FAR)
    scale = np.maximum(1.0, _pixels_of_source(places, step))
    margin = np.ceil(scale) + 1.0
    first = np.maximum(np.floor(places.min((0, 1)) - margin), 0.0).astype(int)
    last = np.minimum(np.ceil(places.max((0, 1)) + margin), [raster.width, raster.height]).astype(int)
    if (last <= first).any():
        return None
    source = raster.read(window=Window(first[0], first[1], *(last - first)))
    if not source[3].any():
        return None
    out = np.empty(((nodes.shape[0] - 1) * step, (nodes.shape[1] - 1) * step, 4), np.uint8)
    _draw(source, places - first, step, float(scale[0]), float(scale[1]), out)
    return out


def _pixels_of_source(places: Array, step: int) -> Array:
    """How many source columns and rows a target pixel covers, float64 (2,)."""
    across, down = np.abs(np.diff(places, axis=1)), np.abs(np.diff(places, axis=0))
    return np.array([np.median(across[..., 0]), np.median(down[..., 1])]) / step


@in_place_kernel
def _draw(source, nodes, step, across, down, target):  # type: ignore[no-untyped-def]
    height, width = source.shape[1], source.shape[2]
    for i in range(target.shape[0]):
        k = i // step
        v = (i + 0.5 - k * step) / step
        for j in range(target.shape[1]):
            m = j // step
            u = (j + 0.5 - m * step) / step
            a, b, c, d = (1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u
            x = a * nodes[k, m, 0] + b * nodes[k, m + 1, 0] + c * nodes[k + 1, m, 0] + d * nodes[k + 1, m + 1, 0] - 0.5
            y = a * nodes[k, m, 1] + b * nodes[k, m + 1, 1] + c * nodes[k + 1, m, 1] + d * nodes[k + 1, m + 1, 1] - 0.5
            red, green, blue, opaque, total = 0.0, 0.0, 0.0, 0.0, 0.0
            for row in range(max(0, int(np.ceil(y - down))), min(height, int(np.floor(y + down)) + 1)):
                weight_y = 1.0 - abs(row - y) / down
                for col in range(max(0, int(np.ceil(x - across))), min(width, int(np.floor(x + across)) + 1)):
                    alpha = source[3, row, col]
                    if alpha > 0:
                        weight = weight_y * (1.0 - abs(col - x) / across)
                        total += weight
                        weight *= alpha
                        opaque += weight
                        red += weight * source[0, row, col]
                        green += weight * source[1, row, col]
                        blue += weight * source[2, row, col]
            if total > _LEAST_WEIGHT:
                target[i, j, 0] = np.uint8(red / opaque + 0.5)
                target[i, j, 1] = np.uint8(green / opaque + 0.5)
                target[i, j, 2] = np.uint8(blue / opaque + 0.5)
                target[i, j, 3] = np.uint8(opaque / total + 0.5)
            else:
                target[i, j, 0] = target[i, j, 1] = target[i, j, 2] = target[i, j, 3] = 0
