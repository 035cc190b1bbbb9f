"""Photos without a position are placed by control points that they show, or stay out with the reason."""

import json
from dataclasses import replace

import pytest

from gcs_plugin.cli.main import main
from tests.batch.test_control_run import survey
from tests.kit.scene import Scene, legs


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Two vehicles over one scene, and points that photos show: vehicle b recorded nothing, or neither did."""
    folder = tmp_path_factory.mktemp("unpositioned")
    scene, shots = Scene(), {}
    for k, vehicle in enumerate("ab"):
        own = [replace(s, north=s.north + 60.0 * k) for s in legs(count=2, photos=8)]
        nothing = [replace(s, tags="none") for s in own]
        scene.fly(folder / "mixed" / vehicle, own if vehicle == "a" else nothing)
        scene.fly(folder / "bare" / vehicle, nothing)
        shots |= {f"{vehicle}/DJI_{i:04d}.JPG": s for i, s in enumerate(own)}
    survey(folder / "control.csv", scene, shots, [(-60.0, -20.0), (55.0, 0.0), (0.0, 90.0), (-40.0, 60.0)])
    survey(folder / "check.csv", scene, shots, [(-30.0, 10.0), (40.0, 60.0), (20.0, -15.0), (-50.0, 85.0)])
    return folder


def mosaic(folder, photos, out, *more):
    arguments = ["mosaic", str(folder / photos), "--out", str(out), "--workers", "1", "--fov-min", "80"]
    return main([*arguments, *map(str, more)])


@pytest.mark.slow
def test_photos_that_recorded_nothing_are_placed_by_control_points(flight, tmp_path):
    out = tmp_path / "out"
    assert mosaic(flight, "bare", out, "--control", flight / "control.csv", "--checkpoints", flight / "check.csv") == 0
    report = json.loads((out / "report.json").read_text())
    assert report["frames"]["used"] == 32 and report["frames"]["rejected"] == 0
    assert report["checkpoints"]["checkpoints"] == 4 and report["checkpoints"]["rmse_h_m"] < 0.3
    assert any("32 photos without a position were placed by control points" in w for w in report["warnings"])
    assert not any("receivers say" in w for w in report["warnings"])  # none has a receiver


@pytest.mark.slow
def test_photos_with_positions_help_to_place_those_without(flight, tmp_path):
    """One point lies in photos of the other vehicle only: a single one could not place it alone."""
    lines = (flight / "control.csv").read_text().splitlines()
    (tmp_path / "one.csv").write_text("\n".join([lines[0], *(line for line in lines if line.startswith("p0,"))]))
    out = tmp_path / "out"
    assert mosaic(flight, "mixed", out, "--control", tmp_path / "one.csv", "--checkpoints", flight / "check.csv") == 0
    report = json.loads((out / "report.json").read_text())
    assert report["frames"]["used"] == 32
    assert report["checkpoints"]["rmse_h_m"] < 2.0  # as good as receivers


def test_without_control_points_they_stay_out_with_the_reason(flight, tmp_path, capsys):
    assert mosaic(flight, "bare", tmp_path / "none") == 2
    assert "has no position" in capsys.readouterr().err
    out = tmp_path / "mixed"
    assert mosaic(flight, "mixed", out, "--until", "realtime") == 0
    frames = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    left = [f for f in frames if f["stage"] == "rejected"]
    assert {f["vehicle"] for f in left} == {"b"} and len(left) == 16
    assert all("no position" in f["reason"] for f in left)


def test_one_point_cannot_place_them(flight, tmp_path, capsys):
    lines = (flight / "control.csv").read_text().splitlines()
    (tmp_path / "one.csv").write_text("\n".join([lines[0], *(line for line in lines if line.startswith("p0,"))]))
    out = tmp_path / "out"
    assert mosaic(flight, "bare", out, "--control", tmp_path / "one.csv") == 2
    assert "has no position" in capsys.readouterr().err and not out.exists()
