"""Ground between the tracks of one vehicle: its lift under the corners, and denser points (RECIPE.md 5b and 9)."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.refine.flight.relative_block import Flight
from orthoswarm.refine.surface.ground_offset import draw_positions, measure_ground_offset
from orthoswarm.refine.surface.terrain import TerrainFit
from orthoswarm.refine.surface.vehicle_ground import GroundModel, fit_surface
from orthoswarm.refine.surface.vertical_line_locus import LARGE, SMALL, dense_ground, spaced_cameras

Array = NDArray[np.float64]

CELL_M = 14.0
USUAL_HEIGHT_M = 150.0
HIGH_FROM_M, HIGH_SHARE = 6.0, 0.25
"""Heights over the ground, metres and a share of the flying height, between which cells without ground are searched."""
HIGH_SMALL, HIGH_LARGE = (replace(s, baselines_m=(25.0, 50.0, 75.0)) for s in (SMALL, LARGE))
"""What stands high is near the cameras: fewer pictures show it."""


def refit_ground(flight: Flight, surface: GroundModel, *, as_smooth: bool = False) -> GroundModel:
    """The ground fitted to the points now and to heights at free positions between them.

    Corners sit on raised things; small patches at free positions tell the ground itself, so that what is left over
    (the lift) is small. as_smooth: the ground stays as smooth as it is, which saves the search for its smoothness.
    """
    if surface.fit is None:
        surface = fit_surface(flight.adjustment, surface)
        if surface.fit is None:
            return surface
    cameras = flight.cameras()
    positions = draw_positions(
        cameras.position[:, :2], spread_m=100.0 * flying_height(flight, surface) / USUAL_HEIGHT_M
    )
    gray = flight.pictures.gray
    free = measure_ground_offset(cameras, gray, positions, surface.terrain(), flight.leg).points
    kappa = surface.fit.kappa if as_smooth and isinstance(surface.fit, TerrainFit) else None
    surface = replace(surface, ground_offset_m=0.0)
    return fit_surface(flight.adjustment, surface, kappa=kappa, extra=(free.points, free.sigma_z))


def dense_points(flight: Flight, surface: GroundModel) -> tuple[Array, Array, Array]:
    """Ground points (K, 3) and their sigmas, one in each cell that shows its height; points (H, 3) high above it."""
    cameras, height = flight.cameras(), flying_height(flight, surface)
    cells = cells_near(cameras.position[:, :2], dense_cell(height), sight_reach(flight))
    if not len(cells):
        return np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))
    ground, gray = surface.terrain(), flight.pictures.gray
    found = dense_ground(cameras, gray, cells, ground, flight.leg)
    high = np.zeros((0, 3))
    above = 0.5 * (HIGH_FROM_M + HIGH_SHARE * height), 0.5 * (HIGH_SHARE * height - HIGH_FROM_M)
    if above[1] > 0.0:
        left = np.delete(cells, found.cell, axis=0)
        raised = replace(ground, z=ground.z + np.float32(above[0]))
        sweeps = [replace(s.at_height(height), reach_m=above[1]) for s in (HIGH_SMALL, HIGH_LARGE)]
        high = dense_ground(cameras, gray, left, raised, flight.leg, sweeps).points
    return found.points, found.sigma_z, high


def spaced_pictures(flight: Flight, surface: GroundModel) -> NDArray[np.bool_]:
    """The pictures from which `dense_points` takes heights, bool (N,), and those between legs.

    They show all that there is to see: what needs no more than these has fewer to decode.
    """
    _, camera, _ = spaced_cameras(
        flight.cameras(), flight.leg, SMALL.at_height(flying_height(flight, surface)).spacing_m
    )
    out = np.asarray(flight.leg < 0)
    out[camera] = True
    return out


def dense_cell(height_m: float) -> float:
    """Distance of the cells at a flying height, metres."""
    return CELL_M * height_m / USUAL_HEIGHT_M


def sight_reach(flight: Flight) -> float:
    """How far from below the camera a vehicle's pictures show the ground, to their corners, metres."""
    cameras = flight.cameras()
    diagonal = float(np.hypot(*flight.pictures.size))
    return float(0.5 * diagonal / cameras.lens[0, 0] * np.median(cameras.position[:, 2]))


def cells_near(path: Array, cell_m: float, reach_m: float) -> Array:
    """Centres of the cells within reach of the path."""
    low = np.floor((path.min(0) - reach_m) / cell_m).astype(int)
    high = np.ceil((path.max(0) + reach_m) / cell_m).astype(int)
    if (high - low).prod() > 400_000:
        return np.zeros((0, 2))
    near = np.zeros(tuple(high - low), bool)
    k = int(reach_m / cell_m)
    at = np.floor(path / cell_m).astype(int) - low
    for i, j in np.unique(at, axis=0):
        near[max(0, i - k) : i + k + 1, max(0, j - k) : j + k + 1] = True
    return np.asarray((np.argwhere(near) + low + 0.5) * cell_m)


def flying_height(flight: Flight, surface: GroundModel) -> float:
    """Flying height above the ground, metres."""
    return max(1.0, float(np.median(flight.cameras().position[:, 2])) - surface.level_m)
