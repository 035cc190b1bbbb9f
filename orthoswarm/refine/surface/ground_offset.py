"""The ground under the corners: how far a surface through corner points lies above the ground around them.

Corners sit at the edges of raised things, and a surface through them is a little too high, although every point
lies on it: the height on which pictures are rectified and compared with the map is then wrong everywhere by the same
amount. Small patches at free positions, not at corners, tell the level of the ground itself.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.placement import Terrain
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.surface.vertical_line_locus import SMALL, Gray, LocusPoints, Sweep, dense_ground, height_above

Array = NDArray[np.float64]

NEAR = replace(SMALL, reach_m=3.0, height_step_m=0.25, rival_m=np.inf)
"""Small patches (a large one straddles rubble and finds only half of the lift), searched near the surface."""


@dataclass(frozen=True, slots=True)
class GroundOffset:
    """Level of the ground against a surface.

    Attributes:
        ground_offset_m: to be added to the surface wherever height above ground matters (usually negative).
        count: heights found; 0 lift below the minimum.
        points: what the level was taken from. They are good ground points by themselves: a surface fitted to them
            and the tracks together follows the ground where the lift differs from place to place (rubble here,
            streets there), and then the lift that is left is a few centimetres.
    """

    ground_offset_m: float
    count: int
    points: LocusPoints


def draw_positions(camera_xy: Array, *, count: int = 900, spread_m: float = 100.0, seed: int = 0) -> Array:
    """Free positions, float64 (count, 2): around pictures' positions (N, 2) evenly in a square of +-spread_m.

    Drawn once and kept, so that the lift changes with the surface and not with the draw. The default spread, for
    150 m above ground, reaches to the border of what the outer pictures see.
    """
    rng = np.random.default_rng(seed)
    at = np.asarray(camera_xy, float)[np.linspace(0, len(camera_xy) - 1, count).round().astype(int)]
    return np.asarray(at[:, :2] + rng.uniform(-spread_m, spread_m, (count, 2)))


def measure_ground_offset(
    cameras: CameraBlock,
    gray: Gray,
    positions: Array,
    terrain: Terrain,
    leg_of_camera: NDArray[np.integer],
    sweep: Sweep | None = None,
    *,
    least: int = 60,
    kernel_m: float = 0.2,
    limits_m: tuple[float, float] = (-1.5, 0.5),
) -> GroundOffset:
    """Level of the ground over the terrain at free positions (see `draw_positions`), with small patches.

    Args:
        cameras: cameras.
        gray: picture of a camera by index, uint8.
        positions: float64 (C, 2).
        terrain: the surface, within sweep.reach_m of the ground.
        leg_of_camera: int (N,), -1 for cameras that must not be used.
        sweep: how heights are searched; None: NEAR, for the cameras' height above the terrain.
        least: with fewer heights than this the lift is 0.
        kernel_m: width of the kernel whose mode is taken.
        limits_m: the lift is clipped to this range.
    """
    found = dense_ground(
        cameras, gray, positions, terrain, leg_of_camera, (sweep or NEAR.at_height(height_above(cameras, terrain)),)
    )
    above = found.points[:, 2] - terrain.height(found.points[:, :2])
    if len(above) < least:
        return GroundOffset(0.0, len(above), found)
    return GroundOffset(float(np.clip(kernel_mode(above, kernel_m), *limits_m)), len(above), found)


def kernel_mode(values: Array, kernel_m: float, rounds: int = 20) -> float:
    """Most frequent value: mean shift with a Gaussian kernel from the best of many starts."""
    starts = np.quantile(values, np.linspace(0.02, 0.98, 49))
    near = np.exp(-0.5 * ((values[None, :] - starts[:, None]) / kernel_m) ** 2)
    at = float(starts[near.sum(1).argmax()])
    for _ in range(rounds):
        w = np.exp(-0.5 * ((values - at) / kernel_m) ** 2)
        at = float((w * values).sum() / w.sum())
    return at
