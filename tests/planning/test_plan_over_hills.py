"""`orthoswarm plan --dem`: spacing for the highest ground, and 20 m above it."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from gcs_plugin.cli.main import main
from tests.kit.flown_area import CORNER, EPSG, FlownArea


@pytest.fixture
def hill(tmp_path: Path) -> Path:
    """Ground at 300 m with a ridge of 40 m along the middle of the area."""
    east = np.arange(-300, 900, 5.0) + 2.5
    row = 300.0 + 40.0 * np.exp(-(((east - 200.0) / 80.0) ** 2))
    path = tmp_path / "dem.tif"
    size = {"width": len(east), "height": 240, "count": 1, "dtype": "float32"}
    transform = from_origin(CORNER[0] - 300.0, CORNER[1] + 900.0, 5.0, 5.0)
    with rasterio.open(path, "w", driver="GTiff", crs=f"EPSG:{EPSG}", transform=transform, **size) as file:
        file.write(np.repeat(row[None], 240, 0).astype(np.float32), 1)
    return path


def _arguments(tmp_path: Path, altitude: float, *more: object) -> list[str]:
    flown = FlownArea()
    area = flown.area(tmp_path / "a.geojson")
    start = ",".join(f"{v:.7f}" for v in flown.grid.to_geographic(CORNER - 150.0))
    given = ["plan", area, "--vehicles", 2, "--altitude", altitude, "--fov-min", 60, "--out", tmp_path / "p"]
    return [*map(str, given), "--start", start, "--json", *map(str, more)]


def test_lines_are_spaced_for_the_highest_ground(
    tmp_path: Path, hill: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(_arguments(tmp_path, 100, "--dem", hill)) == 0
    out = json.loads(capsys.readouterr().out)
    assert out["footprint_m"][0] == pytest.approx(2 * 60.0 * np.tan(np.radians(30.0)), rel=0.02)
    assert out["altitude_m"] == 100 and any("over takeoff" in w for w in out["warnings"])


def test_less_than_20_m_above_the_ground_is_refused(
    tmp_path: Path, hill: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(_arguments(tmp_path, 55, "--dem", hill)) == 2
    assert "--altitude 60" in capsys.readouterr().err


def test_a_start_is_needed(tmp_path: Path, hill: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = _arguments(tmp_path, 100, "--dem", hill)
    given = [*given[: given.index("--start")], "--dem", str(hill)]
    assert main(given) == 2
    assert "--start" in capsys.readouterr().err
