"""Several components behind one system id, several ports of one autopilot, several parts of one text."""

import pytest

from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.flight_state import summary
from gcs_plugin.fleet.preflight import Level, Wanted, preflight
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.exchange import Address
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from tests.kit.vehicles.memory_link import SimLink, VirtualClock

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
GENERIC, INVALID, ARDUPILOT = 0, 8, 3
TYPES = {name: int(getattr(dialect, f"MAV_TYPE_{name}")) for name in ("GENERIC", "ONBOARD_CONTROLLER", "ADSB", "ODID")}
COMPANION = 191


def heartbeat(kind, autopilot):
    return dialect.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)


def say(world, sender, message):
    raw = message.pack(sender)
    sender.seq = (sender.seq + 1) & 0xFF
    world.link.down.put((0, raw), world.clock.now)


@pytest.mark.parametrize(
    ("kind", "autopilot", "component"),
    [
        (TYPES["ONBOARD_CONTROLLER"], GENERIC, COMPANION), (TYPES["ONBOARD_CONTROLLER"], INVALID, COMPANION),
        (TYPES["ADSB"], GENERIC, 156), (TYPES["ODID"], GENERIC, 236), (TYPES["GENERIC"], GENERIC, 195),
    ],
)  # fmt: skip
def test_commands_go_to_the_autopilot_though_another_component_is_heard_first(make_world, kind, autopilot, component):
    world = make_world(SimVehicle(system=1, autopilot=AP))
    say(world, dialect.MAVLink(None, 1, component), heartbeat(kind, autopilot))
    world.meet()
    assert world.fleet.vehicles[1].address == Address(1, 1) and world.fleet.vehicles[1].autopilot is AP
    assert world.finish(world.fleet.rtl(1))[0].ok


def test_an_autopilot_with_another_component_id_is_a_vehicle_and_an_antenna_tracker_is_none(make_world):
    world = make_world(SimVehicle(system=1), SimVehicle(system=2, kind=int(dialect.MAV_TYPE_ANTENNA_TRACKER)))
    say(world, dialect.MAVLink(None, 3, 7), heartbeat(int(dialect.MAV_TYPE_QUADROTOR), ARDUPILOT))
    world.wait(5.0)
    assert sorted(world.fleet.vehicles) == [1, 3]


def test_a_vehicle_whose_autopilot_is_silent_is_lost_though_its_companion_is_heard(make_world):
    world = make_world(SimVehicle(system=1))
    world.meet()
    world.vehicles[1].reboot(world.clock.now, silence_s=1e6)
    companion = dialect.MAVLink(None, 1, COMPANION)
    for _ in range(8):
        say(world, companion, heartbeat(TYPES["ONBOARD_CONTROLLER"], INVALID))
        world.wait(1.0)
    vehicle = world.fleet.vehicles[1]
    (link,) = [item for item in preflight(vehicle, Wanted(), world.clock.now).items if item.name == "link"]
    assert vehicle.lost and link.level is Level.RED
    assert "lost" in [event.kind for event in world.events]


def test_the_faults_of_a_stream_are_counted_for_who_watches_its_link(make_world):
    world = make_world(SimVehicle(system=1))
    world.meet()
    none = {"lost_share": 0.0, "damaged": 0, "impossible": 0}
    assert summary(world.fleet.vehicles[1], world.clock.now)["faults"] == none
    sender = dialect.MAVLink(None, 1, 1)
    say(world, sender, dialect.MAVLink_global_position_int_message(1000, 950_000_000, 85_000_000, 0, 0, 0, 0, 0, 0))
    damaged = bytearray(heartbeat(int(dialect.MAV_TYPE_QUADROTOR), ARDUPILOT).pack(sender))
    damaged[-1] ^= 0xFF
    for _ in range(2):
        world.link.down.put((0, bytes(damaged)), world.clock.now)
    world.wait(1.0)
    faults = summary(world.fleet.vehicles[1], world.clock.now)["faults"]
    assert (faults["damaged"], faults["impossible"]) == (2, 1)


class TwoPorts:
    """One vehicle on two radios, each on a port of its own; the second one has its own packet counter."""

    def __init__(self):
        self.clock = VirtualClock()
        self.first, self.second = SimLink([SimVehicle(system=1)], self.clock), SimLink([], self.clock)
        self.events, self._packer = [], dialect.MAVLink(None, 1, 1)
        self.fleet = Fleet([self.first, self.second], clock=self.clock, wall=self.clock.utc)
        self.fleet.on_event(self.events.append)
        self._say, self.first._say = self.first._say, self._twice
        self.second.send = lambda peer, data, expires=0.0: True

    def _twice(self, peer, messages, now):
        self._say(peer, messages, now)
        for message in messages:
            if message.get_type() != "ATTITUDE":
                raw = message.pack(self._packer)
                self._packer.seq = (self._packer.seq + 1) & 0xFF
                self.second.down.put((0, raw), now)

    def wait(self, seconds):
        end = self.clock.now + seconds
        while self.clock.now < end:
            self.clock.now += 0.02
            self.fleet.poll(0.0)


@pytest.fixture
def two_ports():
    made = TwoPorts()
    yield made
    made.fleet.close()


def test_a_vehicle_on_two_serial_lines_has_no_losses_and_keeps_its_link(two_ports):
    two_ports.wait(60.0)
    assert two_ports.fleet.vehicles[1].missed == 0
    assert [event.kind for event in two_ports.events] == ["found"]


LONG = "Preflight Fail: Accelerometer 0 uncalibrated, calibrate it first"


def test_a_long_text_on_two_lines_is_said_once(two_ports):
    two_ports.wait(5.0)
    for at, text in enumerate((LONG, "short", LONG)):
        packers = (dialect.MAVLink(None, 1, 1), dialect.MAVLink(None, 1, 1))
        parts = [text[k : k + 50] for k in range(0, len(text), 50)]
        for number, part in enumerate(parts):
            for link, packer in zip((two_ports.first, two_ports.second), packers, strict=True):
                own = 3 + at if link is two_ports.first else 40 + at
                message = dialect.MAVLink_statustext_message(2, part.encode(), own, number)
                link.down.put((0, message.pack(packer)), two_ports.clock.now)
                two_ports.wait(0.1)
        two_ports.wait(2.0)
    said = [event.text for event in two_ports.events if event.kind == "text"]
    assert said == [f"vehicle 1 says: {text}" for text in (LONG, "short", LONG)]


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ([("a" * 50, 7, 0), ("a" * 50, 7, 0), ("b", 7, 1), ("b", 7, 1)], ["a" * 50 + "b"]),  # a loop in the network
        ([("a" * 50, 7, 0), ("b", 7, 2)], ["a" * 50 + "...b"]),
        ([("a" * 50, 7, 0)], ["a" * 50]),  # PX4 ends a text of 50 characters with nothing
        ([("a" * 50, 7, 0), ("b" * 50, 8, 0), ("c", 8, 1)], ["a" * 50, "b" * 50 + "c"]),
        ([("one", 0, 0), ("two", 0, 0)], ["one", "two"]),
    ],
)
def test_texts_are_joined_by_the_numbers_of_their_parts(make_world, parts, said):
    world = make_world(SimVehicle(system=1, autopilot=PX4))
    world.meet()
    packer = dialect.MAVLink(None, 1, 1)
    for text, number, part in parts:
        say(world, packer, dialect.MAVLink_statustext_message(6, text.encode(), number, part))
        world.wait(0.1)
    world.wait(3.0)
    assert [event.text.removeprefix("vehicle 1 says: ") for event in world.events if event.kind == "text"] == said
