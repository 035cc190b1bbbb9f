"""Raw photos (DNG) are developed and mapped; those whose finished picture lies beside them are not used twice."""

import json
import sys

import numpy as np
import pytest

import telemetry
from gcs_plugin.cli.main import main
from orthoswarm.raster.picture_file import read_gray, read_rgb
from telemetry.ingest.ingest import survey
from tests.kit.scene import Scene, legs
from tests.telemetry.ingest.raw_photo import write_dng

SHOTS = legs(count=2, photos=8)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder, scene = tmp_path_factory.mktemp("raw"), Scene()
    for i, shot in enumerate(SHOTS):
        lat, lon = scene.grid.to_geographic(np.add(scene.middle, np.add((shot.east, shot.north), shot.recorded)))
        write_dng(folder / f"DJI_{i:04d}.DNG", scene.picture(shot), float(lat), float(lon))
    return folder


def test_a_raw_photo_has_the_colours_and_the_size_of_what_it_shows(flight):
    found, wanted = read_rgb(flight / "DJI_0003.DNG"), Scene().picture(SHOTS[3])
    assert found.shape == wanted.shape and np.abs(found.astype(int) - wanted).mean() < 3.0
    gray = read_gray(flight / "DJI_0003.DNG", 2)
    assert gray.shape == (wanted.shape[0] // 2, wanted.shape[1] // 2)
    assert read_rgb(flight / "DJI_0003.DNG", 160).shape[:2] == gray.shape


def test_raw_photos_are_mapped(flight, tmp_path):
    arguments = ["--workers", "1", "--fov-min", "80"]
    assert main(["mosaic", str(flight), "--out", str(tmp_path / "out"), *arguments]) == 0
    rows = {r["image"]: r for r in map(json.loads, (tmp_path / "out" / "frames.jsonl").read_text().splitlines())}
    assert len(rows) == 16 and {row["stage"] for row in rows.values()} == {"coarse"}
    errors = [Scene().error_m(rows[f"DJI_{i:04d}.DNG"], shot) for i, shot in enumerate(SHOTS)]
    assert np.median(errors) < 2.0


def test_a_raw_photo_beside_its_finished_picture_is_not_used(flight, tmp_path):
    Scene().fly(tmp_path, SHOTS[:3])
    for name in ("DJI_0000.DNG", "DJI_0001.DNG", "DJI_0007.DNG"):
        (tmp_path / name).write_bytes((flight / name).read_bytes())
    [source] = survey([tmp_path]).sources
    assert [str(f)[:14] for f in source.findings if f.code == "raw-pictures"] == ["2 raw pictures"]
    found = telemetry.load([tmp_path])
    used = {frame.image for frame in found.frames} | {rejected.image for rejected in found.rejected}
    assert used == {"DJI_0000.JPG", "DJI_0001.JPG", "DJI_0002.JPG", "DJI_0007.DNG"}


def test_without_the_extra_a_raw_photo_is_told_what_it_needs(flight, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    assert main(["mosaic", str(flight), "--out", str(tmp_path / "out"), "--workers", "1"]) == 2
    assert "needs the extra 'raw'" in capsys.readouterr().err


def test_a_damaged_raw_photo_is_left_out_with_the_reason(flight, tmp_path):
    data = (flight / "DJI_0000.DNG").read_bytes()
    (tmp_path / "DJI_0000.DNG").write_bytes(data[: len(data) // 2])
    (tmp_path / "DJI_0001.DNG").write_bytes((flight / "DJI_0001.DNG").read_bytes())
    found = telemetry.load([tmp_path])
    assert [frame.image for frame in found.frames] == ["DJI_0001.DNG"]
    assert [rejected.image for rejected in found.rejected] == ["DJI_0000.DNG"]
