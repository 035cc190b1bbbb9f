"""Alarms about vehicles in the air that come near each other, and values that are no longer reported."""

import math

import pytest

from gcs_plugin.fleet.flight_state import summary
from gcs_plugin.fleet.preflight import Level, Wanted, preflight
from gcs_plugin.fleet.separation.separation_watch import SeparationWatch
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.exchange import Address
from gcs_plugin.sim.simulated_swarm import Faults
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from tests.vehicles.test_preflight import CHART, line

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])


def meeting(make_world, *, above_m=0.0, heights=(30.0, 30.0), down=None):
    """Two vehicles on one line; the second one stands 80 m east and `above_m` higher."""
    homes = [(*CHART.to_degrees(0.0, east), 488.0 + up) for east, up in ((0.0, 0.0), (80.0, above_m))]
    world = make_world(*(SimVehicle(system=s, home=home) for s, home in zip((1, 2), homes, strict=True)), down=down)
    world.meet()
    world.wait(3.0)
    loaded = [line(AP, 40, 80, home_east=80.0 * k, north=40.0, height=heights[k]) for k in (0, 1)]
    uploads = [world.fleet.upload(system, mission) for system, mission in zip((1, 2), loaded, strict=True)]
    assert all(outcome.ok for outcome in world.finish(*uploads))
    assert all(outcome.ok for outcome in world.finish(world.fleet.start(1), world.fleet.start(2)))
    return world


def near(world):
    return [event for event in world.events if event.kind == "near"]


def test_vehicles_at_one_altitude_are_an_alarm_though_their_heights_above_takeoff_differ(make_world):
    world = meeting(make_world, above_m=20.0, heights=(50.0, 30.0))
    closest = []

    def look():
        poses = [v.pose_at(v.flight.time_s) for v in world.vehicles.values()]
        (n, e), (n2, e2) = (CHART.to_metres(p.lat_deg, p.lon_deg) for p in poses)
        closest.append(math.dist((n, e, poses[0].alt_m), (n2, e2, poses[1].alt_m)))
        return bool(near(world))

    assert world.until(look, 60.0)
    assert min(closest) > 4.0  # it is said before


def test_vehicles_at_the_same_height_above_takeoffs_at_two_levels_are_an_alarm_too(make_world):
    """One of the two altitudes may be wrong."""
    world = meeting(make_world, above_m=20.0)
    assert world.until(lambda: bool(near(world)), 60.0)


@pytest.mark.parametrize("wrong_m", [-4.0, 4.0])
def test_vehicles_in_two_layers_are_no_alarm_because_their_receivers_differ_in_height(make_world, wrong_m):
    """They take off from one level; the second one's altitude is as wrong as receivers are."""
    world = meeting(make_world, above_m=wrong_m, heights=(30.0, 35.0))
    world.wait(60.0)
    assert near(world) == []


def test_an_alarm_does_not_end_because_a_link_is_lost(make_world):
    world = meeting(make_world)
    assert world.until(lambda: bool(near(world)), 60.0)
    said = len(world.events)
    world.link.down.faults = Faults(silent=((world.clock.now, world.clock.now + 9.0),))
    world.wait(8.0)
    since = [event for event in world.events[said:] if event.kind in ("near", "apart")]
    assert [event.kind for event in since] == ["near"] and "as v1 and v2 last said so" in since[0].text
    assert "not known" in world.fleet.separation.text(1) and "not known" in world.fleet.separation.text(2)
    assert world.until(lambda: world.events[-1].kind == "apart" or not world.fleet.separation.alarms, 240.0)


@BOTH
@pytest.mark.parametrize(("kind", "age"), [("SYS_STATUS", "battery_s"), ("GPS_RAW_INT", "gps_s")])
def test_battery_and_receiver_are_asked_for_again_and_have_an_age(make_world, autopilot, kind, age):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    world.wait(5.0)
    vehicle, number = world.fleet.vehicles[1], int(getattr(dialect, f"MAVLINK_MSG_ID_{kind}"))
    assert summary(vehicle, world.clock.now)[age] == 0
    silence = dialect.MAVLink_command_long_message(1, 1, 511, 0, float(number), -1.0, 0, 0, 0, 0, 0)

    def silent():  # another ground station wants none, again and again
        world.vehicles[1].handle(silence, Address(200, 190), world.clock.now)
        return False

    world.until(silent, 20.0, 0.1)
    row = summary(vehicle, world.clock.now)
    assert row[age] >= 18 and row["silent_s"] < 2.0
    check = preflight(vehicle, Wanted(), world.clock.now)
    assert any(item.name == age.removesuffix("_s") and "has not reported" in item.reason for item in check.red())
    world.wait(30.0)
    assert summary(vehicle, world.clock.now)[age] == 0


@BOTH
def test_a_vehicle_that_no_longer_says_where_it_is_is_not_taken_to_be_where_it_was(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot), SimVehicle(system=2, autopilot=autopilot))
    world.meet()
    world.wait(3.0)
    for vehicle in world.fleet.vehicles.values():  # side by side in the air
        vehicle.armed, vehicle.landed, vehicle.height_m = True, "in air", 30.0
    watch = SeparationWatch()
    new, _ = watch.look(world.fleet.vehicles.values(), world.clock.now)
    assert [near.silent for near in new] == [()]
    world.vehicles[1].withheld = {int(dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT)}  # PX4 without a global position
    world.wait(20.0)
    for vehicle in world.fleet.vehicles.values():
        vehicle.armed, vehicle.landed, vehicle.height_m = True, "in air", 30.0
    new, ended = watch.look(world.fleet.vehicles.values(), world.clock.now)
    assert [near.silent for near in new] == [(1,)] and not ended and not world.fleet.vehicles[1].lost
    assert "where they are now is not known, as v1 last said so" in watch.text(2)
    (gps,) = [i for i in preflight(world.fleet.vehicles[1], Wanted(), world.clock.now).items if i.name == "gps"]
    assert gps.level is Level.RED and "not reported its position for" in gps.reason
