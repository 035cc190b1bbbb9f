"""Other programs are measured whole, stopped at their limit, brought to the ground by rule and judged by the truth."""

import dataclasses
import json
import os
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.transform import from_origin

from benchmarks.peers import georeferencing
from benchmarks.peers import programs as peers
from benchmarks.peers.__main__ import main as compare
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.errors import OrthoSwarmError

# -- measuring ----------------------------------------------------------------------------------------------------

BURN = "import time; x = bytearray(150_000_000); t = time.process_time()\nwhile time.process_time() - t < {}: pass"


def python(code):
    return [sys.executable, "-c", code]


def test_time_and_memory_of_children_count(tmp_path):
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {BURN.format(0.7)!r}]); print('made')"
    used = peers.run_measured(python(code), tmp_path / "log", 60.0, out=tmp_path / "out")
    assert used.code == 0 and used.cpu_s >= 0.7 and used.wall_s >= 0.7
    assert 150 < used.peak_rss_mb < 400
    assert (tmp_path / "out").read_text() == "made\n"


def test_memory_of_the_measuring_process_does_not_count(tmp_path):
    held = np.ones(600_000_000 // 8)
    used = peers.run_measured(python(BURN.format(0.7)), tmp_path / "log", 60.0)
    assert held.all() and 150 < used.peak_rss_mb < 400


def test_a_program_at_its_limit_is_stopped_with_its_children(tmp_path):
    code = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([sys.executable, '-c', {BURN.format(60)!r}])\n"
        "print(child.pid, flush=True); time.sleep(60)"
    )
    start = time.monotonic()
    used = peers.run_measured(python(code), tmp_path / "log", 0.5)
    assert used.code is None and used.cpu_s > 0.5 and time.monotonic() - start < 30
    child = Path(f"/proc/{(tmp_path / 'log').read_text().strip()}/stat")
    deadline = time.monotonic() + 10
    while child.exists() and child.read_text().rpartition(")")[2].split()[0] != "Z" and time.monotonic() < deadline:
        os.sched_yield()
    assert not child.exists() or child.read_text().rpartition(")")[2].split()[0] == "Z"


def test_a_program_that_fails_gives_its_code_and_words(tmp_path):
    used = peers.run_measured(python("import sys; sys.exit('no overlap')"), tmp_path / "log", 60.0)
    assert used.code == 1 and (tmp_path / "log").read_text() == "no overlap\n"


def test_variables_reach_the_program(tmp_path):
    show = python("import os; print(os.environ['OMP_NUM_THREADS'])")
    peers.run_measured(show, tmp_path / "log", 60.0, {"OMP_NUM_THREADS": "7"})
    assert (tmp_path / "log").read_text() == "7\n"


# -- bringing to the ground ---------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), scale=st.floats(0.01, 100.0), angles=st.tuples(*[st.floats(-3, 3)] * 3))
def test_a_similarity_is_found_in_spite_of_outliers(seed, scale, angles):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(60, 3)) * (10, 7, 0.3)
    rotation = rotation_from_angles(*angles)
    target = scale * source @ rotation.T + (327_000.0, 3_383_000.0, 150.0)
    off = rng.choice(60, 6, replace=False)
    target[off] += rng.normal(size=(6, 3)) * 3 * scale
    found = georeferencing.fit_similarity(source, target)
    good = np.setdiff1d(np.arange(60), off)
    assert np.abs(found.apply(source)[good] - target[good]).max() < 0.05 * scale
    assert found.scale == pytest.approx(scale, rel=0.01)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "source", [np.zeros((3, 3)), np.outer(np.arange(9.0), (1.0, 2.0, 0.0))], ids=["three", "on a line"]
)
def test_positions_that_leave_a_rotation_undetermined_are_refused(source):
    with pytest.raises(OrthoSwarmError, match=r"too few|collinear"):
        georeferencing.fit_similarity(source, source * 2.0)


def model_of(cameras, names, rng):
    """What inside/colmap.py would say of cameras, in a frame of its own, with points on the ground."""
    turn, scale, shift = rotation_from_angles(*rng.uniform(-3, 3, 3)), rng.uniform(0.02, 0.2), rng.normal(size=3)
    center = np.mean([cameras[n].position for n in names], 0)

    def own(x):
        return ((np.asarray(x) - center) @ turn.T * scale + shift).tolist()

    points = [(*(center[:2] + p), -4.0) for p in rng.uniform(-50, 50, (30, 2))]
    said = {
        n: {"center": own(cameras[n].position), "rotation": (turn @ cameras[n].rotation).tolist(), "width": 640,
            "height": 480, "focal_px": cameras[n].lens.focal_px, "k1": cameras[n].lens.k1}
        for n in names
    }  # fmt: skip
    return {"cameras": said, "points": own(points)}


def test_models_in_frames_of_their_own_come_to_the_recorded_grid():
    rng = np.random.default_rng(4)
    cameras = {
        f"uav/{i:02d}.jpg": Camera(
            np.array([327_000.0 + 12 * (i % 6), 3_383_000.0 + 40 * (i // 6), 146.0]) + rng.normal(size=3) * 0.5,
            rotation_from_angles(rng.uniform(-3, 3), np.radians(-88.0), 0.03),
            Lens(640, 480, 350.0, k1=-0.02),
        )
        for i in range(24)
    }
    names = sorted(cameras)
    large, small = names[:14], names[12:]
    line = names[:3]  # too few to be placed
    models = [model_of(cameras, part, rng) for part in (line, small, large)]
    recorded = {n: c.position for n, c in cameras.items()}
    placed, level = georeferencing.placed_models(models, recorded)
    assert sorted(placed) == names and level == pytest.approx(-4.0, abs=1e-6)
    pixels = np.array([[0.0, 0.0], [639.0, 240.0], [320.0, 479.0]])
    for name in names:
        assert np.abs(placed[name].to_ground(pixels, level) - cameras[name].to_ground(pixels, -4.0)).max() < 1e-4
    with pytest.raises(OrthoSwarmError, match="no model"):
        georeferencing.placed_models(models[:1], recorded)


def texture(seed, size=700):
    rng = np.random.default_rng(seed)
    noise = sum(cv2.resize(rng.normal(size=(size // k, size // k)), (size, size)) * k for k in (5, 10, 25))
    return cv2.normalize(noise, None, 1, 255, cv2.NORM_MINMAX).astype(np.uint8)


def write_map(path, gray):
    where = {"crs": "EPSG:32648", "transform": from_origin(327_000, 3_383_000, 0.3, 0.3), "dtype": "uint8"}
    rows, cols = gray.shape
    with rasterio.open(path, "w", driver="GTiff", width=cols, height=rows, count=3, **where) as file:
        file.write(np.repeat(gray[None], 3, 0))


def test_a_stitched_picture_is_laid_where_it_belongs(tmp_path):
    ground = texture(1)
    write_map(tmp_path / "reference.tif", ground)
    h = cv2.getPerspectiveTransform(
        np.array([[80, 60], [620, 90], [600, 640], [100, 600]], np.float32),
        np.array([[0, 0], [420, 30], [400, 430], [10, 400]], np.float32),
    )
    picture = cv2.warpPerspective(ground, h, (430, 440), flags=cv2.INTER_AREA)
    picture[:50] = 0  # what a stitcher leaves empty
    cv2.imwrite(str(tmp_path / "picture.png"), picture)
    assert (
        georeferencing.lay_on_reference(tmp_path / "picture.png", tmp_path / "reference.tif", tmp_path / "laid.tif")
        >= 40
    )
    with rasterio.open(tmp_path / "laid.tif") as laid:
        seen, gray = laid.dataset_mask() > 0, laid.read(1)
    assert 0.3 < seen.mean() < 0.7 and not seen[:100].any()
    inner = cv2.erode(seen.astype(np.uint8), np.ones((15, 15))) > 0
    flow = cv2.phaseCorrelate(np.where(inner, gray, 0).astype(float), np.where(inner, ground, 0).astype(float))[0]
    assert np.hypot(*flow) < 0.5
    assert np.corrcoef(gray[inner], ground[inner])[0, 1] > 0.9


def test_a_picture_of_another_place_is_not_laid_anywhere(tmp_path):
    write_map(tmp_path / "reference.tif", texture(1))
    cv2.imwrite(str(tmp_path / "picture.png"), texture(2))
    with pytest.raises(OrthoSwarmError, match="cannot be read as a picture"):
        georeferencing.lay_on_reference(tmp_path / "none.png", tmp_path / "reference.tif", tmp_path / "laid.tif")
    with pytest.raises(OrthoSwarmError, match="could not be registered"):
        georeferencing.lay_on_reference(tmp_path / "picture.png", tmp_path / "reference.tif", tmp_path / "laid.tif")


# -- judging ------------------------------------------------------------------------------------------------------


def test_what_is_missing_from_a_map_counts_like_what_is_wrong():
    ceiling = {"blocks": 200, "share_within_1m": 0.99}
    whole = peers.with_verdict({"blocks": 198, "share_within_1m": 0.97}, ceiling)
    half = peers.with_verdict({"blocks": 100, "share_within_1m": 1.0}, ceiling)
    wrong = peers.with_verdict({"blocks": 200, "share_within_1m": 0.5}, ceiling)
    assert whole["succeeded"] and not half["succeeded"] and not wrong["succeeded"]
    assert half["right_share"] == wrong["right_share"] == 0.5
    moved = peers.with_verdict(
        {"blocks": 200, "share_within_1m": 0.0, "shape": {"blocks": 200, "share_within_1m": 0.95}}, ceiling
    )
    assert moved["shape_share"] == 0.95 and not moved["succeeded"]
    nowhere = peers.with_verdict({"shape": {"blocks": 200, "share_within_1m": 0.95}}, ceiling)
    assert nowhere["right_share"] is None and nowhere["succeeded"]
    assert not peers.with_verdict({"error": "no"}, ceiling)["succeeded"]


@pytest.fixture
def tiny(tmp_path):
    """A set with ten empty photos of two vehicles and a true map of made-up ground."""
    folder = tmp_path / "tiny"
    (folder / "truth").mkdir(parents=True)
    write_map(folder / "truth" / "reference.tif", texture(3))
    (folder / "basemap.tif").touch()
    (folder / "truth" / "manifest.json").write_text('{"disaster": "none", "noise_name": "paper", "seed": 1}')
    for i in range(10):
        photo = folder / "photos" / f"uav{i % 2}" / f"{i}.JPG"
        photo.parent.mkdir(parents=True, exist_ok=True)
        photo.touch()
    return folder


def test_programs_are_run_judged_and_kept_and_a_failure_is_shown(tiny, tmp_path, monkeypatch, capsys):
    """One that answers with the truth, one that gives up, one that never ends, one that is not there."""
    truth = tiny / "truth" / "reference.tif"

    def program(code, packages=()):
        product = lambda job: (job.out / "map.tif", 7)  # noqa: E731
        return peers.Program(
            title="a | b",
            packages=packages,
            command=lambda job, _: [*python(code), str(job.out), str(job.flat)],
            product=product,
            georeferenced="yes",
        )

    copy = f"import shutil, sys; shutil.copy({str(truth)!r}, sys.argv[1] + '/map.tif')"
    count = "; import os; assert len(os.listdir(sys.argv[2])) == 6"
    made = {
        "good": program(copy + count),
        "bad": program("import sys; print('working', file=sys.stderr); sys.exit('no | pairs')"),
        "endless": program("while True: pass"),
        "absent": program(copy, ("something",)),
        "placeless": dataclasses.replace(program(copy), placed=False, georeferenced="no"),
    }
    monkeypatch.setattr(peers, "PROGRAMS", made)
    out = tmp_path / "out"
    out.mkdir()
    ceiling = {"program": "truth", "every": 2, "photos": 6, "used": 6, "blocks": 81, "share_within_1m": 1.0}
    ceiling |= {"median_m": 0.01, "p95_m": 0.02, "unmatched_share": 0.0}
    (out / "tiny-truth-every2.json").write_text(json.dumps(ceiling))
    command = [str(tiny), "--programs", ",".join(made), "--every", "2", "--limit-s", "1"]
    (tmp_path / "file").touch()  # where no environment can be made
    command += ["--environments", str(tmp_path / "file"), "--out", str(out)]
    assert compare(command) == 0
    capsys.readouterr()
    result = json.loads((out / "peers-every2.json").read_text())
    rows = {r["program"]: r for r in result["rows"]}
    assert rows["good"]["succeeded"] and rows["good"]["median_m"] < 0.05 and rows["good"]["used"] == 7
    assert rows["good"]["photos"] == 6 and rows["good"]["peak_rss_mb"] > 0  # it ends within a look or two
    assert rows["bad"]["error"] == "no | pairs" and not rows["bad"]["succeeded"]
    assert rows["endless"]["error"] == "stopped at the limit of 1 CPU s" and 1 < rows["endless"]["cpu_s"] < 10
    assert rows["absent"]["error"].startswith("it could not be installed: ")
    assert rows["truth"]["right_share"] == 1.0
    assert (out / "tiny-good-every2.jpg").stat().st_size > 1000 and not (out / "run" / "good").exists()
    assert (out / "peers-every2.jpg").stat().st_size > 5000
    kept = out / "tiny-good-every2.json"
    kept.write_text(json.dumps(json.loads(kept.read_text()) | {"median_m": 7.0}))
    assert compare(command) == 0
    table = capsys.readouterr().out
    assert "clear, paper, seed 1, 1 of 2 photos | a | b | 7 of 6 | yes | yes | 100.0 % | - | 7.00 |" in table
    assert "| 7 of 6 | no | yes (its shape) | - | 100.0 % | 0.0" in table
    assert "no: no / pairs" in table and "true poses (the ceiling)" in table and "cores of" in table


def test_wrong_arguments(tiny, tmp_path, capsys):
    command = [str(tiny), "--out", str(tmp_path / "out")]
    assert compare([*command, "--programs", "magic"]) == 2
    assert compare([*command, "--every", "0"]) == 2
    assert "pycolmap" in capsys.readouterr().err
