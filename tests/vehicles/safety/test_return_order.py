"""Vehicles that return in turn keep apart on their ways home, and all of them come home."""

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcs_plugin.fleet.autopilot_settings import Setting, SetTo
from gcs_plugin.fleet.separation.return_order import ReturnOrder, aloft_of, apart, return_height_m
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.items import RTL, TAKEOFF, WAYPOINT, Mission, MissionItem
from gcs_plugin.sim.multirotor import Airframe, Chart
from gcs_plugin.sim.simulated_swarm import make_swarm

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
HOME = (47.397742, 8.545594, 488.0)
SPACING_M = 4.0


def outward(autopilot, place, height):
    """A mission that flies to a place (north, east of the first home) and back."""
    chart = Chart(*HOME)
    items = [MissionItem.at(WAYPOINT, *chart.to_degrees(0, 0), 0)] if autopilot is AP else []
    items += [MissionItem.at(TAKEOFF, *chart.to_degrees(0, 0), height)]
    items += [MissionItem.at(WAYPOINT, *chart.to_degrees(*place), height), MissionItem.do(RTL)]
    return Mission(autopilot, tuple(items))


CRAFT = Airframe(climb_m_s=8.0)


def flown_out(make_world, places, *, autopilots=(AP,), height=30.0, seconds=45.0, spacing_m=SPACING_M, airframe=CRAFT):
    """Vehicles of neighbouring starts on their ways to places, and their true positions as a function."""
    swarm = make_swarm(len(places), autopilots=autopilots, home=HOME, spacing_m=spacing_m, airframe=airframe)
    world = make_world(*swarm)
    world.meet()
    fleet = world.fleet
    world.until(lambda: all(v.prearm_ok and v.ekf_ok and v.home for v in fleet.vehicles.values()), 120.0)
    uploads = [
        fleet.upload(s, outward(fleet.vehicles[s].autopilot, p, height))
        for s, p in zip(fleet.vehicles, places, strict=True)
    ]
    assert all(outcome.ok for outcome in world.finish(*uploads))
    assert all(outcome.ok for outcome in world.finish(*(fleet.start(s) for s in fleet.vehicles)))
    world.wait(seconds)
    assert all(v.flying for v in fleet.vehicles.values())

    def positions():
        found = {}
        for k, vehicle in enumerate(swarm):
            motion = vehicle.flight.motion
            if motion.up > 2.0:
                found[vehicle.system] = (motion.north, motion.east + spacing_m * k, motion.up)
        return found

    return world, positions


def nearest(positions):
    """The least distance of two in the air that are less than 4 m apart in height."""
    pairs = itertools.combinations(positions.values(), 2)
    level = [math.dist(a[:2], b[:2]) for a, b in pairs if abs(a[2] - b[2]) < 4.0]
    return min(level, default=math.inf)


def come_home(world, positions, order=None, limit_s=900.0):
    """Fly until all have landed; the least distance of two on the way."""
    fleet, least, end = world.fleet, math.inf, world.clock.now + limit_s
    if order is None:
        world.finish(*(fleet.rtl(s) for s in fleet.vehicles))
    else:
        first = order.look(aloft_of(fleet.vehicles, world.clock.now))
        world.finish(*(fleet.rtl(s) for s in first), *(fleet.pause(s) for s in order.waits))
        for system in order.waits:
            order.holds(system)
    while positions() and world.clock.now < end:
        world.wait(1.0)
        least = min(least, nearest(positions()))
        if order is not None and order.waits:
            for system in order.look(aloft_of(fleet.vehicles, world.clock.now)):
                fleet.rtl(system)
    assert not positions(), "not all have come home"
    return least


def look(world, order):
    return order.look(aloft_of(world.fleet.vehicles, world.clock.now))


def go_on(world, order, seconds):
    """Send home those whose turn has come, once a second."""
    for _ in range(seconds):
        world.wait(1.0)
        for system in look(world, order):
            world.fleet.rtl(system)


def one_waits_holding(world):
    """Of two vehicles one returns and the other holds; gives their order and the one that holds."""
    order = ReturnOrder(world.fleet.vehicles, world.clock)
    (first,) = look(world, order)
    (held,) = order.waits
    world.finish(world.fleet.rtl(first), world.fleet.pause(held))
    order.holds(held)
    return order, held


FAN = [(600, 240 * (k - 2)) for k in range(6)]


@pytest.mark.parametrize("autopilots", [(AP,), (PX4,), (AP, PX4)], ids=["ardupilot", "px4", "mixed"])
def test_those_of_neighbouring_starts_keep_apart_on_their_ways_home(make_world, autopilots):
    world, positions = flown_out(make_world, FAN, autopilots=autopilots)
    assert come_home(world, positions) < 8.0  # all at once: as near as their starts, and nearer where ways cross
    world, positions = flown_out(make_world, FAN, autopilots=autopilots)
    order = ReturnOrder(world.fleet.vehicles, world.clock)
    assert come_home(world, positions, order) > 8.0
    assert not order.waits


def test_those_whose_ways_do_not_meet_return_at_once(make_world):
    world, _ = flown_out(make_world, FAN[:3], spacing_m=80.0)
    order = ReturnOrder(world.fleet.vehicles, world.clock)
    assert sorted(look(world, order)) == [1, 2, 3]
    assert not order.waits


def test_known_return_heights_let_more_return_at_a_time(make_world):
    world, _ = flown_out(make_world, FAN[:3])
    vehicles = world.fleet.vehicles

    def at_once(*heights):
        for vehicle, height_m in zip(vehicles.values(), heights, strict=True):
            vehicle.settings[Setting.RETURN_HEIGHT] = SetTo("RTL_ALT", height_m)
        return len(ReturnOrder(vehicles, world.clock).look(aloft_of(vehicles, world.clock.now)))

    # They come down at one place at one time all the same: one after the other, but for the lowest.
    assert at_once(40.0, 40.0, 40.0) <= at_once(40.0, 80.0, 120.0)
    assert at_once(40.0, 80.0, 120.0) >= 2


def test_whoever_must_not_wait_returns_at_once(make_world):
    world, _ = flown_out(make_world, FAN)
    vehicles = world.fleet.vehicles
    order = ReturnOrder(vehicles, world.clock)
    order.look(aloft_of(vehicles, world.clock.now))
    low, lost, unknown = sorted(order.waits)[:3]
    vehicles[low].battery = 0.05
    vehicles[lost].lost = True
    vehicles[unknown].home = vehicles[unknown].launch = None
    assert {low, lost, unknown} <= set(order.look(aloft_of(vehicles, world.clock.now)))
    assert not {low, lost, unknown} & order.waits.keys()


def test_one_that_was_given_another_command_waits_no_longer(make_world):
    world, positions = flown_out(make_world, FAN)
    order = ReturnOrder(world.fleet.vehicles, world.clock)
    look(world, order)
    held = sorted(order.waits)[-1]
    assert order.drop(held) and not order.drop(held)
    world.finish(*(world.fleet.pause(s) for s in (held, *order.waits)))
    go_on(world, order, 400)
    assert set(positions()) == {held}


@pytest.mark.parametrize(
    ("autopilot", "shown"), [(AP, "has left the place where it held"), (PX4, "its mode is MISSION")]
)
def test_one_that_another_station_or_a_remote_control_commands_waits_no_longer(make_world, autopilot, shown):
    world, _ = flown_out(make_world, FAN[:2], autopilots=(autopilot,))
    order, held = one_waits_holding(world)
    for _ in range(8):
        world.wait(1.0)
        assert look(world, order) == [] and not order.left
    world.finish(world.fleet.resume(held))
    world.wait(4.0)
    assert look(world, order) == [] and order.over
    assert shown in order.left[held]


@pytest.mark.parametrize(("autopilot", "mode"), [(AP, 5), (PX4, 3 << 16)], ids=["LOITER", "POSCTL"])
def test_a_pilot_who_takes_over_as_soon_as_it_holds_keeps_the_aircraft(make_world, autopilot, mode):
    world, _ = flown_out(make_world, FAN[:2], autopilots=(autopilot,))
    order, held = one_waits_holding(world)
    world.wait(1.0)
    world.vehicles[held].flight.set_mode(mode)
    for _ in range(8):
        world.wait(1.0)
        look(world, order)
    assert held not in order.waits and order.over


@pytest.mark.parametrize("accel_m_s2", [2.5, 1.0])
def test_one_that_brakes_slowly_keeps_its_turn(make_world, accel_m_s2):
    craft = Airframe(speed_m_s=12.0, climb_m_s=8.0, accel_m_s2=accel_m_s2)
    world, _ = flown_out(make_world, FAN[:2], airframe=craft)
    order, _ = one_waits_holding(world)
    for _ in range(20):
        world.wait(1.0)
        look(world, order)
        assert not order.left


def test_one_that_did_not_acknowledge_has_its_turn_again(make_world):
    world, _ = flown_out(make_world, FAN[:2])
    order = ReturnOrder(world.fleet.vehicles, world.clock)
    (sent,) = look(world, order)
    (held,) = order.waits
    assert order.waits[held] == (sent,)
    order.again(sent)
    world.wait(1.0)
    assert look(world, order) == [sent]


def test_nobody_is_sent_through_one_that_the_operator_holds(make_world):
    world, positions = flown_out(make_world, [(600, 0), (600, 0)])
    order = ReturnOrder(world.fleet.vehicles, world.clock)
    (first,) = look(world, order)
    (second,) = order.waits
    world.finish(world.fleet.rtl(first), world.fleet.pause(second))
    world.wait(10.0)
    world.finish(world.fleet.pause(first))  # as the alarm of nearness proposes
    order.drop(first)
    for _ in range(120):
        world.wait(1.0)
        assert look(world, order) == []
    assert order.waits[second] == (first,)
    world.fleet.rtl(first)
    go_on(world, order, 240)
    assert not positions() and order.over


def test_one_that_was_lost_has_its_turn_when_it_is_heard_again(make_world):
    world, positions = flown_out(make_world, FAN[:2])
    order = ReturnOrder(world.fleet.vehicles, world.clock)
    (first,) = look(world, order)
    (second,) = order.waits
    world.finish(world.fleet.rtl(first), world.fleet.pause(second))
    world.fleet.vehicles[second].lost = True
    assert look(world, order) == [second] and not order.waits and not order.over  # told blindly, and not heard
    world.fleet.vehicles[second].lost = False
    look(world, order)
    assert order.waits or order.over
    go_on(world, order, 300)
    assert not positions() and order.over


def test_one_that_sinks_on_a_mission_that_is_not_known_is_not_taken_for_landing(make_world):
    world, _ = flown_out(make_world, FAN[:1])
    vehicle = world.fleet.vehicles[1]
    vehicle.mission, vehicle.velocity_m_s = None, (0.0, 0.0, 2.0)
    assert not aloft_of(world.fleet.vehicles, world.clock.now)[1].goes_home
    vehicle.custom_mode = vehicle.modes.rtl
    assert aloft_of(world.fleet.vehicles, world.clock.now)[1].goes_home


@settings(max_examples=60)
@given(
    places=st.lists(st.tuples(st.floats(-200, 200), st.floats(-200, 200), st.floats(5, 80)), min_size=1, max_size=7),
    rtl_m=st.lists(st.floats(0, 80), min_size=7, max_size=7),
)
def test_whoever_sets_out_keeps_apart_from_those_that_fly_and_somebody_always_does(vehicle_at, places, rtl_m):
    vehicles = {k + 1: vehicle_at(k + 1, place, rtl_m[k]) for k, place in enumerate(places)}
    aloft = aloft_of(vehicles, 0.0)
    order = ReturnOrder(vehicles, lambda: 0.0)
    ready = order.look(aloft)
    assert ready
    assert set(ready) | order.waits.keys() == vehicles.keys() and not set(ready) & order.waits.keys()
    if len(ready) > 1:
        for one, other in itertools.combinations(ready, 2):
            assert apart(aloft[one].way, aloft[other].way)


@pytest.fixture(scope="module")
def vehicle_at():
    """Makes a vehicle in the air of the fleet's own kind: its place about the first home, its return height."""
    from tests.kit.vehicles.memory_link import World

    def make(system, place, rtl_m):
        with World(make_swarm(1, home=HOME)) as world:
            world.meet()
            vehicle = world.fleet.vehicles[1]
        chart = Chart(*HOME)
        vehicle.address = vehicle.address.__class__(system, 1)
        vehicle.home = chart.to_degrees(0.0, SPACING_M * system)
        vehicle.lat_deg, vehicle.lon_deg = chart.to_degrees(*place[:2])
        vehicle.height_m, vehicle.armed, vehicle.landed, vehicle.lost = place[2], True, "in air", False
        vehicle.settings[Setting.RETURN_HEIGHT] = SetTo("RTL_ALT", rtl_m)
        return vehicle

    return make


# -- what is assumed of a way home ------------------------------------------------------------------------------------


def aloft_at(make_world, autopilot, height_m, **settings):
    """A vehicle in the air, a way off its home, with these settings (in the parameter's own units)."""
    world, _ = flown_out(make_world, [(200.0, 0.0)], autopilots=(autopilot,), height=height_m)
    vehicle = world.fleet.vehicles[1]
    vehicle.settings |= {Setting[name]: SetTo(name, value) for name, value in settings.items()}
    return world, vehicle


@pytest.mark.parametrize(
    ("autopilot", "away_m", "settings", "expected_m"),
    [
        (AP, 100.0, {"RETURN_HEIGHT": 40.0}, 40.0),
        (AP, 10.0, {"RETURN_HEIGHT": 40.0}, 30.0),  # RTL_CONE_SLOPE is 3 if it is not told
        (AP, 15.0, {"RETURN_HEIGHT": 40.0, "RETURN_CONE": 2.5}, 37.5),
        (AP, 10.0, {"RETURN_HEIGHT": 40.0, "RETURN_CONE": 0.0}, 40.0),
        (AP, 100.0, {"RETURN_HEIGHT": 15.0, "RETURN_CLIMB": 10.0}, 40.0),
        (AP, 1.0, {"RETURN_HEIGHT": 15.0, "RETURN_CLIMB": 10.0}, 40.0),
        (PX4, 15.0, {"RETURN_HEIGHT": 60.0}, 60.0),
        (PX4, 15.0, {}, 60.0),
    ],
)
def test_the_height_of_the_way_home_is_the_autopilots(make_world, autopilot, away_m, settings, expected_m):
    _, vehicle = aloft_at(make_world, autopilot, 30.0)
    vehicle.settings = {Setting[name]: SetTo(name, value) for name, value in settings.items()}
    vehicle.height_m = 30.0
    assert return_height_m(vehicle, away_m) == pytest.approx(expected_m)


def test_a_way_home_takes_as_long_as_its_own_speed_does(make_world):
    world, vehicle = aloft_at(make_world, AP, 30.0, SPEED=10.0, RETURN_SPEED=0.0)
    fast = aloft_of(world.fleet.vehicles, world.clock.now)[1].way
    vehicle.settings[Setting.RETURN_SPEED] = SetTo("RTL_SPEED_MS", 2.0)
    slow = aloft_of(world.fleet.vehicles, world.clock.now)[1].way
    assert fast is not None and slow is not None and len(slow.places) > 1.5 * len(fast.places)


@pytest.mark.parametrize(("autopilot", "name"), [(AP, "RTL_ALT_TYPE"), (PX4, "RTL_TYPE")])
def test_heights_do_not_keep_apart_a_vehicle_that_returns_in_another_way(make_world, autopilot, name):
    world, vehicle = aloft_at(make_world, autopilot, 30.0, RETURN_HEIGHT=30.0)
    for kind, known in ((0.0, True), (1.0, False)):
        vehicle.settings[Setting.RETURN_TYPE] = SetTo(name, kind)
        assert aloft_of(world.fleet.vehicles, world.clock.now)[1].height_known is known


@pytest.mark.parametrize(("enabled", "top_m", "known"), [(1.0, 60.0, False), (1.0, 100.0, True), (0.0, 60.0, True)])
def test_heights_do_not_keep_apart_a_vehicle_whose_fence_keeps_its_way_lower(make_world, enabled, top_m, known):
    """Two with RTL_ALT 70 and 80 would both fly home at 58 m."""
    world, vehicle = aloft_at(make_world, AP, 30.0, RETURN_HEIGHT=80.0, FENCE=enabled, FENCE_KINDS=7.0, FENCE_TOP=top_m)
    assert aloft_of(world.fleet.vehicles, world.clock.now)[1].height_known is known
    vehicle.settings[Setting.RETURN_HEIGHT] = SetTo("RTL_ALT_M", 15.0)
    assert aloft_of(world.fleet.vehicles, world.clock.now)[1].height_known
