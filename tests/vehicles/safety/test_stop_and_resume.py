"""Commands to stop while a start is under way, and vehicles that are not resumed because they return or land."""

import pytest

from gcs_plugin.fleet.commands import Order
from gcs_plugin.fleet.flight_state import Word, flight_state
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.exchange import Verdict
from gcs_plugin.sim.simulated_swarm import Faults
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from tests.vehicles.test_commands import end_of, flying, give
from tests.vehicles.test_fleet import END
from tests.vehicles.test_sim import mission

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])


@BOTH
@pytest.mark.parametrize("verb", ["pause", "rtl", "land"])
@pytest.mark.parametrize("after_s", [0.1, 0.3, 0.7, 1.1, 1.5, 1.9, 2.5])
def test_a_start_that_is_under_way_ends_with_a_command_to_stop(make_world, autopilot, verb, after_s):
    """Its mode change, arming or MISSION_START may be on the way to the vehicle at that moment."""
    world = make_world(SimVehicle(system=1, autopilot=autopilot), up=Faults(delay_s=(0.3, 0.3)))
    world.meet()
    assert world.finish(world.fleet.upload(1, mission(autopilot, END)))[0].ok
    start = give(world, "start", 1)
    world.wait(after_s)
    result = end_of(world, give(world, verb, 1))
    assert result.outcome is Verdict.DONE, result
    world.wait(20.0)
    flight, state = world.vehicles[1].flight, flight_state(world.fleet.vehicles[1])
    assert start.outcome is not None
    if verb == "pause" and flight.motion.up > 0.0:  # it had left the ground before
        assert flight.mode == flight.modes.hold or state.word is Word.PAUSED
    else:
        assert not flight.armed and state.word is not Word.ON_MISSION


def test_a_start_that_was_given_before_a_command_to_stop_is_void(make_world):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    world.meet()
    assert world.finish(world.fleet.upload(1, mission(AP, END)))[0].ok
    before = Order(verb="start", system=1, given_s=world.clock.now, stops=world.fleet.stops.get(1, 0))
    end_of(world, give(world, "pause", 1))  # refused, as it stands on the ground, but meant
    result = end_of(world, world.fleet.order(before))
    assert result.outcome is Verdict.NOT_SENT and "told to stop" in result.reason
    assert not world.vehicles[1].flight.armed


@BOTH
@pytest.mark.parametrize("verb", ["rtl", "land"])
def test_a_vehicle_that_returns_or_lands_is_not_resumed(make_world, autopilot, verb):
    world = flying(make_world, autopilot)
    assert end_of(world, give(world, verb, 1)).outcome is Verdict.DONE
    flight = world.vehicles[1].flight
    for word in ("just now", "returning" if verb == "rtl" else "landing", "landing"):
        result = end_of(world, give(world, "resume", 1))
        assert result.outcome is Verdict.REFUSED and word in result.reason
        assert flight.mode == getattr(flight.modes, verb)
        if word != "landing":
            world.wait(6.0)
        if word == "returning":
            world.until(lambda: flight_state(world.fleet.vehicles[1]).word is Word.LANDING, 120.0)
    world.until(lambda: not world.vehicles[1].flight.armed, 120.0)
    world.wait(2.0)
    result = end_of(world, give(world, "resume", 1))
    assert result.outcome is Verdict.REFUSED and "no pause" in result.reason
    assert flight.mode == getattr(flight.modes, verb)


@BOTH
def test_a_vehicle_that_was_paused_in_its_climb_is_resumed(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    assert world.finish(world.fleet.upload(1, mission(autopilot, END)))[0].ok
    start = give(world, "start", 1)
    assert world.until(lambda: world.fleet.vehicles[1].height_m > 2.0, 60.0)
    end_of(world, start)
    assert world.fleet.vehicles[1].height_m < 20.0
    assert end_of(world, give(world, "pause", 1)).outcome is Verdict.DONE
    result = end_of(world, give(world, "resume", 1))
    assert result.outcome is Verdict.DONE, result


@BOTH
@pytest.mark.parametrize("after_s", [0.0, 6.0])
def test_a_paused_vehicle_is_resumed(make_world, autopilot, after_s):
    world = flying(make_world, autopilot)
    assert end_of(world, give(world, "pause", 1)).outcome is Verdict.DONE
    world.wait(after_s)
    assert end_of(world, give(world, "resume", 1)).outcome is Verdict.DONE
    world.wait(6.0)
    assert flight_state(world.fleet.vehicles[1]).word is Word.ON_MISSION
