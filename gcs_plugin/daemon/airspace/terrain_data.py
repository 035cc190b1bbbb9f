"""Terrain data for vehicles that follow terrain themselves, from the station's height model.

ArduPilot requests missing data around its position and mission by TERRAIN_REQUEST, and stores it on its card:
blocks of 7 x 8 tiles (north, east) of 4 x 4 heights, a bit of the mask each. TERRAIN_DATA answers with a tile.
"""

import logging
import queue
import threading
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from gcs_plugin.links.mavlink import Message, dialect
from gcs_plugin.plans.plan_request import DEM_MARGIN_M
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.raster.height_model import HeightModel

if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.fleet.vehicle_state import Vehicle

_TILES_EAST: Final = 8  # of a request's mask (MAVLink TERRAIN_REQUEST)
_TILES_NORTH: Final = 7
_TILE: Final = 4  # points a side
_DEG_M: Final = 111318.84502145034  # metres a degree of latitude, as ArduPilot counts
_MOST_WAITING: Final = 100  # requests; vehicles repeat theirs
_log = logging.getLogger(__name__)


class TerrainData:
    """Answers vehicles' requests for terrain data."""

    def __init__(self, dem: Path, fleet: "Fleet") -> None:
        self._dem, self._fleet = dem, fleet
        self._wanted: queue.Queue[tuple[int, int, int, int, int] | None] = queue.Queue(_MOST_WAITING)
        self._thread = threading.Thread(target=self._run, name="terrain", daemon=True)
        fleet.subscribe(self._requested, "TERRAIN_REQUEST")

    def start(self) -> None:
        """Begin to answer."""
        self._thread.start()

    def close(self) -> None:
        """Stop."""
        if self._thread.ident is not None:
            self._wanted.put(None)
            self._thread.join()

    def _requested(self, vehicle: "Vehicle", message: Any, _: float) -> None:
        if not self._wanted.full():  # the vehicle repeats its request
            self._wanted.put((vehicle.system, message.lat, message.lon, message.grid_spacing, message.mask))

    def _run(self) -> None:
        while (wanted := self._wanted.get()) is not None:
            system, lat, lon, spacing_m, mask = wanted
            try:
                answers = terrain_answers(self._dem, lat, lon, spacing_m, mask)
                self._fleet.call(partial(self._fleet.send, system, answers))
            except OrthoSwarmError as error:
                _log.warning("no terrain data for vehicle %d: %s", system, error)


def terrain_answers(dem: Path, lat_e7: int, lon_e7: int, spacing_m: int, mask: int) -> list[Message]:
    """The TERRAIN_DATA messages for a TERRAIN_REQUEST, without tiles for which the model has no heights.

    Args:
        dem: the height model. lat_e7, lon_e7: south-west corner of the block, 1e-7 degrees.
        spacing_m: distance of the heights. mask: bit 8 n + e stands for the tile n to the north, e to the east.

    Raises:
        InputError: the model cannot be read, or has no heights there.
    """
    if not 1 <= spacing_m <= 1000:
        return []
    heights, known = _block(dem, lat_e7, lon_e7, spacing_m)
    answers = []
    for bit in range(_TILES_NORTH * _TILES_EAST):
        north, east = (_TILE * k for k in divmod(bit, _TILES_EAST))
        tile = np.s_[north : north + _TILE, east : east + _TILE]
        if mask >> bit & 1 and known[tile].all():
            data = [int(z) for z in np.clip(np.rint(heights[tile]), -32000, 32000).ravel()]
            answers.append(dialect.MAVLink_terrain_data_message(lat_e7, lon_e7, spacing_m, bit, data))
    return answers


@lru_cache(maxsize=64)
def _block(dem: Path, lat_e7: int, lon_e7: int, spacing_m: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Heights (28, 32) of a block in the model's own datum, north and east from its corner; and where it has any."""
    lat, lon = lat_e7 * 1e-7, lon_e7 * 1e-7
    north = lat + spacing_m * np.arange(_TILE * _TILES_NORTH) / _DEG_M
    east = lon + spacing_m * np.arange(_TILE * _TILES_EAST) / (_DEG_M * np.cos(np.radians(lat)))
    lats, lons = np.meshgrid(north, east, indexing="ij")
    epsg = area_epsg(lats.ravel(), lons.ravel())
    places = LocalGrid(epsg).to_grid(lats, lons)
    bounds = BoundingBox.around_points(places.reshape(-1, 2), DEM_MARGIN_M)
    model = HeightModel.open(dem, epsg, bounds, np.empty((0, 3)))
    ground = model.window(bounds)
    return ground.terrain.height(places) + model.zero_m, ground.knows(places)
