"""The default refiner for tests: a batch with the local origin that the batch would take."""

import pickle

from orthoswarm.model.geo import local_origin
from orthoswarm.model.task_runner import Continued, serial
from orthoswarm.refine.strategy.swarm_refiner import RefinerOptions, SwarmRefiner


def refine_all(vehicles, basemap, grid, *, options=None, run=serial, progress=None):
    """Refine vehicles (id -> frames) with the default refiner."""
    origin = local_origin(grid, (f for frames in vehicles.values() for f in frames))
    return SwarmRefiner(grid.epsg, origin, options or RefinerOptions()).refine_batch(vehicles, basemap, run, progress)


def through_pickle(function, items):
    """Run tasks as processes would: what goes there, what goes on elsewhere and what comes back is pickled."""
    for item in items:
        task = Continued(function, item)
        while isinstance(task, Continued):
            half = pickle.loads(pickle.dumps(task))
            task = pickle.loads(pickle.dumps(half.function(half.item)))
        yield task
