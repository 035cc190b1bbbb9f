"""DroneCAN over python-can and through MAVLink CAN_FRAME."""

import threading
import time

import numpy as np
import pytest

from orthoswarm.model.errors import InputError
from telemetry.live.live_poses import LivePoses

can = pytest.importorskip("can")
dronecan = pytest.importorskip("dronecan")

from telemetry.live.dronecan_bus import BusDriver, CanSource, TunnelDriver, open_bus  # noqa: E402


def quaternion_xyzw(yaw, pitch, roll):
    y, p, r = np.radians([yaw, pitch, roll]) / 2
    cy, sy, cp, sp, cr, sr = np.cos(y), np.sin(y), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    return [
        float(sr * cp * cy - cr * sp * sy), float(cr * sp * cy + sr * cp * sy),
        float(cr * cp * sy - sr * sp * cy), float(cr * cp * cy + sr * sp * sy),
    ]  # fmt: skip


def fix2(number: int):
    message = dronecan.uavcan.equipment.gnss.Fix2()
    message.gnss_timestamp.usec = 1_700_000_000_000_000 + 100_000 * number
    message.gnss_time_standard = message.GNSS_TIME_STANDARD_UTC
    message.latitude_deg_1e8 = round((47.0 + 1e-5 * number) * 1e8)
    message.longitude_deg_1e8 = round(8.25 * 1e8)
    message.height_msl_mm = 512_000
    message.status, message.mode, message.sub_mode = 3, message.MODE_RTK, message.SUB_MODE_RTK_FIXED
    message.covariance = [0.0004, 0.0004, 0.001, 0.01, 0.01, 0.01]
    return message


def attitude(yaw, pitch=0.0, roll=0.0):
    message = dronecan.uavcan.equipment.ahrs.Solution()
    message.orientation_xyzw = quaternion_xyzw(yaw, pitch, roll)
    return message


def camera_down_in_body():
    """Camera z = body z (down), picture's up = body x: camera x right = body y, camera y down = -body x."""
    message = dronecan.uavcan.equipment.camera_gimbal.Status()
    message.camera_orientation_in_body_frame_xyzw = [0.0, 0.0, float(np.sqrt(0.5)), float(np.sqrt(0.5))]
    return message


def sender(bus):
    return dronecan.node.Node(BusDriver(bus), node_id=42)


def test_fixes_attitude_and_gimbal_come_from_a_bus():
    poses = LivePoses("uav1", clock=lambda: 1_700_000_005.0)
    node = sender(can.Bus(interface="virtual", channel="t1"))
    with CanSource(BusDriver(open_bus("virtual:t1")), poses, clock=lambda: 1_700_000_005.0) as source:
        node.broadcast(attitude(30.0))
        node.broadcast(camera_down_in_body())
        for number in range(100):
            node.broadcast(fix2(number))
        deadline = time.monotonic() + 5.0
        while source.received < 102 and time.monotonic() < deadline:
            source.spin(0.05)
        assert source.received == 102
    node.close()
    sample = poses.at(1_700_000_005.05)
    assert sample.lat_deg == pytest.approx(47.0 + 50.5e-5, abs=1e-8)
    assert sample.altitude_m == pytest.approx(512.0)
    assert poses.latest.sigma_m == pytest.approx(0.02, abs=1e-3)
    assert (poses.latest.yaw_deg, poses.latest.pitch_deg) == pytest.approx((30.0, -90.0), abs=0.2)


def test_fixes_come_over_udp_multicast():
    pytest.importorskip("msgpack")
    group = "udp_multicast:239.74.163.2"
    poses = LivePoses("uav1", clock=lambda: 1_700_000_005.0)
    try:  # packets stay on this machine
        node = sender(can.Bus(interface="udp_multicast", channel="239.74.163.2", hop_limit=0))
        source = CanSource(BusDriver(open_bus(group)), poses, clock=lambda: 1_700_000_005.0)
    except (OSError, can.CanError, InputError) as error:
        pytest.skip(f"no multicast here: {error}")
    with source:
        for number in range(20):
            node.broadcast(fix2(number))
        deadline = time.monotonic() + 20.0
        while source.received < 20 and time.monotonic() < deadline:
            source.spin(0.05)
    assert source.received == 20
    node.close()


def test_an_rtk_receiver_on_the_bus_outdoes_the_autopilots_position():
    from telemetry.samples.sample import Sample

    poses = LivePoses("uav1")
    for tenth in range(10):
        at = 100.0 + tenth / 10
        poses.add(Sample(time_s=at, lat_deg=47.0, lon_deg=8.0, height_m=60.0 + tenth))
        poses.add(Sample(time_s=at, lat_deg=47.0001, lon_deg=8.0, sigma_m=0.02))
    sample = poses.at(100.55)
    assert (sample.lat_deg, sample.sigma_m, sample.height_m) == pytest.approx((47.0001, 0.02, 65.5))
    poses.add(Sample(time_s=110.0, lat_deg=47.0, lon_deg=8.0))  # the receiver fell silent
    assert poses.at(110.0).lat_deg == 47.0


def test_the_older_fix_is_read_where_the_newer_is_missing():
    poses = LivePoses("uav1")
    node = sender(can.Bus(interface="virtual", channel="t2"))
    message = dronecan.uavcan.equipment.gnss.Fix()
    message.latitude_deg_1e8, message.longitude_deg_1e8, message.status = 4_700_000_000, 825_000_000, 3
    with CanSource(BusDriver(open_bus("virtual:t2")), poses) as source:
        node.broadcast(message)
        source.spin(0.2)
        assert poses.latest.lat_deg == pytest.approx(47.0)
        node.broadcast(fix2(1))
        node.broadcast(message)
        source.spin(0.2)
        assert poses.latest.lat_deg == pytest.approx(47.00001)
    node.close()


def test_the_bus_comes_through_mavlink_too():
    mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
    frames = []

    class Recorder(TunnelDriver):
        def send_frame(self, frame):
            frames.append(frame)

    node = dronecan.node.Node(Recorder(), node_id=42)
    for number in range(200):
        node.broadcast(fix2(number))
    poses = LivePoses("uav1")
    source = CanSource(TunnelDriver(), poses)
    for frame in frames:
        data = list(bytes(frame.data)) + [0] * (8 - len(frame.data))
        source.feed(mavlink.MAVLink_can_frame_message(0, 0, 0, len(frame.data), frame.id | 0x80000000, data))
    assert source.received == 200
    assert poses.latest.lat_deg == pytest.approx(47.0 + 199e-5)


def test_reading_ends_when_told_to():
    stop = threading.Event()
    with CanSource.open("virtual:t3", LivePoses("uav1")) as source:
        thread = threading.Thread(target=source.run, args=(stop,))
        thread.start()
        stop.set()
        thread.join(5.0)
        assert not thread.is_alive()


def test_damaged_frames_are_dropped():
    rng = np.random.default_rng(0)
    poses = LivePoses("uav1")
    node = sender(can.Bus(interface="virtual", channel="t4"))
    noise = can.Bus(interface="virtual", channel="t4")
    with CanSource(BusDriver(open_bus("virtual:t4")), poses) as source:
        for number in range(50):
            data = bytes(rng.integers(0, 256, int(rng.integers(0, 9)), dtype=np.uint8))
            ident = int(rng.integers(0, 1 << 29)) if number % 2 else 0x18042701 | 42
            noise.send(can.Message(arbitration_id=ident, data=data, is_extended_id=True))
            node.broadcast(fix2(number))
            source.spin(0.0)
        source.spin(0.2)
    noise.shutdown()
    node.close()
    assert source.received >= 40
    assert 47.0 <= poses.latest.lat_deg < 47.001


def test_a_bus_that_is_not_there_is_one_clear_error():
    with pytest.raises(InputError, match="cannot be opened"):
        open_bus("socketcan:nothing0")
    with pytest.raises(InputError, match="names no CAN bus"):
        open_bus("socketcan")
