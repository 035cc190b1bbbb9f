"""Vehicles that do not reach the speed of their plan: warned about before the start, and said in flight."""

from dataclasses import replace

import pytest

from gcs_plugin.fleet.preflight import Level, Wanted, preflight
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.items import CHANGE_SPEED, RTL, TAKEOFF, WAYPOINT, Mission, MissionItem
from gcs_plugin.sim.multirotor import Airframe, Chart
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.config import DEFAULT

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])
CHART = Chart(47.397742, 8.545594, 488.0)


def lines(autopilot, speed):
    """Three lines of 300 m."""

    def at(command, north, east):
        return MissionItem.at(command, *CHART.to_degrees(north, east), 30.0)

    items = [at(WAYPOINT, 0, 0)] if autopilot is AP else []
    items += [at(TAKEOFF, 0, 0), MissionItem.do(CHANGE_SPEED, 1, speed)]
    corners = [(20, 20), (20, 320), (60, 320), (60, 20), (100, 20), (100, 320)]
    items += [at(WAYPOINT, north, east) for north, east in corners]
    return Mission(autopilot, (*items, MissionItem.do(RTL)))


def flown(make_world, autopilot, top_m_s):
    """The world after a flight at 10 m/s as real autopilots fly, by a vehicle that reaches such a speed."""
    frame = replace(Airframe().as_flown(DEFAULT.times(autopilot.value)), top_m_s=top_m_s)
    world = make_world(SimVehicle(system=1, autopilot=autopilot, airframe=frame))
    world.meet()
    assert world.finish(world.fleet.upload(1, lines(autopilot, 10.0)))[0].ok
    assert world.finish(world.fleet.start(1))[0].ok
    assert world.until(lambda: "complete" in world.kinds(1), 400.0)
    world.wait(1.0)
    return world


@BOTH
def test_a_speed_that_it_is_not_set_up_for_is_warned_about(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()

    def speed(asked):
        mission = lines(autopilot, asked)
        assert world.finish(world.fleet.upload(1, mission))[0].ok
        world.finish(world.fleet.download(1))
        world.wait(1.0)
        check = preflight(world.fleet.vehicles[1], Wanted(mission=mission), world.clock.now)
        return next(item for item in check.items if item.name == "speed")

    most, name = (10.0, "WPNAV_SPEED") if autopilot is AP else (12.0, "MPC_XY_VEL_MAX")
    assert speed(most).level is Level.OK
    warning = speed(most + 2.0)
    assert warning.level is Level.WARNING
    assert f"asked for {most + 2.0:g} m/s" in warning.reason and f"{name} is {most:g} m/s" in warning.reason
    world.fleet.vehicles[1].settings.clear()  # one that does not answer
    assert "has not said" in next(
        i.reason for i in preflight(world.fleet.vehicles[1], Wanted(), world.clock.now).items if i.name == "speed"
    )


@BOTH
def test_a_vehicle_that_falls_behind_its_plan_is_said_once(make_world, autopilot):
    world = flown(make_world, autopilot, 6.0)
    said = [event for event in world.events if event.kind in ("behind", "caught_up")]
    assert [event.kind for event in said] == ["behind", "caught_up"]
    allowed_s = DEFAULT.times(autopilot.value).schedule_slack_s
    late_s = float(said[0].text.split(" s late")[0].split()[-1])
    assert allowed_s <= late_s <= allowed_s + 2.0
    assert f"up to {allowed_s:.0f} s" in said[0].text and "pause;" not in said[0].text


@BOTH
def test_a_vehicle_that_was_paused_is_late_by_order_until_it_is_late_besides(make_world, autopilot):
    frame = replace(Airframe().as_flown(DEFAULT.times(autopilot.value)), top_m_s=10.0)
    world = make_world(SimVehicle(system=1, autopilot=autopilot, airframe=frame))
    world.meet()
    fleet = world.fleet
    assert world.finish(fleet.upload(1, lines(autopilot, 10.0)))[0].ok
    assert world.finish(fleet.start(1))[0].ok
    assert world.until(lambda: fleet.vehicles[1].mission_seq >= 4, 100.0)
    assert world.finish(fleet.pause(1))[0].ok
    world.wait(60.0)
    assert world.finish(fleet.resume(1))[0].ok
    assert world.until(lambda: bool(fleet.behind(1)), 30.0)
    assert fleet.behind_ordered(1) and " s late after its pause; its plan" in fleet.behind(1)
    fleet._reception._lateness[1].paused_s -= 40.0  # as if it had stood for longer than it was told to
    assert not fleet.behind_ordered(1) and "after its pause" not in fleet.behind(1)


@BOTH
def test_a_vehicle_in_time_is_not(make_world, autopilot):
    world = flown(make_world, autopilot, 12.0)
    assert not [event for event in world.events if event.kind in ("behind", "caught_up")]


def test_one_that_was_paused_is_behind_as_it_goes_on(make_world):
    world = make_world(SimVehicle(system=1, airframe=Airframe().as_flown(DEFAULT.times("ardupilot"))))
    world.meet()
    assert world.finish(world.fleet.upload(1, lines(AP, 10.0)))[0].ok
    assert world.finish(world.fleet.start(1))[0].ok
    world.wait(35.0)
    world.finish(world.fleet.pause(1))
    world.wait(25.0)
    world.finish(world.fleet.resume(1))
    world.wait(3.0)
    assert [event.kind for event in world.events if event.kind in ("behind", "caught_up")] == ["behind"]
