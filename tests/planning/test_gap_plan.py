"""`orthoswarm plan --gaps`: gaps of a coverage are flown again, and nothing else."""

import json
from pathlib import Path

import numpy as np
import pytest
import shapely

from gcs_plugin.cli.main import main
from orthoswarm.model.geo import LocalGrid
from tests.kit.flown_area import CORNER, EPSG, FlownArea

GRID = LocalGrid(EPSG)


def _gaps(path: Path, *gaps: tuple[tuple[float, float, float, float], str]) -> Path:
    features = []
    for (west, south, east, north), cause in gaps:
        corners = CORNER + np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])
        ring = [[float(lon), float(lat)] for lat, lon in GRID.to_geographic(corners)]
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "properties": {"cause": cause}, "geometry": geometry})
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def _plan(tmp_path: Path, capsys: pytest.CaptureFixture[str], *more: object) -> dict:
    given = ["plan", "--altitude", 80, "--endurance", 20, "--out", tmp_path / "p", "--json", *more]
    assert main([str(a) for a in given]) == 0
    return json.loads(capsys.readouterr().out)


def _legs(tmp_path: Path) -> list[np.ndarray]:
    features = json.loads((tmp_path / "p" / "all.geojson").read_text())["features"]
    lines = [np.array(f["geometry"]["coordinates"]) for f in features if f["properties"]["kind"] == "leg"]
    return [GRID.to_grid(line[:, 1], line[:, 0]) - CORNER for line in lines]


def test_gaps_of_a_coverage_are_covered_with_the_solved_lens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flown = FlownArea(
        dropped={(2, k) for k in range(99)} | {(5, k) for k in range(5, 20)}, spacing_m=66.0, fov_deg=55.0
    )
    made = flown.write(tmp_path / "map")
    area = flown.area(tmp_path / "a.geojson")
    assert main(["coverage", str(made), "--area", str(area), "--out", str(tmp_path / "c"), "--json"]) == 0
    missed = json.loads(capsys.readouterr().out)
    out = _plan(
        tmp_path, capsys, "--gaps", tmp_path / "c" / "gaps.geojson", "--map", made, "--vehicles", 2, "--fly-not-arrived"
    )
    assert out["method"] == "gaps" and out["covered_share"] > 0.999
    assert out["footprint_m"][0] == pytest.approx(2 * 80 * np.tan(np.radians(55.0 / 2)), rel=1e-3)
    features = json.loads((tmp_path / "c" / "gaps.geojson").read_text())["features"]
    seen = shapely.union_all([shapely.LineString(leg).buffer(0.5 * out["footprint_m"][0]) for leg in _legs(tmp_path)])
    for feature in features:
        ring = np.array(feature["geometry"]["coordinates"][0])
        gap = shapely.Polygon(GRID.to_grid(ring[:, 1], ring[:, 0]) - CORNER)
        assert gap.difference(seen).area < 0.01 * gap.area
    length = sum(float(np.hypot(*(leg[-1] - leg[0]))) for leg in _legs(tmp_path))
    assert missed["missed_share"] > 0.1 and length < 0.4 * 6 * 300.0


@pytest.mark.parametrize("recorded_share", [1.25, 0.8])
def test_the_map_gives_what_its_pictures_saw_from_the_heights_that_were_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], recorded_share: float
) -> None:
    made = FlownArea(fov_deg=60.0, recorded_share=recorded_share).write(tmp_path / "map")
    gaps = _gaps(tmp_path / "g.geojson", ((0, 0, 100, 200), "not flown"))
    out = _plan(tmp_path, capsys, "--gaps", gaps, "--map", made, "--vehicles", 1)
    assert out["footprint_m"][0] == pytest.approx(2 * 80 / recorded_share * np.tan(np.radians(30.0)), rel=1e-3)


def test_neighbouring_gaps_become_one_leg(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gaps = _gaps(tmp_path / "g.geojson", *(((0, 30 * k, 20, 30 * k + 20), "not flown") for k in range(5)))
    out = _plan(tmp_path, capsys, "--gaps", gaps, "--fov-min", 60, "--vehicles", 1)
    (leg,) = _legs(tmp_path)
    assert any("--no-fly" in w for w in out["warnings"])
    assert abs(leg[0, 0] - 10.0) < 40.0 and abs(leg[-1, 1] - leg[0, 1]) > 60.0


def test_pictures_that_have_not_arrived_are_not_flown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    far = ((300, 0, 340, 200), "pictures not arrived")
    gaps = _gaps(tmp_path / "g.geojson", ((0, 0, 40, 200), "not flown"), far)
    out = _plan(tmp_path, capsys, "--gaps", gaps, "--fov-min", 60, "--vehicles", 1)
    assert all(leg[:, 0].max() < 100.0 for leg in _legs(tmp_path)) and any("not arrived" in w for w in out["warnings"])
    _plan(tmp_path, capsys, "--gaps", gaps, "--fov-min", 60, "--vehicles", 1, "--fly-not-arrived")
    assert any(leg[:, 0].min() > 250.0 for leg in _legs(tmp_path))


def test_gaps_in_no_fly_zones_are_told_and_not_flown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gaps = _gaps(tmp_path / "g.geojson", ((0, 0, 40, 200), "not flown"), ((200, 50, 240, 90), "not flown"))
    zone = _gaps(tmp_path / "z.geojson", ((190, 40, 250, 100), ""))
    out = _plan(tmp_path, capsys, "--gaps", gaps, "--fov-min", 60, "--vehicles", 2, "--no-fly", zone)
    assert any("no-fly" in w for w in out["warnings"])
    assert all(leg[:, 0].max() < 100.0 for leg in _legs(tmp_path))


def test_a_short_battery_makes_several_sorties(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gaps = _gaps(tmp_path / "g.geojson", *(((300 * k, 0, 300 * k + 40, 900), "not flown") for k in range(4)))
    start = ",".join(f"{v:.6f}" for v in GRID.to_geographic(CORNER))
    out = _plan(tmp_path, capsys, "--gaps", gaps, "--fov-min", 60, "--vehicles", 1, "--endurance", 8, "--start", start)
    (vehicle,) = out["vehicles"]
    assert vehicle["sorties"] > 1 and all(f["time_s"] <= 480.0 for f in vehicle["flights"])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (["--fov-min", "60"], "--endurance"),
        (["--endurance", "20"], "--fov-min"),
        (["--fov-min", "60", "--endurance", "20", "AREA"], "either"),
    ],
)
def test_what_is_not_known_is_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: list[str], said: str
) -> None:
    gaps = _gaps(tmp_path / "g.geojson", ((0, 0, 40, 200), "not flown"))
    given = ["plan", "--gaps", str(gaps), "--vehicles", "1", "--altitude", "80", "--out", str(tmp_path / "p"), *change]
    assert main(given) == 2
    assert said in capsys.readouterr().err


def test_no_gap_is_nothing_to_fly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gaps = _gaps(tmp_path / "g.geojson")
    given = ["plan", "--gaps", gaps, "--vehicles", 1, "--altitude", 80, "--fov-min", 60, "--endurance", 9]
    assert main([*map(str, given), "--out", str(tmp_path / "p")]) == 2
    assert "nothing to fly" in capsys.readouterr().err
