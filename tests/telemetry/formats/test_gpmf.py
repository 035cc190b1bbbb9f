"""GoPro's metadata track, from packets made by its published layout."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from telemetry.formats.video.gpmf import read_gpmf
from telemetry.videos.picture_poses import Poses
from telemetry.videos.video_file import PictureNote, VideoScan


def entry(key, kind, size, rows, body):
    return key + struct.pack(">BBH", ord(kind) if kind else 0, size, rows) + body + bytes(-len(body) % 4)


def nested(key, *inner):
    body = b"".join(inner)
    return entry(key, "", 1, len(body), body)


def gps5(count=18):
    rows = [(475_000_000 + 100 * i, 82_500_000, 612_500, 5000, 50) for i in range(count)]
    return nested(
        b"DEVC",
        nested(
            b"STRM",
            entry(b"GPSF", "L", 4, 1, struct.pack(">I", 3)),
            entry(b"GPSU", "U", 16, 1, b"240506101112.500"),
            entry(b"SCAL", "l", 4, 5, struct.pack(">5i", 10**7, 10**7, 1000, 1000, 100)),
            entry(b"GPS5", "l", 20, count, b"".join(struct.pack(">5i", *row) for row in rows)),
        ),
    )


def test_gps5_is_read_with_its_scale_and_time():
    samples = read_gpmf(gps5())
    assert len(samples) == 18
    assert (samples[1].lat_deg, samples[1].lon_deg, samples[1].altitude_m) == pytest.approx((47.50001, 8.25, 612.5))
    assert samples[0].time_s == pytest.approx(1_714_990_272.5)


def test_gps9_is_read_with_a_time_for_each_sample():
    scale = struct.pack(">9i", 10**7, 10**7, 1000, 1000, 100, 1, 1000, 100, 1)
    row = struct.pack(">7iHH", 475_000_000, 82_500_000, 612_500, 0, 0, 8892, 36_672_500, 150, 3)
    data = nested(b"DEVC", nested(b"STRM", entry(b"SCAL", "l", 4, 9, scale), entry(b"GPS9", "?", 32, 1, row)))
    (sample,) = read_gpmf(data)
    assert (sample.lat_deg, sample.lon_deg) == pytest.approx((47.5, 8.25))
    assert sample.time_s == pytest.approx(1_714_990_272.5)


def test_positions_stand_between_the_samples_of_the_track(tmp_path):
    scan = VideoScan(path=tmp_path / "a.mp4", codec="h264", width=64, height=48, rate=10.0)
    scan.pictures = [PictureNote(0.1 * i) for i in range(10)]
    scan.gpmf_samples = [(i / 18, sample) for i, sample in enumerate(read_gpmf(gps5()))]
    pose = Poses(scan).of(5)
    assert pose.origin == "GPMF"
    assert pose.sample.lat_deg == pytest.approx(47.5 + 9e-5)


@given(st.data())
def test_damaged_packets_are_survived(data):
    raw = bytearray(gps5(3))
    for _ in range(data.draw(st.integers(1, 6))):
        raw[data.draw(st.integers(0, len(raw) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    read_gpmf(bytes(raw[: data.draw(st.integers(0, len(raw)))]))
