"""Geofences: read from vehicles of both dialects, shown as zones, and never in the way of what an operator asks for."""

import math
import threading
from dataclasses import replace
from functools import partial

import pytest

from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.geofence import FenceZone, zones_of
from gcs_plugin.mission.items import FRAME_GLOBAL, WAYPOINT, MissionItem
from gcs_plugin.sim.simulated_swarm import make_swarm
from orthoswarm.model.errors import OrthoSwarmError
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


def test_zones_to_stay_out_of_are_put_into_vehicles_and_those_to_stay_in_stay(open_links, folder) -> None:  # noqa: F811
    vehicles = make_swarm(2, autopilots=(AP, PX4), home=HOME)
    for vehicle in vehicles:
        vehicle.store.fence = list(FENCE)
    links = open_links(vehicles)
    ready(links, 2)
    upload_all(links, folder)
    missions = [len(vehicle.store.items) for vehicle in vehicles]
    wait(lambda: all(row["fence"] is not None for row in links.rows()))
    other = FenceZone("exclusion", ((8.02, 47.02), (8.03, 47.02), (8.03, 47.03)))
    round_ = FenceZone("exclusion", ((8.05, 47.05),), 40.0)
    for system in (1, 2):
        assert f"vehicle {system} holds the geofence: 8 items, read back" in links.upload_fence(system, [other, round_])
    wanted = [ZONES[0], other.document(), round_.document()]
    wait(lambda: all(row["fence"]["zones"] == wanted for row in links.rows()))
    for vehicle in vehicles:
        assert [zone.document() for zone in zones_of(vehicle.store.fence)] == wanted
    assert [len(vehicle.store.items) for vehicle in vehicles] == missions
    assert "holds the geofence: 4 items" in links.upload_fence(1, [])  # none to stay out of


def test_a_geofence_is_not_changed_in_the_air_nor_before_it_was_read(open_links) -> None:  # noqa: F811
    vehicles = make_swarm(1, autopilots=(AP,), home=HOME)
    links = open_links(vehicles)
    ready(links, 1)
    links._fences._fences.clear()
    with pytest.raises(OrthoSwarmError, match="has not been read yet"):
        links.upload_fence(1, [])
    wait(lambda: links.rows()[0]["fence"] is not None)
    vehicle = links.fleet.vehicles[1]
    vehicle.armed, vehicle.landed = True, "in air"
    with pytest.raises(OrthoSwarmError, match="changed on the ground only"):
        links.fleet.upload_fence(1, [])


def test_the_routes_are_what_the_vehicles_hold(open_links, folder) -> None:  # noqa: F811
    vehicles = make_swarm(2, autopilots=(AP, PX4), home=HOME)
    links = open_links(vehicles)
    ready(links, 2)
    assert links.routes() == [] and [row["route"] for row in links.rows()] == [0, 0]
    upload_all(links, folder)
    numbers = [row["route"] for row in links.rows()]
    assert [(row["vehicle"], row["route"]) for row in links.routes()] == [("v1", numbers[0]), ("v2", numbers[1])]
    for system, row in enumerate(links.routes(), start=1):
        items = links.fleet.vehicles[system].mission.items
        flown = [(k, items[k].lon_deg, items[k].lat_deg) for k in range(len(items)) if items[k].command == WAYPOINT]
        assert [point for point in row["points"] if point in flown][-1] == flown[-1]
        assert row["points"][-1][0] == len(items) - 1  # the way home, by the last item
        assert row["points"][-1][1:] == pytest.approx(row["points"][0][1:], abs=1e-4)
    held = [vehicle.mission for vehicle in links.fleet.vehicles.values()]
    for system in (1, 2):  # what is left to PX4 is not a number, which equals nothing
        links.finish(links.fleet.call(partial(links.fleet.download, system)))
    assert [row["route"] for row in links.rows()] == numbers
    assert all(v.mission is mission for v, mission in zip(links.fleet.vehicles.values(), held, strict=True))
    upload_all(links, folder)  # the same again
    assert all(row["route"] > number for row, number in zip(links.rows(), numbers, strict=True))
