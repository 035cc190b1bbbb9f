"""Terrain data for vehicles: a request for blocks of heights is answered from the station's height model."""

import time
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from gcs_plugin.daemon.airspace import TerrainData, terrain_answers
from gcs_plugin.links.mavlink import Autopilot, Message, dialect
from gcs_plugin.mission.exchange import Address
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.model.geo import LocalGrid
from tests.kit.vehicles.memory_link import World

EPSG = 32632
TILES: set[int] = set()
CORNER = np.array([500_000.0, 5_200_000.0])


@pytest.fixture
def dem(tmp_path: Path) -> Path:
    """A plane over 4 km, 400 m in its corner, rising 5 m a hundred metres east and 2 m a hundred metres north."""
    at = np.arange(0.0, 4000.0, 20.0) + 10.0
    z = 400.0 + 0.05 * at[None, :] + 0.02 * at[::-1, None]
    path = tmp_path / "dem.tif"
    size = {"width": len(at), "height": len(at), "count": 1, "dtype": "float32"}
    transform = from_origin(CORNER[0], CORNER[1] + 4000.0, 20.0, 20.0)
    with rasterio.open(path, "w", driver="GTiff", crs=f"EPSG:{EPSG}", transform=transform, **size) as file:
        file.write(z.astype(np.float32), 1)
    return path


def _corner(east: float, north: float) -> tuple[int, int]:
    lat, lon = LocalGrid(EPSG).to_geographic(CORNER + np.array([east, north]))
    return round(float(lat) * 1e7), round(float(lon) * 1e7)


def test_heights_lie_where_the_vehicle_expects_them(dem: Path) -> None:
    lat, lon = _corner(100.0, 200.0)
    mask = 1 << 0 | 1 << 10  # the corner, and the tile one to the north and two to the east
    first, other = terrain_answers(dem, lat, lon, 30, mask)
    assert (first.lat, first.lon, first.grid_spacing, first.gridbit, other.gridbit) == (lat, lon, 30, 0, 10)
    base = 400.0 + 0.05 * 100.0 + 0.02 * 200.0
    grid = base + 0.05 * 30.0 * np.arange(4)[None, :] + 0.02 * 30.0 * np.arange(4)[:, None]
    assert np.array(first.data).reshape(4, 4) == pytest.approx(grid, abs=0.8)
    assert other.data[0] == pytest.approx(base + 0.05 * 240.0 + 0.02 * 120.0, abs=0.8)


def test_what_the_model_does_not_hold_is_not_answered(dem: Path) -> None:
    lat, lon = _corner(3500.0, 3500.0)
    answered = {m.gridbit for m in terrain_answers(dem, lat, lon, 30, (1 << 56) - 1)}
    assert 0 in answered and 55 not in answered


class _Asking(SimVehicle):
    """A vehicle that asks for two tiles once."""

    wanted: tuple[int, int] | None = None

    def advance(self, now: float) -> list[Message]:
        said = super().advance(now)
        if self.wanted is not None:
            said.append(dialect.MAVLink_terrain_request_message(*self.wanted, 30, 0b11))
            self.wanted = None
        return said

    def handle(self, message: Message, sender: Address, now: float) -> list[Message]:
        if message.get_type() == "TERRAIN_DATA":
            TILES.add(int(message.gridbit))
        return super().handle(message, sender, now)


def test_a_vehicle_that_asks_gets_its_tiles(dem: Path) -> None:
    TILES.clear()
    vehicle = _Asking(system=1, autopilot=Autopilot.ARDUPILOT)
    world = World([vehicle])
    data = TerrainData(dem, world.fleet)
    data.start()
    try:
        world.meet()
        vehicle.wanted = _corner(100.0, 200.0)
        end = time.monotonic() + 240.0
        while {0, 1} != TILES and time.monotonic() < end:
            world.wait(0.2)
            time.sleep(0.02)
    finally:
        data.close()
        world.fleet.close()
    assert {0, 1} == TILES
