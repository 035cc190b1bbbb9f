"""`orthoswarm coverage`: shares, causes and files, through the command line."""

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio

from gcs_plugin.cli.main import main
from orthoswarm.model.frame import Rejection
from tests.kit.flown_area import EPSG, FlownArea


def _run(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict:
    assert main(["coverage", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def _hole(line: int = 3) -> set[tuple[int, int]]:
    return {(line, k) for k in range(8, 18)}


def test_all_seen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = FlownArea()
    out = _run(
        capsys, flown.write(tmp_path / "map"), "--area", flown.area(tmp_path / "a.geojson"), "--out", tmp_path / "c"
    )
    assert out["seen_share"] == 1.0 and out["gaps"] == [] and out["missing_pictures"] == []
    assert out["area_m2"] == pytest.approx(400 * 300, rel=0.01)


def test_without_a_folder_for_results_figures_are_printed_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flown = FlownArea(dropped=_hole(), spacing_m=66.0)
    inputs = [flown.write(tmp_path / "map"), "--area", flown.area(tmp_path / "a.geojson")]
    before = sorted(tmp_path.rglob("*"))
    assert _run(capsys, *inputs)["gaps"]
    assert main(["coverage", *map(str, inputs)]) == 0
    said = capsys.readouterr().out
    assert "gap of" in said and "written" not in said
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("skip_numbers", "cause"), [(True, "pictures not arrived"), (False, "not triggered")])
def test_a_hole_in_a_leg_is_told_by_the_file_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], skip_numbers: bool, cause: str
) -> None:
    flown = FlownArea(dropped=_hole(), skip_numbers=skip_numbers, spacing_m=66.0)
    out = _run(
        capsys, flown.write(tmp_path / "map"), "--area", flown.area(tmp_path / "a.geojson"), "--out", tmp_path / "c"
    )
    assert len(out["missing_pictures"]) == 10
    biggest = out["gaps"][0]
    # 120 m without a picture, of which 69 m are seen from both ends, on the strip only this line sees.
    assert biggest["cause"] == cause and biggest["vehicle"] == "v2" and 1000 < biggest["area_m2"] < 8000
    assert out["missed_share"] == pytest.approx(
        sum(g["area_m2"] for g in out["gaps"] if not g["detail"]) / 120e3, abs=0.01
    )


def test_rejected_pictures_are_no_missing_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    everything = {p.frame.image: p.frame.time_s for p in FlownArea(spacing_m=66.0).placed()}
    flown = FlownArea(dropped=_hole(), spacing_m=66.0)
    lost = everything.keys() - {p.frame.image for p in flown.placed()}
    rejected = [Rejection(i, "damaged", i.split("/")[0], everything[i]) for i in lost]
    out = _run(
        capsys,
        flown.write(tmp_path / "map", rejected),
        "--area",
        flown.area(tmp_path / "a.geojson"),
        "--out",
        tmp_path / "c",
    )
    assert {m["cause"] for m in out["missing_pictures"]} == {"pictures rejected"}
    assert {m["image"] for m in out["missing_pictures"]} == lost
    assert out["gaps"][0]["cause"] == "pictures rejected"


def test_a_line_that_was_not_flown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = FlownArea(dropped={(2, k) for k in range(99)}, spacing_m=80.0, fov_deg=70.0)
    out = _run(
        capsys, flown.write(tmp_path / "map"), "--area", flown.area(tmp_path / "a.geojson"), "--out", tmp_path / "c"
    )
    assert out["gaps"][0]["cause"] == "not flown"
    assert out["missed_share"] == pytest.approx(48.0 / 400.0, abs=0.02)  # 2 x 80 m less what both neighbours see


def test_a_lens_narrower_than_planned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = FlownArea(fov_deg=30.0)
    area = flown.area(tmp_path / "a.geojson")
    plan = ["plan", area, "--vehicles", 2, "--altitude", 80, "--fov-min", 60, "--out", tmp_path / "p"]
    assert main([*map(str, plan)]) == 0
    capsys.readouterr()
    out = _run(capsys, flown.write(tmp_path / "map"), "--area", area, "--plan", tmp_path / "p", "--out", tmp_path / "c")
    assert {g["cause"] for g in out["gaps"] if not g["detail"]} == {"lens narrower than planned"}
    assert out["missed_share"] > 0.1


def test_demands_make_views_poor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = FlownArea(sigma_m=0.2)
    given = [flown.write(tmp_path / "map"), "--area", flown.area(tmp_path / "a.geojson"), "--out", tmp_path / "c"]
    gsd = 80.0 * 2 * np.tan(np.radians(30.0)) / 1600
    assert _run(capsys, *given, "--want-m", 1.05 * gsd, "--want-sigma-m", 0.3)["seen_share"] == 1.0
    coarse = _run(capsys, *given, "--want-m", 0.95 * gsd)
    assert coarse["poor_share"] == 1.0 and coarse["gaps"][0]["detail"] == "too coarse"
    unsure = _run(capsys, *given, "--want-sigma-m", 0.1)
    assert unsure["poor_share"] == 1.0 and unsure["gaps"][0]["detail"] == "position uncertain"


def test_two_sigma_shrink_the_footprint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # One line of 92 m wide pictures on a strip of 80 m: 6 m margin on each side.
    sharp = FlownArea(width_m=80.0, spacing_m=80.0, vehicles=1, sigma_m=2.0)
    loose = FlownArea(width_m=80.0, spacing_m=80.0, vehicles=1, sigma_m=4.0)
    area = sharp.area(tmp_path / "a.geojson")
    first = _run(capsys, sharp.write(tmp_path / "m1"), "--area", area, "--out", tmp_path / "c1")
    second = _run(capsys, loose.write(tmp_path / "m2"), "--area", area, "--out", tmp_path / "c2")
    assert first["seen_share"] == 1.0
    assert second["seen_share"] < 1.0 and second["missed_share"] == 0.0
    assert {g["detail"] for g in second["gaps"]} == {"edge of a picture"}


def test_files_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = FlownArea(dropped=_hole(), spacing_m=66.0)
    out = _run(
        capsys, flown.write(tmp_path / "map"), "--area", flown.area(tmp_path / "a.geojson"), "--out", tmp_path / "c"
    )
    with rasterio.open(tmp_path / "c" / "cells.tif") as file:
        state = file.read(1)
        assert file.crs.to_epsg() == EPSG and max(file.res) <= 1.0
        assert file.tags(1)["value_4"] == "missed"
    inside = state[(state > 0) & (state < 5)]
    assert (inside == 2).mean() == pytest.approx(out["seen_share"])
    features = json.loads((tmp_path / "c" / "gaps.geojson").read_text())["features"]
    assert [f["properties"]["area_m2"] for f in features] == [g["area_m2"] for g in out["gaps"]]
    info = pyogrio.read_info(tmp_path / "c" / "gaps.gpkg")
    assert info["features"] == len(features) and info["crs"] == f"EPSG:{EPSG}"
    assert (tmp_path / "c" / "gaps.kml").read_text().count("<Placemark>") == len(features)
    assert (tmp_path / "c" / "coverage.png").stat().st_size > 1000


def test_an_area_elsewhere_is_missed_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = FlownArea(width_m=100.0, height_m=100.0)
    other = tmp_path / "b.geojson"
    lat, lon = flown.grid.to_geographic([610_000.0, 5_300_000.0])
    ring = [[lon, lat], [lon + 0.001, lat], [lon + 0.001, lat + 0.001], [lon, lat + 0.001], [lon, lat]]
    other.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    out = _run(capsys, flown.write(tmp_path / "map"), "--area", other, "--out", tmp_path / "c")
    assert out["missed_share"] == 1.0 and any("belong together" in w for w in out["warnings"])


def test_no_map_or_no_polygon(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = FlownArea(width_m=100.0, height_m=100.0)
    area = flown.area(tmp_path / "a.geojson")
    (tmp_path / "none").mkdir()
    assert main(["coverage", str(tmp_path / "none"), "--area", str(area), "--out", str(tmp_path / "c")]) == 2
    assert "report.json" in capsys.readouterr().err
    line = tmp_path / "line.geojson"
    line.write_text(json.dumps({"type": "LineString", "coordinates": [[9.0, 48.0], [9.1, 48.0]]}))
    out = flown.write(tmp_path / "map")
    assert main(["coverage", str(out), "--area", str(line), "--out", str(tmp_path / "c")]) == 2
    assert "polygon" in capsys.readouterr().err


def test_camera_events_of_a_log_say_that_pictures_have_not_arrived(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The files' numbers go on, so without the log the hole looks as if the camera had not been triggered."""
    whole = FlownArea(vehicles=1, spacing_m=66.0)
    flown = FlownArea(vehicles=1, spacing_m=66.0, dropped=_hole(), skip_numbers=False)
    grid = whole.grid
    rows = ["% GPST latitude(deg) longitude(deg) height(m) Q ns sdn sde"]
    log = tmp_path / "exposures.pos"
    for placed in whole.placed():
        lat, lon = grid.to_geographic(placed.camera.position[:2])
        when = datetime.fromtimestamp(placed.frame.time_s, UTC).strftime("%Y/%m/%d %H:%M:%S.%f")[:-3]
        rows.append(f"{when} {lat:.9f} {lon:.9f} 80.0 1 12 0.01 0.01")
    log.write_text("\n".join(rows).replace("% GPST", "% UTC") + "\n")
    out = _run(
        capsys, flown.write(tmp_path / "map"), "--area", flown.area(tmp_path / "a.geojson"), "--out", tmp_path / "c",
        "--log", log,
    )  # fmt: skip
    assert {m["cause"] for m in out["missing_pictures"]} == {"pictures not arrived"}
    assert len(out["missing_pictures"]) == len(_hole()) and out["gaps"][0]["cause"] == "pictures not arrived"
