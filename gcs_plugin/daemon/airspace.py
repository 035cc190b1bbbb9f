"""What bounds the flight: other aircraft, the vehicles' geofences, and the terrain that they follow."""

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gcs_plugin.daemon.stoppable_thread import Background
from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Message, dialect
from gcs_plugin.mission.download import MissionDownload
from gcs_plugin.mission.geofence import FenceZone, zones_of
from gcs_plugin.plans.plan_request import DEM_MARGIN_M
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.raster.height_model import HeightModel

_AT_ONCE: Final = 4  # fences that are read at a time, so that links stay free
_AGAIN_S: Final = 60.0
_FAILED_S: Final = 15.0


@dataclass(slots=True)
class _Fence:
    """What is known of a vehicle's fence.

    Attributes:
        read: under way. due: when to read (again), monotonic. document: for the vehicle's row.
        zones: the same; both None until it was read.
    """

    due: float
    read: MissionDownload | None = None
    document: dict[str, Any] | None = None
    zones: tuple[FenceZone, ...] | None = None


class Fences:
    """Reads geofences, a few vehicles at once; whatever an operator asks for comes first and breaks the reading off."""

    def __init__(self, fleet: Fleet, clock: Callable[[], float] = time.monotonic) -> None:
        self._fleet, self._clock = fleet, clock
        self._fences: dict[int, _Fence] = {}

    def look(self) -> None:
        """Take what has been read and begin what is due; in the fleet's thread."""
        now = self._clock()
        for fence in self._fences.values():
            if fence.read is None or fence.read.outcome is None:
                continue
            if fence.read.items is not None:
                fence.zones = tuple(zones_of(fence.read.items))
                zones = [zone.document() for zone in fence.zones]
                if fence.document is None or fence.document["zones"] != zones:
                    fence.document = {"zones": zones, "read_s": round(time.time(), 1)}
            fence.due = now + (_AGAIN_S if fence.read.outcome.ok else _FAILED_S)
            fence.read = None
        under_way = sum(fence.read is not None for fence in self._fences.values())
        for system, vehicle in self._fleet.vehicles.items():
            fence = self._fences.setdefault(system, _Fence(now))
            known_in_air = vehicle.armed and fence.document is not None
            if under_way < _AT_ONCE and fence.read is None and now >= fence.due and not known_in_air:
                with contextlib.suppress(OrthoSwarmError):  # lost, or busy with something else
                    fence.read = self._fleet.read_fence(system)
                    under_way += 1

    def read_again(self, system: int) -> None:
        """Read a vehicle's geofence at the next look: it was changed."""
        self._fences[system].due = self._clock()

    def zones(self) -> dict[int, tuple[FenceZone, ...]]:
        """The zones of each vehicle whose fence has been read, by system id; from any thread."""
        return {s: fence.zones for s, fence in list(self._fences.items()) if fence.zones is not None}

    def of(self, system: int) -> dict[str, Any] | None:
        """A vehicle's geofence: `zones`, and `read_s`, when they were first read (epoch seconds); None before that."""
        fence = self._fences.get(system)
        return None if fence is None else fence.document


FORGET_S: Final = 30.0
"""An aircraft that nobody heard for so long is dropped; receivers repeat each second what they hear."""
_COORDINATES: Final = int(dialect.ADSB_FLAGS_VALID_COORDS)
_ALTITUDE: Final = int(dialect.ADSB_FLAGS_VALID_ALTITUDE)
_HEADING: Final = int(dialect.ADSB_FLAGS_VALID_HEADING)
_VELOCITY: Final = int(dialect.ADSB_FLAGS_VALID_VELOCITY)
_CALLSIGN: Final = int(dialect.ADSB_FLAGS_VALID_CALLSIGN)
_DEGE7: Final = 1e-7


class Traffic:
    """The recently received aircraft, each once, from any vehicle; any thread; `clock`: monotonic seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._heard: dict[int, tuple[float, dict[str, Any]]] = {}
        self._published: list[dict[str, Any]] = []

    def heard(self, _vehicle: Any, message: Any, _utc: float) -> None:
        """Process an ADSB_VEHICLE; one without a valid position is ignored."""
        lat, lon = message.lat * _DEGE7, message.lon * _DEGE7
        if not message.flags & _COORDINATES or abs(lat) > 90.0 or abs(lon) > 180.0:
            return
        number = int(message.ICAO_address)
        name = str(message.callsign).strip("\x00 ") if message.flags & _CALLSIGN else ""
        row = {
            "id": f"{number:06x}",
            "name": "".join(letter for letter in name if letter.isascii() and letter.isprintable()),
            "lat_deg": round(lat, 7),
            "lon_deg": round(lon, 7),
            "alt_m": round(message.altitude / 1e3, 1) if message.flags & _ALTITUDE else None,
            "heading_deg": message.heading / 100.0 if message.flags & _HEADING else None,
            "speed_m_s": message.hor_velocity / 100.0 if message.flags & _VELOCITY else None,
        }
        with self._lock:
            self._heard[number] = self._clock() - float(message.tslc), row

    def rows(self) -> list[dict[str, Any]]:
        """A row per aircraft; unknown values are None.

        Keys: `id` (ICAO address), `name` (callsign), `lat_deg`, `lon_deg`, `alt_m` (above sea level or standard
        pressure, as it sends), `heading_deg`, `speed_m_s`.
        """
        with self._lock:
            end = self._clock() - FORGET_S
            self._heard = {number: heard for number, heard in self._heard.items() if heard[0] > end}
            return [row for _, row in self._heard.values()]

    def changed(self) -> bool:
        """Whether the rows differ from those at the last call."""
        rows = self.rows()
        changed, self._published = rows != self._published, rows
        return changed


_TILES_EAST: Final = 8  # of a request's mask (MAVLink TERRAIN_REQUEST)
_TILES_NORTH: Final = 7
_TILE: Final = 4  # points a side
_DEG_M: Final = 111318.84502145034  # metres a degree of latitude, as ArduPilot counts
_MOST_WAITING: Final = 100  # requests; vehicles repeat theirs
_log = logging.getLogger(__name__)


class TerrainData(Background):
    """Answers vehicles' requests for terrain data."""

    def __init__(self, dem: Path, fleet: Fleet) -> None:
        super().__init__("terrain", join_s=None)
        self._dem, self._fleet = dem, fleet
        self._wanted: queue.Queue[tuple[int, int, int, int, int] | None] = queue.Queue(_MOST_WAITING)
        fleet.subscribe(self._requested, "TERRAIN_REQUEST")

    def close(self) -> None:
        """Stop."""
        if self._thread.ident is not None:
            self._wanted.put(None)
        super().close()

    def _requested(self, vehicle: Vehicle, message: Any, _: float) -> None:
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
