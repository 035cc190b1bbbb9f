"""KLV: ST 0601 and EG 0104, checked against another implementation and real streams."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.formats.video import klv
from telemetry.samples.rotations import camera_angles_deg, euler_ned, mounted_down_deg


def local_set(items: dict[int, bytes], *, good: bool = True) -> bytes:
    body = b"".join(bytes([tag, len(raw)]) + raw for tag, raw in items.items()) + b"\x01\x02"
    total = len(body) + 2
    length = bytes([total]) if total < 128 else b"\x82" + total.to_bytes(2, "big")
    whole = klv.ST0601_KEY + length + body
    check = klv.checksum(whole) ^ (0 if good else 1)
    return whole + check.to_bytes(2, "big")


def lat(value: float) -> bytes:
    return round(value / 180 * 4294967294).to_bytes(4, "big", signed=True)


def lon(value: float) -> bytes:
    return round(value / 360 * 4294967294).to_bytes(4, "big", signed=True)


def altitude(value: float) -> bytes:
    return round((value + 900) / 19900 * 65535).to_bytes(2, "big")


def angle(value: float) -> bytes:
    return round(value / 360 * 4294967295).to_bytes(4, "big")


NADIR = {
    2: (1_700_000_000_500_000).to_bytes(8, "big"),
    4: b"AF-101",
    5: round(30.0 / 360 * 65535).to_bytes(2, "big"),
    13: lat(47.5),
    14: lon(-8.25),
    15: altitude(600.0),
    16: round(60.0 / 180 * 65535).to_bytes(2, "big"),
    18: angle(0.0),
    19: lon(-90.0),
    20: angle(0.0),
    25: altitude(480.0),
    65: b"\x11",
}


def test_a_camera_that_looks_straight_down():
    (packet,) = klv.packets(local_set(NADIR))
    sample = packet.sample
    assert (sample.lat_deg, sample.lon_deg) == pytest.approx((47.5, -8.25), abs=1e-6)
    assert (sample.yaw_deg, sample.pitch_deg, sample.roll_deg) == pytest.approx((30.0, -90.0, 0.0), abs=0.01)
    assert sample.altitude_m == pytest.approx(600.0, abs=0.2)
    assert sample.height_m == pytest.approx(120.0, abs=0.3)
    assert sample.height_is_ground
    assert sample.fov_deg == pytest.approx(60.0, abs=0.01)
    assert sample.time_s == pytest.approx(1_700_000_000.5)
    assert sample.vehicle == "AF-101"


SLANT_RANGE_110_M = round(110.0 / 5_000_000.0 * 4294967295).to_bytes(4, "big")


@pytest.mark.parametrize(
    ("heights", "expected"),
    [
        ({15: 600.0, 25: 480.0}, 120.0),
        ({75: 648.0, 78: 528.0}, 120.0),
        ({15: 600.0, 75: 648.0, 25: 480.0}, 120.0),
        ({15: 600.0, 75: 648.0, 78: 528.0}, 120.0),
        ({75: 648.0, 25: 480.0}, 110.0),  # the geoid lies between them: the slant range is left
        ({15: 600.0, 78: 528.0}, 110.0),
    ],
)
def test_a_height_is_the_difference_of_heights_over_one_surface(heights, expected):
    """The sensor 120 m over ground at 480 m above sea level, the geoid 48 m over the ellipsoid."""
    items = {tag: raw for tag, raw in NADIR.items() if tag not in (15, 25)}
    items |= {21: SLANT_RANGE_110_M} | {tag: altitude(value) for tag, value in heights.items()}
    (packet,) = klv.packets(local_set(dict(sorted(items.items()))))
    assert packet.sample.height_m == pytest.approx(expected, abs=0.4)
    assert packet.sample.height_is_ground


def test_a_wrong_or_missing_checksum_is_refused_with_its_reason():
    (packet,) = klv.packets(local_set(NADIR, good=False))
    assert packet.sample is None
    assert "checksum" in packet.error
    whole = klv.ST0601_KEY + bytes([len(lat(1)) + 2, 13, 4]) + lat(47.0)
    (packet,) = klv.packets(whole)
    assert "checksum" in packet.error


def test_a_bad_packet_does_not_hide_the_next():
    data = local_set(NADIR, good=False) + b"junk" + local_set(NADIR) + klv.ST0601_KEY + b"\x82\xff\xff"
    found = list(klv.packets(data))
    assert [bool(p.sample) for p in found] == [False, True, False]
    assert found[-1].error == "the packet is cut off"


def test_a_sync_stream_with_access_unit_headers_is_found():
    data = b"\xfc\x00\x0f\x00\x60" + local_set(NADIR)
    assert [p.sample is not None for p in klv.packets(data)] == [True]


def test_out_of_range_markers_are_no_numbers():
    (packet,) = klv.packets(local_set({**NADIR, 13: b"\x80\0\0\0"}))
    assert packet.sample.lat_deg is None
    assert packet.sample.yaw_deg is not None


NAMES = {
    5: "platform_heading", 6: "platform_pitch", 7: "platform_roll", 13: "sensor_latitude",
    14: "sensor_longitude", 15: "sensor_altitude", 16: "horizontal_fov", 17: "vertical_fov",
    18: "relative_azimuth", 19: "relative_elevation", 20: "relative_roll", 21: "slant_range",
    22: "target_width", 23: "frame_center_latitude", 24: "frame_center_longitude",
    25: "frame_center_elevation", 75: "sensor_ellipsoid_height", 90: "platform_pitch_full",
    78: "frame_center_ellipsoid_height", 91: "platform_roll_full",
}  # fmt: skip


def _items(whole: bytes) -> dict[int, bytes]:
    """Items with one-byte tags of a real packet."""
    length, at = klv.ber_length(whole, 16)
    end, items = at + length, {}
    while at < end:
        tag = whole[at]
        size, start = klv.ber_length(whole, at + 1 + (tag >= 128))
        items[tag] = whole[start : start + size]
        at = start + size
    return items


def _compare(whole: bytes) -> int:
    st0601 = pytest.importorskip("stanag4609.st0601")
    theirs = st0601.decode_uas_local_set(whole)
    (ours,) = klv.packets(whole)
    compared = 0
    for tag, name in NAMES.items():
        field = theirs.get(tag)
        if field is not None and isinstance(field.value, float):
            assert ours.values[name] == pytest.approx(field.value, abs=1e-9), name
            compared += 1
    return compared


def test_real_st0601_values_agree_with_stanag4609(real_data):
    body = klv_of((real_data("kwiver_klv") / "h264_klv.ts").read_bytes())
    assert sum(p.sample is not None for p in klv.packets(body)) == 30
    items = _items(body)
    kept = {tag: items[tag] for tag in (2, *NAMES, 65) if tag in items}
    assert _compare(local_set(kept)) == len(NAMES)


@given(st.lists(st.integers(0, 2**32 - 1), min_size=len(NAMES), max_size=len(NAMES)))
@settings(max_examples=60, deadline=None)
def test_any_st0601_values_agree_with_stanag4609(raw):
    items = {2: NADIR[2]}
    for (tag, _), value in zip(NAMES.items(), raw, strict=True):
        size = klv._NUMBERS[tag][1]
        items[tag] = (value % (1 << 8 * size)).to_bytes(size, "big")
    _compare(local_set({**items, 65: b"\x11"}))


def klv_of(transport: bytes) -> bytes:
    import io

    import av

    with av.open(io.BytesIO(transport)) as container:
        return b"".join(bytes(p) for p in container.demux() if p.stream.type == "data" and p.size)


def test_our_encoding_of_the_test_set_is_read_alike_by_stanag4609():
    st0601 = pytest.importorskip("stanag4609.st0601")
    theirs = st0601.decode_uas_local_set(local_set(NADIR))
    assert theirs.get(13).value == pytest.approx(47.5, abs=1e-6)
    assert theirs.get(14).value == pytest.approx(-8.25, abs=1e-6)
    assert theirs.get(19).value == pytest.approx(-90.0, abs=1e-6)


def test_universal_sets_of_real_aircraft(real_data):
    """The optical axis must hit the ground where the packet says the frame's centre is."""
    import numpy as np

    from telemetry.samples.course import local_metres

    found = list(klv.packets(klv_of((real_data("kwiver_klv") / "aphill_short.ts").read_bytes())))
    assert len(found) == 48
    assert {p.kind for p in found} == {"EG 0104"}
    for packet in found:
        s, v = packet.sample, packet.values
        centre = (v["frame_center_latitude"], v["frame_center_longitude"])
        east, north = local_metres([s.lat_deg, centre[0]], [s.lon_deg, centre[1]])[1]
        down = np.tan(np.radians(90.0 + s.pitch_deg)) * s.height_m
        predicted = down * np.array([np.sin(np.radians(s.yaw_deg)), np.cos(np.radians(s.yaw_deg))])
        assert np.hypot(*(predicted - (east, north))) < 60.0  # 4 % of the distance: two sensors' errors


def universal(items: dict[str, bytes]) -> bytes:
    body = b"".join(bytes.fromhex("060e2b3401010101" + key) + bytes([len(raw)]) + raw for key, raw in items.items())
    return klv.EG0104_KEY + b"\x82" + len(body).to_bytes(2, "big") + body


def test_universal_set_fields():
    data = universal(
        {
            "0702010101050000": (1_700_000_000_000_000).to_bytes(8, "big"),
            "0701020102040200": struct.pack(">d", 47.5),
            "0701020102060200": struct.pack(">d", 8.5),
            "0701020102020000": struct.pack(">f", 900.0),
            "0701080101000000": struct.pack(">f", 1000.0),
            "0701100102000000": struct.pack(">f", 90.0),
            "0701100103000000": struct.pack(">f", 30.0),
        }
    )
    (packet,) = klv.packets(data)
    assert packet.sample.pitch_deg == pytest.approx(-30.0)
    assert packet.sample.yaw_deg == pytest.approx(90.0)
    assert packet.sample.height_m == pytest.approx(500.0)


@given(st.floats(-170, 170), st.floats(-80, 80), st.floats(-80, 80))
@settings(max_examples=100, deadline=None)
def test_camera_under_an_airframe_has_the_airframes_angles(yaw, pitch, roll):
    assert mounted_down_deg(euler_ned(yaw, pitch, roll)) == pytest.approx((yaw, pitch - 90.0, roll), abs=1e-6)


@given(st.floats(-170, 170), st.floats(-89, -1))
@settings(max_examples=50, deadline=None)
def test_an_optical_axis_keeps_azimuth_and_elevation(yaw, elevation):
    assert camera_angles_deg(euler_ned(yaw, elevation, 0.0))[:2] == pytest.approx((yaw, elevation), abs=1e-6)


@given(st.binary(max_size=300))
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_survived(data):
    list(klv.packets(data))
    list(klv.packets(klv.ST0601_KEY + data))
    list(klv.packets(klv.EG0104_KEY + data))


@given(st.data())
@settings(max_examples=300, deadline=None)
def test_flipped_bits_never_give_a_silently_wrong_packet(data):
    whole = bytearray(local_set(NADIR))
    whole[data.draw(st.integers(16, len(whole) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    assert all(packet.sample is None for packet in klv.packets(bytes(whole)))
