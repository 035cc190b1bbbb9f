"""The transition at a seam: a few pixels to either side take something of the other picture as well."""

import numpy as np

from orthoswarm.canvas.tile_store import Key, TileStore
from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Floats, Ints


def labels_around(store: TileStore, key: Key, border_px: int) -> Ints:
    """A tile's labels with those of its neighbours' nearest pixels, int32 (T + 2 border, T + 2 border); 0 = none."""
    t, b = store.tile_px, border_px
    around = np.zeros((t + 2 * b, t + 2 * b), np.int32)
    spans = {
        -1: (slice(0, b), slice(t - b, t)),
        0: (slice(b, b + t), slice(0, t)),
        1: (slice(b + t, None), slice(0, b)),
    }
    for i, (to_rows, rows) in spans.items():
        for j, (to_cols, cols) in spans.items():
            if key[0] + i < 0 or key[1] + j < 0:
                continue
            tile = store.get((key[0] + i, key[1] + j))
            if tile is not None:
                around[to_rows, to_cols] = tile.plane[rows, cols]
    return around


def transition(around: Ints, width_px: int) -> tuple[Ints, Floats]:
    """The other picture of each pixel near a seam.

    Args:
        around: int32 (T + 2 width, T + 2 width), labels, see `labels_around`.
        width_px: how far from the seam pixels are mixed.

    Returns:
        int32 (T, T), label of the nearest pixel that has another, 0 where there is none within the width; and the share
        of it, float32 (T, T), from nearly a half at the seam to 0.
    """
    import cv2

    b = width_px
    edge = np.zeros(around.shape, np.uint8)
    differ = around[:, 1:] != around[:, :-1]
    edge[:, 1:] |= differ
    edge[:, :-1] |= differ
    differ = around[1:] != around[:-1]
    edge[1:] |= differ
    edge[:-1] |= differ
    near = cv2.dilate(edge, np.ones((2 * b - 1, 2 * b - 1), np.uint8))[b:-b, b:-b]
    offsets = np.stack(np.meshgrid(np.arange(-b, b + 1), np.arange(-b, b + 1)), -1).reshape(-1, 2)
    distance = np.hypot(*offsets.T)
    order = np.argsort(distance, kind="stable")
    order = order[(distance[order] > 0) & (distance[order] <= b)]
    other, share = np.zeros(near.shape, np.int32), np.zeros(near.shape, np.float32)
    _transition(around, np.asarray(near), offsets[order], distance[order], b, other, share)
    return other, share


@in_place_kernel
def _transition(around, near, offsets, distance, border, other, share):  # type: ignore[no-untyped-def]
    rows, columns = near.shape
    for r in range(rows):
        for c in range(columns):
            own = around[r + border, c + border]
            if near[r, c] == 0 or own == 0:
                continue
            for n in range(len(offsets)):
                k = around[r + border + offsets[n, 1], c + border + offsets[n, 0]]
                if k > 0 and k != own:
                    other[r, c] = k
                    share[r, c] = 0.5 * (1.0 - (distance[n] - 0.5) / border)
                    break


@kernel
def mix(packed, index, share, colors):  # type: ignore[no-untyped-def]
    """Mix into a tile's colours those of the other pictures near seams.

    Args:
        packed: uint32 (T, T), changed in place.
        index, share, colors: see `seam_pixels.SeamPixels`.
    """
    flat, eight = packed.ravel(), np.uint32(8)
    for n in range(len(index)):
        own, other = flat[index[n]], colors[0, n]
        if own >> np.uint32(24) == 0 or other >> np.uint32(24) == 0:
            continue
        mixed = np.uint32(0xFF000000)
        for channel in range(3):
            shift = eight * np.uint32(channel)
            here = np.float32((own >> shift) & np.uint32(255))
            there = np.float32((other >> shift) & np.uint32(255))
            mixed |= np.uint32(here + share[n] * (there - here) + np.float32(0.5)) << shift
        flat[index[n]] = mixed
