"""The tone of a map at low frequency: the map takes part in the balancing like one more picture, which stays as it is.

Means over blocks of a picture (a fourth of its width) are compared with those of the map at the same ground. Cars,
leaves and shadows vanish in such means; seasons do not, therefore the ratios have a large sigma: single pictures hardly
follow them, the mean of many does.
"""

from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np

from orthoswarm.model.arrays import Array, Bytes, Flags
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Camera
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.kernels.render_arrays import Shots
from orthoswarm.mosaic.overlap_colors import BRIGHT_LEVEL, DARK_LEVEL, OverlapColors, grid_on_ground

_MAP_SIGMA: Final = 0.25  # log ratio of a picture's block to a map: another season, light and sensor, local changes
_MAP_BLOCK_PX: Final = 4  # side of a block of the map's colours, pixels of a thumbnail
_MAP_BLOCK_LEAST_M: Final = 0.1  # least side of a block on the ground
_MAP_PARTS: Final = 7  # pixels of the map across a block (for its time)
_MAP_COVERED_SHARE: Final = 0.9  # least share of a block that the map shows


class ColorMap(Protocol):
    """A map in colour (raster.basemap.Basemap)."""

    def rgb(self, bounds: BoundingBox, gsd_m: float) -> tuple[Bytes, Flags]:
        """Colours (rows, columns, 3) and validity of a window; see GroundGrid.around for its frame."""


def map_colors(
    cameras: Sequence[Camera], shots: Shots, small: Bytes, terrain: Terrain, tone: ColorMap
) -> OverlapColors:
    """Compare frames with a map; the map's index as a frame is the number of cameras.

    cameras: N cameras; shots: the same as arrays. small: uint8 (N, rows, columns, 3) thumbnails. terrain: the ground.
    tone: the map; where it is grey its hue says nothing.
    """
    count = len(cameras)
    side = _MAP_BLOCK_PX
    rows, columns = small.shape[1] // side, small.shape[2] // side
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    share = np.stack([u.ravel(), v.ravel()], 1)
    blocks = small[:, : rows * side, : columns * side].astype(np.float64)
    seen = blocks.reshape(count, rows, side, columns, side, 3).mean((2, 4)).reshape(count, -1, 3)
    ground = grid_on_ground(cameras, shots, terrain, share)
    drawn, valid = _at(tone, ground, columns)
    valid &= ((seen > DARK_LEVEL) & (seen < BRIGHT_LEVEL)).all(-1)
    valid &= ((drawn > DARK_LEVEL) & (drawn < BRIGHT_LEVEL)).all(-1)
    ratio = np.log(np.maximum(seen, 1.0)) - np.log(np.maximum(drawn, 1.0))
    if not (drawn[valid] != drawn[valid][:, :1]).any():
        ratio[:] = ratio.mean(-1, keepdims=True)
    place = np.zeros((*ratio.shape[:2], 2, 4), np.float32)
    place[:, :, 0, :2] = 2.0 * share - 1.0
    place[:, :, 0, 1] *= (shots.size[:, 1] / shots.size[:, 0])[:, None]
    rise = np.maximum(shots.position[:, 2] - terrain.height(shots.position[:, :2]), 1e-3)
    place[:, :, 0, 2:] = (ground - shots.position[:, None, :2]) / rise[:, None, None]
    frame = np.stack(np.broadcast_arrays(np.arange(count)[:, None], count), -1).astype(np.int32)
    frame = np.broadcast_to(frame, (count, len(share), 2))
    sigma = np.full(int(valid.sum()), _MAP_SIGMA, np.float32)
    return OverlapColors(frame[valid], ratio[valid].astype(np.float32), place[valid], sigma)


def _at(tone: ColorMap, ground: Array, columns: int) -> tuple[Array, Flags]:
    """The map's means (N, P, 3) about places (N, P, 2), and where there are any."""
    import cv2

    known = np.asarray(np.isfinite(ground).all(axis=-1))
    if not known.any():
        return np.zeros((*ground.shape[:2], 3)), known
    across = np.hypot(*(ground[:, columns - 1] - ground[:, 0]).T)
    block, parts = max(float(np.nanmedian(across)) / max(columns - 1, 1), _MAP_BLOCK_LEAST_M), _MAP_PARTS
    low, high = ground[known].min(0) - block, ground[known].max(0) + block
    bounds = BoundingBox(float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    fine = block / parts
    colors, mask = tone.rgb(bounds, fine)
    share = cv2.blur(mask.astype(np.float32), (parts, parts))
    means = cv2.blur(np.where(mask[..., None], colors, 0).astype(np.float32), (parts, parts))
    cell = np.rint(GroundGrid.around(0, bounds, fine).to_pixel(np.where(known[..., None], ground, low))).astype(int)
    column, row = cell[..., 0].clip(0, mask.shape[1] - 1), cell[..., 1].clip(0, mask.shape[0] - 1)
    covered = share[row, column]
    return means[row, column] / np.maximum(covered, 1e-3)[..., None], known & (covered > _MAP_COVERED_SHARE)
