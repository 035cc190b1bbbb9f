"""`orthoswarm plan --dem`: legs over hills, spaced for what pictures see there, and never lower than 20 m."""

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from gcs_plugin.cli.main import main
from gcs_plugin.mission.makers.maker_files import read_mission_file
from gcs_plugin.mission.mission_files import FRAME_TERRAIN, NAV_WAYPOINT, parse_mission
from gcs_plugin.mission.plan_folder import plan_needs
from tests.kit.flown_area import CORNER, EPSG, FlownArea

Height = Callable[[np.ndarray, np.ndarray], np.ndarray]


def _hill(height_m: float, wide_m: float = 80.0) -> Height:
    """Heights of a hill in the middle of the area, over east and north from its corner."""
    return lambda e, n: 300.0 + height_m * np.exp(-((e - 200.0) ** 2 + (n - 200.0) ** 2) / wide_m**2)


def _posts(height_m: float, apart_m: float = 20.0, side_m: float = 2.0) -> Height:
    """Level ground with square posts in both directions between 100 and 200 m north and east."""

    def height(east: np.ndarray, north: np.ndarray) -> np.ndarray:
        post = (east % apart_m < side_m) & (north % apart_m < side_m)
        for across in (east, north):
            post &= (across >= 100.0) & (across < 200.0)
        return 300.0 + height_m * post

    return height


def _dem(path: Path, height: Height, step_m: float = 5.0) -> Path:
    at = np.arange(-300, 900, step_m) + 0.5 * step_m
    z = height(at[None, :], at[::-1, None]).astype(np.float32)
    size = {"width": len(at), "height": len(at), "count": 1, "dtype": "float32"}
    transform = from_origin(CORNER[0] - 300.0, CORNER[1] + 900.0, step_m, step_m)
    with rasterio.open(path, "w", driver="GTiff", crs=f"EPSG:{EPSG}", transform=transform, **size) as file:
        file.write(z, 1)
    return path


def _arguments(tmp_path: Path, altitude: float, *more: object) -> list[str]:
    flown = FlownArea()
    area = flown.area(tmp_path / "a.geojson")
    start = ",".join(f"{v:.7f}" for v in flown.grid.to_geographic(CORNER - 150.0))
    given = ["plan", area, "--vehicles", 2, "--altitude", altitude, "--fov-min", 60, "--out", tmp_path / "p"]
    return [*map(str, given), "--start", start, "--json", *map(str, more)]


def _planned(tmp_path: Path, capsys: pytest.CaptureFixture[str], altitude: float, *more: object) -> dict[str, Any]:
    assert main(_arguments(tmp_path, altitude, *more)) == 0
    out: dict[str, Any] = json.loads(capsys.readouterr().out)
    return out


def _sampled(feature: dict[str, Any]) -> tuple[Any, Any, Any]:
    """A line of a written mission every metre: east and north from the corner, and height over takeoff, metres."""
    lon, lat, z = np.array(feature["geometry"]["coordinates"]).T
    points = FlownArea().grid.to_grid(lat, lon)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.arange(0.0, along[-1], 1.0)
    east, north = (np.interp(at, along, points[:, axis]) - CORNER[axis] for axis in range(2))
    return east, north, np.interp(at, along, z)


def _above_ground(folder: Path, height: Height) -> Iterator[tuple[float, float]]:
    """Lowest and highest point above the ground of each leg, sampled every metre along the written missions."""
    for feature in json.loads((folder / "all.geojson").read_text())["features"]:
        if feature["properties"]["kind"] != "leg":
            continue
        east, north, z = _sampled(feature)
        above = z - (height(east, north) - 300.0)
        yield float(above.min()), float(above.max())


def _least_beside(folder: Path, height: Height, beside_m: float) -> float:
    """Least height of the missions over all ground up to a distance from them, sampled every metre."""
    found = []
    disc = [(e, n) for e in np.arange(-10.0, 10.5) for n in np.arange(-10.0, 10.5) if np.hypot(e, n) <= beside_m]
    for feature in json.loads((folder / "all.geojson").read_text())["features"]:
        if feature["geometry"]["type"] != "LineString":
            continue
        east, north, z = _sampled(feature)
        top = np.max([height(east + e, north + n) for e, n in disc], axis=0) - 300.0
        found.append(float((z - top).min()))
    return min(found)


def test_ground_beside_a_path_counts_as_ground_below_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Posts of 110 m, higher than the flight, of two pixels of the model: every line there passes some within 10 m."""
    posts = _posts(110.0)
    out = _planned(tmp_path, capsys, 80, "--dem", _dem(tmp_path / "dem.tif", posts, 1.0))
    assert _least_beside(tmp_path / "p", posts, 9.0) > 19.9
    assert out["over_ground"]["way_least_m"] == pytest.approx(20.0, abs=0.1)
    assert out["over_ground"]["above_ground_m"][1] == pytest.approx(130.0, abs=0.1)
    assert out["over_ground"]["return_height_m"] == 130.0  # over the posts, which a straight way home may pass
    assert plan_needs(tmp_path / "p").return_height_m == 130.0
    assert any("20 m or more above the highest within 10 m" in warning for warning in out["warnings"])
    assert any("to 130 m or more" in warning for warning in out["warnings"])  # a return height


def test_a_level_flight_counts_the_tops_between_the_nodes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A mast of one pixel of 1 m has a quarter of its height in the mean about a node."""
    dem = _dem(tmp_path / "dem.tif", _posts(75.0, 50.0, 1.0), 1.0)
    assert main(_arguments(tmp_path, 80, "--dem", dem, "--relief", "level")) == 2
    assert "13 m above the highest ground" in capsys.readouterr().err


def test_a_vehicle_that_keeps_its_height_itself_is_not_lifted_over_what_stands_beside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dem = _dem(tmp_path / "dem.tif", _posts(110.0), 1.0)
    assert main(_arguments(tmp_path, 80, "--dem", dem, "--relief", "follow", "--terrain-items")) == 2
    assert "highest ground within 10 m" in capsys.readouterr().err


def test_legs_follow_the_ground_within_the_tolerance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hill = _hill(60.0)
    out = _planned(tmp_path, capsys, 80, "--dem", _dem(tmp_path / "dem.tif", hill), "--height-tolerance", 6)
    assert out["over_ground"]["follows"] and out["complete"]
    # The model is sampled every 5 m and bilinear between.
    assert all(low > 73.5 and high < 86.5 for low, high in _above_ground(tmp_path / "p", hill))
    assert out["over_ground"]["above_ground_m"] == pytest.approx([74.0, 86.0], abs=1.5)
    assert 60.0 < out["over_ground"]["way_least_m"] < 74.0  # 10 m beside it the ground is up to 6 m higher


def test_an_area_that_is_flat_within_the_tolerance_is_flown_at_one_height(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = _planned(tmp_path, capsys, 80, "--dem", _dem(tmp_path / "dem.tif", _hill(10.0)))
    assert not out["over_ground"]["follows"]
    assert out["altitude_m"] == pytest.approx(85.0, abs=0.5)  # 80 m over the middle of 0 and 10 m
    assert out["footprint_m"][0] == pytest.approx(2 * 75.0 * np.tan(np.radians(30.0)), rel=0.02)


def test_the_kind_that_is_done_sooner_is_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dem = _dem(tmp_path / "dem.tif", _hill(30.0, 150.0))
    auto, follow, level = (
        _planned(tmp_path, capsys, 80, "--dem", dem, "--relief", kind) for kind in ("auto", "follow", "level")
    )
    assert follow["over_ground"]["follows"] and not level["over_ground"]["follows"]
    assert auto["makespan_s"] == min(follow["makespan_s"], level["makespan_s"])
    # Both keep the pixels at most as large as the tolerance allows.
    assert max(follow["over_ground"]["ground_pixels"][1], level["over_ground"]["ground_pixels"][1]) < 1.11


def test_steep_ground_is_seen_from_lines_that_lie_closer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dem = _dem(tmp_path / "dem.tif", _hill(100.0))
    hilly = _planned(tmp_path, capsys, 80, "--dem", dem, "--relief", "follow", "--side-overlap", 0.05)
    assert hilly["covered_share"] >= 0.999


def test_less_than_20_m_above_the_ground_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dem = _dem(tmp_path / "dem.tif", _hill(40.0))
    assert main(_arguments(tmp_path, 40, "--dem", dem, "--relief", "level")) == 2
    assert "--altitude" in capsys.readouterr().err
    assert main(_arguments(tmp_path, 21, "--dem", dem, "--relief", "follow")) == 2
    assert "20 m" in capsys.readouterr().err


def test_a_mission_holds_the_heights_over_its_own_takeoff(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Takeoff from the hill: the mission's heights count from there."""
    flown, hill = FlownArea(), _hill(60.0)
    top = ",".join(f"{v:.7f}" for v in flown.grid.to_geographic(CORNER + np.array([200.0, 200.0])))
    given = _arguments(tmp_path, 80, "--dem", _dem(tmp_path / "dem.tif", hill), "--relief", "follow", "--vehicles", 1)
    given[given.index("--start") + 1] = top
    assert main(given) == 0
    items = parse_mission((tmp_path / "p" / "v1.waypoints").read_text()).items
    assert items[0].alt_m == pytest.approx(80.0, abs=0.5)
    assert min(i.alt_m for i in items if i.has_position) < 40.0  # the foot of the hill lies 60 m lower


def test_a_start_is_needed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dem = _dem(tmp_path / "dem.tif", _hill(40.0))
    given = _arguments(tmp_path, 100)
    assert main([*given[: given.index("--start")], "--dem", str(dem)]) == 2
    assert "--start" in capsys.readouterr().err


def test_arducopter_gets_heights_above_the_ground_where_it_is_to_keep_them_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dem = _dem(tmp_path / "dem.tif", _hill(60.0))
    out = _planned(tmp_path, capsys, 80, "--dem", dem, "--relief", "follow", "--terrain-items")
    assert out["over_ground"]["terrain_items"] and out["complete"]
    items = parse_mission((tmp_path / "p" / "v1.plan").read_text()).items
    flown = [i for i in items if i.command == NAV_WAYPOINT]
    assert {i.frame for i in flown} == {FRAME_TERRAIN} and {i.alt_m for i in flown} <= {80.0, 85.0, 90.0, 95.0, 100.0}
    legs = sum(flight["legs"] for flight in out["vehicles"][0]["flights"])
    assert len(flown) <= 3 * legs + 4  # no points put in for their height alone


@pytest.mark.parametrize("autopilot", ["px4", "m300"])
def test_others_have_no_heights_above_the_ground_and_get_those_over_takeoff(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], autopilot: str
) -> None:
    dem = _dem(tmp_path / "dem.tif", _hill(60.0))
    given = ("--dem", dem, "--relief", "follow", "--terrain-items", "--autopilot", autopilot)
    out = _planned(tmp_path, capsys, 80, *given)
    assert not out["over_ground"]["terrain_items"] and any(f"{autopilot} has no items" in w for w in out["warnings"])
    items = parse_mission((tmp_path / "p" / "v1.plan").read_text()).items
    assert FRAME_TERRAIN not in {i.frame for i in items}
    if autopilot == "m300":
        data = (tmp_path / "p" / "v1.kmz").read_bytes()
        heights = [[i.alt_m for i in m if i.has_position] for m in (items, read_mission_file(data).items)]
        assert heights[1] == pytest.approx(heights[0], abs=0.05) and np.ptp(heights[1]) > 30.0
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            text = archive.read("wpmz/waylines.wpml").decode()
        assert f"<wpml:globalRTHHeight>{out['over_ground']['return_height_m']:.0f}<" in text
        assert text.count("coordinateTurn") >= 3  # points for the height alone, passed without a stop
