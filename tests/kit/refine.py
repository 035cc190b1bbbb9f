"""The default refiner for tests: a batch with the local origin that the batch would take."""

from orthoswarm.model.geo import local_origin
from orthoswarm.model.task_runner import serial
from orthoswarm.refine.strategy.swarm_refiner import Options, SwarmRefiner


def refine_all(vehicles, basemap, grid, *, options=None, run=serial, progress=None):
    """Refine vehicles (id -> frames) with the default refiner."""
    origin = local_origin(grid, (f for frames in vehicles.values() for f in frames))
    return SwarmRefiner(grid.epsg, origin, options or Options()).refine_batch(vehicles, basemap, run, progress)
