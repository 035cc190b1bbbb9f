"""Before a start: the check as data, takeoffs that wait for each other, and vehicles in the air that come too near."""

import itertools
import json
import threading
from dataclasses import replace

import pytest

from gcs_plugin.cli.main import main
from gcs_plugin.fleet.flight_state import summary
from gcs_plugin.fleet.preflight import ITEMS, Level, Wanted, preflight, preflight_all, red_text
from gcs_plugin.fleet.separation.takeoff_schedule import TakeoffSchedule
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.items import CHANGE_SPEED, LAND, RTL, TAKEOFF, WAYPOINT, Mission, MissionItem
from gcs_plugin.mission.plan_folder import PlanNeeds
from gcs_plugin.mission.track import Airspace, flight_seconds, highest_m
from gcs_plugin.sim.multirotor import Chart
from gcs_plugin.sim.simulated_swarm import Faults, SimSwarm, make_swarm
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.config import config_of
from orthoswarm.model.earth import distance_m
from tests.kit.missions import sortie_mission
from tests.kit.servers.ports import free_port
from tests.vehicles.test_fleet_cli import HOME, fleet, folder  # noqa: F401
from tests.vehicles.test_mission_builder import make_plan
from tests.vehicles.test_sim import mission

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
pytestmark = pytest.mark.usefixtures("in_vehicle_time")
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])
CHART = Chart(47.397742, 8.545594, 488.0)


def levels(world, wanted=Wanted()):  # noqa: B008
    check = preflight(world.fleet.vehicles[1], wanted, world.clock.now)
    return {item.name: item.level for item in check.items}, {item.name: item.reason for item in check.items}


def line(autopilot, east, length, *, home_east=0.0, height=30.0, north=0.0):
    """A mission along a line northward, `east` metres beside the origin."""

    def at(command, n, e):
        return MissionItem.at(command, *CHART.to_degrees(n, e), height)

    items = [at(WAYPOINT, 0, 0)] if autopilot is AP else []
    items += [at(TAKEOFF, 0, home_east), MissionItem.do(CHANGE_SPEED, 1, 8), at(WAYPOINT, north, east)]
    items += [at(WAYPOINT, north + length, east), MissionItem.do(RTL)]
    return Mission(autopilot, tuple(items))


# -- the check ----------------------------------------------------------------------------------------------------


@BOTH
def test_a_vehicle_that_becomes_ready_turns_green_item_by_item(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot, ready_s=40.0))
    world.wait(8.0)
    state, why = levels(world)
    assert tuple(state) == ITEMS
    assert [state[name] for name in ("gps", "ekf", "pre-arm", "mission")] == [Level.RED] * 4
    assert "no 3D fix" in why["gps"] and "position filter" in why["ekf"] and "not been read" in why["mission"]
    assert ("GPS 1: Bad fix" if autopilot is AP else "Waiting for estimator") in why["pre-arm"]
    world.wait(12.0)
    state, why = levels(world)
    assert (state["gps"], state["ekf"], state["pre-arm"]) == (Level.OK, Level.RED, Level.RED)
    world.finish(world.fleet.upload(1, mission(autopilot, MissionItem.do(RTL))))
    world.finish(world.fleet.download(1))
    world.wait(42.0 - world.clock.now)
    state, why = levels(world)
    assert set(state.values()) == {Level.OK}, why


def test_each_item_turns_red_for_its_own_reason(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.meet()
    held = mission(AP, MissionItem.do(RTL))
    world.finish(world.fleet.upload(1, held))
    world.finish(world.fleet.download(1))
    world.wait(6.0)
    vehicle = world.fleet.vehicles[1]
    assert set(levels(world)[0].values()) == {Level.OK}

    def red(wanted=Wanted()):  # noqa: B008
        return [item.name for item in preflight(vehicle, wanted, world.clock.now).red()]

    vehicle.battery = 0.0
    assert red() == ["battery"]
    vehicle.battery = 1.0
    vehicle.satellites = 4
    assert red() == ["gps"]
    vehicle.satellites = 14
    assert red(Wanted(mission=line(AP, 10, 50))) == ["mission"]
    assert red(Wanted(legal_height_m=15.0)) == ["height"]
    assert red(Wanted(near="comes within 3 m of v2")) == ["separation"]
    assert red(Wanted(needs=PlanNeeds(endurance_s=20.0))) == ["battery"]
    world.link.down.faults = Faults(loss=1.0)
    world.wait(6.0)
    assert red() == ["link"]
    check = preflight(vehicle, Wanted(), world.clock.now)
    assert check.red(["link"]) == []  # overridden by its name
    assert red_text([check], {}) == {1: f"link: {check.items[0].reason}"}
    document = check.document("Falcon")
    assert document["vehicle"] == "Falcon" and document["state"] == "red"
    assert document["items"][0].keys() == {"name", "state", "reason"} and json.dumps(document)


def test_missions_that_cross_without_a_plan_are_red(make_world):
    second = SimVehicle(system=2, autopilot=AP, home=(*CHART.to_degrees(0.0, 80.0), 488.0))
    world = make_world(SimVehicle(system=1, autopilot=AP), second)
    world.wait(8.0)
    missions = {1: line(AP, 40, 60), 2: line(AP, 40, 60, home_east=80.0)}
    checks = preflight_all(dict(world.fleet.vehicles), {}, missions, {}, world.clock.now)
    assert all(item.name == "separation" for check in checks for item in check.red() if item.level is Level.RED)
    assert "comes within 0 m from v2" in red_text(checks, {})[1]
    apart = preflight_all(dict(world.fleet.vehicles), {}, missions, {2: 60.0}, world.clock.now)
    assert red_text(apart, {}) == {}


@BOTH
def test_a_mission_turns_the_gimbal_down_and_the_check_says_where_it_looks(make_world, autopilot):
    sim = SimVehicle(system=1, autopilot=autopilot)
    sim.flight.gimbal_pitch_deg = 0.0
    world = make_world(sim)
    world.meet()
    plain, aimed = (
        sortie_mission(plan, plan.vehicles[0].sorties[0], autopilot)
        for plan in (make_plan(), make_plan(gimbal_pitch_deg=-90.0))
    )
    world.wait(4.0)
    state, why = levels(world, Wanted(plain))
    assert state["gimbal"] is Level.WARNING and "at 0 degrees" in why["gimbal"] and "--gimbal-pitch" in why["gimbal"]
    assert world.finish(world.fleet.upload(1, aimed))[0].ok
    state, why = levels(world, Wanted(aimed))
    assert state["gimbal"] is Level.OK and "turns it to -90" in why["gimbal"]
    assert world.finish(world.fleet.start(1))[0].ok
    assert world.until(lambda: sim.flight.triggers > 0, 200.0)
    world.wait(1.0)
    assert sim.flight.gimbal_pitch_deg == -90.0
    assert world.fleet.vehicles[1].gimbal_pitch_deg == pytest.approx(-90.0, abs=0.1)
    sim.flight.gimbal_pitch_deg = -20.0  # by hand
    world.wait(1.0)
    state, why = levels(world, Wanted(aimed))
    assert state["gimbal"] is Level.WARNING and "not at -90 as its mission says" in why["gimbal"]
    assert world.finish(world.fleet.pause(1))[0].ok
    world.wait(3.0)  # PX4 levels it there and turns it again as it goes on
    assert levels(world, Wanted(aimed))[0]["gimbal"] is (Level.OK if autopilot is PX4 else Level.WARNING)


@BOTH
def test_a_vehicle_without_a_gimbal_flies_the_same_mission(make_world, autopilot):
    sim = SimVehicle(system=1, autopilot=autopilot)
    world = make_world(sim)
    world.meet()
    plan = make_plan(gimbal_pitch_deg=-90.0)
    aimed = sortie_mission(plan, plan.vehicles[0].sorties[0], autopilot)
    assert world.finish(world.fleet.upload(1, aimed))[0].ok
    state, why = levels(world, Wanted(aimed))
    assert state["gimbal"] is Level.OK and "no gimbal" in why["gimbal"]
    assert world.finish(world.fleet.start(1))[0].ok
    assert world.until(lambda: "complete" in world.kinds(1), 400.0)
    assert sim.flight.triggers > 10


# -- times --------------------------------------------------------------------------------------------------------


def test_a_track_takes_the_planners_time_and_height():
    one = line(AP, 0, 80.0)
    assert highest_m(one) == 30.0
    # Takeoff and setting off, climb, 160 m, turning, waiting above home, 20 m down, and the last 10 m.
    assert flight_seconds(one) == pytest.approx(6 + 30 / 2.5 + 160 / 8 + 5 + 12 + 20 / 1.5 + 10 / 0.5, abs=4.0)
    landed = replace(
        one, items=(*one.items[:-1], MissionItem.at(LAND, one.items[1].lat_deg, one.items[1].lon_deg, 0.0))
    )
    assert 6.0 < flight_seconds(one) - flight_seconds(landed) < 9.0  # LAND does not wait above home


def test_the_next_start_keeps_every_pair_apart():
    airspace = Airspace.of(
        {1: line(AP, 40, 60), 2: line(AP, 40, 60, home_east=80.0), 3: line(AP, 400, 60, home_east=360.0)}
    )
    assert airspace.conflicts({1: 0.0, 2: 0.0, 3: 0.0})
    start = airspace.next_start(2, 0.0, {1: 0.0, 3: 0.0})
    assert start > 5.0
    for off in (-3.0, 0.0, 3.0):
        assert airspace.conflicts({1: 0.0, 2: start + off, 3: 0.0}) == [] or off != 0.0
    assert airspace.next_start(3, 0.0, {1: 0.0, 2: 0.0}) == 0.0


def test_a_plan_is_flown_by_the_times_that_it_was_made_with():
    missions = {1: line(AP, 40, 60), 2: line(AP, 40, 60, home_east=80.0)}
    config = config_of({"ardupilot": {"takeoff_s": 22.6, "schedule_slack_s": 2.0}})
    usual, own = Airspace.of(missions), Airspace.of(missions, needs=PlanNeeds(config=config))
    assert (usual.slack_s, own.slack_s) == (10.0, 2.0)
    assert len(own.tracks[1].places) == len(usual.tracks[1].places) + 40  # each of half a second


def test_one_that_is_late_moves_those_that_wait():
    missions = {1: line(AP, 40, 60), 2: line(AP, 40, 60, home_east=80.0)}
    apart = Airspace.of(missions).next_start(2, 0.0, {1: 0.0})
    schedule = TakeoffSchedule.of({1: 0.0, 2: apart}, 100.0, Airspace.of(missions))
    assert schedule.due(100.0) == [1]
    assert schedule.started(1, 103.0, str) == [] and schedule.waiting == {2: 100.0 + apart}  # in time
    schedule = TakeoffSchedule.of({1: 0.0, 2: apart}, 100.0, Airspace.of(missions))
    assert schedule.due(100.0 + apart) == [1] and schedule.due(100.0 + apart) == []  # the first is undecided
    said = schedule.started(1, 100.0 + 14.0, "north {}".format)
    assert said[0] == "north 1 took off 14 s late" and "north 2 takes off 14 s later" in said[1]
    assert schedule.waiting[2] == pytest.approx(100.0 + apart + 14.0, abs=1.0)


@pytest.mark.parametrize("late", [1, 2])
def test_one_that_is_late_and_comes_near_another_is_told_with_the_others_name(late):
    """Vehicles 1 and 2 fly lines that they share, vehicle 3 one far away."""
    missions = {1: line(AP, 40, 60), 2: line(AP, 40, 60, home_east=80.0), 3: line(AP, 400, 60, home_east=360.0)}
    schedule = TakeoffSchedule.of({1: 0.0, 2: 0.0, 3: 0.0}, 0.0, Airspace.of(missions))
    early = 3 - late
    assert {*schedule.due(0.0)} == {1, 2, 3}
    assert schedule.started(early, 0.0, str) == [] and schedule.started(3, 0.0, str) == []
    off = next(s for s in range(6, 60) if schedule.airspace.conflicts({early: 0.0, late: float(s)}))
    said = schedule.started(late, float(off), {1: "red", 2: "blue", 3: "far"}.__getitem__)
    one, other = ("red", "blue") if late == 1 else ("blue", "red")
    assert len(said) == 2 and said[1].startswith(f"{one} may come within ") and f" m of {other} in " in said[1]


def test_one_that_does_not_take_off_holds_those_that_wait():
    schedule = TakeoffSchedule.of({1: 0.0, 2: 5.0, 3: 9.0}, 0.0)
    assert schedule.due(0.0) == [1]
    assert schedule.failed(1) == [2, 3] and schedule.due(100.0) == []


# -- on the ground and in the air, from the command line -----------------------------------------------------------


def swarm_of(vehicles, speed=10.0):
    port = free_port()
    return SimSwarm(vehicles, f"udpout:127.0.0.1:{port}", speed=speed), f"udpin:127.0.0.1:{port}"


@pytest.mark.slow
def test_all_wait_until_the_last_one_is_ready_and_say_for_what(folder, capsys):  # noqa: F811
    vehicles = make_swarm(3, autopilots=(AP, PX4), home=HOME)
    swarm, link = swarm_of(vehicles)
    with swarm:
        assert fleet(capsys, "upload", folder, "--link", link)[0] == 0
        vehicles[1].ready_s = ready_s = swarm.now + 130.0
        code = main(["fleet", "start", "--override", "separation", "--plan", str(folder), "--link", link])
        said = capsys.readouterr().out.splitlines()
        assert code == 0, said
        assert said[0].startswith("waiting: v2 ") and "pre-arm" in said[0]
        assert [text for text in said if "flies its mission" in text] == [
            f"vehicle {number} flies its mission" for number in (1, 2, 3)
        ]
        assert swarm.now >= ready_s


@pytest.mark.slow
def test_what_vehicles_wait_for_is_said_once_for_those_that_it_is_new_for(folder, capsys):  # noqa: F811
    vehicles = make_swarm(3, autopilots=(AP,), home=HOME)
    swarm, link = swarm_of(vehicles)
    with swarm:
        assert fleet(capsys, "upload", folder, "--link", link)[0] == 0
        for vehicle, ready_s in zip(vehicles, (50.0, 130.0, 130.0), strict=True):
            vehicle.ready_s = swarm.now + ready_s
        assert main(["fleet", "start", "--override", "separation", "--plan", str(folder), "--link", link]) == 0
        lines = capsys.readouterr().out.splitlines()
    said = [line for line in lines if line.startswith(("waiting: ", "ready: "))]
    assert "ready: v1" in said
    after = said[said.index("ready: v1") + 1 :]
    assert not any("v1" in line for line in after)
    for name in ("v1", "v2", "v3"):
        mine = [line.partition(" v")[2].partition(" ")[2] for line in said if name in line]
        assert all(one != other for one, other in itertools.pairwise(mine)), said


@pytest.mark.slow
def test_nobody_takes_off_where_one_does_not_become_ready(folder, capsys):  # noqa: F811
    vehicles = make_swarm(3, autopilots=(AP, PX4), home=HOME)
    vehicles[1].ready_s = 1e9
    swarm, link = swarm_of(vehicles)
    with swarm:
        assert fleet(capsys, "upload", folder, "--link", link)[0] == 0
        code, said = fleet(
            capsys, "start", "--override", "separation", "--plan", folder, "--ready", 2, "--link", link, "--json"
        )
        assert code == 1
        assert [row["outcome"] for row in said["vehicles"]] == ["not_sent", "refused", "not_sent"]
        assert "pre-arm" in said["vehicles"][1]["text"]
        assert not any(vehicle.flight.armed for vehicle in vehicles)


def test_one_that_cannot_arm_at_its_time_holds_the_others(folder, capsys):  # noqa: F811
    vehicles = make_swarm(3, autopilots=(AP,), home=HOME)
    swarm, link = swarm_of(vehicles)
    with swarm:
        assert fleet(capsys, "upload", folder, "--link", link)[0] == 0
        vehicles[1].arms = False  # nothing in its checks says so
        code, said = fleet(capsys, "start", "--override", "separation", "--plan", folder, "--link", link, "--json")
        assert code == 1
        outcomes = [row["outcome"] for row in said["vehicles"]]
        assert outcomes == ["done", "refused", "not_sent"], said
        assert "stays on the ground, because vehicle 2 did not take off" in said["vehicles"][2]["text"]
        assert "Arm: Motors: Check frame class" in said["vehicles"][1]["text"]


def test_a_height_above_the_legal_one_is_asked_about(folder, capsys):  # noqa: F811
    swarm, link = swarm_of(make_swarm(1, home=HOME))
    with swarm:
        path = folder / "high.waypoints"
        path.write_text((folder / "v1.waypoints").read_text().replace("\t60.000\t", "\t400.000\t"))
        assert fleet(capsys, "upload", path, "--vehicle", 1, "--link", link)[0] == 0
        code, said = fleet(capsys, "start", "--vehicle", 1, "--link", link, "--json")
        assert code == 1 and "over 120 m" in said["vehicles"][0]["text"]
        assert fleet(capsys, "check", "--vehicle", 1, "--link", link)[0] == 1
        assert fleet(capsys, "check", "--vehicle", 1, "--max-height", 500, "--link", link)[0] == 0
        assert fleet(capsys, "start", "--vehicle", 1, "--max-height", 500, "--link", link)[0] == 0


@pytest.mark.parametrize(("late", "passed"), [("GPS_RAW_INT", True), ("SYS_STATUS", False)])
def test_what_a_vehicle_has_not_reported_yet_is_waited_for_before_the_check(folder, capsys, late, passed):  # noqa: F811
    """Its receiver would be red, and its empty battery would not be."""
    vehicles = make_swarm(1, home=HOME)
    number = getattr(dialect, f"MAVLINK_MSG_ID_{late}")
    vehicles[0].withheld.add(number)
    vehicles[0].used_s = 0.0 if passed else 1e9
    swarm, link = swarm_of(vehicles)
    with swarm:
        assert fleet(capsys, "upload", folder / "v1.plan", "--vehicle", 1, "--link", link)[0] == 0
        said = threading.Timer(0.7, vehicles[0].withheld.discard, (number,))
        said.start()
        code, text = fleet(capsys, "check", "--vehicle", 1, "--wait", 60, "--link", link)
        assert (code == 0) is passed, text
        said.join()


def test_a_speed_that_a_vehicle_may_not_reach_is_said_as_it_starts(folder, capsys):  # noqa: F811
    swarm, link = swarm_of(make_swarm(1, home=HOME))
    with swarm:
        rows = [line.split("\t") for line in (folder / "v1.waypoints").read_text().splitlines()]
        for row in rows:
            if row[3:4] == [str(CHANGE_SPEED)]:
                row[5] = "14"
        path = folder / "fast.waypoints"
        path.write_text("\n".join("\t".join(row) for row in rows) + "\n")
        assert fleet(capsys, "upload", path, "--vehicle", 1, "--link", link)[0] == 0
        code, said = fleet(capsys, "start", "--vehicle", 1, "--link", link)
        assert code == 0
        assert "warning: v1 speed: is asked for 14 m/s but may not reach that (WPNAV_SPEED is 10 m/s)" in said


def test_what_is_overridden_must_be_named(folder, capsys):  # noqa: F811
    swarm, link = swarm_of(make_swarm(1, home=HOME))
    with swarm:
        assert main(["fleet", "start", "--override", "everything", "--link", link]) == 2
        assert "choose from link, gps" in capsys.readouterr().err


def test_the_list_fits_a_terminal_of_80_columns(folder, capsys, monkeypatch):  # noqa: F811
    monkeypatch.setenv("COLUMNS", "80")
    one, first = swarm_of(make_swarm(1, home=HOME))
    vehicles = make_swarm(2, autopilots=(AP, PX4), home=HOME)
    two, second = swarm_of(vehicles[1:])
    with one, two:
        assert fleet(capsys, "upload", folder, "--link", first, "--link", second, "--vehicle", "1,2")[0] == 0
        _, text = fleet(capsys, "list", "--link", first, "--link", second)
        rows = text.splitlines()
        assert all(len(row) <= 80 for row in rows[:3]) and "…" not in text
        assert "on ground" in rows[1] and rows[1].rstrip().endswith("12 items")
        assert f"v2 on {second}" in rows[4]


def test_vehicles_that_come_too_near_raise_an_alarm_with_a_proposal(make_world):
    world = make_world(
        SimVehicle(system=1, autopilot=AP), SimVehicle(system=2, autopilot=AP, home=(*CHART.to_degrees(0, 80.0), 488.0))
    )
    world.meet()
    fleet_ = world.fleet
    for system, home_east in ((1, 0.0), (2, 80.0)):
        world.finish(fleet_.upload(system, line(AP, 40, 60, home_east=home_east)))
    world.finish(fleet_.start(1), fleet_.start(2))
    assert world.until(lambda: any(e.kind == "near" for e in world.events), 100.0)
    alarm = next(e for e in world.events if e.kind == "near")
    assert "they should keep 10 m" in alarm.text and "pause v" in alarm.text
    near = fleet_.separation.alarms[1, 2]  # said while a pause still helps: two to three seconds before
    assert near.ahead_s >= 2.0 and "will be in" in alarm.text
    places = [(v.lat_deg, v.lon_deg) for v in fleet_.vehicles.values()]
    assert distance_m(*places[0], *places[1]) > 10.0
    assert alarm.pair == (1, 2)
    assert fleet_.separation.text(1) and fleet_.separation.text(2)
    assert sum(e.kind == "near" for e in world.events) == 1  # said once


@pytest.mark.parametrize(("apart_m", "alarms"), [(4.95, 0), (4.0, 1)])
def test_heights_that_a_plan_keeps_five_metres_apart_are_apart_within_what_vehicles_hold(make_world, apart_m, alarms):
    """Of 32 ArduCopters in one plan four pairs crossed 4.99 m above each other."""
    world = make_world(
        SimVehicle(system=1, autopilot=AP), SimVehicle(system=2, autopilot=AP, home=(*CHART.to_degrees(0, 80.0), 488.0))
    )
    world.meet()
    for system, home_east in ((1, 0.0), (2, 80.0)):
        height = 30.0 + apart_m * (system - 1)
        world.finish(world.fleet.upload(system, line(AP, 40, 60, home_east=home_east, height=height)))
    world.finish(world.fleet.start(1), world.fleet.start(2))
    world.wait(60.0)
    assert sum(event.kind == "near" for event in world.events) == alarms


def test_neighbours_that_take_off_side_by_side_raise_no_alarm(make_world):
    world = make_world(
        SimVehicle(system=1, autopilot=AP), SimVehicle(system=2, autopilot=AP, home=(*CHART.to_degrees(0, 5.0), 488.0))
    )
    world.meet()
    for system, north in ((1, 30.0), (2, -90.0)):
        world.finish(world.fleet.upload(system, line(AP, 5.0 * system, 60, home_east=5.0 * (system - 1), north=north)))
    world.finish(world.fleet.start(1), world.fleet.start(2))
    world.wait(60.0)
    assert not [e for e in world.events if e.kind == "near"]


# -- several batteries ----------------------------------------------------------------------------------------------


def test_the_emptiest_of_two_batteries_counts(make_world):
    """ArduPilot's SYS_STATUS shows the first one only."""
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.vehicles[1].second_battery = 0.6
    world.wait(8.0)
    vehicle = world.fleet.vehicles[1]
    assert vehicle.ready_to_check and vehicle.battery == pytest.approx(0.6)
    world.vehicles[1].second_battery = 0.05
    world.wait(6.0)
    state, why = levels(world)
    assert summary(vehicle, world.clock.now)["battery"] == pytest.approx(0.05)
    assert state["battery"] is Level.RED and "5 % left in its battery 2" in why["battery"]
    world.vehicles[1].withheld.add(int(dialect.MAVLINK_MSG_ID_BATTERY_STATUS))
    world.wait(20.0)
    assert "has not reported its battery for" in levels(world)[1]["battery"]  # SYS_STATUS still comes


def test_a_check_waits_until_all_batteries_were_told(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.vehicles[1].second_battery = 0.05
    assert world.until(lambda: bool(world.fleet.vehicles) and world.fleet.vehicles[1].ready_to_check, 60.0)
    assert world.fleet.vehicles[1].battery == pytest.approx(0.05)


def test_a_battery_whose_first_message_was_lost_is_waited_for(make_world):
    """Two messages of the first one are no proof that there is no other where packets were lost between them."""
    world = make_world(SimVehicle(system=1, autopilot=AP))
    told, battery = dialect.MAVLINK_MSG_ID_BATTERY_STATUS, 0.05
    world.vehicles[1].withheld.add(int(told))
    world.wait(8.0)
    vehicle = world.fleet.vehicles[1]
    for number, left, lost in ((0, 90, 0), (0, 90, 1), (1, round(100 * battery), 0), (0, 90, 0)):
        assert not vehicle.ready_to_check
        vehicle.missed += lost
        vehicle.streams.seen(int(told), world.clock.now)
        vehicle.update(dialect.MAVLink_battery_status_message(number, 0, 0, 0x7FFF, [0xFFFF] * 10, -1, -1, -1, left))
    assert vehicle.ready_to_check and vehicle.battery == pytest.approx(battery)


def test_one_battery_has_no_number(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.wait(8.0)
    assert world.fleet.vehicles[1].battery_name == "" and "% left, the mission" in levels(world)[1]["battery"]


def test_batteries_are_forgotten_at_a_restart(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.vehicles[1].second_battery = 0.05
    world.wait(8.0)
    world.vehicles[1].second_battery = None
    world.vehicles[1].reboot(world.clock.now)
    assert world.until(lambda: any(event.kind == "rebooted" for event in world.events), 30.0)
    assert world.until(lambda: world.fleet.vehicles[1].battery == 1.0, 30.0)
