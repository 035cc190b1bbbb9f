"""Height of the open ground relative to a surface through corner points.

Corners lie at the edges of raised objects, so a surface through them is a little above the open ground, although every
point is right: pictures rectified on it and compared with the map are then shifted by that height times the obliquity
of the view. Small patches at free positions, not at corners, measure the ground itself.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array
from orthoswarm.model.placement import Terrain
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.surface.vertical_line_locus import (
    REFERENCE_HEIGHT_M,
    LocusPoints,
    ReadPicture,
    Sweep,
    dense_ground,
    height_above,
)

_OFFSET_POSITIONS: Final = 900  # free positions where the ground is measured against the surface (0.05 s)
_OFFSET_SPREAD_M: Final = 100.0  # half side of the square about each camera for positions at reference height
_OFFSET_LEAST_HEIGHTS: Final = 60  # with fewer heights found the offset is 0
_OFFSET_KERNEL_M: Final = 0.2  # Gaussian kernel of the mode of the differences
_OFFSET_LIMITS_M: Final = (-1.5, 0.5)  # the offset is clipped to this range
_OFFSET_REACH_M: Final = 3.0  # heights searched above and below the surface for the offset
_OFFSET_HEIGHT_STEP_M: Final = 0.25  # distance of the heights searched for the offset at the reference height


def near_surface() -> Sweep:
    """A sweep of small patches near the surface; a large patch includes rubble and finds only half of the offset."""
    return replace(Sweep.small(), reach_m=_OFFSET_REACH_M, height_step_m=_OFFSET_HEIGHT_STEP_M, rival_m=np.inf)


@dataclass(frozen=True, slots=True)
class GroundOffset:
    """Level of the open ground relative to a surface.

    Attributes:
        ground_offset_m: added to the surface to get the open ground (usually negative).
        count: number of heights found; with too few the offset is 0.
        points: the heights found. They are good ground points: a surface fitted to them together with the tie points
            follows the ground where the offset varies (rubble, streets), and then the
            remaining offset is a few centimetres.
    """

    ground_offset_m: float
    count: int
    points: LocusPoints


def draw_positions(camera_xy: Array, height_m: float, *, seed: int = 0) -> Array:
    """Free positions, float64 (K, 2): around pictures' positions (N, 2) evenly in a square that grows with the height.

    Deterministic for the same cameras, so that the offset depends on the surface and not on the draw.
    """
    count, spread_m = _OFFSET_POSITIONS, _OFFSET_SPREAD_M * height_m / REFERENCE_HEIGHT_M
    rng = np.random.default_rng(seed)
    at = np.asarray(camera_xy, float)[np.linspace(0, len(camera_xy) - 1, count).round().astype(int)]
    return np.asarray(at[:, :2] + rng.uniform(-spread_m, spread_m, (count, 2)))


def measure_ground_offset(
    cameras: CameraBlock,
    gray: ReadPicture,
    positions: Array,
    *,
    terrain: Terrain,
    leg_of_camera: NDArray[np.integer],
    sweep: Sweep | None = None,
) -> GroundOffset:
    """Measure the level of the ground above the terrain at free positions (see `draw_positions`), with small patches.

    Args:
        cameras: cameras.
        gray: picture of a camera by index, uint8.
        positions: float64 (C, 2).
        terrain: the surface, within sweep.reach_m of the ground.
        leg_of_camera: int (N,), -1 for cameras that must not be used.
        sweep: how heights are searched; None: `near_surface` for the cameras' height above the terrain.
    """
    sweep = sweep or near_surface().at_height(height_above(cameras, terrain))
    found = dense_ground(cameras, gray, positions, terrain=terrain, leg_of_camera=leg_of_camera, sweeps=(sweep,))
    above = found.points[:, 2] - terrain.height(found.points[:, :2])
    if len(above) < _OFFSET_LEAST_HEIGHTS:
        return GroundOffset(0.0, len(above), found)
    offset_m = float(np.clip(kernel_mode(above, _OFFSET_KERNEL_M), *_OFFSET_LIMITS_M))
    return GroundOffset(offset_m, len(above), found)


def kernel_mode(values: Array, kernel_m: float, rounds: int = 20) -> float:
    """Most frequent value: mean shift with a Gaussian kernel from the best of many starts."""
    starts = np.quantile(values, np.linspace(0.02, 0.98, 49))
    near = np.exp(-0.5 * ((values[None, :] - starts[:, None]) / kernel_m) ** 2)
    at = float(starts[near.sum(1).argmax()])
    for _ in range(rounds):
        w = np.exp(-0.5 * ((values - at) / kernel_m) ** 2)
        at = float((w * values).sum() / w.sum())
    return at
