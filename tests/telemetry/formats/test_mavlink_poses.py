"""MAVLink messages to poses and exposures, live and from logs; gimbals, rangefinders, reboots."""

import math
import struct

import numpy as np
import pytest

from telemetry.formats.log.dataflash import read_dataflash
from telemetry.formats.log.flight_logs import read_log, read_tlog
from telemetry.formats.log.mavlink_poses import MavlinkPoses, fixed_camera
from telemetry.live.live_poses import LivePoses
from telemetry.samples.sample import Sample
from telemetry.samples.timeline import Timeline

mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")


# --- live MAVLink -------------------------------------------------------------------------------------------------


def messages_of(path):
    """Decoded messages of a tlog with their arrival times."""
    data = path.read_bytes()
    decoder, at = mavlink.MAVLink(None), 0
    while at + 20 < len(data):
        length = 12 + data[at + 9] if data[at + 8] == 0xFD else 8 + data[at + 9]
        yield decoder.decode(bytearray(data[at + 8 : at + 8 + length])), int.from_bytes(data[at : at + 8], "big") * 1e-6
        at += 8 + length


def test_live_poses_agree_with_the_log_read_afterwards(real_data):
    path = real_data("sitl_logs") / "copter_cam_rtl_1x.tlog"
    live, events = LivePoses("one", keep_s=1000.0), []
    for message, arrival in messages_of(path):
        event = live.feed(message, arrival)
        if event is not None:
            events.append(event)
    assert len(events) == 29
    (log,) = read_tlog(path)
    timeline = Timeline(log.samples)
    for event in events:
        now, then = live.at(event.time_s), timeline.at(event.time_s)
        assert now.lat_deg == pytest.approx(then.lat_deg, abs=3e-6)
        assert now.height_m == pytest.approx(then.height_m, abs=0.2)
        assert event.sample.pitch_deg == pytest.approx(event.sample.flight_pitch_deg - 90.0, abs=1e-6)
        assert event.sample.vehicle == "one"


def test_live_memory_is_bounded_and_reading_is_quick(real_data):
    live = LivePoses("one", keep_s=5.0)
    for message, arrival in messages_of(real_data("sitl_logs") / "copter_cam_rtl_1x.tlog"):
        live.feed(message, arrival)
    assert 0 < len(live) < 100
    assert live.at(live.latest.time_s).lat_deg is not None
    assert live.at(live.latest.time_s + 1.0).lat_deg is None


def position(boot_ms, lat=47.0, lon=8.0, height=50.0):
    return mavlink.MAVLink_global_position_int_message(
        boot_ms, int(lat * 1e7), int(lon * 1e7), 500_000, int(height * 1000), 0, 0, 0, 0
    )


def attitude(boot_ms, yaw=0.0, pitch=0.0, roll=0.0):
    return mavlink.MAVLink_attitude_message(boot_ms, *np.radians([roll, pitch, yaw]).tolist(), 0, 0, 0)


def gimbal(boot_ms, q, flags):
    return mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, boot_ms, flags, q, 0, 0, 0, 0)


def quaternion(yaw, pitch, roll):
    """w, x, y, z of Rz Ry Rx."""
    y, p, r = np.radians([yaw, pitch, roll]) / 2
    cy, sy, cp, sp, cr, sr = np.cos(y), np.sin(y), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    return [
        cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("flags", "own_yaw", "expected"),
    [(32, 10.0, 100.0), (64, 10.0, 10.0), (16, 10.0, 10.0), (0, 10.0, 100.0), (16 | 32, 10.0, 100.0)],
)
def test_a_gimbals_yaw_is_read_in_the_frame_its_flags_name(flags, own_yaw, expected):
    live = LivePoses("g", clock=lambda: 0.0)
    live.feed(attitude(1000, yaw=90.0), 1000.0)
    live.feed(gimbal(1000, quaternion(own_yaw, -80.0, 0.0), flags), 1000.0)
    assert live.has_gimbal
    assert live.latest.yaw_deg == pytest.approx(expected, abs=1e-3)
    assert live.latest.pitch_deg == pytest.approx(-80.0, abs=1e-3)


@pytest.mark.parametrize(
    ("heading_deg", "own", "absolute", "expected"),
    [(90.0, 10.0, 0.0, 100.0), (90.0, 10.0, math.nan, 100.0), (90.0, 10.0, 140.0, 140.0), (350.0, 10.0, 0.0, 0.0)],
)
def test_a_mounts_yaw_is_relative_where_the_absolute_one_is_not_filled(heading_deg, own, absolute, expected):
    live = LivePoses("m", clock=lambda: 0.0)
    live.feed(mavlink.MAVLink_mount_orientation_message(900, 0.0, -80.0, own, 0.0), 999.9)
    assert live.latest.yaw_deg is None
    live.feed(attitude(1000, yaw=heading_deg), 1000.0)
    live.feed(mavlink.MAVLink_mount_orientation_message(1000, 0.0, -80.0, own, absolute), 1000.0)
    assert live.latest.yaw_deg == pytest.approx(expected, abs=1e-3)
    assert live.latest.pitch_deg == pytest.approx(-80.0, abs=1e-3)


def test_a_camera_without_a_gimbal_is_fixed_under_the_airframe():
    sample = fixed_camera(Sample(flight_yaw_deg=30.0, flight_pitch_deg=5.0, flight_roll_deg=-3.0))
    assert (sample.yaw_deg, sample.pitch_deg, sample.roll_deg) == pytest.approx((30.0, -85.0, -3.0))


def test_a_rangefinder_gives_the_height_above_ground():
    live = LivePoses("r")
    for ms in (1000, 1200):
        live.feed(position(ms), ms / 1000 + 100.0)
        live.feed(mavlink.MAVLink_rangefinder_message(42.0, 0.0), ms / 1000 + 100.0)
    sample = live.at(101.1)
    assert (sample.height_m, sample.height_is_ground) == (42.0, True)


def test_an_image_captured_report_with_a_camera_quaternion():
    poses = MavlinkPoses()
    poses.feed(mavlink.MAVLink_system_time_message(1_700_000_000_000_000, 1000))

    def captured(q, result=1):
        return mavlink.MAVLink_camera_image_captured_message(
            2000, 1_700_000_001_000_000, 1, int(47e7), int(8e7), 500_000, 60_000, q, 5, result, b""
        )

    event = poses.feed(captured(quaternion(20.0, -90.0, 0.0)))
    assert (event.number, event.time_s) == (5, 1_700_000_001.0)
    assert event.sample.pitch_deg == pytest.approx(-90.0, abs=1e-3)
    event = poses.feed(captured(quaternion(20.0, -5.0, 2.0)))
    assert event.sample.yaw_deg is None
    assert event.sample.flight_pitch_deg == pytest.approx(-5.0, abs=1e-3)
    assert poses.feed(captured([0.0] * 4, result=0)) is None


def test_a_captured_picture_without_a_known_ground_gets_its_height_from_home_or_from_the_track():
    """PX4 fills relative_alt with the distance to the ground, and with -1 m where it does not know that."""

    def captured(boot_ms):
        return mavlink.MAVLink_camera_image_captured_message(
            boot_ms, 1_700_000_000_000_000 + 1000 * boot_ms, 1, int(47e7), int(8e7), 500_000, -1000,
            quaternion(20.0, -5.0, 2.0), 5, 1, b"",
        )  # fmt: skip

    live = LivePoses("px4")
    live.feed(mavlink.MAVLink_system_time_message(1_700_000_001_000_000, 1000))
    for boot_ms in range(1000, 3000, 100):
        live.feed(position(boot_ms, 47.0, 8.0))
    event = live.feed(captured(2050))
    assert event.sample.height_m == pytest.approx(live.at(1_700_000_002.05).height_m)
    poses = MavlinkPoses()
    poses.feed(mavlink.MAVLink_home_position_message(int(47e7), int(8e7), 440_000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0))
    assert poses.feed(captured(2050)).sample.height_m == pytest.approx(60.0)


def test_positions_without_a_fix_and_not_a_number_are_left_out():
    live = LivePoses("n")
    live.feed(position(1000, 0.0, 0.0), 101.0)
    assert live.latest.lat_deg is None
    assert live.latest.height_m is None
    live.feed(attitude(1000, yaw=math.nan), 101.0)
    assert live.latest.flight_yaw_deg is None


def test_a_reboot_and_a_clock_set_back_are_survived():
    live = LivePoses("b", keep_s=60.0)
    for ms in range(100_000, 101_000, 100):
        live.feed(position(ms), ms / 1000 + 1e6)
    for ms in range(1000, 2000, 100):
        live.feed(position(ms, 47.5), ms / 1000 + 1e6 + 120)
    assert live.at(1e6 + 121.5).lat_deg == pytest.approx(47.5)


def test_dataflash_heights_of_a_rangefinder_and_gimbal_are_read(tmp_path):
    out = bytearray()

    def fmt(kind, name, codes, columns):
        size = 3 + struct.calcsize("<" + codes.replace("L", "i").replace("c", "h").replace("M", "B"))
        out.extend(b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, size, name, codes.encode(), columns.encode()))

    def row(kind, codes, *values):
        out.extend(b"\xa3\x95" + bytes([kind]) + struct.pack("<" + codes, *values))

    out.extend(
        b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    )
    fmt(130, b"GPS", "QBIH", "TimeUS,Status,GMS,GWk")
    fmt(131, b"POS", "QLLff", "TimeUS,Lat,Lng,Alt,RelHomeAlt")
    fmt(132, b"RFND", "QfBB", "TimeUS,Dist,Stat,Orient")
    fmt(133, b"MNT", "Qfff", "TimeUS,Roll,Pitch,YawE")
    for i in range(20):
        t = 1_000_000 + 100_000 * i
        row(130, "QBIH", t, 3, 100_000 + 100 * i, 2300)
        row(131, "Qiiff", t, int(47e7), int(8e7), 500.0, 60.0)
        row(132, "QfBB", t, 41.5, 4, 25)
        row(133, "Qfff", t, 0.0, -90.0, 77.0)
    (tmp_path / "a.BIN").write_bytes(out)
    log = read_dataflash(tmp_path / "a.BIN")
    log.samples.sort(key=lambda s: s.time_s)
    timeline = log.timeline()
    sample = timeline.at(timeline.span[0] + 0.55)
    assert log.has_gimbal
    assert (sample.height_m, sample.height_is_ground) == (pytest.approx(41.5), True)
    assert (sample.yaw_deg, sample.pitch_deg) == pytest.approx((77.0, -90.0), abs=1e-4)
    assert timeline.span[0] == pytest.approx(315_964_800 + 2300 * 604_800 + 100.0 - 18.0, abs=0.01)


# --- several components with clocks of their own -------------------------------------------------------------------


T0 = 1_780_000_000.0
DOWN = [math.cos(-math.pi / 4), 0.0, math.sin(-math.pi / 4), 0.0]
GIMBAL, COMPANION, CAMERA = 154, 240, 100


def flight(*, autopilot=1, gimbal_late_s=None, mavros=False, camera_boot_s=None, jitter_s=0.0, pace=1.0, utc=True):
    """Arrival, component and message of 120 s northwards at 10 Hz; every 30 s the heading turns by 180 degrees."""
    rng = np.random.default_rng(3)
    for i in range(1200):
        t = i * 0.1
        boot_ms = round((t + 100) * 1000)

        def put(component, message, t=t):
            message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=component))
            return T0 + t / pace + jitter_s * rng.random(), component, message

        if gimbal_late_s is not None and t + 100 > gimbal_late_s:
            yield put(GIMBAL, gimbal(boot_ms - round(gimbal_late_s * 1000), DOWN, 32))
        if i % 10 == 0:
            yield put(autopilot, mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3))
            if utc:
                yield put(autopilot, mavlink.MAVLink_system_time_message(round((T0 + t) * 1e6), boot_ms))
        yield put(autopilot, position(boot_ms, 47.5 + i * 1e-5))
        yield put(autopilot, attitude(boot_ms, yaw=heading(t)))
        if mavros and i % 10 == 5:
            yield put(COMPANION, mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 0, 3))
            yield put(COMPANION, mavlink.MAVLink_system_time_message(round((T0 + t) * 1e6), 0))
            yield put(COMPANION, attitude(5000, yaw=77.0))
        if camera_boot_s is not None and i % 20 == 8:
            own = round((t + camera_boot_s) * 1000)
            yield put(
                CAMERA,
                mavlink.MAVLink_camera_image_captured_message(
                    own, 0, 1, 0, 0, 0, 0, [math.nan] * 4, i // 20, 1, b""
                ),
            )  # fmt: skip


def heading(t):
    return 0.0 if int(t // 30) % 2 == 0 else 180.0


def tlog(path, heard):
    """A tlog of arrivals and packed messages."""
    order = sorted(heard, key=lambda row: row[0])
    path.write_bytes(b"".join(struct.pack(">Q", round(at * 1e6)) + bytes(m.get_msgbuf()) for at, _, m in order))
    return path


def yaw_errors(at):
    """Errors in degrees of the camera's yaw, away from the turns by 180 degrees."""
    times = [t for t in np.arange(5.03, 115.0, 0.5) if 0.5 < t % 30 < 29.5]
    poses = [(at(T0 + t).yaw_deg, heading(t)) for t in times]
    assert all(yaw is not None for yaw, _ in poses)
    return np.abs([(yaw - true + 180) % 360 - 180 for yaw, true in poses])


@pytest.mark.parametrize("autopilot", [1, 5])
@pytest.mark.parametrize("late_s", [0.0, 5.0, 30.0, -40.0])
def test_a_gimbals_own_clock_moves_neither_the_track_nor_its_angles(tmp_path, late_s, autopilot):
    heard = list(flight(autopilot=autopilot, gimbal_late_s=late_s, jitter_s=0.15))
    (log,) = read_log(tlog(tmp_path / "a.tlog", heard))
    assert not log.findings
    track = [s for s in log.samples if s.has_position]
    assert len(track) > 1100
    assert [s.time_s - T0 - (s.lat_deg - 47.5) * 1e4 for s in track] == pytest.approx(
        0.0 * np.arange(len(track)), abs=0.01
    )
    assert yaw_errors(log.timeline().at).max() < 1.0
    live = LivePoses("v1")
    for at, _, message in sorted(heard, key=lambda row: row[0]):
        live.feed(message, at)
    assert yaw_errors(live.at).max() < 1.0


def test_a_gimbals_own_clock_is_followed_in_a_simulation_that_runs_fast(tmp_path):
    (log,) = read_log(tlog(tmp_path / "a.tlog", flight(gimbal_late_s=30.0, pace=9.0)))
    assert {f.code for f in log.findings} == {"tlog-pace"}
    assert yaw_errors(log.timeline().at).max() < 1.0


def test_a_gimbal_that_restarts_is_no_restart_of_the_vehicle(tmp_path):
    first = [row for row in flight(gimbal_late_s=5.0) if row[0] < T0 + 60.0]
    second = [row for row in flight(gimbal_late_s=155.0) if row[0] >= T0 + 60.0]
    (log,) = read_log(tlog(tmp_path / "a.tlog", first + second))
    assert not log.findings
    assert yaw_errors(log.timeline().at).max() < 1.0


@pytest.mark.parametrize("utc", [True, False])
def test_a_companion_computer_does_not_set_the_vehicles_clock(tmp_path, utc):
    """MAVROS sends SYSTEM_TIME with time_boot_ms 0."""
    (log,) = read_log(tlog(tmp_path / "a.tlog", flight(mavros=True, utc=utc)))
    assert not log.findings
    track = [s for s in log.samples if s.has_position]
    assert [s.time_s - T0 - (s.lat_deg - 47.5) * 1e4 for s in track] == pytest.approx(np.zeros(1200), abs=0.01)
    yaws = [s.flight_yaw_deg for s in log.samples if s.flight_yaw_deg is not None]
    assert yaws == pytest.approx([heading(i * 0.1) for i in range(1200)], abs=1e-3)


def test_a_cameras_own_clock_dates_its_pictures(tmp_path):
    heard = list(flight(camera_boot_s=20.0))
    (log,) = read_log(tlog(tmp_path / "a.tlog", heard))
    assert not log.findings
    assert [e.time_s - T0 for e in log.events] == pytest.approx(np.arange(0.8, 120.0, 2.0), abs=0.15)
    live = LivePoses("v1")
    events = [live.feed(message, at) for at, _, message in heard]
    assert [e.time_s - T0 for e in events if e is not None] == pytest.approx(np.arange(0.8, 120.0, 2.0), abs=0.15)


def test_a_picture_reported_again_is_no_restart():
    poses = MavlinkPoses()
    poses.feed(mavlink.MAVLink_system_time_message(round(T0 * 1e6), 60_000))
    report = mavlink.MAVLink_camera_image_captured_message(20_000, 0, 1, 0, 0, 0, 0, [math.nan] * 4, 3, 1, b"")
    assert poses.feed(report).time_s == pytest.approx(T0 - 40.0)
    assert poses.clocks.reboots == 0
    assert poses.utc(60.0) == pytest.approx(T0)


def sent(at, component, message):
    message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=component))
    return at, component, message


def captured(number, own_s):
    return mavlink.MAVLink_camera_image_captured_message(
        round(own_s * 1000), 0, 1, 0, 0, 0, 0, [math.nan] * 4, number, 1, b""
    )


def times_of_pictures(path, heard):
    """Seconds of the pictures in the order of their messages, by the log and by a link."""
    (log,) = read_log(tlog(path, heard))
    live = LivePoses("v1")
    fed = [live.feed(message, at) for at, _, message in sorted(heard, key=lambda row: row[0])]
    return [[e.time_s - T0 for e in events if e is not None] for events in (log.events, fed)]


@pytest.mark.parametrize("attitudes", [False, True])
@pytest.mark.parametrize("own_s", [100.0, 30.0])
def test_pictures_that_are_sent_again_keep_their_times(tmp_path, own_s, attitudes):
    """Numbers 12 to 17 are lost, and sent again within 0.1 s; the camera has the autopilot's clock, or its own."""
    heard = [sent(T0 + 0.8 * k + 0.03, CAMERA, captured(k, own_s + 0.8 * k)) for k in range(70) if not 12 <= k < 18]
    heard += [sent(T0 + 30.0 + 0.02 * (k - 12), CAMERA, captured(k, own_s + 0.8 * k)) for k in range(12, 18)]
    if attitudes:  # sent at once, so that they tell the clock
        own_ms = [round((own_s + t) * 1000) for t in range(60)]
        heard += [sent(T0 + t, CAMERA, gimbal(ms, DOWN, 32)) for t, ms in enumerate(own_ms)]
    log, live = times_of_pictures(tmp_path / "a.tlog", [*flight(), *heard])
    assert log == pytest.approx(0.8 * np.arange(70), abs=0.15)
    assert sorted(live) == pytest.approx(0.8 * np.arange(70), abs=0.15)


def test_a_camera_whose_first_report_is_an_old_one_is_dated_by_the_next(tmp_path):
    heard = [sent(T0 + 20.0, CAMERA, captured(3, 5.0))]
    heard += [sent(T0 + t, CAMERA, captured(k, t + 1.0)) for k, t in enumerate(np.arange(21.0, 60.0, 2.0), 12)]
    log, _ = times_of_pictures(tmp_path / "a.tlog", [*flight(), *heard])
    assert log[1:] == pytest.approx(np.arange(21.0, 60.0, 2.0), abs=0.15)


@pytest.mark.parametrize("first", [0, 40])
def test_a_camera_that_restarts_is_dated_by_its_new_clock(tmp_path, first):
    """Its numbers begin again, or go on; those before the restart were sent again once."""
    heard = [sent(T0 + 2.0 * k, CAMERA, captured(k, 50.0 + 2.0 * k)) for k in range(30) if k != 7]
    heard.append(sent(T0 + 59.5, CAMERA, captured(7, 64.0)))
    heard += [sent(T0 + 70.0 + 2.0 * k, CAMERA, captured(first + k, 4.0 + 2.0 * k)) for k in range(20)]
    log, live = times_of_pictures(tmp_path / "a.tlog", [*flight(), *heard])
    expected = [*2.0 * np.arange(30), *(70.0 + 2.0 * np.arange(20))]
    assert log == pytest.approx(expected, abs=0.15)
    assert sorted(live) == pytest.approx(expected, abs=0.15)


def heartbeat(kind=2, autopilot=3):
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 0, 3)


def without_heartbeats(component):
    return [row for row in flight(autopilot=component) if row[2].get_type() != "HEARTBEAT"]


OTHERS = {
    "heartbeats of component 1": lambda: [*without_heartbeats(2), *(sent(T0 + t, 1, heartbeat()) for t in range(120))],
    "one heartbeat of component 1": lambda: [*flight(autopilot=2), sent(T0 + 30.0, 1, heartbeat())],
    "a rangefinder of component 1": lambda: [
        *flight(autopilot=25), sent(T0 + 30.0, 1, mavlink.MAVLink_rangefinder_message(30.0, 0.0))
    ],
    "an attitude of component 1": lambda: [*flight(autopilot=25), sent(T0 + 30.0, 1, attitude(5000, yaw=77.0))],
    "positions of another than the clock": lambda: [
        *(row for row in flight() if row[2].get_type() != "GLOBAL_POSITION_INT"),
        *(row for row in flight(autopilot=2) if row[2].get_type() == "GLOBAL_POSITION_INT"),
    ],
    "positions of a companion, too": lambda: [
        *flight(), *(sent(T0 + t, COMPANION, position(1000 * t + 5000, 10.0)) for t in range(1, 120))
    ],
}  # fmt: skip


@pytest.mark.parametrize("case", OTHERS)
def test_messages_of_other_components_take_no_position_away(tmp_path, case):
    heard = OTHERS[case]()
    (log,) = read_log(tlog(tmp_path / "a.tlog", heard))
    track = [s for s in log.samples if s.has_position]
    assert not log.findings
    assert len(track) == 1200
    assert [s.time_s - T0 - (s.lat_deg - 47.5) * 1e4 for s in track] == pytest.approx(np.zeros(1200), abs=0.01)
    yaws = [s.flight_yaw_deg for s in log.samples if s.flight_yaw_deg is not None]
    assert yaws == pytest.approx([heading(i * 0.1) for i in range(1200)], abs=1e-3)
    live = LivePoses("v1")
    for at, _, message in sorted(heard, key=lambda row: row[0]):
        live.feed(message, at)
    assert live.at(T0 + 100.05).lat_deg == pytest.approx(47.5 + 0.010005, abs=2e-6)
