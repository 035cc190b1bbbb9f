"""`orthoswarm inspect` and `orthoswarm frames`: contract, traps of the real data, round trips."""

import json
import math

import numpy as np
import pytest

from gcs_plugin.cli.main import main
from telemetry.ingest.ingest import LoadOptions, load, survey
from telemetry.ingest.summary import summarise
from tests.telemetry.ingest.test_ingest import flight, photo
from tests.telemetry.ingest.test_photos import gps_exif, jpeg
from tests.telemetry.videos.test_video import make_video, pose

from telemetry.write.sei_writer import add_sei  # isort: skip


def inspect_json(capsys, *arguments) -> dict:
    code = main(["inspect", *map(str, arguments), "--json"])
    assert code == 0
    return json.loads(capsys.readouterr().out)


def codes(document: dict) -> set[str]:
    return {finding["code"] for source in document["sources"] for finding in source["findings"]}


def test_the_json_keeps_its_contract(tmp_path, capsys):
    flight(tmp_path / "set" / "v1", [0, 180], yaw=lambda c: c)
    (tmp_path / "set" / "v1" / "bad.jpg").write_bytes(b"")
    document = inspect_json(capsys, tmp_path / "set", "--no-pictures")
    (source,) = document["sources"]
    assert source["path"] == "v1"
    assert source["kind"] == "photos"
    assert source["counts"] == {"frames": 10, "sei": 0, "klv": 0, "camera_events": 0}
    (vehicle,) = source["vehicles"]
    assert {"id": "v1", "frames": 10, "legs": 2}.items() <= vehicle.items()
    assert vehicle["start"] == "2024-05-06T12:00:00.000Z"
    assert vehicle["end"] == "2024-05-06T12:00:27.000Z"
    assert all({"code", "message"} <= set(finding) for finding in source["findings"])
    assert [r["image"] for r in document["rejected"]] == ["v1/bad.jpg"]


def test_a_missing_input_is_wrong_and_an_empty_folder_gives_nothing(tmp_path, capsys):
    assert main(["inspect", str(tmp_path / "none")]) == 2
    assert main(["inspect", str(tmp_path)]) == 1


def test_the_table_names_vehicles_and_findings(tmp_path, capsys):
    flight(tmp_path / "set", [0, 180], yaw=lambda c: c, height=lambda c: None)
    assert main(["inspect", str(tmp_path / "set"), "--no-pictures"]) == 0
    out = capsys.readouterr().out
    assert "height-missing" in out
    assert "10 pictures" in out


def test_the_tracks_are_drawn(tmp_path, capsys):
    flight(tmp_path / "set", [0, 90], yaw=lambda c: c)
    picture = tmp_path / "tracks.png"
    inspect_json(capsys, tmp_path / "set", "--no-pictures", "--picture", picture)
    assert picture.read_bytes()[:4] == b"\x89PNG"


TRAPS = {
    "sheffield_cross_800": {
        "altitude-implausible", "height-missing", "oblique", "attitude-makernotes", "control-points-scale",
        "control-points-height", "yaw-confirmed",
    },
    "brighton_beach_1600": {"yaw-flip"},
    "brighton_derived": {"raster"},
    "mirafiori_rtk": {"lens-distortion", "rtk", "short-base", "focal-and-height", "yaw-confirmed"},
    "jwcate_1200": {"yaw-relative", "time-whole-seconds", "gaps", "sparse", "yaw-confirmed"},
    "autzen": {"raster"},
    "kwiver_klv": {"klv-eg0104", "sei-clock"},
    "dji_srt_small": {"srt-tuple-order", "srt-no-position", "srt-mixed", "position-coarse"},
}  # fmt: skip


@pytest.mark.parametrize("folder", TRAPS)
def test_every_trap_of_the_real_data_is_named(real_data, capsys, folder):
    document = inspect_json(capsys, real_data(folder))
    assert TRAPS[folder] <= codes(document)


def test_the_turned_leg_of_brighton_is_named_and_no_other(real_data):
    document = summarise(survey([real_data("brighton_beach_1600")]))
    (finding,) = [f for f in document["sources"][0]["findings"] if f["code"] == "yaw-flip"]
    assert "DJI_0024.JPG to DJI_0029.JPG" in finding["message"]
    assert "1 leg of 3" in finding["message"]


def test_legs_of_real_flights_are_counted(real_data):
    document = summarise(survey([real_data("sheffield_cross_800"), real_data("mirafiori_rtk")]), pictures=False)
    legs = {v["id"]: v["legs"] for s in document["sources"] for v in s["vehicles"]}
    assert legs == {"sheffield_cross_800": 11, "mirafiori_rtk": 3}


def test_frames_of_a_video_become_photos_with_the_same_poses(tmp_path, capsys):
    source = make_video(tmp_path / "s.mp4")
    add_sei(source, tmp_path / "flight.mp4", pose)
    out = tmp_path / "out"
    assert main(["frames", str(tmp_path / "flight.mp4"), "--out", str(out), "--every-m", "6", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    written = document["written"]
    assert len(written) > 8
    assert [p.name for p in out.iterdir()] == ["uav7"]
    again = load([out]).frames
    assert len(again) == len(written)
    for frame in again:
        expected = pose(int(frame.image.rsplit("_", 1)[1].split(".")[0]))
        fix = frame.fix
        assert (fix.lat_deg, fix.lon_deg) == pytest.approx((expected.lat_deg, expected.lon_deg), abs=1e-10)
        assert fix.height_m == pytest.approx(expected.height_m, abs=1e-3)
        assert fix.altitude_m == pytest.approx(expected.altitude_m, abs=1e-3)
        angles = np.degrees([fix.yaw_rad, fix.pitch_rad, fix.roll_rad])
        assert angles == pytest.approx([expected.yaw_deg, expected.pitch_deg, expected.roll_deg], abs=1e-4)
        assert frame.time_s == pytest.approx(expected.time_s, abs=1e-6)
        assert math.degrees(frame.fov_hint_rad) == pytest.approx(expected.fov_deg, abs=1e-4)
        assert frame.vehicle == "uav7"


def test_other_software_reads_the_written_tags(tmp_path, capsys):
    from PIL import Image

    source = make_video(tmp_path / "s.mp4", count=4)
    add_sei(source, tmp_path / "flight.mp4", pose)
    assert main(["frames", str(tmp_path / "flight.mp4"), "--out", str(tmp_path / "o")]) == 0
    path = min((tmp_path / "o" / "uav7").iterdir())
    with Image.open(path) as image:
        image.load()
        exif = image.getexif()
        gps, detail = exif.get_ifd(0x8825), exif.get_ifd(0x8769)
        assert float(gps[2][0] + gps[2][1] / 60 + gps[2][2] / 3600) == pytest.approx(47.0)
        assert detail[0x9003] == "2023:11:14 22:13:20"
        assert detail[0xA405] == 18
        assert b"Camera:Pitch" in image.info["xmp"]


def test_photos_are_copied_with_what_a_geo_txt_adds(tmp_path, capsys):
    photo(tmp_path / "in" / "a.JPG", yaw=10.0, pitch=-80.0)
    (tmp_path / "in" / "geo.txt").write_text("EPSG:4326\na.JPG 9.0 48.0 600\n")
    assert main(["frames", str(tmp_path / "in"), "--out", str(tmp_path / "o")]) == 0
    (frame,) = load([tmp_path / "o"]).frames
    assert (frame.fix.lat_deg, frame.fix.altitude_m) == pytest.approx((48.0, 600.0))
    assert math.degrees(frame.fix.pitch_rad) == pytest.approx(-80.0, abs=1e-4)


@pytest.mark.parametrize(("offset", "written"), [("+02:00", "+00:00"), (None, None)])
def test_frames_state_a_zone_only_where_it_is_known(tmp_path, capsys, offset, written):
    from PIL import Image

    (tmp_path / "in").mkdir()
    jpeg(tmp_path / "in" / "a.jpg", exif_bytes=gps_exif(offset=offset))
    assert main(["frames", str(tmp_path / "in"), "--out", str(tmp_path / "o")]) == 0
    with Image.open(tmp_path / "o" / "in" / "a.jpg") as image:
        exif = image.getexif()
        assert exif.get_ifd(0x8769).get(0x9011) == written
        assert (7 in exif.get_ifd(0x8825)) == (written is not None)
        assert exif.get_ifd(0x8769)[0x9003] == ("2024:05:06 10:00:01" if offset else "2024:05:06 12:00:01")


def test_times_without_a_zone_are_told_once(tmp_path):
    for name, offset in (("a/1", None), ("a/2", None), ("b/1", None), ("c/1", "+02:00")):
        path = tmp_path / f"{name}.jpg"
        path.parent.mkdir(exist_ok=True)
        jpeg(path, exif_bytes=gps_exif(offset=offset))
    said = [w for w in load([tmp_path]).warnings if "zone" in w]
    assert len(said) == 1 and said[0].startswith("times of 3 pictures have no zone and are taken as UTC")
    found = summarise(survey([tmp_path]))["findings"]
    assert [f["code"] for f in found if "zone" in f["message"]] == ["time-without-zone"]
    assert not any("zone" in w for w in load([tmp_path / "c"]).warnings)


def test_frames_without_anything_to_take_is_one_clear_error(tmp_path, capsys):
    make_video(tmp_path / "a.mp4", count=3)
    assert main(["frames", str(tmp_path / "a.mp4"), "--out", str(tmp_path / "o")]) == 2
    assert "no position" in capsys.readouterr().err
    assert main(["frames", str(tmp_path / "a.mp4"), "--out", str(tmp_path / "o"), "--every-m", "-1"]) == 2


def test_nothing_is_left_of_the_working_folder(tmp_path):
    source = make_video(tmp_path / "s.mp4", count=4)
    add_sei(source, tmp_path / "f.mp4", pose)
    assert main(["frames", str(tmp_path / "f.mp4"), "--out", str(tmp_path / "o")]) == 0
    assert [p.name for p in (tmp_path / "o").iterdir()] == ["uav7"]


def test_looking_at_a_video_takes_no_pictures(tmp_path):
    source = make_video(tmp_path / "s.mp4", count=8)
    add_sei(source, tmp_path / "f.mp4", pose)
    source.unlink()
    cache = tmp_path / "cache"
    document = summarise(survey([tmp_path], options=LoadOptions(decode=False, cache=cache)))
    assert not cache.exists()
    assert document["sources"][0]["counts"]["sei"] == 8
    assert document["sources"][0]["vehicles"][0]["frames"] == 8


def test_what_a_card_loses_is_named(tmp_path, real_data, capsys):
    """A log in a folder of its own, and photos without a place in two folders: one line a reason."""
    card = tmp_path / "card"
    flight(card / "DCIM", [0.0])
    for i in range(5):
        jpeg(card / "DCIM" / f"X_{i}.JPG", exif_bytes=gps_exif(0.0, 0.0, local="1980:01:06 00:00:00", subsec="0"))
    (card / "logs").mkdir()
    (card / "logs" / "a.tlog").write_bytes((real_data("sitl_logs") / "swarm_v1.tlog").read_bytes())
    found = load([card])
    (apart,) = [warning for warning in found.warnings if "logs/a.tlog" in warning and "no picture" in warning]
    assert "as an input of its own" in apart
    assert not [w for w in load([card / "DCIM", card / "logs"]).warnings if "as an input of its own" in w]
    assert main(["inspect", str(card)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "DCIM/X_0.JPG, DCIM/X_1.JPG, DCIM/X_2.JPG and 2 more" in said
    assert said.count("the picture has no position") == 1
