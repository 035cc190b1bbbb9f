"""Ground between the tie points of one vehicle: heights at free positions for its terrain, and a dense grid."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array, Flags
from orthoswarm.model.placement import Terrain
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.flight.relative_block import FlightBlock
from orthoswarm.refine.surface.terrain import TerrainFit
from orthoswarm.refine.surface.vehicle_ground import GroundModel, fit_surface
from orthoswarm.refine.surface.vertical_line_locus import (
    LARGE_PATCH,
    REFERENCE_HEIGHT_M,
    SMALL_PATCH,
    LocusPoints,
    ReadPicture,
    dense_ground,
    height_above,
    spaced_cameras,
)

_FREE_POSITIONS: Final = 900  # free positions where the ground is measured (0.05 s)
HIGH_FROM_M: Final = 6.0  # cells without ground are searched for what stands high from this height over it on ...
HIGH_TO_SHARE: Final = 0.25  # ... up to this share of the flying height
_FREE_SPREAD_M: Final = 100.0  # half side of the square about each camera for them at reference height
_FREE_REACH_M: Final = 3.0  # heights searched there above and below the surface
_FREE_HEIGHT_STEP_M: Final = 0.25  # distance of these heights at the reference height
_DENSE_CELL_M: Final = 14.0  # side of the cells that get one height each at the reference height
_DENSE_MOST_CELLS: Final = 400_000  # areas of more cells are left without dense points (memory)
_HIGH_BASELINES_M: Final = (30.0, 65.0)  # baselines of that search at reference height


def refit_ground(flight: FlightBlock, surface: GroundModel, *, as_smooth: bool = False) -> GroundModel:
    """Fit the ground to the present points and heights at free positions; as_smooth: with the present smoothness."""
    if surface.fit is None:
        surface = fit_surface(flight.adjustment, surface)
        if surface.fit is None:
            return surface
    cameras = flight.cameras()
    positions = draw_positions(cameras.position[:, :2], flying_height(flight, surface))
    free = free_ground(cameras, flight.pictures.gray, positions, surface.terrain(), flight.leg)
    kappa = surface.fit.kappa if as_smooth and isinstance(surface.fit, TerrainFit) else None
    return fit_surface(flight.adjustment, surface, kappa=kappa, extra=(free.points, free.sigma_z))


def draw_positions(camera_xy: Array, height_m: float) -> Array:
    """Free positions (K, 2) in a square about each camera that grows with the height, the same for the same cameras."""
    spread_m = _FREE_SPREAD_M * height_m / REFERENCE_HEIGHT_M
    at = camera_xy[np.linspace(0, len(camera_xy) - 1, _FREE_POSITIONS).round().astype(int)]
    return np.asarray(at + np.random.default_rng(0).uniform(-spread_m, spread_m, (_FREE_POSITIONS, 2)))


def free_ground(
    cameras: CameraBlock, gray: ReadPicture, positions: Array, terrain: Terrain, leg: NDArray[np.integer]
) -> LocusPoints:
    """Heights of the ground at free positions (see `draw_positions`), searched near the terrain with small patches.

    Corners lie at the edges of raised objects: a surface through them is a little above the open ground, and pictures
    rectified on it are displaced from the map by that height times the obliquity of the view. Small patches away from
    corners measure the ground itself; large ones include rubble and find half of the difference.
    """
    near = replace(SMALL_PATCH, reach_m=_FREE_REACH_M, height_step_m=_FREE_HEIGHT_STEP_M, rival_m=np.inf)
    sweep = near.at_height(height_above(cameras, terrain))
    return dense_ground(cameras, gray, positions, terrain=terrain, leg_of_camera=leg, sweeps=(sweep,))


def dense_points(flight: FlightBlock, surface: GroundModel) -> tuple[Array, Array, Array]:
    """Ground points (K, 3) and their sigmas, one per cell where a height was found; and points (H, 3) high above it."""
    cameras, height = flight.cameras(), flying_height(flight, surface)
    cells = cells_near(cameras.position[:, :2], _DENSE_CELL_M * height / REFERENCE_HEIGHT_M, sight_reach(flight))
    if not len(cells):
        return np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))
    ground, gray = surface.terrain(), flight.pictures.gray
    found = dense_ground(cameras, gray, cells, terrain=ground, leg_of_camera=flight.leg)
    high = np.zeros((0, 3))
    middle_m = 0.5 * (HIGH_FROM_M + HIGH_TO_SHARE * height)
    reach_m = 0.5 * (HIGH_TO_SHARE * height - HIGH_FROM_M)
    if reach_m > 0.0:
        left = np.delete(cells, found.cell, axis=0)
        raised = replace(ground, z=ground.z + np.float32(middle_m))
        patches = (replace(s, baselines_m=_HIGH_BASELINES_M) for s in (SMALL_PATCH, LARGE_PATCH))
        sweeps = [replace(s.at_height(height), reach_m=reach_m) for s in patches]
        high = dense_ground(cameras, gray, left, terrain=raised, leg_of_camera=flight.leg, sweeps=sweeps).points
    return found.points, found.sigma_z, high


def spaced_pictures(flight: FlightBlock, surface: GroundModel) -> Flags:
    """Pictures used by `dense_points`, which cover all visible ground, and those between legs: bool (N,)."""
    spacing_m = SMALL_PATCH.at_height(flying_height(flight, surface)).spacing_m
    camera, _ = spaced_cameras(flight.cameras(), flight.leg, spacing_m)
    out = np.asarray(flight.leg < 0)
    out[camera] = True
    return out


def sight_reach(flight: FlightBlock) -> float:
    """Distance from the nadir point to the corners of a vehicle's pictures on the ground, metres."""
    cameras = flight.cameras()
    diagonal = float(np.hypot(*flight.pictures.size))
    return float(0.5 * diagonal / cameras.lens[0, 0] * np.median(cameras.position[:, 2]))


def cells_near(path: Array, cell_m: float, reach_m: float) -> Array:
    """Centres of the cells within reach of the path."""
    low = np.floor((path.min(0) - reach_m) / cell_m).astype(int)
    high = np.ceil((path.max(0) + reach_m) / cell_m).astype(int)
    if (high - low).prod() > _DENSE_MOST_CELLS:
        return np.zeros((0, 2))
    near = np.zeros(tuple(high - low), bool)
    k = int(reach_m / cell_m)
    at = np.floor(path / cell_m).astype(int) - low
    for i, j in np.unique(at, axis=0):
        near[max(0, i - k) : i + k + 1, max(0, j - k) : j + k + 1] = True
    return np.asarray((np.argwhere(near) + low + 0.5) * cell_m)


def flying_height(flight: FlightBlock, surface: GroundModel) -> float:
    """Flying height above the ground, metres."""
    return max(1.0, float(np.median(flight.cameras().position[:, 2])) - surface.level_m)
