"""Geofences: read from vehicles of both dialects, shown as zones, and never in the way of what an operator asks for."""

import math
import threading
from dataclasses import replace

import pytest

from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.geofence import zones_of
from gcs_plugin.mission.items import FRAME_GLOBAL, MissionItem
from gcs_plugin.sim.simulated_swarm import make_swarm
from tests.vehicles.test_fleet_cli import HOME, folder  # noqa: F401
from tests.vehicles.test_vehicle_links import AP, PX4, open_links, ready, upload_all, wait  # noqa: F401

INSIDE = int(dialect.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION)
OUTSIDE = int(dialect.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION)
CIRCLE = int(dialect.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION)
RETURN = int(dialect.MAV_CMD_NAV_FENCE_RETURN_POINT)


def polygon(command: int, corners: list[tuple[float, float]]) -> list[MissionItem]:
    """Vertices (latitude, longitude) as they travel."""
    count = (float(len(corners)), 0.0, 0.0, 0.0)
    return [MissionItem.at(command, lat, lon, 0.0, params=count, frame=FRAME_GLOBAL) for lat, lon in corners]


def circle(lat: float, lon: float, radius_m: float) -> MissionItem:
    return MissionItem.at(CIRCLE, lat, lon, 0.0, params=(radius_m, 0.0, 0.0, 0.0), frame=FRAME_GLOBAL)


SQUARE = [(47.0, 8.0), (47.0, 8.01), (47.01, 8.01), (47.01, 8.0)]
TRIANGLE = [(47.002, 8.002), (47.002, 8.004), (47.004, 8.004)]
FENCE = [*polygon(INSIDE, SQUARE), *polygon(OUTSIDE, TRIANGLE), circle(47.008, 8.008, 30.0)]
ZONES = [
    {"kind": "inclusion", "ring": [[lon, lat] for lat, lon in SQUARE]},
    {"kind": "exclusion", "ring": [[lon, lat] for lat, lon in TRIANGLE]},
    {"kind": "exclusion", "center": [8.008, 47.008], "radius_m": 30.0},
]


def test_zones_of_a_fence_list() -> None:
    assert [zone.document() for zone in zones_of(FENCE)] == ZONES
    home = MissionItem.at(RETURN, 47.0, 8.0, 0.0, frame=FRAME_GLOBAL)
    assert [zone.document() for zone in zones_of([home, *FENCE])] == ZONES
    twice = zones_of([*polygon(OUTSIDE, TRIANGLE), *polygon(OUTSIDE, TRIANGLE)])  # neighbours of one kind
    assert len(twice) == 2


@pytest.mark.parametrize("count", [math.nan, math.inf, -3.0])
def test_a_fence_with_values_that_are_no_numbers_has_no_such_zone(count: float) -> None:
    broken = [replace(item, params=(count, 0.0, 0.0, 0.0)) for item in polygon(INSIDE, SQUARE)]
    assert zones_of([*broken, circle(47.0, 8.0, math.nan), *FENCE[-1:]]) == zones_of(FENCE[-1:])


@pytest.mark.parametrize("items", [[], FENCE[:3], [*FENCE[:2], FENCE[4]], polygon(INSIDE, SQUARE[:2])])
def test_what_is_not_whole_is_no_zone(items: list[MissionItem]) -> None:
    assert zones_of(items) == []


def test_fences_are_read_from_both_dialects_and_the_missions_stay_as_they_are(open_links, folder) -> None:  # noqa: F811
    vehicles = make_swarm(3, autopilots=(AP, PX4), home=HOME)
    for vehicle in vehicles[:2]:
        vehicle.store.fence = list(FENCE)
    links = open_links(vehicles)
    ready(links, 3)
    upload_all(links, folder)
    wait(lambda: all(row["fence"] is not None for row in links.rows()))
    by_id = {row["id"]: row["fence"]["zones"] for row in links.rows()}
    assert by_id == {"v1": ZONES, "v2": ZONES, "v3": []}
    for number, vehicle in links.fleet.vehicles.items():
        assert vehicle.mission is not None and len(vehicle.mission.items) > len(FENCE), number


def test_an_upload_does_not_wait_for_a_fence_that_is_being_read(open_links, folder) -> None:  # noqa: F811
    (vehicle,) = vehicles = make_swarm(1, autopilots=(Autopilot.PX4,), home=HOME)
    vehicle.store.fence = list(FENCE)
    links = open_links(vehicles)
    ready(links, 1)
    begun = threading.Event()

    def begin() -> None:
        links.fleet.read_fence(1)
        assert not links.fleet.busy(1)
        begun.set()

    links.fleet.call(begin).result(60.0)
    assert begun.is_set()
    upload_all(links, folder)  # raises if the vehicle is busy
    assert links.fleet.vehicles[1].mission is not None
