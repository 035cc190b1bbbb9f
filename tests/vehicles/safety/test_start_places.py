"""The check before a start: where vehicles stand, what else flies there, how long they can, and their fences."""

import json
from dataclasses import replace

import pytest

from gcs_plugin.daemon.takeoffs import Takeoffs
from gcs_plugin.fleet.autopilot_settings import Setting, SetTo
from gcs_plugin.fleet.preflight import Level, Wanted, preflight, preflight_all
from gcs_plugin.fleet.separation.separation_check import flights_of, others_of, separation_of
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.geofence import FenceZone
from gcs_plugin.mission.items import FRAME_GLOBAL
from gcs_plugin.mission.plan_folder import PlanNeeds
from gcs_plugin.sim.simulated_swarm import make_swarm
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.model.plan import Apart
from tests.vehicles.test_fleet_cli import HOME as FOLDER_HOME
from tests.vehicles.test_fleet_cli import folder  # noqa: F401
from tests.vehicles.test_preflight import CHART, line
from tests.vehicles.test_vehicle_links import PlanFolder, open_links, ready, upload_all  # noqa: F401

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])


def standing(make_world, autopilot, loaded, north=0.0):
    """A vehicle that stands so far from the origin and holds a mission."""
    world = make_world(SimVehicle(system=1, autopilot=autopilot, home=(*CHART.to_degrees(north, 0.0), 488.0)))
    world.wait(8.0)
    assert world.finish(world.fleet.upload(1, loaded))[0].ok
    world.finish(world.fleet.download(1))  # asks for its settings, too
    assert world.until(lambda: world.fleet.vehicles[1].ready_to_check, 30.0)
    return world


def item(world, name, wanted=Wanted()):  # noqa: B008
    check = preflight(world.fleet.vehicles[1], wanted, world.clock.now)
    return next(item for item in check.items if item.name == name)


@BOTH
@pytest.mark.parametrize(("north", "level"), [(0.0, Level.OK), (10.0, Level.OK), (40.0, Level.RED)])
def test_a_vehicle_that_stands_elsewhere_than_its_mission_takes_off_is_red(make_world, autopilot, north, level):
    loaded = line(autopilot, 10, 80)
    world = standing(make_world, autopilot, loaded, north)
    for wanted in (Wanted(), Wanted(mission=loaded)):
        found = item(world, "home", wanted)
        assert found.level is level, found
    assert level is Level.OK or "it stands 40 m from where its mission takes off" in found.reason


def test_a_vehicle_that_stands_higher_than_its_mission_says_is_red(make_world):
    loaded = line(AP, 10, 80)
    world = standing(make_world, AP, loaded)
    for altitude, level in ((480.0, Level.OK), (430.0, Level.RED)):
        planned = replace(loaded, items=(replace(loaded.items[0], z=altitude, frame=FRAME_GLOBAL), *loaded.items[1:]))
        found = item(world, "home", Wanted(mission=planned))
        assert found.level is level, found
    assert "58 m above where its mission takes off" in found.reason


# -- separation ---------------------------------------------------------------------------------------------------


def two(make_world, *, above_m=0.0, heights=(30.0, 30.0)):
    """Two vehicles that hold missions over one line; the second one stands 80 m east and `above_m` higher."""
    homes = [(*CHART.to_degrees(0.0, east), 488.0 + up) for east, up in ((0.0, 0.0), (80.0, above_m))]
    world = make_world(*(SimVehicle(system=s, home=home) for s, home in zip((1, 2), homes, strict=True)))
    world.wait(8.0)
    loaded = {s: line(AP, 40, 80, home_east=80.0 * (s - 1), north=40.0, height=heights[s - 1]) for s in (1, 2)}
    assert all(o.ok for o in world.finish(*(world.fleet.upload(s, m) for s, m in loaded.items())))
    return world, loaded


def kept_apart(world, planned, starts=None):
    checks = preflight_all(dict(world.fleet.vehicles), planned, {}, starts or {}, world.clock.now)
    return [item.level for check in checks for item in check.items if item.name == "separation"]


def test_a_plans_missions_are_examined_too(make_world):
    world, loaded = two(make_world)
    assert kept_apart(world, loaded) == [Level.RED] * 2
    assert kept_apart(world, loaded, {2: 120.0}) == [Level.OK] * 2


def test_the_levels_of_the_homes_count(make_world):
    world, loaded = two(make_world, above_m=20.0, heights=(50.0, 30.0))
    assert kept_apart(world, loaded) == [Level.RED] * 2
    world, loaded = two(make_world, above_m=20.0)
    assert kept_apart(world, loaded) == [Level.OK] * 2


def test_a_single_start_keeps_apart_from_those_in_the_air_and_those_that_wait(make_world):
    world, _ = two(make_world)

    def found(waiting=None):
        first, second = world.fleet.vehicles[1], world.fleet.vehicles[2]
        flights = others_of({1: first}, waiting or {}) | flights_of({2: second}, {}, {}, {})
        result = separation_of(flights)
        assert 1 not in result.near and 1 not in result.unexamined
        return result.near.get(2, ""), result.unexamined.get(2, "")

    assert found() == ("", "")
    assert "from v1" in found({1: 3.0})[0] and found({1: 300.0}) == ("", "")
    world.fleet.start(1)
    assert world.until(lambda: world.fleet.vehicles[1].height_m > 2.0, 60.0)
    assert world.until(lambda: "from v1" in found()[0], 10.0)
    assert world.finish(world.fleet.pause(1))[0].ok
    world.wait(4.0)
    assert found()[0] == "" and "v1 flies or waits, and its way is not known" in found()[1]


def test_what_was_not_examined_is_said(make_world):
    loaded = line(AP, 10, 80)
    world = standing(make_world, AP, loaded)
    found = item(world, "separation", Wanted(unexamined="v3 flies, and its way is not known"))
    assert found.level is Level.WARNING and found.reason.startswith("not examined: v3")


# -- endurance and fence ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("distance_m", "level"), [(4.0, Level.WARNING), (8.0, Level.RED), (None, Level.RED)])
def test_vehicles_of_a_plan_are_to_keep_apart_as_it_was_made(make_world, distance_m, level):
    homes = [(*CHART.to_degrees(0.0, east), 488.0) for east in (0.0, 80.0)]
    world = make_world(*(SimVehicle(system=s, home=home) for s, home in zip((1, 2), homes, strict=True)))
    world.wait(8.0)
    loaded = {1: line(AP, 40, 80, north=40.0), 2: line(AP, 46, 80, home_east=80.0, north=40.0)}  # 6 m beside each other
    needs = PlanNeeds(apart=None if distance_m is None else Apart(distance_m, 5.0))
    vehicles = dict(world.fleet.vehicles)
    found = [
        item
        for check in preflight_all(vehicles, loaded, {}, {}, world.clock.now, needs=needs)
        for item in check.items
        if item.name == "separation"
    ]
    assert [item.level for item in found] == [level] * 2, found
    assert level is Level.RED or "only 4 m apart" in found[0].reason
    flat = PlanNeeds(apart=Apart(10.0, 2.0))  # another way to be nearer than alarms allow
    far = preflight_all({1: vehicles[1]}, {1: loaded[1]}, {}, {}, world.clock.now, needs=flat)
    (item,) = [item for item in far[0].items if item.name == "separation"]
    assert item.level is Level.WARNING and "or 2 m in height" in item.reason
    # Who is not of the plan is kept as far away as ever.
    stranger = preflight_all(vehicles, {1: loaded[1]}, {2: loaded[2]}, {}, world.clock.now, needs=needs)
    assert any(item.name == "separation" and item.level is Level.RED for check in stranger for item in check.items)


def test_the_endurance_of_the_plan_counts(open_links, folder):  # noqa: F811
    document = json.loads((folder / "plan.json").read_text())
    document["vehicles"] = document["vehicles"][:1]
    links = open_links(make_swarm(1, home=FOLDER_HOME))
    ready(links, 1)
    upload_all(links, folder)
    takeoffs = Takeoffs(links, PlanFolder(folder), lambda _: None)
    for endurance_min, state in ((None, "ok"), (1.0, "red")):
        (folder / "plan.json").write_text(json.dumps(document | {"endurance_min": endurance_min}))
        (row,) = takeoffs.preflight("plan-1")
        assert {i["name"]: i["state"] for i in row["items"]}["battery"] == state, row
    takeoffs.close()


@pytest.mark.parametrize(
    ("kind", "radius_m", "level"),
    [("inclusion", 50.0, Level.RED), ("inclusion", 500.0, Level.OK), ("exclusion", 20.0, Level.RED)],
)
def test_a_mission_that_breaks_the_geofence_is_red(make_world, kind, radius_m, level):
    loaded = line(AP, 10, 80)
    world = standing(make_world, AP, loaded)
    north = 0.0 if kind == "inclusion" else 60.0
    lat, lon = CHART.to_degrees(north, 10.0)
    zones = [FenceZone(kind, ((lon, lat),), radius_m)]
    assert item(world, "fence", Wanted(zones=zones)).level is level
    other = line(AP, 10, 90)  # whoever allows the fence does not allow another mission with it
    assert item(world, "mission", Wanted(mission=other, zones=zones)).level is Level.RED
    assert item(world, "fence").level is Level.OK and "not read" in item(world, "fence").reason


@BOTH
def test_a_mission_within_one_of_two_inclusion_zones(make_world, autopilot):
    """ArduPilot wants it in all, unless FENCE_OPTIONS says otherwise."""
    world = standing(make_world, autopilot, line(autopilot, 10, 80))
    (lat, lon), (beside, _) = CHART.to_degrees(0.0, 10.0), CHART.to_degrees(400.0, 10.0)
    zones = [FenceZone("inclusion", ((lon, lat),), 300.0), FenceZone("inclusion", ((lon, beside),), 300.0)]
    assert item(world, "fence", Wanted(zones=zones)).level is (Level.RED if autopilot is AP else Level.OK)
    world.fleet.vehicles[1].settings[Setting.FENCE_OPTIONS] = SetTo("FENCE_OPTIONS", 2.0)
    assert item(world, "fence", Wanted(zones=zones)).level is Level.OK


def test_a_way_along_the_edge_of_a_fence_keeps_to_it(make_world):
    world = standing(make_world, AP, line(AP, 10, 80))
    corners = [CHART.to_degrees(north, east) for north, east in ((-10, 10), (200, 10), (200, 300), (-10, 300))]
    ring = tuple((round(lon, 6), round(lat, 6)) for lat, lon in corners)
    found = item(world, "fence", Wanted(zones=[FenceZone("exclusion", ring)]))
    assert found.level is Level.OK, found.reason


def test_a_check_is_red_while_the_mission_is_being_read(make_world):
    world = standing(make_world, AP, line(AP, 10, 80))
    found = item(world, "mission", Wanted(reading=True))
    assert found.level is Level.RED and "still being read" in found.reason
