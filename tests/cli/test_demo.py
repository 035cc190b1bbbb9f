"""The demonstration: the whole swarm simulated, the map measured against the truth."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest

from gcs_plugin.cli.main import main
from gcs_plugin.demo.demonstration import PacedClock, vehicle_rate, wait_for
from gcs_plugin.demo.simulated_camera import DemoSetting, Errors
from orthoswarm.model.errors import OrthoSwarmError


def test_a_folder_with_something_else_in_it_is_left_alone(tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "contains other files" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("arguments", [["--vehicles", "0"], ["--vehicles", "99"], ["--speed", "0"]])
def test_impossible_demonstrations_are_refused(arguments, tmp_path):
    assert main(["demo", "--out", str(tmp_path / "d"), *arguments]) == 2


def test_the_area_grows_with_the_swarm():
    small, large = DemoSetting(vehicles=1), DemoSetting(vehicles=6)
    assert large.extent_m[0] == 6 * small.extent_m[0]
    across, along = large.twin.plan.extent_m
    assert across < 0.5 * large.extent_m[0]
    assert along < 0.5 * large.extent_m[1]


def test_vehicles_differ_and_stay_as_they_are():
    setting = DemoSetting()
    assert Errors.of(setting, 1) == Errors.of(setting, 1)
    assert Errors.of(setting, 1) != Errors.of(setting, 2)


def test_vehicles_fly_slower_while_pictures_wait():
    assert vehicle_rate(8.0, 0, 0) == vehicle_rate(8.0, 4, 20) == 8.0
    rates = [vehicle_rate(8.0, to_render, 0) for to_render in (4, 8, 16, 64, 1000)]
    assert rates == sorted(rates, reverse=True) and rates[1] < 4.0
    assert vehicle_rate(8.0, 0, 100) < 4.0
    assert 0.0 < rates[-1] == vehicle_rate(8.0, 0, 10_000)  # heartbeats still come
    assert vehicle_rate(0.2, 1000, 0) == 0.2


def test_the_clock_runs_as_it_is_told(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("gcs_plugin.demo.demonstration.time.monotonic", lambda: now[0])
    clock = PacedClock()
    now[0] += 2.0
    assert clock() == pytest.approx(2.0)
    clock.share = 0.25
    now[0] += 2.0
    assert clock() == pytest.approx(2.5)


def test_a_wait_lasts_as_long_as_anything_moves(monkeypatch):
    """However slow: an hour between steps of nine minutes is waited out, ten minutes without a step are not."""
    now, told = [0.0], []
    monkeypatch.setattr("gcs_plugin.demo.demonstration.time.monotonic", lambda: now[0])
    monkeypatch.setattr("gcs_plugin.demo.demonstration.time.sleep", lambda _: now.__setitem__(0, now[0] + 60.0))
    wait_for(lambda: now[0] >= 3600.0, "the map", lambda: now[0] // 540, lambda: told.append(now[0]))
    assert len(told) == 60
    with pytest.raises(OrthoSwarmError, match="the map: nothing has moved for 600 s"):
        wait_for(lambda: False, "the map", lambda: 0, lambda: None)
    assert now[0] < 4500.0


@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal to a group of processes")
def test_a_ctrl_c_at_the_terminal_ends_all_of_it_in_a_sentence(tmp_path):
    mark = tmp_path / "demo" / "demo.json"
    command = [sys.executable, "-m", "gcs_plugin.cli", "demo", "--no-browser", "--out", str(mark.parent)]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells ignore it for what runs behind them
    )  # fmt: skip
    while not mark.exists():
        assert process.poll() is None
        time.sleep(0.02)
    time.sleep(1.0)  # there is nothing to wait for: any moment of its start will do
    os.killpg(process.pid, signal.SIGINT)
    try:
        _, said = process.communicate(timeout=240)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    # Interrupted inside exec(), as imports use it, Python ends by the signal itself; a shell shows 130 in both cases.
    assert process.returncode in (130, -signal.SIGINT)
    assert "Traceback" not in said and "interrupted" in said


@pytest.mark.slow
def test_the_demonstration_maps_a_city_within_half_a_metre(tmp_path):
    out = tmp_path / "demo"
    assert main(["demo", "--vehicles", "2", "--out", str(out), "--median", "0.5", "--no-browser"]) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["frames"]["used"] == report["demo"]["pictures"]
    completions = report["completions"]
    assert {row["vehicle"] for row in completions} == {"v1", "v2"}
    assert completions[0]["still_flying"]
    for row in completions:
        assert row["complete_s"] < row["refine_started_s"] < row["refine_ended_s"]
        assert row["version"] > row["version_before"]
    assert report["accuracy_realtime"]["median_m"] < 1.0  # pictures lay on the basemap when they came
    for name in ("orthoimage.tif", "realtime.tif", "report.html", "export/orthoimage.mbtiles", "export/orthoimage.kmz"):
        assert (out / name).exists()


@pytest.mark.slow
@pytest.mark.loaded
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux pins processes to a core")
def test_a_demonstration_on_a_quarter_of_a_core_ends_well_and_says_how_far_it_is(tmp_path):
    core = min(os.sched_getaffinity(0))
    pinned = ["taskset", "-c", str(core), sys.executable]
    busy = [subprocess.Popen([*pinned, "-c", "while True: pass"]) for _ in range(3)]
    try:
        command = [
            *pinned,
            "-m",
            "gcs_plugin.cli",
            "demo",
            "--vehicles",
            "1",
            "--no-browser",
            "--out",
            "demo",
            "--json",
        ]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=1800)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    # A stream that was silent for ten seconds is opened again, without what was under way.
    assert report["frames"]["used"] >= 0.9 * report["demo"]["pictures"] > 20
    assert report["accuracy"]["median_m"] < 0.5
    assert "instead of 6.0" in done.stderr and re.search(r"pictures on the map: \d+ of \d+", done.stderr)
