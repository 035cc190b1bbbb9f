"""SIFT features, spread evenly over the picture, for photos that overlap too little for tracking.

Lowe 2004 (SIFT) as in OpenCV; RootSIFT after Arandjelovic and Zisserman 2012. The globally strongest features sit
on a few glints and roofs; a cap per cell of the picture keeps the geometry well conditioned.
"""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Floats, Gray, Ints

SIFT_PIXELS: Final = 480 * 360
"""Pixels of the reduced picture on which features are found, whatever its shape (measured on four real flights: 31 to
53 ms a photo)."""
_SIFT_CONTRAST: Final = 0.02
"""Contrast threshold of SIFT (Lowe 2004: 0.03); lower, because ground is of little contrast (chosen on four real
flights)."""
_SIFT_DETECTED: Final = 1500  # strongest features that are detected before they are spread
SIFT_CELLS: Final = (8, 6)  # cells of the picture, columns and rows
_SIFT_PER_CELL: Final = 16  # most features of a cell
_SIFT_KEPT: Final = 600  # most features of a photo (its cost)
_SIFT_SIGMA_PX: Final = 0.15
"""Sigma of a small feature's position in reduced pixels: residuals of the adjusted flights of four cameras are level up
to a diameter of 3 pixels."""
_SIFT_SIGMA_SHARE: Final = 0.04  # ... beyond that it grows by this share of the diameter (measured on the same flights)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SiftFeatures:
    """Features of one photo.

    Attributes:
        uv: float32 (n, 2), column and row in the FULL picture (width, height), pixel centres at integers.
        descriptor: uint8 (n, 128), SIFT descriptors as OpenCV gives them.
        sigma_px: float32 (n,), one sigma of the position in pixels of the full picture.
        step_px: full-picture pixels per pixel of the reduced picture.
    """

    uv: Floats
    descriptor: Gray
    sigma_px: Floats
    width: int
    height: int
    step_px: float

    def __len__(self) -> int:
        return len(self.uv)

    @classmethod
    def none(cls, width: int, height: int) -> "SiftFeatures":
        """An empty set for a picture of this size."""
        empty, none = np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)
        return cls(uv=empty, descriptor=none, sigma_px=empty[:, 0], width=width, height=height, step_px=1.0)

    def same_point(self) -> Ints:
        """The first feature at the place of each, int32 (n,): SIFT returns a point once for each strong orientation."""
        _, first, inverse = np.unique(self.uv, axis=0, return_index=True, return_inverse=True)
        return np.asarray(first[inverse.reshape(-1)], dtype=np.int32)


def detect(gray: Gray, width: int, height: int, working_pixels: int = SIFT_PIXELS) -> SiftFeatures:
    """At most `_SIFT_KEPT` features of one photo, the strongest of each cell first.

    Args:
        gray: uint8 (rows, columns), the photo at any size (decoding at reduced size saves time).
        width, height: of the full picture, in whose pixels positions are given.
        working_pixels: number of pixels of the reduced picture on which features are found.
    """
    reduced, step = reduce_picture(gray, width, height, working_pixels)
    sift = cv2.SIFT_create(  # type: ignore[attr-defined,unused-ignore]
        nfeatures=_SIFT_DETECTED, contrastThreshold=_SIFT_CONTRAST, enable_precise_upscale=True
    )
    keypoints, descriptors = sift.detectAndCompute(reduced, None)
    if len(keypoints) == 0:
        return SiftFeatures.none(width, height)
    xy = np.array([k.pt for k in keypoints], np.float32)
    response, size = (np.array([getattr(k, name) for k in keypoints], np.float32) for name in ("response", "size"))
    keep = spread(xy, response, reduced.shape[1], reduced.shape[0])
    uv = (xy[keep] + np.float32(0.5)) * np.float32(step) - np.float32(0.5)
    spread_px = np.hypot(np.float32(_SIFT_SIGMA_PX), np.float32(_SIFT_SIGMA_SHARE) * size[keep])
    sigma = np.float32(step) * spread_px.astype(np.float32)
    return SiftFeatures(
        uv=uv, descriptor=descriptors[keep].astype(np.uint8), sigma_px=sigma, width=width, height=height, step_px=step
    )


def reduce_picture(gray: Gray, width: int, height: int, working_pixels: int) -> tuple[Gray, float]:
    """The picture reduced to about the working size (never enlarged), and full-size pixels per reduced pixel."""
    ratio = min(1.0, float(np.sqrt(working_pixels / (width * height))))
    columns, rows = max(16, round(width * ratio)), max(16, round(height * ratio))
    if (columns, rows) != (gray.shape[1], gray.shape[0]):
        gray = np.asarray(cv2.resize(gray, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8)
    return gray, width / columns


def spread(xy: Floats, response: Floats, columns: int, rows: int) -> NDArray[np.intp]:
    """Indices of features to keep: the strongest of every cell, then the second strongest, until enough."""
    nx, ny = SIFT_CELLS if columns >= rows else SIFT_CELLS[::-1]
    cx = np.clip((xy[:, 0] * nx / columns).astype(np.int64), 0, nx - 1)
    cy = np.clip((xy[:, 1] * ny / rows).astype(np.int64), 0, ny - 1)
    cell = cy * nx + cx
    order = np.lexsort((xy[:, 1], xy[:, 0], -response, cell))
    sorted_cell = cell[order]
    start = np.flatnonzero(np.r_[True, sorted_cell[1:] != sorted_cell[:-1]])
    rank = np.arange(len(order)) - np.repeat(start, np.diff(np.r_[start, len(order)]))
    order, rank = order[rank < _SIFT_PER_CELL], rank[rank < _SIFT_PER_CELL]
    return np.asarray(order[np.lexsort((-response[order], rank))][:_SIFT_KEPT])
