"""DJI subtitles in all layouts of the field, and djmd messages."""

import math
import re
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.formats.video.djmd import parse_message, read_djmd
from telemetry.formats.video.srt import parse_srt, read_srt
from telemetry.videos.picture_poses import Poses
from telemetry.videos.video_file import PictureNote, VideoScan


def block(text: str, n: int = 1) -> str:
    return f"{n}\n00:00:{n:02d},000 --> 00:00:{n:02d},500\n{text}\n\n"


REAL = [
    # file, cues, latitude first, first position, height, altitude, camera pitch and yaw
    ("air2s.srt", 17, None, (41.424724, 2.234156), None, 117.0, None),
    ("matrice_300.srt", 381, True, (36.6146, -6.1120), 0.3, None, None),
    ("mavic_air2.srt", 25, None, (41.420684, 2.162162), None, 27.3, None),
    ("mavic_mini.SRT", 117, False, (48.0771, -121.7458), 200.7, None, None),
    ("mix_p4rtk_mavic2pro.srt", 12, False, (-34.6502, -59.409424), 17.39, None, (-27.3, -76.0)),
    ("p4_rtk.SRT", 55, False, (-34.237922, -58.851745), 85.8, None, (-24.4, 110.4)),
    ("p4p_sample.SRT", 5, False, (47.4692, 8.2090), 45.6, None, None),
]


@pytest.mark.parametrize(("name", "count", "order", "position", "height", "altitude", "gimbal"), REAL)
def test_real_files(real_data, name, count, order, position, height, altitude, gimbal):
    found = read_srt(real_data("dji_srt_small") / name)
    assert len(found.cues) == count
    assert found.latitude_first is order
    sample = found.cues[0].sample
    assert (sample.lat_deg, sample.lon_deg) == pytest.approx(position)
    assert (sample.height_m, sample.altitude_m) == (height, altitude)
    assert gimbal is None or (sample.pitch_deg, sample.yaw_deg) == gimbal
    assert all(-90 <= c.sample.lat_deg <= 90 for c in found.cues if c.sample and c.sample.has_position)


def test_a_real_file_without_positions_says_so(real_data):
    found = read_srt(real_data("dji_srt_small") / "mavic_air.SRT")
    assert "srt-no-position" in found.notes
    assert found.cues[0].sample.time_s == pytest.approx(1519027491.265847)


def test_the_distance_to_home_settles_the_order_of_a_tuple():
    home = "HOME (47.500000, 8.200000, 400m), D {:.2f}m, H 50.0m"
    text = "".join(
        block(f"F/2.8, GPS ({47.5 + 1e-3 * n:.6f}, 8.200000, 12), " + home.format(111.195 * n), n) for n in range(1, 5)
    )
    found = parse_srt(text)
    assert found.latitude_first is True
    assert found.cues[0].sample.lat_deg == pytest.approx(47.501)


def test_a_longitude_beyond_90_settles_the_order_too():
    assert parse_srt(block("GPS (-121.7, 48.0, 17), H 20.0m")).latitude_first is False
    assert parse_srt(block("GPS(48.0,-121.7,0.0M) BAROMETER:0.3M")).latitude_first is True


def test_newer_brackets_with_gimbal_and_both_altitudes():
    text = (
        '<font size="28">FrameCnt: 7, DiffTime: 33ms\n2024-05-06 12:00:01.250\n[iso: 100] [latitude: 47.5] '
        "[longitude: 8.25] [rel_alt: 50.100 abs_alt: 512.300] [gb_yaw: -12.5 gb_pitch: -90.0 gb_roll: 0.0] </font>"
    )
    sample = parse_srt(block(text)).cues[0].sample
    assert (sample.height_m, sample.altitude_m) == (50.1, 512.3)
    assert (sample.yaw_deg, sample.pitch_deg) == (-12.5, -90.0)
    assert sample.number == 7
    assert sample.time_s == 1714996801.25


def test_the_misspelt_longitude_is_read():
    assert parse_srt(block("[latitude : 47.5] [longtitude : 8.25]")).cues[0].sample.lon_deg == 8.25


def test_oddities_are_named():
    text = block("GPS (8.2090, 47.4692, 18), H 45.60m", 5) + block("nothing", 3)
    notes = parse_srt(text).notes
    assert {"position-coarse", "srt-gaps", "time-backwards", "srt-no-attitude"} <= set(notes)
    assert "srt-empty" in parse_srt("no times in here").notes


@pytest.mark.parametrize(
    "written",
    [
        "[latitude: 47.469200] [longitude: 8.209000] [rel_alt: 45.600 abs_alt: 512.300]",
        "GPS (8.2090, 47.4692, 18), D 49.21m, H 45.60m, H.S 2.44m/s, V.S 0.00m/s",
        "GPS(47.4692,8.2090,0.0M) BAROMETER:45.6M",
        "HOME(8.1000,47.4692) 2017.08.05 14:11:51\nGPS(8.2090,47.4692,16) BAROMETER:45.6",
    ],
)
def test_a_decimal_comma_is_read_like_a_point(written):
    point = parse_srt(block("2022-08-07 13:40:40,774,808\n" + written)).cues[0].sample
    comma = parse_srt(block("2022-08-07 13:40:40,774,808\n" + re.sub(r"(\d)\.(\d+)(?!\.)\b", r"\1,\2", written)))
    assert (point.lat_deg, point.lon_deg, point.height_m) == (47.4692, 8.209, 45.6)
    for name in ("lat_deg", "lon_deg", "height_m", "altitude_m"):
        assert getattr(comma.cues[0].sample, name) == getattr(point, name)


def counted(times):
    """Subtitles with a block of a second at each of some times, and their latitudes."""
    places = [47.0 + 0.001 * i for i in range(len(times))]
    text = ""
    for i, t in enumerate(times):
        clock = f"{t // 3600:02d}:{t // 60 % 60:02d}:{t % 60:02d}"
        text += f"{i}\n{clock},000 --> {clock},999\n[latitude: {places[i]:.4f}] [longitude: 8.25]\n\n"
    return text, places


@given(st.lists(st.integers(7, 60), min_size=1, max_size=4))
@settings(max_examples=30, deadline=None)
def test_subtitles_of_joined_recordings_follow_each_other(lengths):
    """Each counts from zero; every block keeps its place in the order of the file."""
    text, places = counted([t for seconds in lengths for t in range(seconds)])
    found = parse_srt(text)
    assert [cue.sample.lat_deg for cue in found.cues] == pytest.approx(places)
    assert [cue.start_s for cue in found.cues] == pytest.approx(range(sum(lengths)), abs=0.01)
    assert len(found.joints_s) == len(lengths) - 1
    assert ("srt-joined" in found.notes) == (len(lengths) > 1)


@given(st.lists(st.integers(7, 60), min_size=1, max_size=3), st.data())
@settings(max_examples=100, deadline=None)
def test_one_damaged_time_leaves_all_other_blocks_where_they_are(lengths, data):
    times = [t for seconds in lengths for t in range(seconds)]
    # Where a recording ends is not known if its last block is damaged.
    inside = [i for i, t in enumerate(times) if t >= 2 and 0 not in times[i + 1 : i + 3]]
    damaged = data.draw(st.sampled_from([0, *inside]))
    times[damaged] = data.draw(st.sampled_from([0, 1, 3]) | st.integers(0, 7200))
    found = parse_srt(counted(times)[0])
    starts = [cue.start_s for i, cue in enumerate(found.cues) if i != damaged]
    assert starts == pytest.approx([i for i in range(len(times)) if i != damaged], abs=0.01)
    assert len(found.joints_s) == len(lengths) - 1


@pytest.mark.parametrize("damaged", [600, 0])
def test_a_damaged_time_is_no_joint_of_recordings(damaged):
    found = parse_srt(counted([*range(8), damaged, *range(9, 20)])[0])
    assert [cue.start_s for cue in found.cues] == [*range(8), damaged, *range(9, 20)]
    assert not found.joints_s and "time-backwards" in found.notes


@given(st.text(max_size=400))
@settings(max_examples=150, deadline=None)
def test_any_text_is_survived(text):
    parse_srt(text)
    parse_srt(block(text))


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_damaged_files_are_survived(data):
    raw = bytearray(
        block("GPS (-58.851745, -34.237922, 15), HOME (-58.847509, -34.232707, -57.98m), D 698.70m, H 85.80m, "
              "F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-24.4°, 0.0°, 110.4°)").encode() * 3
    )  # fmt: skip
    for _ in range(data.draw(st.integers(1, 10))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    for cue in parse_srt(raw[: data.draw(st.integers(0, len(raw)))].decode("utf-8", "replace")).cues:
        if cue.sample is not None and cue.sample.has_position:
            assert abs(cue.sample.lat_deg) <= 90
            assert abs(cue.sample.lon_deg) <= 180


def test_a_hostile_file_takes_no_longer_than_its_size():
    parse_srt("GPS(" * 100_000)
    parse_srt(block("[" * 3000 + "latitude: " * 300))
    parse_srt("00:00:01,000 --> 00:00:02,000\n" * 20_000)


def varint(value: int) -> bytes:
    value &= 2**64 - 1
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def message(fields: dict[int, object]) -> bytes:
    out = b""
    for number, value in fields.items():
        if isinstance(value, dict):
            value = message(value)
        if isinstance(value, bytes):
            out += varint(number << 3 | 2) + varint(len(value)) + value
        elif isinstance(value, float):
            out += varint(number << 3 | 1) + struct.pack("<d", value)
        else:
            out += varint(number << 3) + varint(value)
    return out


def djmd(*, yaw=1235, pitch=-900, lat=47.5, lon=8.25, degrees=False) -> bytes:
    place = {2: lat, 3: lon} if degrees else {2: math.radians(lat), 3: math.radians(lon)}
    position = {1: ({1: 1} if degrees else {}) | place, 2: 512_300}
    body = {1: {1: 17}, 3: {3: {1: -5, 2: 12, 3: 1200}, 4: position, 5: {1: 50_100}}, 4: {3: {1: pitch, 3: yaw}}}
    return message({3: body})


@pytest.mark.parametrize("degrees", [False, True])
def test_djmd_of_a_mavic_3(degrees):
    sample = read_djmd(djmd(degrees=degrees))
    assert (sample.lat_deg, sample.lon_deg) == pytest.approx((47.5, 8.25))
    assert (sample.altitude_m, sample.height_m) == pytest.approx((512.3, 50.1))
    assert (sample.yaw_deg, sample.pitch_deg, sample.roll_deg) == pytest.approx((123.5, -90.0, 0.0))
    assert sample.flight_roll_deg == pytest.approx(-0.5)
    assert sample.flight_yaw_deg == pytest.approx(120.0)
    assert sample.number == 17


def test_djmd_of_an_avata_and_of_an_action_camera():
    position = {1: {2: math.radians(47.5), 3: math.radians(8.25)}, 2: 512_300}
    sample = read_djmd(message({3: {4: {3: {3: 900}, 4: position, 5: {1: 50_100}}}}))
    assert (sample.lat_deg, sample.height_m, sample.flight_yaw_deg) == pytest.approx((47.5, 50.1, 90.0))
    assert sample.yaw_deg is None
    sample = read_djmd(message({3: {4: {2: position}}}))
    assert sample.lat_deg == pytest.approx(47.5)
    assert sample.height_m is None


def test_the_utc_of_an_action_camera_dates_its_pictures_between_the_seconds(tmp_path):
    scan = VideoScan(path=tmp_path / "a.mp4", codec="h264", width=64, height=48, rate=10.0)
    scan.pictures = [PictureNote(0.1 * i) for i in range(40)]
    for i in range(40):
        text = f"2024-05-06 10:11:{12 + (3 + i) // 10:02d}".encode()  # the video begins at 12.3 s
        place = {1: {2: math.radians(47.5), 3: math.radians(8.25)}, 2: 512_300, 6: {1: text}}
        scan.djmd_samples.append((0.1 * i, read_djmd(message({3: {4: {2: place}}}))))
    poses = Poses(scan)
    assert [poses.of(i).sample.time_s for i in (0, 5, 39)] == pytest.approx(
        [1_714_990_272.3, 1_714_990_272.8, 1_714_990_276.2]
    )


@given(st.binary(max_size=300))
@settings(max_examples=200, deadline=None)
def test_any_message_is_survived(data):
    parse_message(data)
    read_djmd(data)
    read_djmd(message({3: data}))


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_flipped_bits_in_djmd_are_survived(data):
    raw = bytearray(djmd())
    for _ in range(data.draw(st.integers(1, 6))):
        raw[data.draw(st.integers(0, len(raw) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    sample = read_djmd(bytes(raw))
    assert sample is None or not sample.has_position or abs(sample.lat_deg) <= 90


@pytest.mark.parametrize(
    "text",
    ["HOME(8.0,47.0) 2017.08.05 14:11:51\nGPS(8.25,47.5,16) BAROMETER(91.2)", "GPS (8.25, 47.5, 16), D 9.0m, Hb:91.2"],
)
def test_heights_of_older_forms_are_read(text):
    (cue,) = parse_srt(f"1\n00:00:00,000 --> 00:00:01,000\n{text}\n").cues
    assert cue.sample.height_m == 91.2


def test_a_file_without_cue_times_is_placed_by_its_dates():
    block = "{}\n2019-04-01 10:00:{:02d}.500\n[latitude: 47.5] [longitude: 8.25]\n"
    cues = parse_srt("\n".join(block.format(i, 10 + 2 * i) for i in range(3))).cues
    assert [cue.start_s for cue in cues] == [0.0, 2.0, 4.0]
    assert all(cue.sample.lat_deg == 47.5 for cue in cues)
