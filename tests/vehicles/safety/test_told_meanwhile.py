"""What a vehicle says while a command is repeated, a mission rests or a start is given counts at once: one case each.

They are the shortest of what `test_two_stations` found.
"""

import pytest

from gcs_plugin.fleet.commands import Order
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.links.packets import Framer
from gcs_plugin.mission.completion import CompletionDetector, MissionEvent
from gcs_plugin.mission.exchange import Address
from gcs_plugin.mission.start_dialogue import LastLook
from gcs_plugin.sim.mission_flight import MissionState
from gcs_plugin.sim.simulated_swarm import NO_FAULTS, Faults
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from tests.kit.vehicles.memory_link import World
from tests.vehicles.safety.two_stations import ARM, CURRENT, HOME, SET_MODE, START, OtherStation, short_mission

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
BOTH = pytest.mark.parametrize("autopilot", [AP, PX4])
SILENT = Faults(loss=1.0)
OPEN = []


class Pair:
    """A vehicle, our station and another one; `sent` are the commands of ours with their times."""

    def __init__(self, autopilot, shared=False, **mission):
        self.sim = SimVehicle(system=1, autopilot=autopilot)
        self.world = World([self.sim])
        OPEN.append(self.world)
        self.other, self.flight, self.fleet = OtherStation(self.world, shared), self.sim.flight, self.world.fleet
        self.modes, self.sent, self.heard = self.flight.modes, [], []
        put = self.world.link.send

        def send(peer, data, expires=0.0):
            for packet in Framer().feed(data):
                if packet.message.get_type() == "COMMAND_LONG":
                    self.sent.append((self.world.clock.now, int(packet.message.command)))
            return put(peer, data, expires)

        self.world.link.send = send
        self.world.meet()
        self.mission = short_mission(self.sim, **mission)
        assert self.world.finish(self.fleet.upload(1, self.mission))[0].ok
        self.world.wait(1.5)

    def give(self, verb):
        return self.fleet.order(Order(verb=verb, system=1, given_s=self.world.clock.now))

    def until(self, done, limit_s=120.0):
        assert self.world.until(done, limit_s)

    def lost_on_its_way(self, command, verb):
        """Our command is given and lost; from then on nothing of ours reaches the vehicle."""
        count, order = len(self.sent), self.give(verb)
        self.until(lambda: any(sent == command for _, sent in self.sent[count:]), 20.0)
        self.world.link.up.take(1e9)
        self.world.link.up.faults = SILENT
        return order

    def link_is_back(self, after_s):
        self.world.wait(after_s)
        self.world.link.up.faults = NO_FAULTS

    def fly(self):
        self.give("start")
        self.until(lambda: self.flight.motion.north > 10.0)


@pytest.fixture(autouse=True)
def close_worlds():
    yield
    while OPEN:
        OPEN.pop().fleet.close()


@pytest.mark.parametrize("shown", ["by its heartbeat", "by its answer"])
@pytest.mark.parametrize(
    ("autopilot", "command"), [(AP, SET_MODE), (AP, ARM), (AP, START), (PX4, ARM), (PX4, START)], ids=str
)
def test_a_start_ends_when_another_station_stops_the_vehicle_amid_a_command(autopilot, command, shown):
    pair = Pair(autopilot, shared=shown == "by its answer")
    pair.lost_on_its_way(command, "start")
    if shown == "by its answer":
        pair.other.mode(pair.sim, pair.flight.mode)  # a hold, or what it is in: no heartbeat tells
    else:
        pair.other.command(pair.sim, HOME)
    mode = pair.flight.mode
    pair.link_is_back(0.3 if autopilot is AP or shown == "by its answer" else 1.1)
    pair.world.wait(15.0)
    assert pair.flight.mode == mode and pair.flight.motion.up < 0.1


@BOTH
def test_arming_ends_when_the_vehicle_is_put_back_into_the_mode_that_it_stood_in(autopilot):
    pair = Pair(autopilot)
    pair.other.command(pair.sim, HOME)  # it stands in RTL, from its last flight
    pair.world.wait(2.0)
    pair.lost_on_its_way(ARM, "start")
    pair.world.wait(0.1)
    assert pair.flight.mode == pair.modes.ready
    pair.other.command(pair.sim, HOME)
    pair.until(lambda: pair.fleet.vehicles[1].custom_mode == pair.modes.rtl)
    told, pair.world.link.up.faults = pair.world.clock.now, NO_FAULTS
    pair.world.wait(8.0)
    assert all(at <= told for at, command in pair.sent if command == ARM)
    assert pair.flight.mode == pair.modes.rtl and not pair.flight.armed


def test_arming_is_not_repeated_on_what_was_heard_over_a_second_ago():
    pair, beats = Pair(AP), []
    for channel in (pair.world.link.up, pair.world.link.down):
        channel.faults = Faults(delay_s=(0.1, 0.1))
    pair.fleet.subscribe(lambda vehicle, message, utc: beats.append(pair.world.clock.now), "HEARTBEAT")
    pair.give("start")
    pair.until(lambda: pair.fleet.vehicles[1].custom_mode == pair.modes.ready)
    say = pair.world.link._say
    pair.world.link._say = lambda peer, messages, now: say(
        peer, [m for m in messages if m.get_type() not in ("HEARTBEAT", "COMMAND_ACK")], now
    )
    pair.until(lambda: any(command == ARM for _, command in pair.sent), 5.0)
    pair.sim.arms = False
    pair.world.wait(5.0)
    assert max(at for at, command in pair.sent if command == ARM) <= beats[-1] + 1.05


@BOTH
def test_a_vehicle_that_shows_its_place_seldom_is_asked_for_it(autopilot):
    pair = Pair(autopilot)
    pair.sim.withheld = {int(dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT)}
    pair.give("start")
    pair.until(lambda: pair.flight.armed, 10.0)


def test_a_refused_arming_is_not_repeated_many_times_a_second():
    pair = Pair(AP)
    pair.sim.arms = False
    order = pair.give("start")
    pair.until(lambda: order.outcome is not None, 20.0)
    assert sum(command == ARM for _, command in pair.sent) <= 6


@BOTH
@pytest.mark.parametrize("shared", [False, True])
def test_a_command_to_go_on_is_not_repeated_after_a_return_was_shown(autopilot, shared):
    pair = Pair(autopilot, shared=shared)
    pair.fly()
    pair.other.mode(pair.sim, pair.modes.hold)
    pair.world.wait(6.0)
    pair.lost_on_its_way(SET_MODE, "resume")
    pair.other.command(pair.sim, HOME)
    pair.link_is_back(1.1)
    pair.world.wait(8.0)
    assert pair.flight.mode == pair.modes.rtl


@BOTH
def test_a_pause_does_not_count_as_a_silence_in_which_the_rest_may_have_been_flown(autopilot):
    pair = Pair(autopilot)
    pair.fly()
    pair.other.mode(pair.sim, pair.modes.hold)
    pair.world.wait(12.0)
    pair.other.mode(pair.sim, pair.modes.mission)
    pair.world.wait(2.0)
    pair.other.command(pair.sim, CURRENT, float(len(pair.mission.items) - 1))
    pair.until(lambda: not pair.flight.armed)
    pair.world.wait(3.0)
    assert "complete" not in pair.world.kinds(1) and "aborted" in pair.world.kinds(1)


@BOTH
def test_braking_from_a_descent_is_no_alarm(autopilot):
    pair = Pair(autopilot, height_m=30.0)
    pair.give("start")
    pair.until(lambda: pair.flight.motion.up > 25.0)
    pair.other.command(pair.sim, HOME)
    pair.until(lambda: pair.flight.motion.vu < -1.9)
    pair.world.wait(3.0)
    assert pair.world.finish(pair.fleet.pause(1))[0].ok
    pair.world.wait(8.0)
    assert "danger" not in [event.kind for event in pair.world.events]


def test_what_was_said_on_the_ground_is_no_alarm_in_the_air():
    """PX4 refuses a start right after an upload, and obeys the next one."""
    pair = Pair(PX4)
    assert pair.world.finish(pair.fleet.upload(1, short_mission(pair.sim, mirrored=True)))[0].ok
    pair.give("start")
    pair.until(lambda: pair.flight.motion.up > 5.0)
    assert any("denied" in event.text for event in pair.world.events)
    assert "danger" not in [event.kind for event in pair.world.events]


def test_in_the_air_a_start_ends_when_another_station_stops_the_vehicle_before_it_is_armed():
    pair = Pair(AP)
    pair.fly()
    pair.other.mode(pair.sim, pair.modes.hold)
    pair.world.wait(6.0)
    pair.lost_on_its_way(CURRENT, "start")
    pair.other.command(pair.sim, HOME)
    pair.world.wait(0.2)
    pair.other.mode(pair.sim, pair.modes.ready)
    pair.link_is_back(0.1)
    pair.world.wait(8.0)
    assert pair.flight.mode == pair.modes.ready


@BOTH
def test_a_vehicle_that_is_carried_away_while_it_is_being_armed_stays_down(autopilot):
    pair = Pair(autopilot)
    pair.lost_on_its_way(ARM, "start")
    pair.flight.motion.north += 30.0
    pair.link_is_back(0.3)
    pair.world.wait(15.0)
    assert not pair.flight.armed


def test_a_mission_that_was_replaced_unseen_by_one_of_as_many_items_is_not_complete():
    """ArduPilot flies on at the same item, and reaches it elsewhere."""
    pair = Pair(AP, ending="waypoint")
    pair.fly()
    pair.until(lambda: pair.flight.motion.east > 8.0)
    for _ in pair.other.upload(pair.sim, short_mission(pair.sim, mirrored=True, ending="waypoint")):
        pass
    pair.until(lambda: pair.flight.state is MissionState.COMPLETE)
    pair.world.wait(8.0)
    assert "complete" not in pair.world.kinds(1)


@BOTH
def test_a_mission_that_was_stored_in_flight_is_not_complete_where_it_was_flown_from_its_middle(autopilot):
    """It is read only after it was seen to be flown: the link loses packets, and reading takes a while."""
    vehicle = SimVehicle(system=1, autopilot=autopilot)
    first, events = int(autopilot is AP), []
    mission, other = (short_mission(vehicle, mirrored=m, ending="waypoint") for m in (False, True))
    detector, mode = CompletionDetector(autopilot=autopilot), vehicle.flight.modes.mission
    disarmed, armed = (dialect.MAVLink_heartbeat_message(2, 3, 81 | flag, mode, 4, 3) for flag in (0, 128))

    def current(seq, state=3):
        return dialect.MAVLink_mission_current_message(seq + first, 6, state, 1)

    def feed(*messages):
        for message in messages:
            events.extend(detector.feed(message))

    detector.uploaded(mission)
    feed(disarmed, armed, armed, current(0), current(0), current(2), current(3))
    feed(dialect.MAVLink_mission_request_int_message(254, 190, 0, 0), current(3), current(3), current(3))
    detector.knows_mission(other)
    for seq, item in enumerate(other.items[3 + first :], 3):
        place = dialect.MAVLink_global_position_int_message(1000 * seq, item.x, item.y, 0, 8000, 0, 0, 0, 0)
        feed(current(seq), place, dialect.MAVLink_mission_item_reached_message(seq + first), place)
    feed(current(5, 5), place, place)
    assert events == [MissionEvent.STARTED, MissionEvent.ABORTED, MissionEvent.STARTED, MissionEvent.ABORTED]


def test_a_look_ends_when_a_vehicle_that_was_armed_is_disarmed_amid_it():
    """One that was told to start in the air has landed."""
    modes = SimVehicle(system=1).flight.modes
    look = LastLook(Address(1), modes=modes, mode=modes.ready, armed=True, place=(47.0, 8.0))
    look.start(0.0)
    for at, flag in ((0.1, 128), (0.6, 0)):
        look.feed(dialect.MAVLink_heartbeat_message(2, 3, 81 | flag, modes.ready, 4, 3), at)
    look.feed(dialect.MAVLink_global_position_int_message(1000, 470000000, 80000000, 0, 0, 0, 0, 0, 0), 0.7)
    assert look.outcome is not None and not look.outcome.ok


def test_going_on_ends_when_the_vehicle_answers_another_station_that_sends_it_home():
    """Its heartbeat may come a second later."""
    pair = Pair(PX4, shared=True)
    pair.fly()
    pair.other.mode(pair.sim, pair.modes.hold)
    pair.world.wait(6.0)
    beats = []
    pair.fleet.subscribe(lambda *_: beats.append(1), "HEARTBEAT")
    pair.until(lambda: beats)  # the next one comes in a second
    pair.lost_on_its_way(SET_MODE, "resume")
    pair.other.command(pair.sim, HOME)
    pair.world.wait(0.1)
    told = pair.world.clock.now
    pair.link_is_back(0.0)
    pair.world.wait(8.0)
    assert SET_MODE not in [command for at, command in pair.sent if at > told]


def test_a_place_that_was_passed_between_two_messages_about_the_present_item_counts():
    vehicle = SimVehicle(system=1, autopilot=AP)
    mission, detector, events = short_mission(vehicle), CompletionDetector(autopilot=AP), []
    heartbeat = dialect.MAVLink_heartbeat_message(2, 3, 81 | 128, 3, 4, 3)
    places = [i for i in mission.items[1:] if i.command == 16]

    def feed(*messages):
        for message in messages:
            events.extend(detector.feed(message))

    detector.uploaded(mission)
    feed(heartbeat, heartbeat, *[dialect.MAVLink_mission_current_message(3, 6, 3, 1)] * 2)
    for second, place in enumerate(places):
        feed(dialect.MAVLink_global_position_int_message(1000 * second, place.x, place.y, 0, 8000, 0, 0, 0, 0))
    # MISSION_CURRENT of items 4 and 5 was lost, and so were all MISSION_ITEM_REACHED
    feed(dialect.MAVLink_mission_current_message(6, 6, 3, 1), dialect.MAVLink_mission_current_message(6, 6, 5, 1))
    feed(dialect.MAVLink_global_position_int_message(3000, places[2].x, places[2].y, 0, 8000, 0, 0, 0, 0))
    assert events == [MissionEvent.STARTED, MissionEvent.COMPLETE]
