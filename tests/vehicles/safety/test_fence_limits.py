"""What a vehicle's geofence allows by its parameters is compared with the mission before a start."""

import json
import re
from dataclasses import replace

import pytest

from gcs_plugin.daemon.takeoffs import Takeoffs
from gcs_plugin.fleet import autopilot_settings
from gcs_plugin.fleet.autopilot_settings import Setting
from gcs_plugin.fleet.preflight import Level, Wanted, preflight
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.items import FRAME_GLOBAL, FRAME_TERRAIN, RTL, TAKEOFF, WAYPOINT, Mission, MissionItem
from gcs_plugin.mission.mission_builder import read_mission
from gcs_plugin.sim.multirotor import Airframe, Chart
from gcs_plugin.sim.simulated_swarm import Faults, SimSwarm, make_swarm
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from tests.kit.servers.ports import free_port
from tests.vehicles.test_fleet_cli import HOME, fleet, folder  # noqa: F401
from tests.vehicles.test_geofence import FENCE
from tests.vehicles.test_vehicle_links import PlanFolder, open_links, ready, upload_all  # noqa: F401

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])
CHART = Chart(47.397742, 8.545594, 488.0)
NAMES = {AP: ("FENCE_RADIUS", "FENCE_ALT_MAX"), PX4: ("GF_MAX_HOR_DIST", "GF_MAX_VER_DIST")}


def flight(autopilot, *, far=240.0, heights=(50.0, 50.0), **more):
    """A mission to waypoints at these heights, `far` metres north of its start at most."""
    takeoff = MissionItem.at(TAKEOFF, *CHART.to_degrees(0.0, 0.0), heights[0])
    legs = [
        MissionItem.at(WAYPOINT, *CHART.to_degrees(far if k else 20.0, 0.0), height, **more)
        for k, height in enumerate(heights)
    ]
    home = [MissionItem.at(WAYPOINT, *CHART.to_degrees(0.0, 0.0), 0.0)] if autopilot is AP else []
    return Mission(autopilot, (*home, takeoff, *legs, MissionItem.do(RTL)))


def fence_of(make_world, autopilot, mission, parameters, **faults):
    """The check's item about a vehicle with these parameters."""
    world = make_world(SimVehicle(system=1, autopilot=autopilot), **faults)
    world.vehicles[1].parameters |= parameters
    world.meet()
    world.finish(world.fleet.upload(1, mission))
    world.finish(world.fleet.download(1))
    assert world.until(lambda: world.fleet.vehicles[1].ready_to_check, 30.0)
    check = preflight(world.fleet.vehicles[1], Wanted(), world.clock.now)
    return next(item for item in check.items if item.name == "fence")


@BOTH
def test_a_mission_that_goes_beyond_a_fence_around_home_is_red(make_world, autopilot):
    radius, top = NAMES[autopilot]
    kept = {"FENCE_ENABLE": 1} if autopilot is AP else {}
    item = fence_of(make_world, autopilot, flight(autopilot), kept | {radius: 100.0})
    assert item.level is Level.RED
    # from where its receiver says that it stands
    assert re.search(rf"goes 2(39|40|41|42) m from home, but its geofence ends at 100 m \({radius}\)", item.reason)
    assert re.search(rf"set {radius} to 24\d if it may", item.reason)
    assert ("returns, or lands (FENCE_ACTION)" if autopilot is AP else "starts no mission") in item.reason
    item = fence_of(make_world, autopilot, flight(autopilot), kept | {top: 40.0})
    assert item.level is Level.RED and f"goes up to 50 m, but its geofence ends at 40 m ({top})" in item.reason


@BOTH
def test_a_mission_within_the_fence_or_without_one_passes(make_world, autopilot):
    radius, top = NAMES[autopilot]
    kept = {"FENCE_ENABLE": 1} if autopilot is AP else {}
    item = fence_of(make_world, autopilot, flight(autopilot), kept | {radius: 300.0, top: 80.0})
    assert item.level is Level.OK and item.reason.startswith("its mission keeps to its geofence")
    off = {"FENCE_ENABLE": 0, radius: 30.0} if autopilot is AP else {radius: 0.0, top: 0.0}
    assert fence_of(make_world, autopilot, flight(autopilot), off).level is Level.OK


def test_a_mission_near_the_fence_is_warned_about(make_world):
    item = fence_of(make_world, AP, flight(AP), {"FENCE_ENABLE": 1, "FENCE_RADIUS": 250.0, "FENCE_MARGIN": 20.0})
    assert item.level is Level.WARNING and "may be carried beyond" in item.reason
    item = fence_of(make_world, PX4, flight(PX4), {"GF_MAX_VER_DIST": 60.0})  # it rises by metres as it brakes
    assert item.level is Level.WARNING and "goes up to 50 m" in item.reason


@pytest.mark.parametrize(
    ("parameters", "level"),
    [
        ({"FENCE_ENABLE": 1, "FENCE_TYPE": 0b0101}, Level.OK),  # no circle
        ({"FENCE_ENABLE": 1, "FENCE_TYPE": 0b0010}, Level.RED),
        ({"FENCE_ENABLE": 0, "FENCE_AUTOENABLE": 3}, Level.RED),  # enabled as it arms
        ({"FENCE_ENABLE": 1, "FENCE_ACTION": 0}, Level.WARNING),  # only reports
        ({"FENCE_ENABLE": 1, "FENCE_MARGIN": 150.0, "FENCE_RADIUS": 300.0}, Level.WARNING),
    ],
)
def test_what_arducopters_fence_consists_of_is_regarded(make_world, parameters, level):
    item = fence_of(make_world, AP, flight(AP), {"FENCE_RADIUS": 100.0} | parameters)
    assert item.level is level, item.reason


def test_a_fence_that_was_switched_on_in_the_field_counts(make_world):
    world = make_world(SimVehicle(system=1))
    world.vehicles[1].parameters["FENCE_RADIUS"] = 100.0
    world.meet()
    world.finish(world.fleet.upload(1, flight(AP)))
    world.finish(world.fleet.download(1))
    assert world.until(lambda: world.fleet.vehicles[1].ready_to_check, 30.0)
    vehicle, on = world.fleet.vehicles[1], int(dialect.MAV_SYS_STATUS_GEOFENCE)
    for enabled, level in ((0, Level.OK), (on, Level.RED)):
        vehicle.update(dialect.MAVLink_sys_status_message(on, enabled, on, 0, 12_000, 0, 90, 0, 0, 0, 0, 0, 0))
        items = {item.name: item for item in preflight(vehicle, Wanted(), world.clock.now).items}
        assert items["fence"].level is level, items["fence"].reason


def test_a_mission_that_sinks_to_the_floor_of_a_fence_is_red(make_world):
    floor = {"FENCE_ENABLE": 1, "FENCE_TYPE": 0b1000, "FENCE_ALT_MIN": 30.0}
    sinks, low = flight(AP, heights=(50.0, 25.0)), flight(AP, heights=(25.0, 20.0))
    item = fence_of(make_world, AP, sinks, floor)
    assert (
        item.level is Level.RED and "goes down to 25 m, but its geofence begins at 30 m (FENCE_ALT_MIN)" in item.reason
    )
    home, *above_sea = flight(AP, heights=(538.0, 513.0), frame=FRAME_GLOBAL).items
    takeoff = MissionItem.at(TAKEOFF, *CHART.to_degrees(0.0, 0.0), 538.0, frame=FRAME_GLOBAL)
    above_sea = Mission(AP, (replace(home, z=488.0, frame=FRAME_GLOBAL), takeoff, *above_sea[1:]))
    item = fence_of(make_world, AP, above_sea, floor)
    assert item.level is Level.RED and "goes down to 25 m" in item.reason
    assert fence_of(make_world, AP, low, floor).level is Level.OK  # it never was above it
    assert fence_of(make_world, AP, sinks, floor | {"FENCE_ALT_MIN": -10.0}).level is Level.OK


def test_heights_above_the_ground_are_not_compared_with_a_top_above_home(make_world):
    item = fence_of(make_world, AP, flight(AP, frame=FRAME_TERRAIN), {"FENCE_ENABLE": 1})
    assert item.level is Level.WARNING and "count from the ground" in item.reason


def test_a_px4_that_returns_above_its_fence_is_warned_about(make_world):
    item = fence_of(make_world, PX4, flight(PX4), {"GF_MAX_VER_DIST": 70.0, "RTL_RETURN_ALT": 80.0})
    assert item.level is Level.WARNING and "flies home 80 m above home (RTL_RETURN_ALT)" in item.reason


@BOTH
def test_the_fence_is_asked_for_until_it_is_told(make_world, autopilot):
    kept = {"FENCE_ENABLE": 1} if autopilot is AP else {}
    lossy = Faults(loss=0.2, seed=3)
    item = fence_of(make_world, autopilot, flight(autopilot), kept | {NAMES[autopilot][0]: 100.0}, up=lossy, down=lossy)
    assert item.level is Level.RED


def test_a_fence_is_held_to_be_off_only_once_it_is_known_when_it_is_switched_on(make_world):
    """FENCE_AUTOENABLE, or the question, may be lost where all else is told."""
    world = make_world(SimVehicle(system=1))
    del world.vehicles[1].parameters["FENCE_AUTOENABLE"]
    world.vehicles[1].parameters["FENCE_RADIUS"] = 100.0
    world.meet()
    world.wait(8.0)
    world.finish(world.fleet.upload(1, flight(AP)))
    world.finish(world.fleet.download(1))
    vehicle = world.fleet.vehicles[1]
    assert world.until(lambda: {Setting.FENCE, Setting.SPEED} <= vehicle.settings.keys(), 2.0)
    world.vehicles[1].parameters["FENCE_AUTOENABLE"] = 3
    assert world.until(lambda: vehicle.ready_to_check, 30.0)
    items = {item.name: item for item in preflight(vehicle, Wanted(), world.clock.now).items}
    assert items["fence"].level is Level.RED, items["fence"].reason


@pytest.mark.parametrize(("loss", "level"), [(0.0, Level.OK), (0.2, Level.WARNING)])
def test_a_link_that_loses_packets_leaves_it_open_when_a_fence_is_switched_on(make_world, loss, level):
    """Older versions do not have FENCE_AUTOENABLE; on a link that loses packets that looks the same."""
    world = make_world(SimVehicle(system=1), up=Faults(loss=loss, seed=5), down=Faults(loss=loss, seed=6))
    del world.vehicles[1].parameters["FENCE_AUTOENABLE"]
    world.meet()
    world.wait(20.0)
    world.finish(world.fleet.upload(1, flight(AP)))
    vehicle = world.fleet.vehicles[1]
    for _ in range(10):
        world.finish(world.fleet.download(1))
        assert world.until(lambda: vehicle.ready_to_check, 60.0)
        if not vehicle.untold:
            break
    items = {item.name: item for item in preflight(vehicle, Wanted(), world.clock.now).items}
    assert items["fence"].level is level, items["fence"].reason
    assert level is Level.OK or "FENCE_AUTOENABLE" in items["fence"].reason


def test_a_vehicle_that_does_not_tell_is_warned_about(make_world):
    world = make_world(SimVehicle(system=1))
    world.vehicles[1].parameters.clear()
    world.meet()
    world.finish(world.fleet.upload(1, flight(AP)))
    world.finish(world.fleet.download(1))
    assert not world.fleet.vehicles[1].ready_to_check
    assert world.until(lambda: world.fleet.vehicles[1].ready_to_check, 30.0)  # it is not asked for ever
    check = preflight(world.fleet.vehicles[1], Wanted(), world.clock.now)
    item = next(item for item in check.items if item.name == "fence")
    assert item.level is Level.WARNING and "has not said whether it keeps a geofence" in item.reason


@pytest.mark.parametrize("backend", ["pymavlink", "mavsdk"])
def test_no_vehicle_is_started_into_its_fence_from_the_command_line(folder, capsys, backend, in_vehicle_time):  # noqa: F811
    if backend == "mavsdk":
        pytest.importorskip("mavsdk")
    port = free_port()
    link = f"udpin:127.0.0.1:{port}"
    links = ("--link", link, "--backend", backend, "--wait", 60)
    vehicles = make_swarm(2, autopilots=(AP, PX4), home=HOME, spacing_m=30.0, airframe=Airframe(climb_m_s=8.0))
    vehicles[0].parameters |= {"FENCE_ENABLE": 1, "FENCE_RADIUS": 30.0}
    vehicles[1].store.fence = list(FENCE)  # an area to stay in, elsewhere
    with SimSwarm(vehicles, f"udpout:127.0.0.1:{port}", speed=10.0):
        for vehicle in ("1", "2"):
            assert fleet(capsys, "upload", folder / "v1.plan", "--vehicle", vehicle, *links)[0] == 0
        code, said = fleet(capsys, "check", *links, "--json")
        fences = [next(i for i in row["items"] if i["name"] == "fence") for row in said["vehicles"]]
        assert code == 1 and [item["state"] for item in fences] == ["red", "red"]
        returns = [next(i["reason"] for i in row["items"] if i["name"] == "return") for row in said["vehicles"]]
        assert all("RTL altitude 15 m above home" in reason for reason in returns), returns
        assert "FENCE_RADIUS" in fences[0]["reason"] and "leaves its geofence" in fences[1]["reason"]
        words = ["start", "--vehicle", 1, "--override", "home", "--override", "separation", *links, "--json"]
        code, said = fleet(capsys, *words)
        assert code == 1 and "fence: its mission goes" in json.dumps(said) and not vehicles[0].flight.armed
        code, said = fleet(capsys, *words, "--override", "fence")
        assert code == 0 and said["vehicles"][0]["ok"]


def test_the_daemons_check_is_red_too(open_links, folder):  # noqa: F811
    document = json.loads((folder / "plan.json").read_text())
    (folder / "plan.json").write_text(json.dumps(document | {"vehicles": document["vehicles"][:1]}))
    (vehicle,) = vehicles = make_swarm(1, home=HOME)
    links = open_links(vehicles)
    ready(links, 1)
    upload_all(links, folder)
    takeoffs = Takeoffs(links, PlanFolder(folder), lambda _: None)
    for enabled, state in ((1, "red"), (0, "ok")):  # changed in between, as by another station
        vehicle.parameters |= {"FENCE_ENABLE": enabled, "FENCE_RADIUS": 30.0}
        links.fleet.vehicles[1].mission = None  # so that it is read again
        (row,) = takeoffs.preflight("plan-1")
        assert {i["name"]: i["state"] for i in row["items"]}["fence"] == state, row
    takeoffs.close()


@pytest.mark.parametrize("missing", [("RTL_ALT_TYPE",), None])
def test_a_start_does_not_wait_for_what_is_never_told(open_links, folder, monkeypatch, missing):  # noqa: F811
    """One that is too old for a parameter, or that answers about none: its command would be too old by then."""
    monkeypatch.setattr(autopilot_settings, "_ANSWER_S", 0.3)
    (vehicle,) = vehicles = make_swarm(1, home=HOME)
    for name in missing or list(vehicle.parameters):
        del vehicle.parameters[name]
    links = open_links(vehicles)
    ready(links, 1)
    links.upload(1, read_mission(folder / "v1.waypoints", AP))
    asked, ask = [], links.fleet.ask_settings
    monkeypatch.setattr(links.fleet, "ask_settings", lambda system: (asked.append(system), ask(system)))
    for _ in range(3):
        links.preflight(["v1"])
        assert asked == [1]
