"""No file, however damaged, ends a run that has other inputs: it is named, and the rest is mapped."""

import struct

import pytest

from telemetry.formats.log import flight_logs
from telemetry.formats.table import geo_txt, pose_csv
from telemetry.formats.video import srt
from telemetry.ingest import log_ingest, video_ingest
from telemetry.ingest.ingest import LoadOptions, load, survey
from telemetry.ingest.summary import summarise
from telemetry.photos import photo_tags
from telemetry.write.sei_writer import add_sei
from tests.telemetry.formats.test_flight_logs import ulog
from tests.telemetry.ingest.test_photos import gps_exif, jpeg
from tests.telemetry.videos.test_video import make_video, pose

GOOD = "good.jpg"


def good_photo(folder):
    folder.mkdir(parents=True, exist_ok=True)
    return jpeg(folder / GOOD, exif_bytes=gps_exif())


def named(found) -> str:
    """All that is said about the inputs, as one text."""
    findings = [*found.findings, *(f for s in found.sources for f in s.findings)]
    return "\n".join([*map(str, findings), *(f"{r.image}: {r.reason}" for r in found.rejected)])


def test_a_video_of_an_unknown_codec_is_named_and_the_photos_beside_it_are_mapped(tmp_path):
    good_photo(tmp_path)
    video = make_video(tmp_path / "flight.mp4", count=4)
    video.write_bytes(video.read_bytes().replace(b"avc1", b"zzz1"))
    found = load([tmp_path])
    assert [frame.image for frame in found.frames] == [GOOD]
    (rejection,) = found.rejected
    assert rejection.image == "flight.mp4"
    assert "convert the video to H.264" in rejection.reason


def broken(*_args, **_options):
    raise AttributeError("'NoneType' object has no attribute 'name'")


def make_photo(folder):
    jpeg(folder / "bad.jpg", exif_bytes=gps_exif())
    return "bad.jpg"


def make_geo_txt(folder):
    (folder / "geo.txt").write_text("EPSG:4326\ngood.jpg 8.25 47.5\n")
    return "geo.txt"


def make_csv(folder):
    (folder / "poses.csv").write_text("image,lat_deg,lon_deg\ngood.jpg,47.5,8.25\n")
    return "poses.csv"


def make_log(folder):
    ulog(folder / "flight.ulg")
    return "flight.ulg"


def make_clip(folder):
    add_sei(make_video(folder / "plain.mp4", count=4), folder / "flight.mp4", pose)
    (folder / "plain.mp4").unlink()
    return "flight.mp4"


def make_subtitles(folder):
    (folder / "flight.srt").write_text("1\n00:00:00,000 --> 00:00:01,000\n[latitude: 47.0] [longitude: 8.0]\n")
    return "flight.srt"


READERS = [
    (photo_tags, "read_photo", make_photo),
    (geo_txt, "read_geo_txt", make_geo_txt),
    (pose_csv, "read_pose_csv", make_csv),
    (log_ingest, "read_log", make_log),
    (flight_logs.OF_ONE_VEHICLE, ".ulg", make_log),
    (video_ingest, "scan", make_clip),
    (video_ingest, "Poses", make_clip),
    (video_ingest, "extract", make_clip),
    (srt, "read_srt", make_subtitles),
]


@pytest.mark.parametrize(("module", "reader", "make"), READERS, ids=lambda v: v if isinstance(v, str) else "")
def test_any_exception_of_any_reader_names_its_file_and_ends_nothing(tmp_path, monkeypatch, module, reader, make):
    """A reader's own fault stands for every fault that nobody has thought of."""
    if make is not make_photo:
        good_photo(tmp_path)
    else:
        good_photo(tmp_path / "other")
    name = make(tmp_path)
    of_table = isinstance(module, dict)
    whole = module[reader] if of_table else getattr(module, reader)

    def fails(*args, **options):
        return whole(*args, **options) if GOOD in str(args[0]) else broken()

    (monkeypatch.setitem if of_table else monkeypatch.setattr)(module, reader, fails)
    found = survey([tmp_path], options=LoadOptions(cache=tmp_path / ".cache"))
    assert [frame.image.rsplit("/", 1)[-1] for frame in found.frames()] == [GOOD]
    assert name in named(found)
    assert "NoneType" in named(found)
    assert summarise(found, pictures=False)["sources"]


def test_a_table_that_cannot_be_read_is_named_and_the_photos_keep_their_own_positions(tmp_path):
    good_photo(tmp_path)
    (tmp_path / "geo.txt").write_text("good.jpg 8.25 47.5\n")
    found = load([tmp_path])
    assert len(found.frames) == 1
    assert any("geo.txt" in w and "projection" in w for w in found.warnings)


@pytest.mark.parametrize("name", ["a.bin", "a.tlog", "a.ulg"])
def test_every_log_that_cannot_be_read_is_named(tmp_path, name):
    good_photo(tmp_path)
    fmt = b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 130, 20, b"POS", b"QLL", b"nothing,fits")
    (tmp_path / name).write_bytes(fmt * 3)
    found = survey([tmp_path])
    (finding,) = [f for f in found.findings if f.code == "not-a-log"]
    assert name in finding.message
    assert not finding.note


def test_a_bin_that_is_no_log_at_all_is_a_note(tmp_path):
    good_photo(tmp_path)
    (tmp_path / "firmware.bin").write_bytes(b"\x00\x01\x02" * 300)
    (finding,) = [f for f in survey([tmp_path]).findings if f.code == "not-a-log"]
    assert finding.note
    assert not any("firmware" in warning for warning in load([tmp_path]).warnings)
