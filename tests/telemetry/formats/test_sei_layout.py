"""Private SEI messages: named where nobody knows them, read where a file describes them."""

import struct

import pytest

from orthoswarm.model.errors import InputError
from telemetry.formats.video import bitstream
from telemetry.formats.video.sei import read_sei_layout
from telemetry.ingest.ingest import LoadOptions, survey
from tests.telemetry.videos.test_video import make_video

av = pytest.importorskip("av")

UUID = "0f1e2d3c4b5a69788796a5b4c3d2e1f0"
LAYOUT = f"""
uuid = "{UUID}"
struct = "<ddfHii"
fields = ["lon_deg", "lat_deg", "altitude_m", "", "yaw_deg*0.01", "pitch_deg*0.01-90"]
"""


def private_video(path, uuid=UUID):
    """A raw H.264 stream whose pictures carry a maker's own message."""
    plain = make_video(path.with_name("plain.h264"), count=5, b_frames=0)
    form, number, out = bitstream.StreamFormat("h264"), 0, b""
    with av.open(str(plain)) as container:
        for packet in container.demux(video=0):
            if packet.size:
                body = struct.pack("<ddfHii", 8.25, 47.5 + number * 1e-5, 500.0, 7, 3000, -100)
                unit = bitstream.sei_unit(5, bytes.fromhex(uuid) + body, form)
                out += bitstream.insert_unit(bytes(packet), unit, form)
                number += 1
    plain.unlink()
    path.write_bytes(out)
    return path


def findings(found):
    return {f.code: f.message for s in found.sources for f in s.findings}


def test_a_message_that_nobody_knows_is_named_with_its_uuid_and_size(tmp_path):
    private_video(tmp_path / "a.h264")
    text = findings(survey([tmp_path], options=LoadOptions(decode=False)))["sei-unknown"]
    assert UUID in text
    assert "30 bytes" in text
    assert "5 SEI messages" in text


def test_an_encoders_settings_are_not_named(tmp_path):
    make_video(tmp_path / "a.mp4", count=3)
    assert "sei-unknown" not in findings(survey([tmp_path], options=LoadOptions(decode=False)))


def test_a_described_message_is_read(tmp_path):
    own = "ff" + UUID[2:]  # what is described once is known from then on
    private_video(tmp_path / "a.h264", own)
    (tmp_path / "maker.toml").write_text(LAYOUT.replace(UUID, own))
    found = survey([tmp_path / "a.h264"], options=LoadOptions(decode=False, sei_layouts=(tmp_path / "maker.toml",)))
    (source,) = found.sources
    (track,) = source.tracks.values()
    assert len(track) == 5
    first = min(track, key=lambda s: s.lat_deg)
    assert (first.lat_deg, first.lon_deg, first.altitude_m) == pytest.approx((47.5, 8.25, 500.0))
    assert (first.yaw_deg, first.pitch_deg) == pytest.approx((30.0, -91.0))
    assert "sei-unknown" not in findings(found)


WRONG = {
    "not a TOML": "uuid = ",
    "32 hexadecimal": 'uuid = "12"',
    "neither a uuid": 'struct = "<d"',
    "not a format": f'uuid = "{UUID}"\nstruct = "<y"\nfields = ["lat_deg"]',
    "each of the 2": f'uuid = "{UUID}"\nstruct = "<dd"\nfields = ["lat_deg"]',
    "is not a field": f'uuid = "{UUID}"\nstruct = "<d"\nfields = ["lattitude"]',
}


@pytest.mark.parametrize("reason", WRONG)
def test_a_wrong_layout_says_which_entry_is_wrong(tmp_path, reason):
    (tmp_path / "maker.toml").write_text(WRONG[reason])
    with pytest.raises(InputError, match=reason):
        read_sei_layout(tmp_path / "maker.toml")
