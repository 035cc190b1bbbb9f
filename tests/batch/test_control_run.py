"""A run with surveyed points: a map that lies beside its place is followed and told, control points put it right."""

import json
from dataclasses import replace

import numpy as np
import pytest
import rasterio

from gcs_plugin.cli.main import main
from tests.kit.scene import Scene, legs

SHIFT = np.array([7.0, -3.0])


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Photos of two vehicles, a map that lies beside its place, and survey tables of the scene."""
    folder = tmp_path_factory.mktemp("control")
    scene, shots = Scene(), {}
    for k, vehicle in enumerate("ab"):
        own = [replace(s, north=s.north + 80.0 * k) for s in legs(count=2, photos=8)]
        scene.fly(folder / "photos" / vehicle, own)
        shots |= {f"{vehicle}/DJI_{i:04d}.JPG": s for i, s in enumerate(own)}
    with rasterio.open(scene.basemap(folder / "map.tif")) as source:
        profile, rgb = source.profile, source.read()
    profile["transform"] = profile["transform"].translation(*SHIFT) * profile["transform"]
    with rasterio.open(folder / "beside.tif", "w", **profile) as out:
        out.write(rgb)
    survey(folder / "control.csv", scene, shots, [(-60.0, -20.0), (55.0, 0.0), (0.0, 90.0)])
    survey(folder / "check.csv", scene, shots, [(-30.0, 10.0), (40.0, 60.0), (20.0, -15.0), (-50.0, 85.0)])
    return folder


def survey(path, scene, shots, places):
    lines = ["name,lat_deg,lon_deg,sigma_m,image,column,row"]
    for k, place in enumerate(places):
        at = scene.middle + place
        lat, lon = scene.grid.to_geographic(at)
        for image, shot in shots.items():
            u, v = scene.camera(shot).project([*at, 0.0])
            if 2 < u < shot.size[0] - 3 and 2 < v < shot.size[1] - 3:
                lines.append(f"p{k},{lat:.9f},{lon:.9f},0.02,{image},{u:.2f},{v:.2f}")
    path.write_text("\n".join(lines))


def mosaic(folder, out, *more):
    assert main(["mosaic", str(folder / "photos"), "--out", str(out), "--workers", "1", *map(str, more)]) == 0
    return json.loads((out / "report.json").read_text())


def test_control_points_move_a_map_that_lies_beside_its_place(flight, tmp_path, capsys):
    beside, check = flight / "beside.tif", flight / "check.csv"
    report = mosaic(flight, tmp_path / "followed", "--basemap", beside, "--checkpoints", check)
    offset = report["map_offset_m"]
    assert (offset["east"], offset["north"]) == pytest.approx(tuple(SHIFT), abs=1.0)
    assert report["against_map_m"]["median"] < 0.4  # it lies on the map, however wrong that is
    assert any("--control FILE" in w for w in report["warnings"])
    assert report["checkpoints"]["rmse_h_m"] == pytest.approx(np.hypot(*SHIFT), abs=0.5)

    control = flight / "control.csv"
    out = tmp_path / "placed"
    report = mosaic(flight, out, "--basemap", beside, "--checkpoints", check, "--control", control)
    assert report["checkpoints"]["checkpoints"] == 4 and report["checkpoints"]["rmse_h_m"] < 0.35
    moved = report["control"]["shift_m"]
    assert report["control"]["points"] == 3
    assert (moved["east"], moved["north"]) == pytest.approx(tuple(-SHIFT), abs=0.3)
    assert report["map_offset_m"]["east"] == pytest.approx(offset["east"], abs=0.1)  # still the map's own
    assert report["against_map_m"] is None
    assert not any("--control FILE" in w for w in report["warnings"])
    assert not any("from where the receivers say" in w for w in report["warnings"])
    assert not report["control_offset_m"]["doubted"]
    page = (out / "report.html").read_text()
    assert "Placed on 3 surveyed points" in page and "4 checkpoints" in page
    with rasterio.open(out / "orthoimage.tif") as placed, rasterio.open(tmp_path / "followed/orthoimage.tif") as was:
        assert placed.bounds.left - was.bounds.left == pytest.approx(-SHIFT[0], abs=1.5)

    capsys.readouterr()
    assert main(["evaluate", str(out), "--checkpoints", str(check), "--json"]) == 0
    alone = json.loads(capsys.readouterr().out)
    assert alone["rmse_h_m"] == pytest.approx(report["checkpoints"]["rmse_h_m"], abs=0.01)


def test_control_points_are_no_checkpoints(flight, tmp_path, capsys):
    control, check, both = flight / "control.csv", flight / "check.csv", tmp_path / "both.csv"
    renamed = (line.replace("p", "q", 1) for line in control.read_text().splitlines()[1:])
    both.write_text("\n".join([check.read_text(), *renamed]))
    options = ["--checkpoints", both, "--control", control]
    report = mosaic(flight, tmp_path / "out", *options)
    found = report["checkpoints"]
    assert found["checkpoints"] == 4 and found["control_left_out"] == ["q0", "q1", "q2"]
    assert any("3 of 7 checkpoints" in warning for warning in report["warnings"])
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "out"), "--checkpoints", str(both), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["checkpoints"] == 4
    assert main(["evaluate", str(tmp_path / "out"), "--checkpoints", str(control)]) == 2
    assert "keep some points out of --control" in capsys.readouterr().err

    head, *rows = (line.split(",") for line in control.read_text().splitlines())
    moved = tmp_path / "moved.csv"  # the same names in a system 2 m off
    moved.write_text(
        "\n".join(",".join(cells) for cells in [head, *([r[0], str(float(r[1]) + 2e-5), *r[2:]] for r in rows)])
    )
    for table in (control, moved):
        out = tmp_path / "none"
        options = ["--control", str(control), "--checkpoints", str(table)]
        assert main(["mosaic", str(flight / "photos"), "--out", str(out), *options]) == 2
        assert "keep some points out of --control" in capsys.readouterr().err
        assert not (out / "orthoimage.tif").exists()


@pytest.mark.parametrize("map_given", [False, True])
def test_control_points_in_another_datum_are_told(flight, tmp_path, capsys, map_given):
    table = tmp_path / "datum.csv"
    lines = (flight / "control.csv").read_text().splitlines()
    words = [line.split(",") for line in lines[1:]]
    table.write_text(
        "\n".join([lines[0], *(",".join([w[0], w[1], f"{float(w[2]) + 0.0011:.9f}", *w[3:]]) for w in words)])
    )
    more = ("--basemap", flight / "map.tif") if map_given else ()
    report = mosaic(flight, tmp_path / "out", "--control", table, *more)
    assert report["control_offset_m"]["east"] == pytest.approx(83.0, abs=3.0)
    said = [w for w in report["warnings"] if "the control points lie" in w]
    assert len(said) == 1 and "datum" in said[0] and ("basemap, which agrees" in said[0]) == map_given
    assert said[0] in capsys.readouterr().err
    assert "one of the two is wrong" in (tmp_path / "out/report.html").read_text()


def test_control_points_of_elsewhere_are_refused_before_the_work(flight, tmp_path, capsys):
    table = tmp_path / "far.csv"
    lines = (flight / "control.csv").read_text().splitlines()
    table.write_text("\n".join([lines[0], *(line.replace(",8.", ",9.") for line in lines[1:])]))
    out = tmp_path / "out"
    assert main(["mosaic", str(flight / "photos"), "--out", str(out), "--control", str(table)]) == 2
    assert "coordinate system" in capsys.readouterr().err
    assert not (out / "orthoimage.tif").exists()


def test_exchanged_coordinates_are_told_and_the_map_is_made(flight, tmp_path, capsys):
    lines = [line.split(",") for line in (flight / "check.csv").read_text().splitlines()]
    table = tmp_path / "swapped.csv"
    table.write_text("\n".join(",".join([name, lon, lat, *rest]) if k else ",".join([name, lat, lon, *rest])
                               for k, (name, lat, lon, *rest) in enumerate(lines)))  # fmt: skip
    report = mosaic(flight, tmp_path / "out", "--checkpoints", table, "--until", "coarse")
    assert report["checkpoints"] is None
    assert any("two coordinates exchanged" in warning for warning in report["warnings"])
    assert "two coordinates exchanged" in capsys.readouterr().err
    for name in ("report.json", "frames.jsonl"):
        text = (tmp_path / "out" / name).read_text()
        assert "NaN" not in text and "Infinity" not in text
    options = ["--out", str(tmp_path / "no"), "--control", str(table)]
    assert main(["mosaic", str(flight / "photos"), *options]) == 2
    assert "two coordinates exchanged" in capsys.readouterr().err
