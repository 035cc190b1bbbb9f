"""Bad input: the rest is mapped and the report says what was left out, or there is one clear error."""

import json
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rasterio

from gcs_plugin.cli.main import main
from tests.kit.scene import Scene, Shot, legs


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.fixture(scope="module")
def basemap(scene, tmp_path_factory):
    return scene.basemap(tmp_path_factory.mktemp("map") / "map.tif")


@pytest.fixture
def mosaic(tmp_path, capsys):
    """Run `orthoswarm mosaic`; gives the exit code, lines of frames.jsonl by image, the report, and what was said."""

    def call(*inputs, basemap=None, **flags):
        out = tmp_path / "out"
        before = listing(out)
        args = ["mosaic", *map(str, inputs), "--out", str(out), "--workers", "1", "--json"]
        args += ["--basemap", str(basemap)] if basemap else []
        for name, value in flags.items():
            args += [f"--{name.replace('_', '-')}", str(value)]
        code = main(args)
        said = capsys.readouterr()
        if code:
            assert listing(out) == before and not said.out
            assert "Traceback" not in said.err and len(said.err.strip().splitlines()[-1]) > 20
            return code, {}, {}, said.err
        rows = {r["image"]: r for r in map(json.loads, (out / "frames.jsonl").read_text().splitlines())}
        report = json.loads(said.out)
        assert report["frames"]["input"] == len(rows)
        assert not list(out.glob(".*.part*"))
        return code, rows, report, said.err

    return call


def listing(folder):
    """What lies in a folder, hidden files too; None where it is not there."""
    return {p: p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()} if folder.exists() else None


def errors(scene, rows, shots, names=None):
    names = names or [f"DJI_{i:04d}.JPG" for i in range(len(shots))]
    return np.array([scene.error_m(rows[n], s) for n, s in zip(names, shots) if rows[n]["stage"] != "rejected"])


def test_damaged_files_are_named_and_the_rest_is_mapped(scene, basemap, tmp_path, mosaic):
    photos = tmp_path / "photos"
    shots = legs(count=2, photos=8)
    files = scene.fly(photos, shots)
    whole = files[5].read_bytes()
    files[5].write_bytes(whole[: len(whole) // 2])  # truncated within the picture
    files[9].write_bytes(whole[:700])  # truncated within the tags
    (photos / "zero.jpg").write_bytes(b"")
    (photos / "text.jpg").write_text("this is not a picture")
    (photos / "other.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"\0" * 50)
    (photos / "movie.dng").write_bytes(b"\0\0\0\x18ftypmp42" + b"\0" * 80)
    (photos / "notes.txt").write_text("seen a fox")
    code, rows, report, _ = mosaic(photos, basemap=basemap)
    assert code == 0
    bad = {"zero.jpg", "text.jpg", "other.png", "movie.dng", "DJI_0009.JPG"}
    assert len(rows) == 20 and "notes.txt" not in rows
    for name in bad:
        assert rows[name]["stage"] == "rejected" and len(rows[name]["reason"]) > 15
    assert report["frames"]["used"] == 20 - len(bad) - (rows["DJI_0005.JPG"]["stage"] == "rejected")
    assert np.median(errors(scene, rows, shots)) < 1.0


def test_pictures_with_one_fault_are_counted_together(scene, tmp_path, mosaic):
    shots = legs(count=2, photos=8)
    shots[3] = replace(shots[3], recorded=(400_000.0, 0.0))
    shots[11] = replace(shots[11], recorded=(0.0, -90_000.0))
    files = scene.fly(tmp_path / "photos", shots)
    for damaged in (files[5], files[9]):  # whole at first sight: the end is there, the middle is not
        damaged.write_bytes(damaged.read_bytes()[:4000] + b"\xff\xd9")
    (tmp_path / "photos" / "again_0.JPG").symlink_to(files[0])
    (tmp_path / "photos" / "again_1.JPG").symlink_to(files[1])
    code, rows, report, _ = mosaic(tmp_path / "photos", until="realtime")
    assert code == 0
    assert sorted(report["left_out"].values()) == [2, 2, 2]
    assert any("damaged JPEG" in reason for reason in report["left_out"])
    assert rows["again_1.JPG"]["detail"] == "DJI_0001.JPG"


def test_photos_without_position_are_left_out_and_counted_by_reason(scene, basemap, tmp_path, mosaic, capsys):
    shots = legs(count=2, photos=8)
    shots[3] = replace(shots[3], tags="none")
    shots[12] = replace(shots[12], tags="none")
    scene.fly(tmp_path / "photos", shots)
    code, rows, report, _ = mosaic(tmp_path / "photos", until="realtime")
    reason = rows["DJI_0003.JPG"]["reason"]
    assert code == 0 and report["frames"] == {"input": 16, "used": 14, "rejected": 2}
    assert report["left_out"] == {reason: 2}
    assert "position" in reason
    code, rows, report, _ = mosaic(tmp_path / "photos", basemap=basemap)
    assert code == 0 and report["frames"] == {"input": 16, "used": 16, "rejected": 0}
    assert any("2 photos without a position were placed by the photos beside them" in w for w in report["warnings"])
    again = ["mosaic", str(tmp_path / "photos"), "--out", str(tmp_path / "again"), "--until", "realtime"]
    assert main([*again, "--workers", "1"]) == 0
    assert f"left out: 2: {reason}" in capsys.readouterr().err
    assert np.median(errors(scene, rows, shots)) < 1.0


def test_nothing_with_a_position_is_one_error(scene, tmp_path, mosaic):
    scene.fly(tmp_path / "photos", [replace(s, tags="none") for s in legs(count=1, photos=4)])
    code, _, _, said = mosaic(tmp_path / "photos")
    assert code == 1 and "position" in said


def test_an_empty_folder_a_missing_one_and_a_text_file_are_errors(tmp_path, mosaic):
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.txt").write_text("x")
    assert mosaic(tmp_path / "empty")[0] == 2
    assert mosaic(tmp_path / "missing")[0] == 2
    assert mosaic(tmp_path / "a.txt")[0] == 2


def test_one_photo_is_mapped(scene, basemap, tmp_path, mosaic):
    shot = Shot(10, 5, yaw=30)
    scene.fly(tmp_path / "photos", [shot])
    for using in (None, basemap):
        code, rows, report, _ = mosaic(tmp_path / "photos", basemap=using, fov_min=82)
        assert code == 0 and report["frames"]["used"] == 1
        assert not any("in common" in w for w in report["warnings"])
        # one photo does not tell its field of view: what the flag says stays
        assert rows["DJI_0000.JPG"]["fov_deg"] == pytest.approx(82.0, abs=0.1)
        assert errors(scene, rows, [shot]).max() < 0.5
        with rasterio.open(tmp_path / "out" / "orthoimage.tif") as image:
            assert (image.read(4) > 0).sum() * image.res[0] ** 2 > 5000


def test_one_photo_without_a_flag_has_the_field_of_view_of_the_quick_picture(scene, tmp_path, mosaic):
    scene.fly(tmp_path / "photos", [Shot(10, 5, yaw=30)])
    rows = mosaic(tmp_path / "photos")[1]
    assert rows["DJI_0000.JPG"]["fov_deg"] == pytest.approx(70.0, abs=0.1)


def test_many_photos_of_one_spot(scene, basemap, tmp_path, mosaic):
    rng = np.random.default_rng(1)
    shots = [Shot(*rng.normal(0, 0.2, 2), yaw=10, time_s=1.7e9 + 2 * i, roll=rng.normal(0, 0.3)) for i in range(40)]
    scene.fly(tmp_path / "photos", shots)
    code, rows, report, _ = mosaic(tmp_path / "photos", basemap=basemap, fov_min=80)
    assert code == 0 and report["frames"]["used"] + report["frames"]["rejected"] == 40
    assert any("basemap was not used" in w for w in report["warnings"])
    assert report["frames"]["used"] >= 1
    assert np.median(errors(scene, rows, shots)) < 12.0
    out = tmp_path / "out"
    assert (out / "coarse.tif").read_bytes() == (out / "orthoimage.tif").read_bytes()
    assert mosaic(tmp_path / "photos", fov_min=80, until="coarse")[0] == 0
    assert (out / "coarse.tif").exists() and not (out / "orthoimage.tif").exists()


def test_a_frame_near_the_ground_among_high_ones(scene, basemap, tmp_path, mosaic):
    shots = [replace(s, height=120.0) for s in legs(count=2, photos=8, step=30)]
    shots[6] = replace(shots[6], height=5.0)
    scene.fly(tmp_path / "photos", shots)
    code, rows, report, _ = mosaic(tmp_path / "photos", basemap=basemap)
    assert code == 0
    assert any("DJI_0006.JPG first" in w for w in report["warnings"])
    others = [i for i in range(16) if i != 6]
    names = [f"DJI_{i:04d}.JPG" for i in others]
    found = errors(scene, rows, [shots[i] for i in others], names)
    assert len(found) >= 14 and np.median(found) < 1.5


def test_oblique_frames_do_not_spoil_the_others(scene, basemap, tmp_path, mosaic):
    shots = legs(count=2, photos=8)
    shots[4] = replace(shots[4], pitch=-45.0)
    shots[11] = replace(shots[11], pitch=-5.0)  # looks at the horizon
    shots[13] = replace(shots[13], pitch=30.0)  # looks at the sky
    scene.fly(tmp_path / "photos", shots)
    code, rows, report, _ = mosaic(tmp_path / "photos", basemap=basemap)
    assert code == 0
    assert "away from straight down" in rows["DJI_0004.JPG"]["reason"]
    assert any("strongly tilted" in w and "left out of the map" in w for w in report["warnings"])
    level = [i for i in range(16) if i not in (4, 11, 13)]
    names = [f"DJI_{i:04d}.JPG" for i in level]
    found = errors(scene, rows, [shots[i] for i in level], names)
    assert len(found) >= 11 and np.median(found) < 2.0
    assert rows["DJI_0013.JPG"]["stage"] == "rejected"
    with rasterio.open(tmp_path / "out" / "orthoimage.tif") as image:
        assert max(image.shape) * image.res[0] < 400


@pytest.mark.parametrize("until", ["realtime", "coarse"])
def test_oblique_frames_are_left_out_of_every_product(scene, tmp_path, mosaic, until):
    shots = [replace(s, pitch=-40.0) if i in (3, 9) else s for i, s in enumerate(legs(count=2, photos=8))]
    scene.fly(tmp_path / "photos", shots)
    code, rows, report, _ = mosaic(tmp_path / "photos", until=until)
    assert code == 0 and report["frames"] == {"input": 16, "used": 14, "rejected": 2}
    assert {n for n, r in rows.items() if r["stage"] == "rejected"} == {"DJI_0003.JPG", "DJI_0009.JPG"}
    for name in ("realtime.tif", "coarse.tif"):
        if (tmp_path / "out" / name).exists():
            with rasterio.open(tmp_path / "out" / name) as image:
                assert max(image.shape) * image.res[0] < 400


def test_a_flight_that_looks_aside_keeps_its_pictures(scene, tmp_path, mosaic):
    scene.fly(tmp_path / "photos", legs(count=2, photos=8, pitch=-50.0))
    code, _, report, _ = mosaic(tmp_path / "photos", until="realtime")
    assert code == 0 and report["frames"]["used"] == 16 and not any("aside" in w for w in report["warnings"])


def test_portrait_and_mixed_sizes(scene, basemap, tmp_path, mosaic):
    landscape, portrait = legs(count=2, photos=8), legs(count=2, photos=8, size=(240, 320))
    shots = [p if i % 5 == 0 else s for i, (s, p) in enumerate(zip(landscape, portrait))]
    shots[7] = replace(shots[7], size=(480, 360))
    scene.fly(tmp_path / "photos", shots)
    code, rows, report, _ = mosaic(tmp_path / "photos", basemap=basemap)
    assert code == 0 and report["frames"]["used"] >= 14
    assert np.median(errors(scene, rows, shots)) < 3.0


def test_the_same_names_in_several_folders(scene, basemap, tmp_path, mosaic):
    first, second = legs(count=1, photos=8), legs(count=1, photos=8, north=60.0)
    scene.fly(tmp_path / "one" / "100MEDIA", first)
    scene.fly(tmp_path / "two" / "100MEDIA", second)
    code, rows, report, _ = mosaic(tmp_path / "one", tmp_path / "two", basemap=basemap)
    assert code == 0 and len(rows) == 16 and len(report["vehicles"]) == 2
    for folder, shots in (("one", first), ("two", second)):
        names = [f"{folder}/100MEDIA/DJI_{i:04d}.JPG" for i in range(8)]
        assert np.median(errors(scene, rows, shots, names)) < 2.0


@pytest.mark.parametrize(
    ("lat", "lon", "zones"),
    [
        (48.2, 12.0, {32632, 32633}),
        (-17.5, 179.9999, {32760, 32701}),
        (66.5, -180.0, {32660, 32601}),
        (-33.9, 18.4, {32734}),
        (0.0, 30.0, {32636, 32736, 32635, 32735}),
    ],
)
def test_zone_borders_the_date_line_and_the_south(lat, lon, zones, tmp_path, mosaic):
    scene = Scene(lat, lon)
    shots = legs(count=2, photos=8)
    scene.fly(tmp_path / "photos", shots)
    code, rows, report, _ = mosaic(tmp_path / "photos", basemap=scene.basemap(tmp_path / "map.tif"))
    assert code == 0 and report["frames"]["used"] == 16
    assert {r["epsg"] for r in rows.values()} == {report["epsg"]} <= zones
    if report["epsg"] == scene.grid.epsg:
        assert np.median(errors(scene, rows, shots)) < 1.0


def test_a_position_far_away_is_left_out(scene, basemap, tmp_path, mosaic):
    shots = legs(count=2, photos=8)
    shots[4] = replace(shots[4], recorded=(400_000.0, 0.0))
    shots[9] = replace(shots[9], recorded=(0.0, -90_000.0))
    scene.fly(tmp_path / "photos", shots)
    code, rows, report, _ = mosaic(tmp_path / "photos", basemap=basemap)
    assert code == 0 and report["frames"]["used"] >= 14
    assert "far from the others" in rows["DJI_0004.JPG"]["reason"]
    assert rows["DJI_0004.JPG"]["detail"].endswith("km from the others")
    names = [n for n in rows if n not in ("DJI_0004.JPG", "DJI_0009.JPG")]
    assert np.median(errors(scene, rows, [shots[int(n[4:8])] for n in names], names)) < 1.5


def test_clock_jumps(scene, basemap, tmp_path, mosaic):
    shots = legs(count=2, photos=8)
    shots = [replace(s, time_s=s.time_s - (3600.0 if i >= 8 else 0.0)) for i, s in enumerate(shots)]
    shots[3] = replace(shots[3], time_s=315_532_800.0)  # 1980: the clock was not set
    scene.fly(tmp_path / "photos", shots)
    code, rows, report, _ = mosaic(tmp_path / "photos", basemap=basemap)
    assert code == 0 and report["frames"]["used"] >= 15
    assert np.median(errors(scene, rows, shots)) < 2.0


def test_positions_only(scene, basemap, tmp_path, mosaic):
    shots = legs(count=3, photos=8, tags="position", noise=0.5)
    scene.fly(tmp_path / "photos", shots)
    code, rows, report, _ = mosaic(tmp_path / "photos", basemap=basemap)
    assert code == 0 and report["frames"]["used"] >= 22
    assert any("height" in w for w in report["warnings"])
    assert 0.3 < report["gsd_m"] < 0.6  # 80 m over 184 px, not what the real-time picture assumed
    assert np.median(errors(scene, rows, shots)) < 5.0


def test_maps_that_are_of_no_use_are_refused_before_work_begins(scene, tmp_path, mosaic):
    scene.fly(tmp_path / "photos", legs(count=1, photos=4))
    elsewhere = Scene(47.4, 8.9).basemap(tmp_path / "elsewhere.tif")
    code, _, _, said = mosaic(tmp_path / "photos", basemap=elsewhere)
    assert code == 2 and "km away" in said
    plain = tmp_path / "plain.png"
    cv2.imwrite(str(plain), np.zeros((20, 20, 3), np.uint8))
    assert mosaic(tmp_path / "photos", basemap=plain)[0] == 2
    assert mosaic(tmp_path / "photos", basemap=tmp_path / "none.tif")[0] == 2


def cut_short(basemap, path):
    """A copy of a map that was broken off: it opens, but half of its blocks are not there."""
    whole = basemap.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    return path


def test_a_map_that_is_cut_short_is_refused_before_work_begins(scene, basemap, tmp_path, mosaic):
    scene.fly(tmp_path / "photos", legs(count=2, photos=4))
    code, _, _, said = mosaic(tmp_path / "photos", basemap=cut_short(basemap, tmp_path / "map.tif"))
    assert code == 2 and "map.tif is cut short; copy or export it again" in said


def test_a_map_that_fails_during_the_work_gives_the_coarse_map_and_is_named(
    scene, basemap, tmp_path, mosaic, monkeypatch
):
    shots = legs(count=2, photos=8)
    scene.fly(tmp_path / "photos", shots)
    monkeypatch.setattr("orthoswarm.raster.basemap.Basemap.require_readable", lambda *_: None)
    bad = cut_short(basemap, tmp_path / "map.tif")
    code, rows, report, _ = mosaic(tmp_path / "photos", basemap=bad)
    assert code == 0 and report["refine"] == "swarm" and report["basemap"] is None
    assert {r["stage"] for r in rows.values()} == {"coarse"}
    (told,) = [w for w in report["warnings"] if "map.tif" in w]
    assert "damaged" in told and "lies where the receivers say" in told
    assert np.median(errors(scene, rows, shots)) < 3.0
    out = tmp_path / "out"
    assert (out / "coarse.tif").read_bytes() == (out / "orthoimage.tif").read_bytes()
    assert not any("there is no basemap" in w for w in report["warnings"])


def test_flags_that_make_no_sense_are_refused(scene, tmp_path, mosaic):
    scene.fly(tmp_path / "photos", legs(count=1, photos=2))
    for flag in ({"gsd": 0}, {"gsd": -1}, {"fov_min": 190}, {"workers": 0}, {"dem": tmp_path / "none.tif"}):
        assert mosaic(tmp_path / "photos", **flag)[0] == 2
    (tmp_path / "out").write_text("a file")
    assert main(["mosaic", str(tmp_path / "photos"), "--out", str(tmp_path / "out")]) == 2


def test_names_that_are_no_text_and_files_that_are_no_files(scene, tmp_path, mosaic):
    photos = tmp_path / "photos"
    files = scene.fly(photos, legs(count=1, photos=5))
    shot = files[2].read_bytes()
    (photos / "._DJI_0001.JPG").write_bytes(b"\0\5\x16\7 resource fork")
    (photos / "copy.JPG").symlink_to(files[0])
    (photos / "gone.JPG").symlink_to(photos / "nowhere")
    expected = {f.name for f in files} | {"._DJI_0001.JPG", "copy.JPG", "gone.JPG"}
    if hasattr(os, "mkfifo"):
        os.mkfifo(photos / "pipe.JPG")  # reading it would wait for ever
        expected.add("pipe.JPG")
    try:
        (photos / os.fsdecode(b"caf\xe9.JPG")).write_bytes(shot)
        files[2].unlink()  # of which that would be a copy
        expected = expected - {files[2].name} | {"caf\\udce9.JPG"}
    except OSError:  # not every file system takes such a name
        pass
    code, rows, _, _ = mosaic(photos, photos, until="realtime")
    assert code == 0 and set(rows) == expected
    reasons = {n: r["reason"] for n, r in rows.items() if r["stage"] == "rejected"}
    assert set(reasons) == expected & {"._DJI_0001.JPG", "copy.JPG", "gone.JPG", "pipe.JPG"}
    assert "hidden" in reasons["._DJI_0001.JPG"] and rows["copy.JPG"]["detail"] == "DJI_0000.JPG"


def test_a_height_model_that_is_none_is_refused_before_the_work(scene, tmp_path, mosaic):
    scene.fly(tmp_path / "photos", legs(count=1, photos=4))
    (tmp_path / "dem.tif").write_text("heights")
    code, _, _, said = mosaic(tmp_path / "photos", dem=tmp_path / "dem.tif")
    assert code == 2 and "not a readable height model" in said


@pytest.mark.parametrize(
    ("east_m", "crs", "height", "says"),
    [(0.0, None, 400.0, "no CRS"), (9000.0, "area", 400.0, "covers"), (0.0, "area", -9999.0, "covers")],
    ids=["without a CRS", "of another place", "without a height"],
)
def test_a_height_model_that_tells_nothing_is_one_clear_error(scene, tmp_path, mosaic, east_m, crs, height, says):
    scene.fly(tmp_path / "photos", legs(count=1, photos=4))
    west, north = np.add(scene.middle, (east_m - 400.0, 400.0))
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", width=160, height=160, count=1, dtype="float32", nodata=-9999.0,
        crs=None if crs is None else f"EPSG:{scene.grid.epsg}", transform=rasterio.Affine(5, 0, west, 0, -5, north),
    ) as dataset:  # fmt: skip
        dataset.write(np.full((160, 160), height, np.float32), 1)
    code, _, _, said = mosaic(tmp_path / "photos", dem=tmp_path / "dem.tif")
    assert code == 2 and says in said.strip().splitlines()[-1]
