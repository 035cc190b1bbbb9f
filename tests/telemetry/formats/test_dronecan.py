"""DroneCAN over python-can and through MAVLink CAN_FRAME: the best source is used, loss and noise are borne."""

import socket
import threading
import time

import numpy as np
import pytest

from orthoswarm.model.errors import InputError
from telemetry.live.live_poses import LivePoses
from telemetry.samples.sample import Sample

can = pytest.importorskip("can")
pytest.importorskip("dronecan")

from telemetry.live.dronecan_bus import CanSource, open_bus  # noqa: E402
from tests.kit.can_node import GROUP, CanNode, attitude, camera_down, fix, fix2  # noqa: E402

T0 = 1_700_000_000.0


def fix_at(number: int, sigma_m=0.02, lat_deg=47.0):
    return fix2(lat_deg + 1e-5 * number, 8.25, 512.0, T0 + number / 10, sigma_m)


class Bus:
    """A CanSource on a virtual bus, with a clock that the test sets."""

    def __init__(self, name, poses=None):
        self.now = T0
        self.poses = poses or LivePoses("uav1", clock=lambda: self.now)
        self.source = CanSource(self.poses, clock=lambda: self.now)
        self.bus = open_bus(f"virtual:{name}")
        self.out = can.Bus(interface="virtual", channel=name)

    def take(self):
        while not self.bus.queue.empty():  # a read whose time ends among frames that are not for it leaves the others
            self.source.read(self.bus, 0.005)

    def send(self, node, message, now=None):
        self.now = self.now if now is None else now
        node.send(self.out, message)
        self.take()

    def close(self):
        self.bus.shutdown()
        self.out.shutdown()


@pytest.fixture
def wire(request):
    opened = Bus(request.node.name)
    yield opened
    opened.close()


def test_fixes_attitude_and_gimbal_come_from_a_bus(wire):
    node = CanNode()
    for number in range(100):
        wire.send(node, fix_at(number), T0 + number / 10)
        wire.send(node, attitude(30.0))
        wire.send(node, camera_down())
    assert wire.source.nodes() == {"42": {"received": 300, "lost": 0}}
    found = wire.poses.read(T0 + 5.05)
    assert found.sample.lat_deg == pytest.approx(47.0 + 50.5e-5, abs=1e-8)
    assert found.sample.altitude_m == pytest.approx(512.0)
    assert found.sample.sigma_m == pytest.approx(0.02, abs=1e-3)
    assert (found.sample.yaw_deg, found.sample.pitch_deg) == pytest.approx((30.0, -90.0), abs=0.2)
    assert found.origin == dict.fromkeys(("position", "flight_yaw", "angles"), "DroneCAN node 42")


def test_fixes_come_over_udp_multicast_between_foreign_packets():
    pytest.importorskip("msgpack")
    poses = LivePoses("uav1")
    number = 0
    source, stop, node = CanSource(poses, clock=lambda: T0 + number / 10), threading.Event(), CanNode()
    try:  # packets stay on this machine
        out = can.Bus(interface="udp_multicast", channel=GROUP, hop_limit=0)
        thread = threading.Thread(target=source.run, args=(f"udp_multicast:{GROUP}", stop))
        thread.start()
    except (OSError, can.CanError) as error:
        pytest.skip(f"no multicast here: {error}")
    end = time.monotonic() + 20.0
    while source.received < 3 and time.monotonic() < end:
        node.send(out, fix_at(number))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            stranger.sendto(b"no CAN frame", (GROUP, 43113))
        time.sleep(0.02)
        number += 1
    stop.set()
    thread.join(5.0)
    out.shutdown()
    assert source.received >= 3
    assert number < 100
    assert 47.0 <= poses.latest.lat_deg < 47.01


@pytest.mark.parametrize(("stated", "used"), [(0.02, "DroneCAN node 42"), (3.0, "MAVLink")])
def test_the_position_with_the_lower_stated_sigma_is_used(wire, stated, used):
    node = CanNode()
    for tenth in range(20):
        at = T0 + tenth / 10
        wire.poses.add(Sample(time_s=at, lat_deg=47.1, lon_deg=8.0, height_m=60.0 + tenth))
        wire.send(node, fix_at(tenth, stated), at)
    found = wire.poses.read(T0 + 0.55)
    assert found.origin["position"] == used
    assert (found.sample.lat_deg < 47.05) == (used != "MAVLink")
    assert found.sample.height_m == pytest.approx(65.5)  # the autopilot's, whichever position is used
    wire.poses.add(Sample(time_s=T0 + 30.0, lat_deg=47.1, lon_deg=8.0))
    assert wire.poses.at(T0 + 30.0).lat_deg == 47.1  # the receiver on the bus fell silent


def test_what_the_autopilots_receiver_states_is_compared(wire):
    dialect = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
    node = CanNode()
    raw = dialect.MAVLink_gps_raw_int_message(0, 6, 471000000, 80000000, 0, 0, 0, 0, 0, 12, h_acc=14)
    wire.poses.feed(raw, T0)
    for tenth in range(10):
        message = dialect.MAVLink_global_position_int_message(
            1000 + 100 * tenth, 471000000, 80000000, 572000, 60000, 0, 0, 0, 0
        )
        wire.poses.feed(message, T0 + tenth / 10)
        wire.send(node, fix_at(tenth, 0.5), T0 + tenth / 10)
    assert wire.poses.read(T0 + 0.5).origin["position"] == "MAVLink"


def test_of_two_receivers_the_better_one_is_used_and_the_other_when_it_falls_silent(wire):
    good, poor = CanNode(10), CanNode(11)
    for tenth in range(40):
        wire.send(poor, fix_at(tenth, 1.0, 47.5), T0 + tenth / 10)
        if tenth < 20:
            wire.send(good, fix_at(tenth, 0.02), T0 + tenth / 10)
    assert wire.poses.read(T0 + 1.0).origin["position"] == "DroneCAN node 10"
    assert wire.poses.read(T0 + 3.5).origin["position"] == "DroneCAN node 11"
    assert set(wire.source.nodes()) == {"10", "11"}


@pytest.mark.parametrize(("stated", "used"), [(0.5, "DroneCAN node 42"), (None, "MAVLink")])
def test_the_gimbal_with_the_lower_stated_sigma_is_used(wire, stated, used):
    for tenth in range(10):
        at = T0 + tenth / 10
        wire.poses.add(Sample(time_s=at, flight_yaw_deg=30.0, flight_pitch_deg=0.0, flight_roll_deg=0.0))
        wire.poses.add(Sample(time_s=at, yaw_deg=90.0, pitch_deg=-80.0, roll_deg=0.0))
        wire.send(CanNode(), camera_down(15.0, stated), at)  # a bus without an attitude of the airframe
    found = wire.poses.read(T0 + 0.5)
    assert found.origin["angles"] == used
    assert found.sample.yaw_deg == pytest.approx(45.0 if stated else 90.0, abs=0.2)


def test_an_exposure_takes_what_the_bus_knows_better(wire):
    dialect = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
    node = CanNode()
    for tenth in range(10):
        wire.send(node, attitude(30.0), T0 + tenth / 10)
        wire.send(node, fix_at(tenth))
        wire.send(node, camera_down(sigma_deg=0.5))
    feedback = dialect.MAVLink_camera_feedback_message(
        round((T0 + 0.5) * 1e6), 1, 0, 7, 471000000, 80000000, 512.0, 60.0, 0.0, 0.0, 99.0, 0.0, 0
    )
    event = wire.poses.feed(feedback, T0 + 0.6)
    assert event.sample.lat_deg == pytest.approx(47.00005, abs=1e-7)
    assert event.sample.yaw_deg == pytest.approx(30.0, abs=0.2)
    assert event.sample.height_m == 60.0


def test_the_older_fix_is_read_where_the_newer_is_missing(wire):
    node = CanNode()
    wire.send(node, fix(46.0, 8.25, 512.0), T0)
    assert wire.poses.latest.lat_deg == pytest.approx(46.0)
    wire.send(node, fix_at(1), T0 + 1)
    wire.send(node, fix(46.0, 8.25, 512.0), T0 + 2)
    assert wire.poses.latest.lat_deg == pytest.approx(47.00001)


@pytest.mark.parametrize("fd", [False, True])
def test_the_bus_comes_through_mavlink_too(fd):
    mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
    now = [T0]
    poses = LivePoses("uav1")
    source, node = CanSource(poses, clock=lambda: now[0]), CanNode(fd=fd)
    make, size = (mavlink.MAVLink_canfd_frame_message, 64) if fd else (mavlink.MAVLink_can_frame_message, 8)
    for number in range(200):
        now[0] = T0 + number / 10
        for identifier, data in node.frames(fix_at(number)):
            padded = list(data) + [0] * (size - len(data))
            source.feed(make(0, 0, 0, len(data), identifier | 0x80000000, padded))
    assert source.received == 200
    assert poses.latest.lat_deg == pytest.approx(47.0 + 199e-5)


def test_reading_ends_when_told_to():
    stop = threading.Event()
    source = CanSource(LivePoses("uav1"))
    thread = threading.Thread(target=source.run, args=("virtual:ends", stop))
    thread.start()
    stop.set()
    thread.join(5.0)
    assert not thread.is_alive()


def test_lost_frames_cost_their_messages_only_and_are_counted(wire):
    rng, node = np.random.default_rng(0), CanNode()
    for number in range(300):
        wire.now = T0 + number / 10
        kept = [m for m in node.messages(fix_at(number)) if rng.random() > 0.02]
        for message in kept:
            wire.out.send(message)
        wire.take()
    count = wire.source.nodes()["42"]
    assert count["received"] + count["lost"] == pytest.approx(300, abs=2)
    assert 200 < count["received"] < 300
    span = [wire.poses.at(T0 + t).lat_deg for t in np.arange(0.5, 29.0, 0.1)]
    known = np.array([(t, v) for t, v in zip(np.arange(0.5, 29.0, 0.1), span, strict=True) if v is not None])
    assert len(known) > 0.95 * len(span)
    assert np.abs(known[:, 1] - (47.0 + 1e-4 * known[:, 0])).max() < 1e-8


def test_a_babbling_node_neither_moves_nor_stops_the_others(wire):
    rng, node, babbler = np.random.default_rng(0), CanNode(), CanNode(77)
    for number in range(50):
        wire.now = T0 + number / 10
        for _ in range(40):  # noise under all identifiers, and under those of the messages that are read
            data = bytes(rng.integers(0, 256, int(rng.integers(0, 9)), dtype=np.uint8))
            kind = int(rng.choice([1000, 1044, 1060, 1063, int(rng.integers(0, 1 << 16))]))
            wire.out.send(can.Message(arbitration_id=16 << 24 | kind << 8 | 77, data=data, is_extended_id=True))
        for _ in range(20):  # and one valid message over and over
            babbler.send(wire.out, fix_at(0, 50.0, 10.0))
        node.send(wire.out, fix_at(number))
        wire.take()
    assert wire.source.nodes()["42"] == {"received": 50, "lost": 0}
    assert wire.source.nodes()["77"]["received"] <= 120
    found = wire.poses.read(T0 + 2.55)
    assert found.origin["position"] == "DroneCAN node 42"
    assert found.sample.lat_deg == pytest.approx(47.0 + 25.5e-5, abs=1e-8)


def test_a_bus_that_is_not_there_is_one_clear_error():
    with pytest.raises(InputError, match="cannot be opened"):
        open_bus("socketcan:nothing0")
    with pytest.raises(InputError, match="names no CAN bus"):
        open_bus("socketcan")
