"""From inputs to frames: naming, merging, and decisions between contradicting tags."""

import math
from pathlib import Path

import numpy as np
import pytest

import telemetry
from orthoswarm.model.errors import InputError
from orthoswarm.mosaic.recorded_pose import nothing_to_map
from telemetry.ingest import discovery
from telemetry.ingest.ingest import LoadOptions, load, survey
from tests.telemetry.ingest.test_photos import gps_exif, jpeg


def photo(path: Path, lat=47.5, lon=8.25, second=0, *, yaw=None, flight=None, pitch=-90.0, roll=0.0, height=100.0):
    tags = []
    if yaw is not None:
        tags += [f'drone-dji:GimbalYawDegree="{yaw:+.2f}" drone-dji:GimbalPitchDegree="{pitch:+.2f}"']
        tags += [f'drone-dji:GimbalRollDegree="{roll:+.2f}"']
    if flight is not None:
        tags += [f'drone-dji:FlightYawDegree="{flight:+.2f}"']
    if height is not None:
        tags += [f'drone-dji:RelativeAltitude="{height:+.2f}"']
    packet = f"<x:xmpmeta><rdf:Description {' '.join(tags)}/></x:xmpmeta>".encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    local = f"2024:05:06 12:{second // 60:02d}:{second % 60:02d}"
    return jpeg(path, xmp_packet=packet, exif_bytes=gps_exif(lat, lon, local=local, subsec="0"))


def flight(folder: Path, courses, *, step=8e-5, legs=5, **angles):
    """Photos along legs of the given courses (degrees); angles: functions of the course."""
    lat, lon, i = 47.5, 8.25, 0
    for course in courses:
        for _ in range(legs):
            photo(folder / f"P_{i}.JPG", lat, lon, 3 * i, **{key: value(course) for key, value in angles.items()})
            lat += step * math.cos(math.radians(course))
            lon += step * math.sin(math.radians(course)) / math.cos(math.radians(lat))
            i += 1
        lat += 2e-4 * math.cos(math.radians(90))
        lon += 4e-4
    return folder


def codes(path: Path) -> set[str]:
    return {finding.code for source in survey([path]).sources for finding in source.findings}


def yaws_deg(frames):
    return [math.degrees(f.fix.yaw_rad) for f in frames]


def test_the_package_offers_load_lazily():
    assert telemetry.load is load
    with pytest.raises(AttributeError):
        telemetry.nothing  # noqa: B018


def test_each_folder_is_a_vehicle_and_names_are_relative(tmp_path):
    photo(tmp_path / "day" / "a.JPG")
    photo(tmp_path / "day" / "v1" / "a.JPG")
    photo(tmp_path / "day" / "v2" / "deep" / "a.JPG")
    frames = load([tmp_path / "day"]).frames
    assert {(f.vehicle, f.image) for f in frames} == {
        ("day", "a.JPG"),
        ("v1", "v1/a.JPG"),
        ("v2/deep", "v2/deep/a.JPG"),
    }


def test_several_inputs_are_named_from_their_common_parent(tmp_path):
    photo(tmp_path / "x" / "flight" / "a.JPG")
    photo(tmp_path / "y" / "flight" / "a.JPG")
    frames = load([tmp_path / "x", tmp_path / "y" / "flight"]).frames
    assert sorted(f.image for f in frames) == ["x/flight/a.JPG", "y/flight/a.JPG"]
    assert sorted(f.vehicle for f in frames) == ["x/flight", "y/flight"]


def test_the_same_input_twice_is_read_once(tmp_path):
    photo(tmp_path / "a.JPG")
    assert len(load([tmp_path, tmp_path, tmp_path / "a.JPG"]).frames) == 1


def test_frames_are_in_order_of_time_then_natural_name(tmp_path):
    photo(tmp_path / "p10.JPG", second=5)
    photo(tmp_path / "p9.JPG", second=5)
    photo(tmp_path / "p11.JPG", second=1)
    assert [f.image for f in load([tmp_path]).frames] == ["p11.JPG", "p9.JPG", "p10.JPG"]


def test_files_that_are_no_pictures_are_ignored_and_bad_pictures_named(tmp_path):
    photo(tmp_path / "a.JPG")
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "table.csv").write_text("a,b\n1,2\n")
    (tmp_path / "._a.JPG").write_bytes(b"x")
    (tmp_path / "empty.jpg").write_bytes(b"")
    jpeg(tmp_path / "nowhere.jpg")
    result = load([tmp_path])
    assert len(result.frames) == 1
    assert {r.image: r.reason.split(";")[0] for r in result.rejected} == {
        "._a.JPG": "a hidden file",
        "empty.jpg": "the file is empty",
        "nowhere.jpg": "the picture has no position",
    }


def test_a_missing_input_and_no_input_are_errors(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        load([tmp_path / "nothing"])
    with pytest.raises(InputError):
        load([])
    with pytest.raises(InputError, match="no picture"):
        raise nothing_to_map(load([tmp_path]))


@pytest.mark.parametrize("again", ["itself", "link"])
def test_a_survey_that_is_given_twice_is_counted_once_and_that_is_said_once(tmp_path, again):
    first = flight(tmp_path / "day1", [0.0], legs=4)
    second = {"itself": first, "link": tmp_path / "day2"}[again]
    if again == "link":
        second.symlink_to(first, target_is_directory=True)
    found = load([first, second])
    assert len(found.frames) == 4 and len({frame.vehicle for frame in found.frames}) == 1
    reasons = [rejection.reason for rejection in found.rejected]
    if again == "link":
        assert len(reasons) == 4
        assert set(reasons) == {"the same photos are in day1, which is in the input already"}


@pytest.mark.parametrize("renamed", [False, True])
def test_a_backup_beside_the_photos_is_told_and_kept(tmp_path, renamed):
    flight(tmp_path / "card" / "DCIM", [0.0], legs=6)
    for number in range(1, 5):  # four of them, and one that is only there
        original = tmp_path / "card" / "DCIM" / f"P_{number}.JPG"
        copy = tmp_path / "card" / "Backup" / (f"old_{number}.JPG" if renamed else original.name)
        copy.parent.mkdir(exist_ok=True)
        copy.write_bytes(original.read_bytes())
    photo(tmp_path / "card" / "Backup" / "X.JPG", second=50)
    found = load([tmp_path / "card"])
    assert len(found.frames) == 6 + 4 + 1 and not found.rejected
    assert {f.vehicle for f in found.frames} == {"DCIM", "Backup"}
    (warning,) = (w for w in found.warnings if "the same files" in w)
    assert "4 photos in DCIM are the same files as photos in Backup" in warning and "leave one folder out" in warning


def test_photos_of_one_size_are_read_beyond_their_beginnings_only_if_these_are_alike(tmp_path, monkeypatch):
    asked, digest = [], discovery._digest
    monkeypatch.setattr(discovery, "_digest", lambda path, samples: asked.append(samples) or digest(path, samples))
    for folder in ("v1", "v2"):
        for i in range(8):  # the first four begin alike
            path = photo(tmp_path / folder / f"{i}.JPG", second=i + 10 * (folder == "v2" and i >= 4))
            path.write_bytes(path.read_bytes() + bytes(300_000) + folder.encode())
    assert discovery.copies_among(sorted(tmp_path.rglob("*.JPG"))) == ({}, {})
    assert sorted(set(asked)) == [0, discovery._SAMPLES] and asked.count(discovery._SAMPLES) == 8


def test_pictures_that_only_a_table_tells_apart_are_no_copies(tmp_path):
    for folder in ("v1", "v2"):
        (tmp_path / folder).mkdir()
        rows = [f"{i}.jpg,{47.5 + 1e-4 * i},8.25" for i in range(5)]
        (tmp_path / folder / "poses.csv").write_text("\n".join(["image,lat_deg,lon_deg", *rows]))
        for i in range(5):
            jpeg(tmp_path / folder / f"{i}.jpg")
    found = load([tmp_path])
    assert len(found.frames) == 10 and not any("the same files" in warning for warning in found.warnings)


def test_an_excluded_folder_is_left_out(tmp_path):
    photo(tmp_path / "a.JPG")
    photo(tmp_path / "out" / "a.JPG")
    assert len(load([tmp_path], options=LoadOptions(exclude=(tmp_path / "out",))).frames) == 1


def test_geo_txt_gives_positions_and_leaves_the_photos_angles_and_heights(tmp_path):
    photo(tmp_path / "a b.JPG", yaw=30.0, height=77.0)
    (tmp_path / "geo.txt").write_text("EPSG:32632\na b.JPG 465000.0 5260000.0 512.0\n")
    (frame,) = load([tmp_path]).frames
    assert frame.fix.lat_deg == pytest.approx(47.4928, abs=1e-3)
    assert frame.fix.altitude_m == 512.0
    assert frame.fix.height_m == 77.0
    assert math.degrees(frame.fix.yaw_rad) == pytest.approx(30.0)
    assert frame.origin["position"] == "geo.txt"


@pytest.mark.parametrize(("written", "expected"), [(0.5, -89.5), (-89.5, -89.5)])
def test_geo_txt_pitch_is_understood_from_nadir_and_from_the_horizon(tmp_path, written, expected):
    jpeg(tmp_path / "a.jpg")
    (tmp_path / "geo.txt").write_text(f"EPSG:4326\na.jpg 8.25 47.5 500 12.0 {written} 1.0 0.02 0.03\n")
    (frame,) = load([tmp_path]).frames
    assert math.degrees(frame.fix.pitch_rad) == pytest.approx(expected)
    assert frame.fix.position_sigma_m == pytest.approx(0.02)


def test_geo_txt_without_projection_is_a_warning_that_says_what_to_do(tmp_path):
    jpeg(tmp_path / "a.jpg")
    (tmp_path / "geo.txt").write_text("a.jpg 8.25 47.5\n")
    (warning,) = load([tmp_path]).warnings
    assert "geo.txt is not used" in warning
    assert "write EPSG:4326 or the projection there" in warning


def test_lines_of_a_table_that_say_nothing_are_named(tmp_path):
    for k, name in enumerate(("a.jpg", "b.jpg", "c.jpg")):
        photo(tmp_path / name, second=k)
    (tmp_path / "geo.txt").write_text("EPSG:4326\na.jpg nan 47.5\nb.jpg 8.2 95.0\nc.jpg 8.2\nd.jpg 8.2 47.5\n")
    findings = {f.code: str(f) for source in survey([tmp_path]).sources for f in source.findings}
    assert "3 lines of geo.txt" in findings["table-lines"]
    assert "d.jpg" in findings["table-pictures"]
    (tmp_path / "geo.txt").unlink()
    long = "v" * 65536
    (tmp_path / "poses.csv").write_text(f"image,lat_deg,lon_deg,vehicle\na.jpg,47.5,8.2,{long}\nb.jpg,,8.2,\n")
    found = survey([tmp_path])
    assert "1 line of poses.csv" in next(str(f) for s in found.sources for f in s.findings if f.code == "table-lines")
    assert max(len(frame.vehicle) for frame in found.frames()) <= 64


def test_a_csv_of_poses_gives_every_field(tmp_path):
    (tmp_path / "v1").mkdir()
    jpeg(tmp_path / "v1" / "a.jpg")
    (tmp_path / "poses.csv").write_text(
        "image,time,lat_deg,lon_deg,height_m,yaw_deg,pitch_deg,roll_deg,fov_deg,vehicle\n"
        "v1/a.jpg,2024-05-06T10:00:00.5Z,47.5,8.25,120,10,-88,1,95,alpha\n"
    )
    (frame,) = load([tmp_path]).frames
    assert (frame.vehicle, frame.time_s, frame.fix.height_m) == ("alpha", 1714989600.5, 120.0)
    assert math.degrees(frame.fov_hint_rad) == pytest.approx(95.0)


def test_gimbal_yaw_is_the_pictures_where_it_is_absolute(tmp_path):
    folder = flight(tmp_path / "f", [0, 180, 0], yaw=lambda c: c + 12.0, flight=lambda c: c)
    frames = load([folder]).frames
    assert yaws_deg(frames)[:2] == pytest.approx([12.0, 12.0])
    assert "yaw-relative" not in codes(folder)


def test_gimbal_yaw_relative_to_the_airframe_is_added_to_the_flight_yaw(tmp_path):
    folder = flight(tmp_path / "f", [80, 260, 80], yaw=lambda c: -1.5, flight=lambda c: c)
    assert np.allclose(np.mod(yaws_deg(load([folder]).frames), 360), [78.5] * 5 + [258.5] * 5 + [78.5] * 5)
    assert "yaw-relative" in codes(folder)


def test_a_gimbal_of_zeros_is_no_horizontal_camera(tmp_path):
    folder = flight(tmp_path / "f", [80, 260], yaw=lambda c: 0.0, pitch=lambda c: 0.0, flight=lambda c: c)
    frames = load([folder]).frames
    assert all(f.fix.pitch_rad is None for f in frames)
    assert yaws_deg(frames)[0] == pytest.approx(80.0)
    assert "gimbal-zero" in codes(folder)


def test_roll_of_180_at_nadir_is_a_turned_yaw(tmp_path):
    folder = flight(tmp_path / "f", [80], yaw=lambda c: -100.0, roll=lambda c: 179.5, flight=lambda c: c)
    frame = load([folder]).frames[0]
    assert math.degrees(frame.fix.yaw_rad) == pytest.approx(80.0)
    assert math.degrees(frame.fix.roll_rad) == pytest.approx(-0.5)
    assert "roll-180" in codes(folder)


def test_yaw_that_turns_on_some_legs_only_is_reported(tmp_path):
    yaws = iter([0.0] * 5 + [180.0] * 5 + [0.0] * 10)
    folder = flight(tmp_path / "f", [0, 180, 0, 180], yaw=lambda course: next(yaws))
    assert "yaw-inconsistent" in codes(folder)


def test_a_camera_that_keeps_its_heading_is_not_suspicious(tmp_path):
    folder = flight(tmp_path / "f", [0, 180, 0, 180], yaw=lambda c: 5.0, flight=lambda c: 5.0)
    assert not {"yaw-inconsistent", "yaw-jump", "yaw-ambiguous", "yaw-relative"} & codes(folder)


def test_a_picture_far_from_its_neighbours_is_named_and_a_return_flight_is_not(tmp_path):
    for i in range(8):
        photo(tmp_path / "a" / f"P_{i}.JPG", 47.5 + 1e-4 * i + (1.0 if i == 4 else 0.0), 8.25, i)
        photo(tmp_path / "b" / f"P_{i}.JPG", 47.5 + 1e-4 * min(i, 8 - i), 8.25, i)
    found = {s.path: [str(f) for f in s.findings if f.code == "position-astray"] for s in survey([tmp_path]).sources}
    assert "P_4.JPG" in found["a"][0] and "111 km" in found["a"][0]
    assert found["b"] == []


def test_heights_that_cannot_be_are_dropped(tmp_path):
    folder = flight(tmp_path / "f", [0], yaw=lambda c: c, height=lambda c: -3.0)
    assert all(f.fix.height_m is None for f in load([folder]).frames)
    assert {"height-implausible", "height-missing"} <= codes(folder)


def test_sheffield_is_read_with_its_traps_named(real_data):
    folder = real_data("sheffield_cross_800")
    frames = load([folder]).frames
    assert len(frames) == 172
    assert all(f.fix.height_m is None and f.fix.yaw_rad is not None for f in frames)
    assert {"altitude-implausible", "height-missing", "oblique"} <= codes(folder)
    assert "yaw-inconsistent" not in codes(folder)


def test_jwcate_takes_flight_and_gimbal_yaw_together(real_data):
    folder = real_data("jwcate_1200")
    frames = load([folder]).frames
    assert len(frames) == 36
    assert math.degrees(frames[0].fix.yaw_rad) == pytest.approx(170.6 - 1.3)
    assert "yaw-relative" in codes(folder)


def test_a_frame_is_made_of_a_sample():
    from telemetry.samples.sample import Sample, frame_of

    place = {"image": "a.jpg", "path": Path("a.jpg"), "vehicle": "v", "width": 64, "height": 48}
    assert frame_of(Sample(yaw_deg=3.0), **place) is None
    frame = frame_of(Sample(lat_deg=47.0, lon_deg=8.0, yaw_deg=90.0, height_m=50.0, time_s=5.0), **place)
    assert (frame.fix.yaw_rad, frame.fix.height_m, frame.time_s) == (pytest.approx(math.pi / 2), 50.0, 5.0)


def test_progress_reaches_the_total(tmp_path):
    for i in range(3):
        photo(tmp_path / f"{i}.JPG")
    seen = []
    load([tmp_path], progress=lambda what, done, total: seen.append((what, done, total)))
    assert seen[-1] == ("reading photos", 3, 3)


def test_a_clock_that_jumps_back_in_flight_is_bridged(tmp_path):
    for i in range(12):
        second = 3 * i if i < 6 else 3 * i - 900 + 1000
        photo(tmp_path / f"P_{i:02d}.JPG", 47.5 + 1e-4 * i, 8.25, second if i >= 6 else second + 1000, yaw=0.0)
    for i in range(6, 12):  # the clock was set back by a quarter of an hour
        photo(tmp_path / f"P_{i:02d}.JPG", 47.5 + 1e-4 * i, 8.25, 3 * i + 100, yaw=0.0)
    frames = load([tmp_path]).frames
    assert [f.image for f in frames] == [f"P_{i:02d}.JPG" for i in range(12)]
    assert np.allclose(np.diff([f.time_s for f in frames]), 3.0)
    assert "clock-jump" in codes(tmp_path)


def test_numbers_that_begin_anew_do_not_overrule_the_times(tmp_path):
    for i in range(12):
        number = 995 + i if i < 5 else i - 4
        photo(tmp_path / f"DJI_{number:04d}.JPG", 47.5 + 1e-4 * i, 8.25, 3 * i, yaw=0.0)
    frames = load([tmp_path]).frames
    assert np.all(np.diff([f.fix.lat_deg for f in frames]) > 0)
    assert "clock-jump" not in codes(tmp_path)


def test_of_a_multispectral_camera_one_band_is_mapped(tmp_path):
    for i in range(3):
        for n, band in enumerate(("Blue", "Green", "NIR")):
            packet = f"<x:xmpmeta><Camera:BandName>{band}</Camera:BandName></x:xmpmeta>".encode()
            exif = gps_exif(47.5 + 1e-4 * i, 8.25, local=f"2024:05:06 12:00:{i:02d}")
            jpeg(tmp_path / f"IMG_{i:04d}_{n}.jpg", xmp_packet=packet, exif_bytes=exif)
    result = load([tmp_path])
    assert [f.image for f in result.frames] == [f"IMG_{i:04d}_1.jpg" for i in range(3)]
    assert len(result.rejected) == 6
    assert "spectral band" in result.rejected[0].reason


def test_a_picture_from_far_below_the_others_is_named(tmp_path):
    for i in range(8):
        photo(tmp_path / f"p{i}.JPG", 47.5 + 1e-4 * i, second=2 * i, yaw=0.0, height=5.0 if i == 4 else 120.0)
    assert any("1 picture taken at 5 m, the others at 120 m (p4.JPG first)" in w for w in load([tmp_path]).warnings)


def test_a_photo_that_is_named_itself_brings_the_table_beside_it(tmp_path):
    bare = jpeg(tmp_path / "a.JPG")
    jpeg(tmp_path / "b.JPG")
    (tmp_path / "geo.txt").write_text("EPSG:4326\na.JPG 8.25 47.5\nb.JPG 8.26 47.6\n")
    (tmp_path / "notes.txt").write_text("windy")
    (frame,) = load([bare]).frames
    assert (frame.image, frame.fix.lat_deg, frame.fix.lon_deg) == ("a.JPG", 47.5, 8.25)


@pytest.mark.parametrize("named", ["tables", "tables/geo.txt"])
def test_a_table_that_is_named_apart_from_the_photos_is_about_all_of_them(tmp_path, named):
    for vehicle in ("v1", "v2"):
        (tmp_path / "photos" / vehicle).mkdir(parents=True)
        jpeg(tmp_path / "photos" / vehicle / f"{vehicle}.JPG")
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "geo.txt").write_text("EPSG:4326\nv1.JPG 8.25 47.5\nv2.JPG 8.26 47.6\n")
    frames = load([tmp_path / "photos", tmp_path / named]).frames
    assert [(f.vehicle, f.fix.lat_deg) for f in frames] == [("photos/v1", 47.5), ("photos/v2", 47.6)]
    assert not load([tmp_path]).frames  # not named: it may be about anything


def test_each_folders_own_table_stays_its_own_when_it_is_named(tmp_path):
    for vehicle, lat in (("v1", 47.5), ("v2", 47.6)):
        (tmp_path / vehicle).mkdir()
        jpeg(tmp_path / vehicle / "a.JPG")
        (tmp_path / vehicle / "geo.txt").write_text(f"EPSG:4326\na.JPG 8.25 {lat}\n")
    inputs = [tmp_path / vehicle / name for vehicle in ("v1", "v2") for name in ("", "geo.txt")]
    assert [(f.vehicle, f.fix.lat_deg) for f in load(inputs).frames] == [("v1", 47.5), ("v2", 47.6)]


def test_a_folder_of_photos_that_is_the_input_is_called_by_its_name(tmp_path):
    photo(tmp_path / "day" / "a.JPG")
    assert [source.path for source in survey([tmp_path / "day"]).sources] == ["day"]
