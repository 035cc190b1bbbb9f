"""What autopilots are set to do by themselves is read, and compared with what the plan needs."""

import json
import re
import struct
from pathlib import Path

import pytest

from gcs_plugin.fleet.autopilot_settings import PARAMETERS, Setting, SetTo, answer
from gcs_plugin.fleet.preflight import ITEMS, Level, Wanted, preflight
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.plan_folder import PlanNeeds, plan_needs
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.config import config_of
from orthoswarm.model.plan import Apart

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])
REAL, INT8, INT32 = (getattr(dialect, f"MAV_PARAM_TYPE_{name}") for name in ("REAL32", "INT8", "INT32"))


def said(name, value, kind, autopilot):
    message = dialect.MAVLink_param_value_message(name.encode(), value, kind, 100, 3)
    packed = message.pack(dialect.MAVLink(None))
    (heard,) = dialect.MAVLink(None).parse_buffer(packed)
    return answer(heard, autopilot)


def bytewise(value):
    return struct.unpack("<f", struct.pack("<i", value))[0]


@pytest.mark.parametrize(
    ("name", "value", "kind", "autopilot", "setting", "si"),
    [
        ("WPNAV_SPEED", 1250.0, REAL, AP, Setting.SPEED, 12.5),
        ("WP_SPD", 12.5, REAL, AP, Setting.SPEED, 12.5),  # ArduPilot 4.7
        ("RTL_ALT", 3000.0, INT32, AP, Setting.RETURN_HEIGHT, 30.0),
        ("RTL_ALT_M", 30.0, REAL, AP, Setting.RETURN_HEIGHT, 30.0),
        ("RTL_SPEED", 500.0, INT32, AP, Setting.RETURN_SPEED, 5.0),
        ("RTL_SPEED_MS", 5.0, REAL, AP, Setting.RETURN_SPEED, 5.0),
        ("FENCE_ALT_MIN", -10.0, REAL, AP, Setting.FENCE_FLOOR, -10.0),
        ("RTL_ALT", 0.0, INT32, AP, Setting.RETURN_HEIGHT, 0.0),
        ("BATT_FS_LOW_ACT", 2.0, INT8, AP, Setting.LOW_BATTERY, 2.0),
        ("RTL_RETURN_ALT", 60.0, REAL, PX4, Setting.RETURN_HEIGHT, 60.0),
        ("COM_LOW_BAT_ACT", bytewise(3), INT32, PX4, Setting.LOW_BATTERY, 3.0),
        ("NAV_DLL_ACT", bytewise(2), INT32, PX4, Setting.NO_STATION, 2.0),
    ],
)
def test_a_setting_is_read_in_its_unit(name, value, kind, autopilot, setting, si):
    found = said(name, value, kind, autopilot)
    assert found is not None and found[0] is setting and found[1].name == name
    assert found[1].value == pytest.approx(si)


@pytest.mark.parametrize(
    ("name", "value", "kind", "autopilot"),
    [
        ("MPC_XY_VEL_MAX", 12.0, REAL, AP), ("WP_SPD", float("nan"), REAL, AP), ("WP_SPD", 0.0, REAL, AP),
        ("RTL_ALT_M", -5.0, REAL, AP), ("COM_LOW_BAT_ACT", bytewise(-1), INT32, PX4), ("PILOT_SPD_UP", 2.5, REAL, AP),
    ],
)  # fmt: skip
def test_other_parameters_and_values_without_a_meaning_are_not_taken(name, value, kind, autopilot):
    assert said(name, value, kind, autopilot) is None


def test_what_a_vehicle_does_is_in_words():
    assert [SetTo("COM_LOW_BAT_ACT", value).action for value in (0.0, 2.0)] == ["", "lands"]
    assert SetTo("BATT_FS_LOW_ACT", 42.0).action == "does what BATT_FS_LOW_ACT 42 says"


def items_of(world, wanted):
    check = preflight(world.fleet.vehicles[1], wanted, world.clock.now)
    return {item.name: item for item in check.items}


@BOTH
def test_a_way_home_through_the_ground_is_red(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    vehicle, high = world.fleet.vehicles[1], Wanted(needs=PlanNeeds(return_height_m=40.0))
    assert items_of(world, high)["return"].level is Level.WARNING  # it has not been asked yet
    world.finish(world.fleet.download(1))
    world.wait(1.0)
    name = "RTL_ALT" if autopilot is AP else "RTL_RETURN_ALT"
    found = items_of(world, high)["return"]
    assert found.level is Level.RED and f"15 m above home, or current if higher ({name})" in found.reason
    native = "4000" if autopilot is AP else "40"  # RTL_ALT counts centimetres
    assert "needs 40 m" in found.reason and f"set {name} to {native}" in found.reason
    assert items_of(world, Wanted(needs=PlanNeeds(return_height_m=15.0)))["return"].level is Level.OK
    assert items_of(world, Wanted())["return"].level is Level.OK
    vehicle.settings[Setting.RETURN_HEIGHT] = SetTo(name, 0.0)
    assert items_of(world, high)["return"].level is Level.RED  # from a valley it would fly straight into the hill


def set_up(make_world, autopilot, parameters):
    """A world with a vehicle that has these parameters, and has told them."""
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.vehicles[1].parameters |= parameters
    world.meet()
    world.finish(world.fleet.download(1))
    assert world.until(lambda: world.fleet.vehicles[1].ready_to_check, 30.0)
    return world


@pytest.mark.parametrize(
    ("autopilot", "parameters", "words"),
    [
        (AP, {"RTL_ALT_TYPE": 1}, "at a height above the ground below it, where it knows that (RTL_ALT_TYPE is 1)"),
        (AP, {"RALLY_TOTAL": 2}, "may return to one of its 2 rally points (RALLY_TOTAL)"),
        (PX4, {"RTL_TYPE": 2}, "along the way of its mission (RTL_TYPE is 2)"),
        (PX4, {"RTL_TYPE": 3}, "to the nearest of home, its mission's landing and rally points (RTL_TYPE is 3)"),
        (PX4, {"RTL_TYPE": 9}, "returns as RTL_TYPE 9 says"),
    ],
)
def test_a_way_home_that_is_not_straight_to_it_is_warned_about(make_world, autopilot, parameters, words):
    world = set_up(make_world, autopilot, parameters)
    for wanted in (Wanted(), Wanted(needs=PlanNeeds(return_height_m=10.0))):
        found = items_of(world, wanted)["return"]
        assert found.level is Level.WARNING and words in found.reason, found


@pytest.mark.parametrize(
    ("autopilot", "parameters", "level"),
    [
        (AP, {"RTL_ALT_TYPE": 1, "RTL_ALT": 1500}, Level.RED),  # above home where it does not know the ground
        (PX4, {"RTL_TYPE": 1, "RTL_RETURN_ALT": 30.0}, Level.RED),  # straight home, for want of a landing
        (PX4, {"RTL_TYPE": 2, "RTL_RETURN_ALT": 30.0}, Level.WARNING),  # back along its mission
    ],
)
def test_a_way_home_that_may_be_straight_is_not_too_low(make_world, autopilot, parameters, level):
    world = set_up(make_world, autopilot, parameters)
    found = items_of(world, Wanted(needs=PlanNeeds(return_height_m=60.0)))["return"]
    assert found.level is level and "TYPE is" in found.reason and "needs 60 m" in found.reason, found


def test_a_fence_that_keeps_the_way_home_below_what_the_ground_needs_is_red(make_world):
    world = make_world(SimVehicle(system=1))
    world.vehicles[1].parameters |= {"RTL_ALT": 6000, "FENCE_ALT_MAX": 50.0}
    world.meet()
    needs = Wanted(needs=PlanNeeds(return_height_m=55.0))
    for kept, level in ((0, Level.OK), (1, Level.RED)):
        world.vehicles[1].parameters["FENCE_ENABLE"] = kept
        world.finish(world.fleet.download(1))
        assert world.until(lambda: world.fleet.vehicles[1].ready_to_check, 30.0)
        found = items_of(world, needs)["return"]
        assert found.level is level, found
    assert "no higher than 48 m" in found.reason and "set FENCE_ALT_MAX to 57" in found.reason


@BOTH
def test_a_vehicle_that_does_nothing_at_a_low_battery_is_warned_about(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    world.finish(world.fleet.download(1))
    world.wait(1.0)
    vehicle = world.fleet.vehicles[1]
    name = "BATT_FS_LOW_ACT" if autopilot is AP else "COM_LOW_BAT_ACT"
    assert items_of(world, Wanted())["failsafe"].level is Level.OK
    del vehicle.settings[Setting.LOW_BATTERY]  # one that does not answer
    found = items_of(world, Wanted())["failsafe"]
    assert (
        found.level is Level.WARNING
        and "has not said" in found.reason
        and "without a ground station it goes on" in found.reason
    )
    vehicle.settings[Setting.LOW_BATTERY] = SetTo(name, 0.0)
    assert items_of(world, Wanted())["failsafe"].level is Level.WARNING
    vehicle.settings[Setting.LOW_BATTERY] = SetTo(name, 2.0)
    assert items_of(world, Wanted())["failsafe"].level is Level.OK


def test_each_autopilot_is_asked_for_every_setting_each_time_that_its_mission_is_read(make_world):
    assert {parameter.setting for parameters in PARAMETERS.values() for parameter in parameters} == set(Setting)
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.meet()
    vehicle = world.fleet.vehicles[1]
    for height_m in (30.0, 10.0):  # changed by another station in between
        world.vehicles[1].parameters["RTL_ALT"] = 100.0 * height_m
        world.finish(world.fleet.download(1))
        world.wait(1.0)
        assert vehicle.settings[Setting.RETURN_HEIGHT] == SetTo("RTL_ALT", height_m, 0.01)


def test_what_a_vehicle_was_set_to_before_its_restart_does_not_count(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.meet()
    world.finish(world.fleet.download(1))
    world.wait(20.0)
    vehicle, needs = world.fleet.vehicles[1], Wanted(needs=PlanNeeds(return_height_m=10.0))
    assert items_of(world, needs)["return"].level is Level.OK
    world.vehicles[1].parameters["RTL_ALT"] = 500.0
    world.vehicles[1].reboot(world.clock.now)
    assert world.until(lambda: any(event.kind == "rebooted" for event in world.events), 30.0)
    assert not vehicle.settings and items_of(world, needs)["return"].level is Level.WARNING
    world.finish(world.fleet.download(1))
    world.wait(1.0)
    assert items_of(world, needs)["return"].level is Level.RED


@BOTH
def test_a_mission_that_goes_on_without_a_ground_station_is_said(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    names, bit = {AP: ("FS_GCS_ENABLE", "FS_OPTIONS"), PX4: ("NAV_DLL_ACT", "COM_DLL_EXCEPT")}[autopilot], 0
    for bit, said in ((2 if autopilot is AP else 1, True), (16 if autopilot is AP else 2, False)):
        world.vehicles[1].parameters |= {names[0]: 2, names[1]: bit}
        world.finish(world.fleet.download(1))
        world.wait(1.0)
        reason = items_of(world, Wanted())["failsafe"].reason
        assert "without a ground station it returns" in reason and (f"not on a mission ({names[1]})" in reason) is said


def test_a_plan_says_what_it_needs(tmp_path):
    assert plan_needs(tmp_path) == PlanNeeds()
    report = {"endurance_min": 18.0, "over_ground": {"return_height_m": 52.0}}
    (tmp_path / "plan.json").write_text(json.dumps(report))
    assert plan_needs(tmp_path) == PlanNeeds(endurance_s=1080.0, return_height_m=52.0)
    (tmp_path / "plan.json").write_text(json.dumps({"endurance_min": None, "over_ground": None}))
    assert plan_needs(tmp_path) == PlanNeeds()
    for report, apart in (
        ({"separation_m": 4.0, "height_step_m": 5}, Apart(4.0, 5.0)),
        ({"separation_m": None, "height_step_m": 5.0}, None),
        ({"separation_m": -4.0, "height_step_m": 5.0}, None),
    ):
        (tmp_path / "plan.json").write_text(json.dumps(report))
        assert plan_needs(tmp_path).apart == apart
    for config in ({"planning": {"launch_s": 9.0}, "px4": {"takeoff_s": 8.0}}, {}):
        (tmp_path / "plan.json").write_text(json.dumps({"config": config}))
        assert plan_needs(tmp_path).config == config_of(config)
    (tmp_path / "plan.json").write_text(json.dumps({"endurance_min": 18.0, "config": {"bundle": {"former": 1}}}))
    assert plan_needs(tmp_path) == PlanNeeds(endurance_s=1080.0)
    (tmp_path / "plan.json").write_text("[]")
    assert plan_needs(tmp_path) == PlanNeeds()


def test_the_page_has_a_name_for_each_item():
    root = Path(__file__).resolve().parents[3]
    words = (root / "gcs_plugin/web/static/core/english.js").read_text(encoding="utf-8")
    assert set(re.findall(r'"preflight\.item\.([a-z-]+)"', words)) == set(ITEMS)
