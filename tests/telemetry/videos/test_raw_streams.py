"""Streams of H.264 and H.265 without a container: their times come from the rate that they state."""

import pytest

from telemetry.formats.video.bitstream import StreamFormat, escape, nal_units, unescape
from telemetry.samples.sample import Sample
from telemetry.write.sei_writer import add_sei
from tests.telemetry.videos.video_files import METRE, write_srt, write_video

pytest.importorskip("av")

SPS = 7


def without_rate(path):
    """Take the timing out of an H.264 stream that states 10 pictures a second (H.264, E.1.1)."""
    data, written = path.read_bytes(), bytearray()
    for start, end in nal_units(data, StreamFormat("h264")):
        unit = data[start:end]
        if unit[0] & 31 == SPS:
            bits = "".join(f"{byte:08b}" for byte in unescape(unit)).rstrip("0")[:-1]
            timing = f"1{1:032b}{20:032b}"  # there is timing: a unit of 1, 20 of them a second, two a picture
            at = bits.index(timing)
            bits = f"{bits[:at]}0{bits[at + len(timing) + 1 :]}1"
            bits += "0" * (-len(bits) % 8)
            unit = escape(bytes(int(bits[i : i + 8], 2) for i in range(0, len(bits), 8)))
        written += b"\0\0\0\1" + unit
    path.write_bytes(written)


@pytest.mark.parametrize("suffix", ["h264", "h265"])
def test_the_stated_rate_gives_the_times(card, mapped, suffix):
    write_video(card / f"a.{suffix}", count=60, codec=f"libx{suffix[1:]}", b_pictures=0)
    write_srt(card / "a.srt", seconds=7)
    frames = mapped(card).frames
    assert len(frames) >= 5
    for frame in frames:
        flown_m = 5.0 * int(frame.image[-6:]) / 10
        assert (frame.fix.lat_deg - 47.0) / METRE == pytest.approx(flown_m, abs=0.2)


def test_where_no_rate_is_stated_one_sentence_says_what_to_do(card, mapped):
    without_rate(write_video(card / "a.h264", count=60))
    write_srt(card / "a.srt", seconds=6)
    (rejection,) = mapped(card).rejected
    assert "states no frame rate" in rejection.reason
    assert "ffmpeg -framerate" in rejection.reason


def test_poses_within_the_stream_need_no_rate(card, tmp_path, mapped):
    without_rate(write_video(tmp_path / "plain.h264", count=40))
    place = [Sample(lat_deg=47.0 + i * METRE, lon_deg=8.0, height_m=90.0) for i in range(40)]
    add_sei(tmp_path / "plain.h264", card / "a.h264", lambda i: place[i])
    found = mapped(card)
    assert found.frames
    assert not any("rate" in warning for warning in found.warnings)
    for frame in found.frames:
        assert frame.fix.lat_deg == pytest.approx(place[int(frame.image[-6:])].lat_deg, abs=1e-9)
