"""SEI: NAL units, our own message, other systems' messages, the registry, damage."""

import json
import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.formats.video import bitstream, sei
from telemetry.formats.video.bitstream import StreamFormat
from telemetry.samples.sample import Sample

FORMATS = [StreamFormat("h264"), StreamFormat("hevc"), StreamFormat("h264", 4), StreamFormat("hevc", 4)]

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)
samples = st.builds(
    Sample,
    time_s=st.none() | st.floats(1.0, 7e9),
    lat_deg=st.floats(-89, 89).filter(lambda v: abs(v) > 1e-3),
    lon_deg=st.floats(-180, 180),
    height_m=st.none() | st.floats(-500, 9000),
    altitude_m=st.none() | st.floats(-500, 9000),
    yaw_deg=st.none() | st.floats(-360, 360),
    pitch_deg=st.none() | st.floats(-180, 180),
    roll_deg=st.none() | st.floats(-180, 180),
    flight_yaw_deg=st.none() | st.floats(-360, 360),
    fov_deg=st.none() | st.floats(1, 170),
    sigma_m=st.none() | st.floats(0.001, 1000),
    vehicle=st.none()
    | st.text(st.characters(min_codepoint=33, max_codepoint=0x2FFF, categories=["L", "N"]), max_size=16, min_size=1),
    height_is_ground=st.booleans(),
)


def packet(form: StreamFormat, slice_bytes: bytes = b"\x11" * 50) -> bytes:
    """A parameter set and a slice, as an encoder lays them."""
    units = [b"\x67\x42\0\x1f\x80", b"\x65" + slice_bytes] if form.codec == "h264" else []
    units = units or [b"\x42\x01\x01\x80", b"\x26\x01" + slice_bytes]
    if form.prefix:
        return b"".join(len(u).to_bytes(form.prefix, "big") + u for u in units)
    return b"".join(b"\0\0\0\1" + u for u in units)


def user_data(uuid: bytes, body: bytes) -> list[tuple[int, bytes]]:
    return [(5, uuid + body)]


@given(samples)
@settings(max_examples=200, deadline=None)
def test_our_message_comes_back_exactly(sample):
    reading = sei.read([(5, sei.encode(sample))])
    assert reading.sample == sample
    assert reading.decoders == ("SEI OrthoSwarm",)


@given(samples, st.sampled_from(FORMATS))
@settings(max_examples=100, deadline=None)
def test_a_message_put_into_a_packet_is_found_there_again(sample, form):
    before = packet(form)
    after = bitstream.insert_unit(before, bitstream.sei_unit(5, sei.encode(sample), form), form)
    assert sei.read(bitstream.sei_messages(after, form)).sample == sample
    kept = [after[a:b] for a, b in bitstream.nal_units(after, form) if not form.is_sei(form.kind(after[a]))]
    assert kept == [before[a:b] for a, b in bitstream.nal_units(before, form)]


@given(st.binary(max_size=300))
@settings(max_examples=300, deadline=None)
def test_emulation_prevention_is_its_own_inverse(data):
    escaped = bitstream.escape(data + b"\x80")
    assert bitstream.unescape(escaped) == data + b"\x80"
    assert b"\0\0\1" not in escaped
    assert b"\0\0\0" not in escaped


@given(st.integers(0, 600), st.binary(max_size=700), st.sampled_from(FORMATS))
@settings(max_examples=150, deadline=None)
def test_any_payload_type_and_size_round_trips(kind, payload, form):
    data = bitstream.insert_unit(packet(form), bitstream.sei_unit(kind, payload, form), form)
    assert bitstream.sei_messages(data, form) == [(kind, payload)]


def test_the_documented_byte_layout():
    payload = sei.encode(Sample(time_s=1.5, lat_deg=47.0, lon_deg=8.0, vehicle="v1", height_is_ground=True))
    assert payload[:16].hex() == "0470547eac274f00856a5455b0eaf430"
    version, flags, length = struct.unpack_from(">BBH", payload, 16)
    assert (version, flags, length) == (1, 1, 2)
    numbers = struct.unpack_from(">11d", payload, 20)
    assert numbers[:3] == (1.5, 47.0, 8.0)
    assert math.isnan(numbers[3])
    assert payload[108:110] == b"v1"
    assert len(payload) == 114


def test_a_flipped_bit_in_our_message_is_noticed():
    payload = bytearray(sei.encode(Sample(lat_deg=47.0, lon_deg=8.0)))
    payload[30] ^= 4
    assert sei.read([(5, bytes(payload))]) is None


def test_an_over_long_vehicle_is_cut():
    reading = sei.read([(5, sei.encode(Sample(lat_deg=1.0, lon_deg=1.0, vehicle="ä" * 65536)))])
    assert reading.sample.vehicle == "ä" * 32


def test_misb_time_in_micro_and_nanoseconds():
    def stamp(value: int) -> bytes:
        b = value.to_bytes(8, "big")
        return b"\x1f" + b[:2] + b"\xff" + b[2:4] + b"\xff" + b[4:6] + b"\xff" + b[6:]

    for uuid, value in (
        (b"MISPmicrosectime", 1_700_000_000_123_456),
        (bytes.fromhex("a8687dd4d7593758a5cef0338b6545f1"), 1_700_000_000_123_456),
        (bytes.fromhex("cf848278ee23306c9265e8fef22fb8b8"), 1_700_000_000_123_456_000),
    ):
        assert sei.read(user_data(uuid, stamp(value))).sample.time_s == pytest.approx(1_700_000_000.123456, abs=1e-5)


def test_misb_time_agrees_with_stanag4609():
    st0604 = pytest.importorskip("stanag4609.st0604")
    value = 1_224_807_209_913_000
    for unit, form in (
        (st0604.encode_avc_timestamp_sei(value), StreamFormat("h264")),
        (st0604.encode_hevc_timestamp_sei(value), StreamFormat("hevc")),
    ):
        unit = unit if unit[:3] in (b"\0\0\1", b"\0\0\0") else b"\0\0\0\1" + unit
        reading = sei.read(bitstream.sei_messages(unit + packet(form), form))
        assert reading.sample.time_s == pytest.approx(value * 1e-6, abs=1e-6)


def test_the_gimbal_camera_struct():
    body = struct.pack(
        "<ddfHBBBBfiiiddhhhiHHHHHHHIII", 8.5, 47.25, 512.5, 2024, 5, 6, 12, 30, 15.5, 9000, -10, -9000,
        0, 0, *([0] * 14),
    )  # fmt: skip
    sample = sei.read(user_data(bytes.fromhex("a1b2c3d4e5f6a7b8c9daebfc1a2b3c4d"), body)).sample
    assert (sample.lat_deg, sample.lon_deg, sample.altitude_m) == (47.25, 8.5, 512.5)
    assert (sample.yaw_deg, sample.roll_deg, sample.pitch_deg) == (90.0, -0.1, -90.0)
    assert sample.time_s == 1714998615.5


def dji_payload(*, yaw=179.5, tilt=90.0, north_mm=70_000, east_mm=-70_000, down_mm=-150_000, home_alt_mm=-30_000):
    def split(value: int) -> tuple[int, int]:
        return value & 0xFFFF, value >> 16

    lows, highs = zip(*map(split, (north_mm, east_mm, down_mm)), strict=True)
    pose = b"\1\2\3" + struct.pack("<iii", round(yaw * 1e7), 0, round(tilt * 1e7))
    pose += struct.pack("<HHHhhh", *lows, *highs)
    pose += struct.pack("<iii", round(47.0 / 180 * 2**32), round(8.0 / 360 * 2**32), home_alt_mm)
    optics = b"\1" + struct.pack("<III", 9652, 5429, 6720)
    records = struct.pack("<HH", 4, len(pose)) + pose + struct.pack("<HH", 10, len(optics)) + optics
    return records + struct.pack("<HH", 6, 9) + b"\0" * 9 + b"\0" * 16


def test_dji_live_streams():
    sample = sei.read([(245, dji_payload())]).sample
    assert sample.yaw_deg == pytest.approx(179.5)
    assert sample.pitch_deg == pytest.approx(0.0)
    assert sample.lat_deg == pytest.approx(47.0 + 70.0 / 111195, abs=1e-7)
    assert sample.lon_deg == pytest.approx(8.0 - 70.0 / (111195 * math.cos(math.radians(47))), abs=1e-7)
    assert (sample.altitude_m, sample.height_m) == (150.0, 120.0)
    assert sample.fov_deg == pytest.approx(math.degrees(2 * math.atan(9652 / 2 / 6720)))


def test_json_under_any_uuid():
    body = json.dumps({"timestamp": 1714998615500, "lat": 47.1, "lng": "8.2", "gimbal": {"gimbal_pitch": -90}}).encode()
    sample = sei.read(user_data(bytes(range(16)), body)).sample
    assert (sample.time_s, sample.lat_deg, sample.lon_deg, sample.pitch_deg) == (1714998615.5, 47.1, 8.2, -90.0)


@pytest.mark.parametrize("body", [b"x264 - core 164 r3095", b'{"encoder": "x"}', b'{"lat": "NaN"', b"", b"{" * 5000])
def test_an_encoders_settings_and_other_text_are_not_recognised(body):
    assert sei.read(user_data(bytes(range(16)), body)) is None


def test_a_position_beats_a_bare_time_stamp_and_both_are_kept():
    stamp = sei.encode(Sample(time_s=5.0))
    place = json.dumps({"lat": 47.1, "lon": 8.2}).encode()
    reading = sei.read([(5, stamp), *user_data(bytes(16), place)])
    assert (reading.sample.time_s, reading.sample.lat_deg) == (5.0, 47.1)


def test_a_users_decoder_takes_ten_lines_and_may_fail():
    uuid = bytes.fromhex("00112233445566778899aabbccddeeff")
    mine = sei.Decoder("mine", 5, uuid, lambda b: Sample(lat_deg=b[0] / 2, lon_deg=b[1] / 2))
    sei.register(mine)
    try:
        assert sei.read(user_data(uuid, b"\x10\x20")).sample.lon_deg == 16.0
        assert sei.read(user_data(uuid, b"")) is None
    finally:
        sei.unregister(mine)
    assert sei.read(user_data(uuid, b"\x10\x20")) is None


def test_a_decoder_is_found_by_its_entry_point_and_a_broken_one_is_passed_over(monkeypatch):
    import importlib.metadata

    class Point:
        def __init__(self, what):
            self._what = what

        def load(self):
            if self._what is None:
                raise ImportError("broken plug-in")
            return self._what

    uuid = bytes(range(100, 116))
    mine = sei.Decoder("mine", 5, uuid, lambda b: Sample(lat_deg=47.0, lon_deg=8.0))
    monkeypatch.setattr(
        importlib.metadata, "entry_points", lambda group: [Point(None), Point("no decoder"), Point(mine)]
    )
    sei.load_entry_points.cache_clear()
    try:
        assert sei.read(user_data(uuid, b"x")).decoders == ("mine",)
    finally:
        sei.unregister(mine)
        sei.load_entry_points.cache_clear()


@pytest.mark.parametrize("bad", [{"lat_deg": 0.0, "lon_deg": 0.0}, {"lat_deg": 91.0, "lon_deg": 5.0}])
def test_impossible_positions_are_dropped(bad):
    reading = sei.read([(5, sei.encode(Sample(yaw_deg=5.0, **bad)))])
    assert not reading.sample.has_position


@given(st.binary(max_size=600), st.sampled_from(FORMATS))
@settings(max_examples=400, deadline=None)
def test_any_bytes_are_survived_and_bounded(data, form):
    messages = bitstream.sei_messages(data, form)
    assert len(messages) <= bitstream.MAX_MESSAGES
    sei.read(messages)


@given(st.data(), st.sampled_from(FORMATS))
@settings(max_examples=300, deadline=None)
def test_flipped_and_cut_packets_are_survived(data, form):
    payloads = [sei.encode(Sample(lat_deg=47.0, lon_deg=8.0, vehicle="v"))]
    whole = bytearray(packet(form))
    for payload in payloads:
        whole = bytearray(bitstream.insert_unit(bytes(whole), bitstream.sei_unit(5, payload, form), form))
    whole = bytearray(bitstream.insert_unit(bytes(whole), bitstream.sei_unit(245, dji_payload(), form), form))
    for _ in range(data.draw(st.integers(1, 6))):
        whole[data.draw(st.integers(0, len(whole) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    cut = bytes(whole[: data.draw(st.integers(0, len(whole)))])
    reading = sei.read(bitstream.sei_messages(cut, form))
    if reading is not None and reading.sample.has_position:
        assert abs(reading.sample.lat_deg) <= 90
        assert abs(reading.sample.lon_deg) <= 180


@pytest.mark.parametrize("kind", [5, 245])
@given(st.binary(max_size=200))
@settings(max_examples=200, deadline=None)
def test_decoders_survive_any_payload(kind, body):
    for uuid in {u for k, u in sei._REGISTRY if k == kind and u} or {b""}:
        sei.read([(kind, uuid + body)])


def test_extradata_tells_the_length_prefix():
    assert StreamFormat.of("h264", b"\x01\x64\0\x1f\xff\xe1") == StreamFormat("h264", 4)
    assert StreamFormat.of("h264", b"\0\0\0\1\x67") == StreamFormat("h264", 0)
    assert StreamFormat.of("hevc", b"\x01" + b"\0" * 20 + b"\xff" + b"\0") == StreamFormat("hevc", 4)
    assert StreamFormat.of("hevc", None) == StreamFormat("hevc", 0)
    assert StreamFormat.of("mpeg2video", b"") is None


@pytest.mark.parametrize("start", [bytes.fromhex("2ca2de09b51747dbbb55a4fe7fc2fc4e"), b""], ids=["UUID", "no UUID"])
def test_the_settings_of_an_encoder_are_no_message_of_a_maker(start):
    settings_text = start + b"x265 (build 192) - 3.5+1: H.265/HEVC codec, options: bitdepth=8"
    assert sei.unknown([(5, settings_text)]) == []
    assert sei.unknown([(5, bytes(16) + b"12")]) == [("00" * 16, 2)]
