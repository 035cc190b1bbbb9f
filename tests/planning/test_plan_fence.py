"""Geofences of a QGroundControl plan: flights stay inside, and the missions carry them on."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gcs_plugin.cli.main import main
from gcs_plugin.mission.mission_files import parse_mission
from orthoswarm.model.plan import Fence
from tests.kit.plan_checks import on_globe

Corners = list[tuple[float, float]]


def _degrees(corners: Corners) -> list[list[float]]:
    """Latitude and longitude of corners in metres."""
    return [[float(v) for v in place] for place in on_globe(corners).shell]


def _box(west: float, south: float, east: float, north: float) -> Corners:
    return [(west, south), (east, south), (east, north), (west, north)]


def _fence(corners: Corners, inclusion: bool) -> dict[str, Any]:
    return {"inclusion": inclusion, "polygon": _degrees(corners), "version": 1}


def _circle(centre: tuple[float, float], radius_m: float, inclusion: bool) -> dict[str, Any]:
    return {"inclusion": inclusion, "circle": {"center": _degrees([centre, (0, 0), (9, 9)])[0], "radius": radius_m}}


def _survey(path: Path, polygons: list[dict[str, Any]], circles: list[dict[str, Any]] | None = None) -> Path:
    """A survey of 600 x 400 m with fences."""
    item = {"type": "ComplexItem", "complexItemType": "survey", "polygon": _degrees(_box(0, 0, 600, 400))}
    document = {
        "fileType": "Plan",
        "mission": {"version": 2, "items": [item], "plannedHomePosition": [47.0, 9.0, 400]},
        "geoFence": {"version": 2, "polygons": polygons, "circles": circles or []},
    }
    path.write_text(json.dumps(document))
    return path


def _plan(area: Path, start: tuple[float, float], *more: object) -> int:
    given = ["plan", area, "--vehicles", 2, "--altitude", 60, "--fov-min", 60, "--out", area.parent / "p", *more]
    ((lat, lon), *_) = _degrees([start, (0, 0), (9, 9)])
    return main([*map(str, given), "--start", f"{lat:.8f},{lon:.8f}"])


def _written(folder: Path) -> tuple[Fence, ...]:
    return parse_mission((folder / "p" / "v1.plan").read_text()).fences


def test_fences_that_flights_keep_are_written_with_each_mission(tmp_path: Path) -> None:
    polygons = [_fence(_box(-50, -50, 650, 450), True), _fence(_box(100, 100, 180, 160), False)]
    circles = [_circle((300, 200), 30, False), _circle((300, 200), 600, True)]
    area = _survey(tmp_path / "s.plan", polygons, circles)
    assert _plan(area, (-30, -30)) == 0
    given, written = parse_mission(area.read_text()).fences, _written(tmp_path)
    assert [(f.inclusion, f.radius_m) for f in written] == [(f.inclusion, f.radius_m) for f in given]
    for one, other in zip(given, written, strict=True):
        assert [c for p in other.points for c in p] == pytest.approx([c for p in one.points for c in p], abs=1e-8)
    assert (tmp_path / "p" / "v2.plan").read_text().count('"inclusion"') == 4


@pytest.mark.parametrize(
    ("fence", "start"),
    [
        ({"polygons": [_fence(_box(-20, -20, 620, 420), True)]}, (-250, 0)),  # the start
        ({"polygons": [_fence(_box(200, 100, 400, 300), True)]}, (300, 200)),  # most of the area
        ({"polygons": [], "circles": [_circle((300, 200), 200, True)]}, (300, 200)),
        ({"polygons": [_fence([(-50, -50), (-50, 450), (650, 450), (650, -50), (300, 380)], True)]}, (-30, 0)),
    ],
)
def test_a_flight_that_leaves_an_inclusion_fence_is_refused(
    tmp_path: Path, fence: dict[str, Any], start: tuple[float, float], capsys: pytest.CaptureFixture[str]
) -> None:
    area = _survey(tmp_path / "s.plan", fence["polygons"], fence.get("circles"))
    assert _plan(area, start) == 2
    assert "m outside the inclusion fence" in capsys.readouterr().err
    assert not (tmp_path / "p").exists()


def test_ardupilot_must_stay_inside_all_fences_and_px4_inside_any(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    halves = [_fence(_box(-50, -50, 350, 450), True), _fence(_box(250, -50, 650, 450), True)]
    area = _survey(tmp_path / "s.plan", halves)
    assert _plan(area, (0, -20)) == 2
    assert "outside the inclusion fence" in capsys.readouterr().err
    assert _plan(area, (0, -20), "--autopilot", "px4") == 0


def test_no_fly_zones_become_fences_where_paths_keep_away_from_them(tmp_path: Path) -> None:
    zone = [[lon, lat] for lat, lon in _degrees(_box(200, 150, 260, 200))]
    drawn = tmp_path / "zone.geojson"
    drawn.write_text(json.dumps({"type": "Polygon", "coordinates": [[*zone, zone[0]]]}))
    area = _survey(tmp_path / "s.plan", [_fence(_box(400, 100, 480, 160), False)])
    assert _plan(area, (-30, -30), "--no-fly", drawn) == 0
    assert len(_written(tmp_path)) == 1
    assert _plan(area, (-30, -30), "--no-fly", drawn, "--clearance", 10) == 0
    own, further = _written(tmp_path)
    assert not own.inclusion and not further.inclusion
    np.testing.assert_allclose(sorted(further.points), sorted((lat, lon) for lon, lat in zone), atol=1e-7)
