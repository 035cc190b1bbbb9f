"""Ground between the tracks of one vehicle: its lift under the corners, and denser points (RECIPE.md 5b and 9)."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.swarm.flight import Flight
from orthoswarm.swarm.ground import GroundModel, ground_points
from orthoswarm.swarm.lift import draw_positions, ground_lift
from orthoswarm.swarm.locus import LARGE, SMALL, dense_ground

Array = NDArray[np.float64]

CELL_M = 14.0
USUAL_HEIGHT_M = 150.0


def with_lift(flight: Flight, surface: GroundModel) -> GroundModel:
    """The surface with the level of the ground between its points."""
    if surface.fit is None:
        return surface
    rig = flight.rig()
    height = float(np.median(rig.position[:, 2]))
    positions = draw_positions(rig.position[:, :2], spread_m=45.0 * height / USUAL_HEIGHT_M)
    bare = replace(surface, lift_m=0.0)
    lift = ground_lift(rig, flight.pictures.gray, positions, bare.terrain(), flight.leg)
    return replace(surface, lift_m=lift.lift_m)


def dense_points(flight: Flight, surface: GroundModel) -> tuple[Array, Array]:
    """Ground points (K, 3) and their sigmas in the cells that no track holds."""
    rig = flight.rig()
    height = float(np.median(rig.position[:, 2] - surface.level_m))
    cell = CELL_M * height / USUAL_HEIGHT_M
    known, _ = ground_points(flight.adjustment)
    cells = _empty_cells(rig.position[:, :2], known[:, :2], cell, _half_width(flight))
    if not len(cells):
        return np.zeros((0, 3)), np.zeros(0)
    sweeps = (SMALL.at_height(height), LARGE.at_height(height))
    found = dense_ground(rig, flight.pictures.gray, cells, surface.terrain(), flight.leg, sweeps)
    return found.points, found.sigma_z


def _half_width(flight: Flight) -> float:
    """How far to the side of its path a vehicle's pictures reach on the ground, metres."""
    rig = flight.rig()
    return float(0.5 * flight.pictures.size[0] / rig.lens[0, 0] * np.median(rig.position[:, 2]))


def _empty_cells(path: Array, known: Array, cell_m: float, reach_m: float) -> Array:
    """Centres of the cells within reach of the path that hold no point."""
    low = np.floor((path.min(0) - reach_m) / cell_m).astype(int)
    high = np.ceil((path.max(0) + reach_m) / cell_m).astype(int)
    if (high - low).prod() > 400_000:
        return np.zeros((0, 2))
    near = np.zeros(tuple(high - low), bool)
    k = int(reach_m / cell_m)
    at = np.floor(path / cell_m).astype(int) - low
    for i, j in np.unique(at, axis=0):
        near[max(0, i - k) : i + k + 1, max(0, j - k) : j + k + 1] = True
    own = np.floor(known / cell_m).astype(int) - low
    inside = ((own >= 0) & (own < near.shape)).all(1)
    near[own[inside, 0], own[inside, 1]] = False
    return np.asarray((np.argwhere(near) + low + 0.5) * cell_m)
