"""What a camera sees of the ground: convex footprints, the limit of sane view angles, and frames that are absurd."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import Camera, Lens
from orthoswarm.mosaic.kernels.lens_arrays import INNER, OUTER, lens_row

MOST_OFF_NADIR_DEG: Final = 75.0
"""Ground that is seen farther from straight down is not drawn: a pixel there is smeared over more than 15 times its
size at nadir."""
TAN_LIMIT: Final = math.tan(math.radians(MOST_OFF_NADIR_DEG))
LEAST_DESCENT: Final = math.cos(math.radians(MOST_OFF_NADIR_DEG))
"""Smallest descent of a ray per unit of depth that is drawn: on level ground a straight line below the horizon."""
_MOST_MAGNIFICATION: Final = 16.0
"""A picture whose ground pixel is more than so many times the map's is none of this flight."""


def default_gsd(cameras: Sequence[Camera], ground_z_m: float = 0.0) -> float:
    """The median ground pixel at nadir, metres: height over the ground / focal length.

    Raises:
        ValueError: if no camera is above the ground.
    """
    heights = np.array([c.position[2] for c in cameras], float) - ground_z_m
    focal = np.array([c.lens.focal_px for c in cameras], float)
    if not (heights > 0).any():
        raise ValueError("no camera is above the ground")
    return float(np.median(heights[heights > 0] / focal[heights > 0]))


def rejections(cameras: Sequence[Camera], ground_z_m: ArrayLike, gsd_m: float) -> dict[int, str]:
    """Frames that cannot be drawn on a map: index -> why, one clause.

    cameras: where the frames' cameras are. ground_z_m: height of the ground below each, (N,) or one number. gsd_m: the
    map's ground pixel.
    """
    if len(cameras) == 0:
        return {}
    position = np.array([c.position for c in cameras], float)
    rotation = np.array([c.rotation for c in cameras], float)
    focal = np.array([c.lens.focal_px for c in cameras], float)
    heights = np.broadcast_to(position[:, 2] - np.asarray(ground_z_m, float), len(cameras))
    steepest = np.full(len(cameras), -np.inf)
    for lens, index in _by_lens(cameras).items():
        steepest[index] = -(rotation[index, 2] @ _corners(lens).T).min(1)
    reasons = {}
    for i, numbers in enumerate(zip(heights.tolist(), focal.tolist(), steepest.tolist())):
        reason = _reason(*numbers, gsd_m)
        if reason is not None:
            reasons[i] = reason
    return reasons


def rejection(camera: Camera, ground_z_m: float, gsd_m: float) -> str | None:
    """Why one frame cannot be drawn on a map, one clause; None if it can. See `rejections`."""
    steepest = -float((_corners(camera.lens) @ camera.rotation[2]).min())
    return _reason(float(camera.position[2]) - ground_z_m, camera.lens.focal_px, steepest, gsd_m)


def _reason(height: float, focal_px: float, steepest: float, gsd_m: float) -> str | None:
    if not (math.isfinite(height) and math.isfinite(focal_px) and math.isfinite(steepest) and focal_px > 0):
        return "its pose is not a number"
    if height <= 0:
        return f"its camera is not above the ground (height {height:.1f} m)"
    if height > _MOST_MAGNIFICATION * gsd_m * focal_px:
        times = height / (gsd_m * focal_px)
        return (
            f"from {height:.0f} m above the ground its pixels are {times:.0f} times as large as the map's: "
            "its height is wrong, or the map's pixel (--gsd) too small"
        )
    if steepest < LEAST_DESCENT:
        return "it looks at the horizon or above, and not at the ground"
    return None


def _by_lens(cameras: Sequence[Camera]) -> dict[Lens, list[int]]:
    groups: dict[Lens, list[int]] = {}
    for i, camera in enumerate(cameras):
        groups.setdefault(camera.lens, []).append(i)
    return groups


@lru_cache(maxsize=256)
def _corners(lens: Lens) -> Array:
    """Rays (4, 3), camera depth 1, of the corners of the box that holds all the undistorted picture, clockwise."""
    x0, x1, y0, y1 = lens_row(lens, 0.0)[OUTER:INNER]
    return np.array([[x0, y0, 1.0], [x1, y0, 1.0], [x1, y1, 1.0], [x0, y1, 1.0]])


@lru_cache(maxsize=256)
def _border(lens: Lens, per_side: int, inset_px: float) -> Array:
    """Undistorted normalised points (4 per_side, 2) around the picture, clockwise from the upper left."""
    w, h = lens.width - 1.0 - inset_px, lens.height - 1.0 - inset_px
    t = np.arange(per_side) / per_side
    i = inset_px
    along_x, along_y = i + (w - i) * t, i + (h - i) * t
    u = np.concatenate([along_x, np.full(per_side, w), along_x[::-1] + (w - i) / per_side, np.full(per_side, i)])
    v = np.concatenate([np.full(per_side, i), along_y, np.full(per_side, h), along_y[::-1] + (h - i) / per_side])
    xy = (np.stack([u, v], -1) - np.array(lens.principal_point)) / lens.focal_px
    return xy if lens.is_pinhole else lens.undistort(xy)


def footprint(camera: Camera, ground_z_m: float = 0.0, inset_px: float = 0.0) -> Array:
    """The ground that a camera sees on a level plane, a closed polygon float64 (K, 2), K = 0 if none.

    Without distortion it is exact and convex, clipped where the view is flatter than `MOST_OFF_NADIR_DEG` (along a
    straight line: the circle of that angle, `reach`, cuts the rest). With distortion the border has 8 points a side,
    and the polygon may be slightly concave. inset_px: how far inside the outermost pixel centres; -0.5 is the picture's
    very edge.
    """
    height = float(camera.position[2]) - ground_z_m
    xy = _border(camera.lens, 1 if camera.lens.is_pinhole else 8, inset_px)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], 1) @ camera.rotation.T
    rays = _clip(rays, LEAST_DESCENT)
    if len(rays) < 3 or height <= 0:
        return np.empty((0, 2))
    return np.asarray(camera.position[:2] + rays[:, :2] * (height / -rays[:, 2:]))


def _clip(rays: Array, least: float) -> Array:
    """The part of a closed polygon of rays (K, 3) that goes down by at least so much per unit of depth."""
    down = -rays[:, 2] - least
    if (down >= 0).all():
        return rays
    clipped = []
    for i in range(len(rays)):
        j = (i + 1) % len(rays)
        if down[i] >= 0:
            clipped.append(rays[i])
        if (down[i] >= 0) != (down[j] >= 0):
            clipped.append(rays[i] + (rays[j] - rays[i]) * (down[i] / (down[i] - down[j])))
    return np.array(clipped).reshape(-1, 3)


def reach(camera: Camera, ground_z_m: float = 0.0) -> float:
    """Greatest distance from the nadir point at which the ground is drawn, metres."""
    return TAN_LIMIT * (float(camera.position[2]) - ground_z_m)


def footprint_boxes(cameras: Sequence[Camera], z_low: float, z_high: float) -> Array:
    """Boxes float64 (N, 4), west, south, east, north, that hold what each camera sees of ground between two heights.

    West > east where a camera sees nothing.
    """
    boxes = np.tile([np.inf, np.inf, -np.inf, -np.inf], (len(cameras), 1))
    least = LEAST_DESCENT
    for lens, index in _by_lens(cameras).items():
        position = np.stack([cameras[i].position for i in index]).astype(float)
        rays = _corners(lens) @ np.stack([cameras[i].rotation for i in index]).transpose(0, 2, 1)
        level = (-rays[..., 2] >= least).all(1)
        descent = np.maximum(-rays[..., 2:], least)
        for z in (z_low, z_high):
            height = position[:, 2] - z
            ground = position[:, None, :2] + rays[..., :2] * (height[:, None, None] / descent)
            low, high, seen = ground.min(1), ground.max(1), level & (height > 0)
            for j in np.nonzero(~level & (height > 0))[0]:
                clipped = _clip(rays[j], least)
                if len(clipped) >= 3:
                    cut = position[j, :2] + clipped[:, :2] * (height[j] / -clipped[:, 2:])
                    low[j], high[j], seen[j] = cut.min(0), cut.max(0), True
            some = np.array(index)[seen]
            boxes[some, :2] = np.minimum(boxes[some, :2], low[seen])
            boxes[some, 2:] = np.maximum(boxes[some, 2:], high[seen])
    return boxes
