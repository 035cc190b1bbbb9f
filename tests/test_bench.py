"""Benchmarks measure what users would run, keep what is measured, and tell failures."""

import json

import pytest

from gcs_plugin.cli import main
from gcs_plugin.commands import bench


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """The smallest twin."""
    folder = tmp_path_factory.mktemp("twin") / "tiny"
    assert main(["twin", "make", "tiny", "--out", str(folder), "--json"]) == 0
    return folder


def test_true_poses_are_better_than_nothing_and_results_are_kept(tiny, tmp_path, capsys):
    out = tmp_path / "bench"
    command = ["bench", "accuracy", str(tiny), "--methods", "nothing,truth", "--workers", "1", "--out", str(out)]
    assert main([*command, "--json"]) == 0
    rows = {r["method"]: r for r in json.loads(capsys.readouterr().out)["rows"]}
    assert rows["truth"]["median_m"] < 0.2 and rows["truth"]["unmatched_share"] < 0.2
    assert rows["nothing"]["poses"]["center_ground_median_m"] > 0.2
    assert rows["nothing"]["cpu_s"] > 0 and rows["nothing"]["peak_rss_mb"] > 50
    assert {p.name for p in out.iterdir()} == {
        "tiny-nothing.json", "tiny-truth.json", "accuracy.json", "accuracy.md",
    }  # fmt: skip
    kept = out / "tiny-truth.json"
    kept.write_text(json.dumps({**rows["truth"], "median_m": 7.0}))
    assert main(command) == 0
    table = capsys.readouterr().out
    assert "| tiny | true poses | 7.000 |" in table and "cores of" in table


@pytest.mark.slow
def test_scaling_counts_vehicles_and_pictures_and_draws_both_figures(tiny, tmp_path, capsys):
    out = tmp_path / "bench"
    command = ["bench", "scaling", str(tiny), "--vehicles", "1,96", "--images", "6,9999", "--out", str(out)]
    assert main([*command, "--workers", "1", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(r["vehicles"], r["images"], r["frames"]) for r in rows] == [(1, 20, 20), (1, 6, 6)]
    assert all("final" in r["stages"] for r in rows)
    assert (out / "fig7.png").stat().st_size > 5000 and (out / "fig8.png").stat().st_size > 5000
    assert not (out / "photos").exists() and not (out / "map").exists()


def test_a_method_that_fails_is_a_row_with_its_message(tiny, tmp_path):
    (tmp_path / "set" / "photos").mkdir(parents=True)
    row = bench.measure(tmp_path / "set", "swarm", tmp_path / "map", 1, False)
    assert "does not exist" in row["error"]
    table = bench.accuracy_table({"machine": "m", "rows": [row]})
    assert "| set | swarm | failed: " in table


def test_wrong_arguments(tiny, tmp_path, capsys):
    out = str(tmp_path / "out")
    assert main(["bench", "accuracy", str(tmp_path), "--out", out]) == 2
    assert main(["bench", "accuracy", str(tiny), "--methods", "magic", "--out", out]) == 2
    assert main(["bench", "scaling", str(tiny), "--vehicles", "many", "--out", out]) == 2
    assert "give for example 1,2,4" in capsys.readouterr().err
