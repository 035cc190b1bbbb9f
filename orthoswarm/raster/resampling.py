"""Resampling between grids of one orientation: exact area means where the answer is coarser, else cubic."""

import numpy as np

from orthoswarm.compute.jit import kernel
from orthoswarm.model.arrays import Bytes, Flags


def resample(
    data: Bytes, valid: Flags, first: tuple[float, float], scale: tuple[float, float], size: tuple[int, int]
) -> tuple[Bytes, Flags]:
    """Bring bands to another grid.

    Args:
        data: uint8 (bands, rows, columns). valid: bool (rows, columns), which pixels count.
        first: left and upper edge of the answer in pixels of the data, from the data's own upper left edge.
        scale: pixels of the data in a pixel of the answer, across and down.
        size: columns and rows of the answer.

    Returns:
        Bands uint8 (bands, rows, columns) and validity bool (rows, columns): more than half of the pixel is valid.
    """
    width, height = size
    if max(scale) >= 1.02:
        out = np.empty((len(data), height, width), np.uint8)
        share = np.empty((height, width), np.float32)
        _area_means(np.ascontiguousarray(data), valid, first[0], first[1], scale[0], scale[1], out, share)
        return out, share > 0.5
    import cv2

    # Pixel centres: x_data + 0.5 = first + scale (x + 0.5).
    x, y = (first[i] + 0.5 * scale[i] - 0.5 for i in (0, 1))
    to_data = np.array([[scale[0], 0.0, x], [0.0, scale[1], y]])
    cubic, linear = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    bands = [cv2.warpAffine(b, to_data, size, flags=cubic, borderMode=cv2.BORDER_REPLICATE) for b in data]
    weight = cv2.warpAffine(valid.astype(np.float32), to_data, size, flags=linear, borderValue=0)
    return np.stack(bands), np.asarray(weight) > 0.5


@kernel
def _area_means(data, valid, left, top, sx, sy, out, share):  # type: ignore[no-untyped-def]
    """Sum rows first, then columns: the inner loops run along the data, without branches."""
    bands, rows, cols = data.shape
    weight = np.empty(cols, np.float32)
    sums = np.empty((bands, cols), np.float32)
    width = out.shape[2]
    first, count = np.empty(width, np.int64), np.empty(width, np.int64)  # columns of the data under each of the answer
    part = np.empty((width, int(np.ceil(sx)) + 2), np.float32)  # ... and how much of each
    for c in range(width):
        x0, x1 = left + c * sx, left + (c + 1) * sx
        first[c] = max(int(np.floor(x0)), 0)
        count[c] = max(min(int(np.ceil(x1)), cols) - first[c], 0)
        for k in range(count[c]):
            j = first[c] + k
            part[c, k] = np.float32(min(x1, j + 1.0) - max(x0, float(j)))
    for r in range(out.shape[1]):
        y0, y1 = top + r * sy, top + (r + 1) * sy
        weight[:] = 0.0
        sums[:] = 0.0
        for i in range(max(int(np.floor(y0)), 0), min(int(np.ceil(y1)), rows)):
            high = np.float32(min(y1, i + 1.0) - max(y0, float(i)))
            for j in range(cols):
                weight[j] += high * np.float32(valid[i, j])
            for b in range(bands):
                for j in range(cols):
                    sums[b, j] += high * np.float32(valid[i, j]) * np.float32(data[b, i, j])
        for c in range(width):
            total = np.float32(0.0)
            for k in range(count[c]):
                total += part[c, k] * weight[first[c] + k]
            share[r, c] = total / (sx * sy)
            for b in range(bands):
                value = np.float32(0.0)
                for k in range(count[c]):
                    value += part[c, k] * sums[b, first[c] + k]
                out[b, r, c] = np.uint8(value / total + np.float32(0.5)) if total > 1e-6 else np.uint8(0)
