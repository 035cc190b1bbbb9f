"""The refiners by name. Only the requested one is imported, as the other's imports would cost memory."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal

from orthoswarm.model.arrays import Array
from orthoswarm.model.placement import Refiner
from orthoswarm.raster.grey_pictures import GreyPictures
from orthoswarm.raster.height_model import HeightModel

RefinerName = Literal["swarm", "paper"]
Factory = Callable[[int, Array, HeightModel | None, GreyPictures | None, str], Refiner]
"""Makes a refiner of the area's grid (EPSG code), the origin (2,) of its local frame, a height model or None, the
pictures that are decoded already, or None, and where networks run."""


def _swarm(epsg: int, origin: Array, dem: HeightModel | None, pictures: GreyPictures | None, device: str) -> Refiner:
    from orthoswarm.refine.strategy.swarm_refiner import RefinerOptions, SwarmRefiner

    options = RefinerOptions(dem=dem, device=device)
    return SwarmRefiner(epsg, origin, options if pictures is None else replace(options, read=pictures.gray))


def _paper(epsg: int, origin: Array, dem: HeightModel | None, pictures: GreyPictures | None, device: str) -> Refiner:
    """The paper's refiner; its ground is flat, so it does not use a height model. It reads the pictures by itself."""
    from orthoswarm.paper import PaperOptions, PaperRefiner

    return PaperRefiner(epsg, origin, PaperOptions(device))


REFINERS: Mapping[RefinerName, Factory] = {"swarm": _swarm, "paper": _paper}


def make_refiner(
    name: RefinerName,
    epsg: int,
    origin: Array,
    dem: HeightModel | None = None,
    pictures: GreyPictures | None = None,
    *,
    device: str = "auto",
) -> Refiner:
    """The refiner of a name for an area.

    Args:
        name: which one. epsg: the area's grid. origin: float64 (2,) of the local frame, see `geo.local_origin`.
        dem: the user's height model, for a refiner that uses it.
        pictures: where the pictures are decoded already, for a refiner that reads them there.
        device: where networks run, see `network_device`.
    """
    return REFINERS[name](epsg, origin, dem, pictures, device)
