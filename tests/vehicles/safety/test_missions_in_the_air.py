"""A mission that is given to a vehicle in the air: it flies nothing of it before its start, then from its first item.

ArduCopter keeps the number of the item at which it left a mission, though another one is stored since, and in AUTO it
flies what is stored under it at once (AP_Mission::resume, AP_Mission_ChangeDetector).
"""

import math

import pytest

from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.links.packets import Framer
from gcs_plugin.mission.exchange import Verdict
from gcs_plugin.mission.items import RTL, MissionItem
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.model.errors import OrthoSwarmError
from tests.vehicles.test_fleet import sent_by
from tests.vehicles.test_sim import mission

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])
END = MissionItem.do(RTL)


def under_way(make_world, autopilot):
    """A vehicle on the third leg of a mission; the item it flies has the number of the return of a shorter one."""
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    world.finish(world.fleet.upload(1, mission(autopilot, END, legs=4)))
    world.finish(world.fleet.start(1))
    last = len(mission(autopilot, END, legs=1)) - 1
    assert world.until(lambda: world.vehicles[1].flight.seq >= last, 200.0)
    world.wait(3.0)
    return world


@BOTH
def test_a_mission_given_to_a_paused_vehicle_moves_nothing_and_starts_at_its_first_item(make_world, autopilot):
    world = under_way(make_world, autopilot)
    (paused,) = world.finish(world.fleet.pause(1))
    world.wait(4.0)
    before = world.vehicles[1].flight.motion.seen
    (stored,) = world.finish(world.fleet.upload(1, mission(autopilot, END, legs=1)))
    world.wait(10.0)
    assert paused.ok and stored.ok
    assert world.vehicles[1].flight.motion.seen == pytest.approx(before, abs=1.0)

    with pytest.raises(OrthoSwarmError, match="has not begun the mission that it was given; start it"):
        world.fleet.resume(1)
    reached, flown = [], len(world.kinds(1))
    world.fleet.subscribe(lambda vehicle, message, utc: reached.append(message.seq), "MISSION_ITEM_REACHED")
    (started,) = world.finish(world.fleet.start(1))
    assert started.ok
    assert world.until(lambda: "complete" in world.kinds(1)[flown:], 200.0)
    assert reached[:3] == ([1, 3, 5] if autopilot is AP else [0, 2, 4])


@BOTH
def test_a_vehicle_that_returns_is_started_from_the_first_item_again(make_world, autopilot):
    world = under_way(make_world, autopilot)
    world.finish(world.fleet.rtl(1))
    world.wait(6.0)
    assert world.finish(world.fleet.start(1))[0].ok
    assert world.vehicles[1].flight.seq <= 3


def lose_modes(world):
    """Changes of mode do not arrive."""
    put = world.link.send

    def send(peer, data, expires=math.inf):
        (packet,) = Framer().feed(data)
        lost = getattr(packet.message, "command", 0) == dialect.MAV_CMD_DO_SET_MODE
        return lost or put(peer, data, expires)

    world.link.send = send
    return sent_by(world)


def test_a_vehicle_that_does_not_leave_its_missions_mode_is_sent_no_mission(make_world):
    world = under_way(make_world, AP)
    world.finish(world.fleet.pause(1))
    sent = lose_modes(world)
    (outcome,) = world.finish(world.fleet.upload(1, mission(AP, END, legs=1)))
    assert outcome.verdict is Verdict.UNKNOWN and "was sent no mission" in outcome.text
    assert "MISSION_COUNT" not in {message.get_type() for message in sent}


def test_a_command_to_return_ends_an_upload_that_still_changes_the_mode(make_world):
    world = under_way(make_world, AP)
    world.finish(world.fleet.pause(1))
    sent = lose_modes(world)
    upload = world.fleet.upload(1, mission(AP, END, legs=1))
    world.wait(0.3)
    (home,) = world.finish(world.fleet.rtl(1))
    until = len(sent)
    world.wait(8.0)
    assert home.ok and not upload.outcome.ok
    assert not [m for m in sent[until:] if getattr(m, "command", 0) == dialect.MAV_CMD_DO_SET_MODE]


@BOTH
def test_a_vehicle_on_the_ground_is_started_as_before(make_world, autopilot):
    world = make_world(SimVehicle(system=1, autopilot=autopilot))
    world.meet()
    world.finish(world.fleet.upload(1, mission(autopilot, END, legs=1)))
    sent = sent_by(world)
    world.finish(world.fleet.start(1))
    commands = [m.command for m in sent if m.get_type() == "COMMAND_LONG"]
    assert dialect.MAV_CMD_DO_SET_MISSION_CURRENT not in commands
    assert commands.index(dialect.MAV_CMD_COMPONENT_ARM_DISARM) < commands.index(dialect.MAV_CMD_MISSION_START)


@pytest.mark.parametrize("broken", [False, True])
def test_a_mission_that_is_being_stored_cannot_be_resumed(make_world, broken):
    """ArduPilot drops its old mission as the new one is announced: what it holds then is a mixture."""
    world = under_way(make_world, AP)
    world.finish(world.fleet.pause(1))
    upload = world.fleet.upload(1, mission(AP, END, legs=3))
    assert world.until(lambda: upload.announced, 20.0)
    if broken:
        upload.cancel("another request came in between")
        world.wait(1.0)
    with pytest.raises(OrthoSwarmError, match="has not begun the mission"):
        world.fleet.resume(1)


def test_the_change_of_mode_before_an_upload_does_not_wait_for_a_link(make_world):
    world = under_way(make_world, AP)
    world.finish(world.fleet.pause(1))
    world.wait(4.0)
    upload = world.fleet.upload(1, mission(AP, END, legs=1))
    assert upload.leaves_mode and upload.message_expires <= world.clock.now + 5.0
    assert world.until(lambda: upload.announced, 20.0)
    assert math.isinf(upload.message_expires)
