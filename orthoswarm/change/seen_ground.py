"""What refined pictures show of a block of ground: the mean of their structure, and how well they agree.

Structure is taken from each picture by itself and then averaged on the ground: what moves (cars, smoke, glints) is in
one picture of many, and what is not drawn on its top stands elsewhere in each.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from orthoswarm.change.structure import structure
from orthoswarm.coverage.view import View
from orthoswarm.model.arrays import Array, Bytes, Floats
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain

_STEEPEST: Final = 1.1  # tangent of the angle off nadir up to which a picture counts ...
_HALVED: Final = 0.35  # ... by half at this one: what stands leans less
_BORDER_PX: Final = 3.0
_ALONE: Final = 0.8  # share of the weight in one picture from which there is nothing to compare it with
Read = Callable[[View], Bytes | None]
"""A view's grey picture, uint8 (rows, columns), perhaps reduced; None where it cannot be read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenGround:
    """What pictures show of a grid; float32 (rows, columns), 0 where none sees it."""

    field: Floats  # (rows, columns, 4), mean structure
    power: Floats  # mean square of its first two in each picture by itself
    gray: Floats  # mean grey value
    contrast: Floats  # mean contrast
    weight: Floats  # how many pictures count
    same: Floats  # the part of `power` that the pictures have in common: of all where only one counts


def heights_on(grid: GroundGrid, terrain: Terrain, of: Floats) -> Floats:
    """Heights `of` a terrain's nodes on a grid's pixels, float32 (rows, columns)."""
    first = grid.to_ground(np.zeros(2))
    column = (first[0] - terrain.west + grid.gsd_m * np.arange(grid.width)) / terrain.step_m
    row = (first[1] - terrain.south - grid.gsd_m * np.arange(grid.height)) / terrain.step_m
    x, y = (np.clip(v, 0, n - 1) for v, n in ((column, of.shape[1]), (row, of.shape[0])))
    r0, r1, c0, c1 = (int(v) for v in (y.min(), np.ceil(y.max()) + 1, x.min(), np.ceil(x.max()) + 1))
    part = np.ascontiguousarray(of[r0:r1, c0:c1])
    at_x = np.broadcast_to((x - c0).astype(np.float32), (grid.height, grid.width))
    at_y = np.broadcast_to((y - r0).astype(np.float32)[:, None], (grid.height, grid.width))
    return np.asarray(
        cv2.remap(part, np.ascontiguousarray(at_x), np.ascontiguousarray(at_y), cv2.INTER_LINEAR,
                  borderMode=cv2.BORDER_REPLICATE)
    )  # fmt: skip


def seen_ground(views: Sequence[View], grid: GroundGrid, height: Floats, read: Read) -> SeenGround:
    """Average what pictures show of a grid.

    Args:
        views: the pictures. grid: pixels of the ground. height: of each, metres, the datum of the views.
        read: gives their grey values.
    """
    shape = height.shape
    field, power = np.zeros((*shape, 4), np.float32), np.zeros(shape, np.float32)
    gray, contrast, weight, twice = (np.zeros(shape, np.float32) for _ in range(4))
    level = float(np.median(height))
    for view in views:
        window = _window(view, grid, level)
        if window is None:
            continue
        picture = read(view)
        if picture is None:
            continue
        rows, columns = window
        corner = grid.to_ground(np.array([columns.start, rows.start], float))
        own, counts = _on_ground(view, picture, corner, height[rows, columns], grid.gsd_m)
        if not counts.any():
            continue
        found = structure(own, grid.gsd_m)
        field[rows, columns] += found.field * counts[..., None]
        power[rows, columns] += found.power * counts
        gray[rows, columns] += own * counts
        contrast[rows, columns] += found.contrast * counts
        weight[rows, columns] += counts
        twice[rows, columns] += counts * counts
    scale = (1.0 / np.maximum(weight, 1e-3)).astype(np.float32)
    field *= scale[..., None]
    power *= scale
    # |mean|^2 = same + (power - same) * share, since pictures agree with themselves
    share = np.clip(twice * scale * scale, 0.0, 1.0).astype(np.float32)
    mean = field[..., 0] ** 2 + field[..., 1] ** 2
    same = np.where(share < _ALONE, (mean - power * share) / (1.0 - np.minimum(share, _ALONE)), power)
    return SeenGround(
        field=field, power=power, gray=gray * scale, contrast=contrast * scale, weight=weight,
        same=same.astype(np.float32),
    )  # fmt: skip


def _window(view: View, grid: GroundGrid, level: float) -> tuple[slice, slice] | None:
    """Rows and columns of the grid around a view's ground; None where it sees nothing of it."""
    lens, down = view.lens, float(view.position[2]) - level
    if down <= 1.0:
        return None
    edge = np.array([(x, y) for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0)]) * [lens.width - 1, lens.height - 1]
    xy = lens.undistort((edge - np.array(lens.principal_point)) / lens.focal_px)
    ray = np.column_stack([xy, np.ones(len(xy))]) @ view.to_camera
    ray = ray[ray[:, 2] < -1e-3]
    if not len(ray):
        return None
    tan = ray[:, :2] / -ray[:, 2:]
    length = np.maximum(np.hypot(tan[:, 0], tan[:, 1]), 1e-6)
    ground = view.position[:2] + down * tan * np.minimum(1.0, _STEEPEST / length)[:, None]
    pixel = grid.to_pixel(ground)
    low, high = np.floor(pixel.min(0)).astype(int), np.ceil(pixel.max(0)).astype(int) + 1
    columns = slice(max(low[0], 0), min(high[0], grid.width))
    rows = slice(max(low[1], 0), min(high[1], grid.height))
    return None if rows.start >= rows.stop or columns.start >= columns.stop else (rows, columns)


def _on_ground(view: View, picture: Bytes, corner: Array, height: Floats, gsd_m: float) -> tuple[Floats, Floats]:
    """A picture's grey values on pixels of the ground, float32, and their weights; corner: where they begin."""
    rows, columns = height.shape
    corner = corner - view.position[:2]
    x = np.float32(corner[0]) + np.float32(gsd_m) * np.arange(columns, dtype=np.float32)
    y = np.float32(corner[1]) - np.float32(gsd_m) * np.arange(rows, dtype=np.float32)
    z = height - np.float32(view.position[2])
    m = view.to_camera.astype(np.float32)
    depth = m[2, 0] * x + (m[2, 1] * y)[:, None] + m[2, 2] * z
    inverse = 1.0 / np.maximum(depth, 1e-3)
    u = (m[0, 0] * x + (m[0, 1] * y)[:, None] + m[0, 2] * z) * inverse
    v = (m[1, 0] * x + (m[1, 1] * y)[:, None] + m[1, 2] * z) * inverse
    lens = view.lens
    if not lens.is_pinhole:
        r2 = u * u + v * v
        bend = 1.0 + r2 * (np.float32(lens.k1) + r2 * (np.float32(lens.k2) + r2 * np.float32(lens.k3)))
        u *= bend
        v *= bend
    factor = lens.width / picture.shape[1]
    focal, (cx, cy) = lens.focal_px / factor, ((p + 0.5) / factor - 0.5 for p in lens.principal_point)
    u = u * np.float32(focal) + np.float32(cx)
    v = v * np.float32(focal) + np.float32(cy)
    gray = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    tan2 = (x * x + (y * y)[:, None]) / np.maximum(z * z, 1.0)
    counts = (1.0 / (1.0 + (tan2 / np.float32(_HALVED**2)) ** 2)).astype(np.float32)
    border = np.minimum(np.minimum(u, picture.shape[1] - 1 - u), np.minimum(v, picture.shape[0] - 1 - v))
    counts *= (border > _BORDER_PX) & (depth > 1.0) & (tan2 < np.float32(_STEEPEST**2))
    return gray, counts
