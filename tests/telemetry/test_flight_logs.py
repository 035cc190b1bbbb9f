"""Flight logs: real ones of ArduPilot, a made one of PX4, damage; photos and videos brought together with them."""

import math
import struct
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.formats.log.dataflash import read_dataflash
from telemetry.formats.log.flight_logs import NotALog, read_log, read_tlog
from telemetry.formats.log.mavlink_poses import MavlinkPoses, fixed_camera
from telemetry.ingest.clock_offset import offset_by_positions, offset_by_turning, offset_by_zone
from telemetry.ingest.event_pairing import by_time, pair
from telemetry.ingest.ingest import LoadOptions, load, survey
from telemetry.live.live_poses import LivePoses
from telemetry.samples.sample import Sample
from telemetry.samples.timeline import Timeline
from tests.telemetry.exposure_grid import exposures, scored
from tests.telemetry.test_photos import gps_exif, jpeg

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


# --- pairing ------------------------------------------------------------------------------------------------------


def uneven(count: int, seed: int) -> np.ndarray:
    """Exposure times with the rhythm of a flight: even on legs, pauses at turns."""
    rng = np.random.default_rng(seed)
    gaps = np.where(np.arange(count) % 9 == 8, rng.uniform(6, 15, count), 2.0 + rng.normal(0, 0.15, count))
    return 1.7e9 + np.cumsum(gaps)


@given(
    seed=st.integers(0, 1000),
    count=st.integers(12, 80),
    offset=st.floats(-90_000, 90_000),
    dropped=st.sets(st.integers(0, 79), max_size=6),
    missing_first=st.integers(0, 3),
    whole=st.booleans(),
)
@settings(max_examples=40, deadline=None)
def test_photos_find_their_events_under_any_clock(seed, count, offset, dropped, missing_first, whole):
    events = uneven(count, seed)
    kept = [i for i in range(count) if i >= missing_first and i not in dropped]
    photos = events[kept] + offset
    photos = np.floor(photos) if whole else photos
    found = by_time(photos, events)
    certain = [(i, j) for i, j in found.pairs if i not in found.doubtful]
    assert all(kept[i] == j for i, j in certain)
    if not found.ambiguous:
        assert found.offset_s == pytest.approx(offset, abs=0.6)
    if not whole:
        assert len(certain) >= 0.95 * len(kept)


# Interval in seconds, whole seconds, share missing, least share that has to be placed without a doubt. With whole
# seconds and several exposures in each second the times alone cannot tell which of them is missing.
GRID = [
    (0.3, False, 0.3, 0.99), (0.7, False, 0.3, 0.99), (1.0, False, 0.3, 0.99), (5.0, False, 0.3, 0.99),
    (2.0, True, 0.0, 0.99), (2.0, True, 0.1, 0.99), (5.0, True, 0.0, 0.99), (5.0, True, 0.3, 0.99),
    (1.0, True, 0.0, 0.9), (1.0, True, 0.1, 0.5), (0.7, True, 0.0, 0.0), (0.3, True, 0.1, 0.0),
]  # fmt: skip


@pytest.mark.parametrize(("interval", "whole", "missing", "least"), GRID)
def test_no_photo_is_given_a_wrong_event_without_a_mark(interval, whole, missing, least):
    placed, total = 0, 0
    for seed in range(3):
        flown = exposures(np.random.default_rng(seed), interval, whole=whole, missing=missing)
        score = scored(flown)
        assert score.wrong_unmarked == 0
        placed, total = placed + score.decided, total + score.both
    assert placed >= least * total


def test_extra_photos_stay_alone():
    events = uneven(30, 1)
    photos = np.sort(np.concatenate([events + 15.0, [events[0] - 60.0, events[12] + 19.5]]))
    found = by_time(photos, events)
    assert found.offset_s == pytest.approx(15.0, abs=0.1)
    assert len(found.pairs) == 30
    assert 0 not in {i for i, _ in found.pairs}


def test_an_even_rhythm_is_ambiguous():
    events = 1.7e9 + 3.0 * np.arange(30)
    assert by_time(events[1:] + 4.0, events).ambiguous


def test_without_times_numbers_and_then_order_decide():
    found = pair([None] * 4, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [101, 102, 104, 106], [1, 2, 3, 4, 5, 6])
    assert (found.how, found.pairs) == ("number", [(0, 0), (1, 1), (2, 3), (3, 5)])
    found = pair([None] * 3, [1.0, 2.0, 3.0])
    assert (found.how, found.pairs, found.ambiguous) == ("order", [(0, 0), (1, 1), (2, 2)], False)
    assert pair([], [1.0]).pairs == []


def photos_of(events, folder, *, offset_s, skip=()):
    """JPEGs without position, their camera clock off by some seconds."""
    folder.mkdir(parents=True, exist_ok=True)
    for n, event in enumerate(events):
        if n not in skip:
            local = datetime.fromtimestamp(event.time_s + offset_s, UTC)
            exif = gps_exif(0.0, 0.0, local=local.strftime("%Y:%m:%d %H:%M:%S"), subsec="0")
            jpeg(folder / f"DSC{n:05d}.JPG", exif_bytes=exif)


@pytest.mark.parametrize("name", ["copter_cam_rtl_1x.BIN", "swarm_v2.tlog"])
def test_photos_beside_a_log_get_the_poses_of_its_camera_events(real_data, tmp_path, name):
    source = real_data("sitl_logs") / name
    (log,) = read_log(source)
    skip = {0, 7, 8}
    photos_of(log.events, tmp_path / "set" / "photos", offset_s=7200.0 + 15.0, skip=skip)
    (tmp_path / "set" / name).write_bytes(source.read_bytes())
    result = load([tmp_path / "set"])
    assert result.rejected == []
    assert len(result.frames) == len(log.events) - 3
    for frame in result.frames:
        event = log.events[int(frame.image[-9:-4])]
        assert frame.fix.lat_deg == pytest.approx(event.sample.lat_deg, abs=1e-9)
        assert frame.fix.height_m == pytest.approx(event.sample.height_m)
        assert frame.time_s == pytest.approx(event.time_s)
        assert math.degrees(frame.fix.pitch_rad) == pytest.approx(event.sample.flight_pitch_deg - 90.0, abs=1e-3)
        assert "camera fixed under the airframe" in frame.origin["angles"]
    assert any("3 camera events" in w and "1 of them before the first photo" in w for w in result.warnings)


def test_three_vehicles_find_their_own_logs(real_data, tmp_path):
    folder = real_data("sitl_logs")
    for n in (1, 2, 3):
        (log,) = read_log(folder / f"swarm_v{n}.tlog")
        photos_of(log.events, tmp_path / "day" / f"camera{n}", offset_s=3600.0 * n + n)
        (tmp_path / "day" / f"swarm_v{n}.tlog").write_bytes((folder / f"swarm_v{n}.tlog").read_bytes())
    result = load([tmp_path / "day"])
    assert len(result.frames) == 3 * 59
    for frame in result.frames:
        assert f"swarm_v{frame.vehicle[-1]}.tlog" in frame.origin["position"]


def test_photos_with_their_own_fields_keep_them(real_data, tmp_path):
    source = real_data("sitl_logs") / "swarm_v1.tlog"
    (log,) = read_log(source)
    (tmp_path / "s").mkdir()
    for n, event in enumerate(log.events[:20]):
        local = datetime.fromtimestamp(event.time_s + 4.0, UTC).strftime("%Y:%m:%d %H:%M:%S")
        lat, lon = event.sample.lat_deg + 1e-5, event.sample.lon_deg
        jpeg(tmp_path / "s" / f"P{n:03d}.JPG", exif_bytes=gps_exif(lat, lon, local=local, subsec="0"))
    (tmp_path / "s" / "v.tlog").write_bytes(source.read_bytes())
    frames = load([tmp_path / "s"]).frames
    assert len(frames) == 20
    for frame, event in zip(frames, log.events, strict=False):
        assert frame.fix.lat_deg == pytest.approx(event.sample.lat_deg + 1e-5, abs=1e-8)
        assert frame.origin["position"] == "EXIF GPS"
        assert frame.fix.height_m == pytest.approx(60.0, abs=0.5)


# --- timeline and clocks ------------------------------------------------------------------------------------------


def test_interpolation_takes_the_short_way_and_leaves_gaps():
    rows = [
        Sample(time_s=0.0, lat_deg=47.0, lon_deg=179.9999, yaw_deg=170.0),
        Sample(time_s=1.0, lat_deg=47.001, lon_deg=-179.9999, yaw_deg=-170.0),
        Sample(time_s=11.0, lat_deg=47.002, lon_deg=-179.9997),
    ]
    timeline = Timeline(rows, max_gap_s=2.0)
    middle = timeline.at(0.5)
    assert middle.lat_deg == pytest.approx(47.0005)
    assert abs(middle.lon_deg) == pytest.approx(180.0)
    assert abs(middle.yaw_deg) == pytest.approx(180.0)
    assert timeline.at(5.0).lat_deg is None
    assert timeline.at(11.0).lat_deg == 47.002
    assert timeline.at(11.5).lat_deg is None
    assert timeline.at(-0.1).lat_deg is None


MICROSECONDS = st.floats(0, 1e6).map(lambda t: round(t, 6))  # no clock is finer


@given(st.lists(st.tuples(MICROSECONDS, st.floats(-80, 80)), min_size=1, max_size=30), st.floats(-10, 1e6 + 10))
@settings(max_examples=100, deadline=None)
def test_interpolated_values_lie_between_their_neighbours(rows, at):
    timeline = Timeline([Sample(time_s=t, lat_deg=v, lon_deg=1.0) for t, v in rows], max_gap_s=1e9)
    value = timeline.at(at).lat_deg
    inside = min(t for t, _ in rows) <= at <= max(t for t, _ in rows)
    assert (value is not None) == inside
    if inside:
        assert min(v for _, v in rows) - 1e-9 <= value <= max(v for _, v in rows) + 1e-9


def test_heights_above_takeoff_and_above_ground_are_not_mixed():
    rows = [Sample(time_s=float(t), height_m=50.0) for t in range(10)]
    rows += [Sample(time_s=t + 0.5, height_m=30.0, height_is_ground=True) for t in range(4)]
    timeline = Timeline(rows)
    assert (timeline.at(2.0).height_m, timeline.at(2.0).height_is_ground) == (30.0, True)
    assert (timeline.at(8.0).height_m, timeline.at(8.0).height_is_ground) == (50.0, False)


@pytest.fixture(scope="module")
def flown(real_data):
    (log,) = read_log(real_data("sitl_logs") / "swarm_v1.tlog")
    return log.timeline()


def test_the_clock_offset_is_found_from_positions_in_any_zone(flown):
    times = np.linspace(flown.span[0] + 70, flown.span[1] - 40, 40)
    places = np.stack([flown.values("lat_deg", times), flown.values("lon_deg", times)], axis=-1)
    offset = offset_by_positions(times - 5 * 3600 + 15.3, places, flown)
    assert offset == pytest.approx(-5 * 3600 + 15.3, abs=0.25)


def test_the_zone_alone_is_found_where_nothing_else_is_known(flown):
    times = np.linspace(flown.span[0] + 70, flown.span[1] - 40, 40)
    assert offset_by_zone(times + 7200, flown) == 7200
    assert offset_by_zone(times + 86400 * 3, flown) is None


@pytest.mark.parametrize("offset", [-1.7e9, 15.0, 3600.0])
def test_the_clock_offset_is_found_from_turning(flown, offset):
    times = np.arange(flown.span[0] + 60, flown.span[1] - 30, 0.25)
    yaw = np.unwrap(np.radians(flown.values("flight_yaw_deg", times)))
    rates = np.degrees(np.gradient(yaw, 0.25)) + np.random.default_rng(0).normal(0, 2.0, len(times))
    found = offset_by_turning(times + offset, rates, flown, search_s=200.0)
    assert found is not None
    assert found[0] == pytest.approx(offset, abs=0.3)


def test_a_straight_flight_gives_no_offset():
    rows = [Sample(time_s=float(t), flight_yaw_deg=10.0) for t in range(200)]
    assert offset_by_turning(np.arange(0, 100, 0.25), np.zeros(400), Timeline(rows)) is None


def test_a_video_beside_a_log_is_placed_by_how_its_pictures_turn(real_data, tmp_path):
    """Pictures of a textured ground under the logged flight, the video's clock unknown."""
    cv2 = pytest.importorskip("cv2")
    av = pytest.importorskip("av")
    source = real_data("sitl_logs") / "swarm_v1.tlog"
    (log,) = read_log(source)
    timeline = log.timeline()
    rng = np.random.default_rng(0)
    ground = cv2.GaussianBlur(rng.integers(0, 255, (1600, 1600), np.uint8), (0, 0), 2.0)
    ground = cv2.normalize(ground, None, 0, 255, cv2.NORM_MINMAX)
    start = log.events[2].time_s
    times = start + np.arange(0, 100, 0.2)
    lat0, lon0 = timeline.values("lat_deg", times[:1])[0], timeline.values("lon_deg", times[:1])[0]
    with av.open(str(tmp_path / "flight.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=5)
        stream.width, stream.height, stream.pix_fmt = 240, 180, "yuv420p"
        for n, sample in enumerate(timeline.at_all(times)):
            north = (sample.lat_deg - lat0) * 111_195.0
            east = (sample.lon_deg - lon0) * 111_195.0 * math.cos(math.radians(lat0))
            turn = cv2.getRotationMatrix2D((120, 90), sample.flight_yaw_deg, 1.0)  # counter-clockwise as seen
            scale = 2.0  # pixels a metre
            shift = np.array([[1, 0, 120 - 800 - scale * east], [0, 1, 90 - 800 + scale * north], [0, 0, 1.0]])
            picture = cv2.warpAffine(
                ground, (np.vstack([turn, [0, 0, 1]]) @ shift)[:2], (240, 180), borderMode=cv2.BORDER_WRAP
            )
            frame = av.VideoFrame.from_ndarray(picture, format="gray").reformat(format="yuv420p")
            frame.pts = n
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    (tmp_path / "flight.tlog").write_bytes(source.read_bytes())
    result = load([tmp_path], options=LoadOptions(cache=tmp_path / "c", every_s=5.0))
    assert len(result.frames) >= 18
    for frame in result.frames:
        at = start + int(frame.image[-6:]) * 0.2
        assert frame.time_s == pytest.approx(at, abs=0.4)
        assert frame.fix.lat_deg == pytest.approx(float(timeline.values("lat_deg", at)), abs=3e-5)


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
    assert len(live._position.times) < 100
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
