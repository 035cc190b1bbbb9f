"""The refiners by name. Only the requested one is imported, as the other's imports would cost memory."""

from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.placement import Refiner
from orthoswarm.raster.height_model import HeightModel

Array = NDArray[np.float64]
RefinerName = Literal["swarm", "paper"]
Factory = Callable[[int, Array, HeightModel | None], Refiner]
"""Makes a refiner of the area's grid (EPSG code), the origin (2,) of its local frame, and a height model or None."""


def _swarm(epsg: int, origin: Array, dem: HeightModel | None) -> Refiner:
    from orthoswarm.refine.strategy.swarm_refiner import Options, SwarmRefiner

    return SwarmRefiner(epsg, origin, Options(dem=dem))


def _paper(epsg: int, origin: Array, dem: HeightModel | None) -> Refiner:
    """The paper's refiner; its ground is flat, so it does not use a height model."""
    from orthoswarm.paper import PaperRefiner

    return PaperRefiner(epsg, origin)


REFINERS: Mapping[RefinerName, Factory] = {"swarm": _swarm, "paper": _paper}


def make_refiner(name: RefinerName, epsg: int, origin: Array, dem: HeightModel | None = None) -> Refiner:
    """The refiner of a name for an area.

    Args:
        name: which one. epsg: the area's grid. origin: float64 (2,) of the local frame, see `geo.local_origin`.
        dem: the user's height model, for a refiner that uses it.
    """
    return REFINERS[name](epsg, origin, dem)
