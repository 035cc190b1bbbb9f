"""The refiners by name. Only the requested one is imported, as the other's imports would cost memory."""

from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.placement import Refiner
from orthoswarm.raster.grey_pictures import GreyPictures
from orthoswarm.raster.height_model import HeightModel

Array = NDArray[np.float64]
RefinerName = Literal["swarm", "paper"]
Factory = Callable[[int, Array, HeightModel | None, GreyPictures | None], Refiner]
"""Makes a refiner of the area's grid (EPSG code), the origin (2,) of its local frame, a height model or None, and the
pictures that are decoded already, or None."""


def _swarm(epsg: int, origin: Array, dem: HeightModel | None, pictures: GreyPictures | None) -> Refiner:
    from orthoswarm.refine.strategy.swarm_refiner import RefinerOptions, SwarmRefiner

    options = RefinerOptions(dem=dem) if pictures is None else RefinerOptions(dem=dem, read=pictures.gray)
    return SwarmRefiner(epsg, origin, options)


def _paper(epsg: int, origin: Array, dem: HeightModel | None, pictures: GreyPictures | None) -> Refiner:
    """The paper's refiner; its ground is flat, so it does not use a height model. It reads the pictures by itself."""
    from orthoswarm.paper import PaperRefiner

    return PaperRefiner(epsg, origin)


REFINERS: Mapping[RefinerName, Factory] = {"swarm": _swarm, "paper": _paper}


def make_refiner(
    name: RefinerName,
    epsg: int,
    origin: Array,
    dem: HeightModel | None = None,
    pictures: GreyPictures | None = None,
) -> Refiner:
    """The refiner of a name for an area.

    Args:
        name: which one. epsg: the area's grid. origin: float64 (2,) of the local frame, see `geo.local_origin`.
        dem: the user's height model, for a refiner that uses it.
        pictures: where the pictures are decoded already, for a refiner that reads them there.
    """
    return REFINERS[name](epsg, origin, dem, pictures)
