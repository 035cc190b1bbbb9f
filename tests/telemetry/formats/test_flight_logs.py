"""Flight logs: tlog, DataFlash and ULog of real and made flights, damaged ones too."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.formats.log.flight_logs import NotALog, read_log
from telemetry.ingest.ingest import survey

mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")


@pytest.mark.parametrize(
    ("name", "vehicle", "count"),
    [
        ("copter_cam_rtl_1x.tlog", "sysid1", 29),
        ("copter_cam_rtl_1x.BIN", "copter_cam_rtl_1x", 29),
        ("swarm_v1.tlog", "sysid1", 59),
        ("swarm_v2.tlog", "sysid2", 59),
        ("swarm_v3.tlog", "sysid3", 59),
    ],
)
def test_camera_events_of_real_logs_lie_on_their_tracks(real_data, name, vehicle, count):
    (log,) = read_log(real_data("sitl_logs") / name)
    assert (log.vehicle, len(log.events)) == (vehicle, count)
    assert [e.number for e in log.events] == list(range(1, count + 1))
    timeline = log.timeline()
    for event in log.events:
        track = timeline.at(event.time_s)
        assert track.lat_deg == pytest.approx(event.sample.lat_deg, abs=2e-6)
        assert track.lon_deg == pytest.approx(event.sample.lon_deg, abs=2e-6)
        assert track.height_m == pytest.approx(event.sample.height_m, abs=0.3)
        turn = (track.flight_yaw_deg - event.sample.flight_yaw_deg + 180) % 360 - 180
        assert abs(turn) < 5.0


def test_both_logs_of_one_flight_agree_and_are_counted_once(real_data):
    folder = real_data("sitl_logs")
    (a,), (b,) = read_log(folder / "copter_cam_rtl_1x.tlog"), read_log(folder / "copter_cam_rtl_1x.BIN")
    for one, two in zip(a.events, b.events, strict=True):
        assert one.time_s == pytest.approx(two.time_s, abs=0.3)
    counts = {s.path: s.counts["camera_events"] for s in survey([folder]).sources}
    assert sum(counts.values()) == 29 + 3 * 59
    assert sorted(counts.values()) == [0, 29, 59, 59, 59]


def test_wall_times_that_run_ten_times_too_fast_are_named(real_data):
    (log,) = read_log(real_data("sitl_logs") / "swarm_v1.tlog")
    assert "tlog-pace" in {f.code for f in log.findings}
    (log,) = read_log(real_data("sitl_logs") / "copter_cam_rtl_1x.tlog")
    assert "tlog-pace" not in {f.code for f in log.findings}


@pytest.mark.parametrize("name", ["copter_cam_rtl_1x.tlog", "copter_cam_rtl_1x.BIN"])
def test_damaged_logs_give_what_is_left(real_data, tmp_path, name):
    whole = (real_data("sitl_logs") / name).read_bytes()
    rng = np.random.default_rng(5)
    for trial in range(4):
        data = bytearray(whole[: len(whole) * (trial + 7) // 10])
        for at in rng.integers(0, len(data), 40 * trial):
            data[at] ^= 1 << int(rng.integers(8))
        path = tmp_path / name
        path.write_bytes(data)
        (log, *_) = read_log(path)
        assert 8 <= len(log.events) <= 31
        inside = [e for e in log.events if e.sample.lat_deg is not None and abs(e.sample.lat_deg + 35.36) < 0.1]
        assert len(inside) >= len(log.events) - 4


@pytest.mark.parametrize("suffix", [".tlog", ".BIN", ".ulg"])
@given(data=st.binary(max_size=2000))
@settings(max_examples=60, deadline=None)
def test_any_bytes_are_no_log(tmp_path_factory, suffix, data):
    path = tmp_path_factory.mktemp("any") / f"a{suffix}"
    path.write_bytes(data)
    with pytest.raises(NotALog):
        read_log(path)
    path.write_bytes(b"ULog\x01\x12\x35\x01" + b"\0" * 8 + data)
    if suffix == ".ulg":
        with pytest.raises(NotALog):
            read_log(path)


# --- ULog ---------------------------------------------------------------------------------------------------------


def ulog(path, *, seconds=20, events=5):
    """A flight north at 5 m/s, 50 m over home, a picture every two seconds."""
    out = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))

    def put(kind: str, body: bytes) -> None:
        out.extend(struct.pack("<HB", len(body), ord(kind)) + body)

    formats = {
        "vehicle_global_position": "uint64_t timestamp;double lat;double lon;float alt;uint8_t[4] _padding0;",
        "vehicle_attitude": "uint64_t timestamp;float[4] q;",
        "sensor_gps": "uint64_t timestamp;uint64_t time_utc_usec;uint8_t fix_type;",
        "home_position": "uint64_t timestamp;double lat;double lon;float alt;",
        "camera_capture": "uint64_t timestamp;uint64_t timestamp_utc;double lat;double lon;uint32_t seq;float alt;"
        "float ground_distance;float[4] q;int8_t result;",
        "something_else": "uint64_t timestamp;float x;",
    }
    for name, text in formats.items():
        put("F", f"{name}:{text}".encode())
    for number, name in enumerate(formats):
        put("A", struct.pack("<BH", 0, number) + name.encode())
    put("D", struct.pack("<HQddf", 3, 100, 47.0, 8.0, 400.0))
    q = (math.cos(math.radians(45)), 0.0, 0.0, math.sin(math.radians(45)))  # heading east
    for i in range(seconds * 5):
        t = 1_000_000 + i * 200_000
        put("D", struct.pack("<HQddf", 0, t, 47.0 + i / 111_195, 8.0, 450.0))
        put("D", struct.pack("<HQ4f", 1, t, *q))
        put("D", struct.pack("<HQQB", 2, t, 1_700_000_000_000_000 + t, 3))
    for i in range(events):
        t = 3_000_000 + i * 2_000_000
        lat = 47.0 + (t - 1_000_000) / 200_000 / 111_195
        body = struct.pack("<HQQddIff4fb", 4, t, 1_700_000_000_000_000 + t, lat, 8.0, i, 450.0, -1.0, *q, 1)
        put("D", body)
    path.write_bytes(out)
    return path


def test_a_ulog_gives_track_and_events(tmp_path):
    (log,) = read_log(ulog(tmp_path / "a.ulg"))
    assert log.kind == "ULog"
    assert len(log.events) == 5
    event = log.events[1]
    assert event.time_s == pytest.approx(1_700_000_005.0)
    track = log.timeline().at(event.time_s)
    assert track.lat_deg == pytest.approx(event.sample.lat_deg, abs=1e-9)
    assert (track.height_m, event.sample.height_m) == pytest.approx((50.0, 50.0))
    assert track.flight_yaw_deg == pytest.approx(90.0, abs=1e-4)


def receivers_ulog(path, instances):
    """A track north and receivers: (topic, instance, (offset of their UTC in seconds, fix type, latitude))."""
    out = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))

    def put(kind: str, body: bytes) -> None:
        out.extend(struct.pack("<HB", len(body), ord(kind)) + body)

    fields = "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;double altitude_msl_m;"
    for topic in ("sensor_gps", "vehicle_gps_position"):
        put("F", f"{topic}:{fields}uint8_t fix_type;".encode())
    for number, (topic, instance, _) in enumerate(instances):
        put("A", struct.pack("<BH", instance, number) + topic.encode())
    for i in range(50):
        t = 1_000_000 + i * 200_000
        for number, (_, _, (offset_s, fix, lat)) in enumerate(instances):
            utc = 0 if offset_s is None else round(offset_s * 1e6) + t
            put("D", struct.pack("<HQQdddB", number, t, utc, lat + i * 1e-6, 8.0, 450.0, fix))
    path.write_bytes(out)
    return path


@pytest.mark.parametrize(
    "instances",
    [
        [("sensor_gps", 0, (None, 0, 0.0)), ("sensor_gps", 1, (1.7e9, 3, 47.0))],
        [("sensor_gps", 0, (None, 0, 0.0)), ("vehicle_gps_position", 0, (1.7e9, 3, 47.0))],
        [("sensor_gps", 0, (1.4451e9, 1, 12.0)), ("sensor_gps", 1, (1.7e9, 3, 47.0))],
    ],
)
def test_a_ulog_of_two_receivers_is_dated_and_placed_by_the_one_with_a_fix(tmp_path, instances):
    (log,) = read_log(receivers_ulog(tmp_path / "a.ulg", instances))
    sample = log.timeline().at(1_700_000_003.0)
    assert (sample.lat_deg, sample.lon_deg) == pytest.approx((47.00001, 8.0), abs=1e-8)


def test_a_ulog_without_utc_is_named(tmp_path):
    with pytest.raises(NotALog, match="no UTC"):
        read_log(receivers_ulog(tmp_path / "a.ulg", [("sensor_gps", 0, (None, 0, 0.0))]))


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_damaged_ulogs_are_survived(tmp_path_factory, data):
    path = ulog(tmp_path_factory.mktemp("u") / "a.ulg", seconds=2, events=1)
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 12))):
        raw[data.draw(st.integers(16, len(raw) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(raw[: data.draw(st.integers(16, len(raw)))])
    try:
        read_log(path)
    except NotALog as reason:
        assert str(reason)


def test_a_ulogs_capture_attitude_is_the_gimbals_where_it_looks_down(tmp_path):
    """PX4 logs the camera's attitude there when a gimbal is fitted, also without the gimbal's own topic."""
    path = ulog(tmp_path / "a.ulg")
    yaw, pitch = math.radians(90.0), math.radians(-90.0)
    down = (
        math.cos(yaw / 2) * math.cos(pitch / 2), -math.sin(yaw / 2) * math.sin(pitch / 2),
        math.cos(yaw / 2) * math.sin(pitch / 2), math.sin(yaw / 2) * math.cos(pitch / 2),
    )  # fmt: skip
    east = struct.pack("<4f", math.cos(math.radians(45)), 0.0, 0.0, math.sin(math.radians(45)))
    data = path.read_bytes()
    captures = struct.pack("<ff", 450.0, -1.0)
    path.write_bytes(data.replace(captures + east, captures + struct.pack("<4f", *down)))
    (log,) = read_log(path)
    sample = log.events[1].sample
    assert (sample.yaw_deg, sample.pitch_deg) == pytest.approx((90.0, -90.0), abs=0.1)
    assert sample.flight_pitch_deg is None
    assert log.has_gimbal


# --- older and sparse logs ------------------------------------------------------------------------------------------


def dataflash(path, formats, records):
    """A DataFlash log of some record types: name -> (codes, columns); records are (name, values)."""
    codes = {"B": "B", "H": "H", "I": "I", "L": "i", "e": "i", "E": "I", "c": "h", "C": "H", "Q": "Q", "f": "f"}
    out, types = bytearray(), {}
    for number, (name, (letters, columns)) in enumerate(formats.items(), 130):
        form = struct.Struct("<" + "".join(codes[letter] for letter in letters))
        types[name] = number, form
        body = struct.pack("<BB4s16s64s", number, form.size + 3, name.encode(), letters.encode(), columns.encode())
        out += b"\xa3\x95\x80" + body
    for name, values in records:
        number, form = types[name]
        out += b"\xa3\x95" + bytes([number]) + form.pack(*values)
    path.write_bytes(out)
    return path


WEEK, WEEK_MS = 1850, 200_000_000
GPS_UTC_S = 315_964_800 + WEEK * 604_800 + WEEK_MS / 1000 - 18


OLDER_GPS = {
    # ArduCopter 3.2: TimeMS is the time of week, T since boot. 3.3 pre-releases: TimeMS is since boot.
    "time of week": ("BIHBcLLeeEefI", "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T"),
    "since boot": ("IBIHBcLLee", "TimeMS,Status,GMS,GWk,NSats,HDop,Lat,Lng,RelAlt,Alt"),
}


@pytest.mark.parametrize("kind", OLDER_GPS)
def test_dataflash_with_milliseconds_is_read_and_placed_by_its_gps(tmp_path, kind):
    formats = {
        "GPS": OLDER_GPS[kind],
        "ATT": ("IccccCC", "TimeMS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
        "CAM": ("IHLLeccC", "GPSTime,GPSWeek,Lat,Lng,Alt,Roll,Pitch,Yaw"),
    }
    records = []
    for i in range(50):
        boot, lat = 60_000 + 200 * i, 470_000_000 + 100 * i
        if kind == "time of week":
            gps = (3, WEEK_MS + 200 * i, WEEK, 12, 80, lat, 80_000_000, 6000, 46000, 0, 0, 0.0, boot)
        else:
            gps = (boot, 3, WEEK_MS + 200 * i, WEEK, 12, 80, lat, 80_000_000, 6000, 46000)
        records += [("GPS", gps), ("ATT", (boot, 0, 100, 0, -200, 0, 9000))]
        if i % 10 == 5:
            records.append(("CAM", (WEEK_MS + 200 * i, WEEK, lat, 80_000_000, 46000, 100, -200, 9000)))
    (log,) = read_log(dataflash(tmp_path / "old.BIN", formats, records))
    assert len(log.events) == 5
    for i, event in enumerate(log.events):
        assert event.time_s == pytest.approx(GPS_UTC_S + 2 * i + 1.0)
        track = log.timeline().at(event.time_s)
        assert track.lat_deg == pytest.approx(event.sample.lat_deg, abs=1e-7)
        assert (track.height_m, track.altitude_m) == (60.0, 460.0)
        assert (track.flight_yaw_deg, track.flight_pitch_deg) == (90.0, -2.0)


def test_a_dataflash_log_without_gps_time_is_named(tmp_path):
    formats = {"ATT": ("Qcc", "TimeUS,Roll,Pitch")}
    with pytest.raises(NotALog, match="no GPS time"):
        read_log(dataflash(tmp_path / "bench.BIN", formats, [("ATT", (1000, 1, 1)), ("ATT", (2_000_000, 1, 1))]))


@pytest.mark.parametrize(
    "fields",
    ["int32_t lat;int32_t lon;int32_t alt;", "double latitude_deg;double longitude_deg;double altitude_msl_m;"],
)
def test_a_ulog_without_the_filters_position_is_placed_by_its_gps(tmp_path, fields):
    out = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))

    def put(kind, body):
        out.extend(struct.pack("<HB", len(body), ord(kind)) + body)

    put("F", f"sensor_gps:uint64_t timestamp;uint64_t time_utc_usec;{fields}float eph;uint8_t fix_type;".encode())
    put("A", struct.pack("<BH", 0, 0) + b"sensor_gps")
    for i in range(20):
        t = 1_000_000 + 200_000 * i
        place = (470_000_000 + 10 * i, 80_000_000, 450_000) if "int32" in fields else (47.0 + i * 1e-6, 8.0, 450.0)
        form = "<HQQiiifB" if "int32" in fields else "<HQQdddfB"
        put("D", struct.pack(form, 0, t, 1_700_000_000_000_000 + t, *place, 0.7, 3))
    (tmp_path / "a.ulg").write_bytes(out)
    (log,) = read_log(tmp_path / "a.ulg")
    sample = log.timeline().at(1_700_000_002.0)
    assert (sample.lat_deg, sample.lon_deg, sample.altitude_m) == pytest.approx((47.000005, 8.0, 450.0), abs=1e-8)
    assert sample.sigma_m == pytest.approx(0.7)
