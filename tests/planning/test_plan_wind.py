"""Plans in wind: footprints that are turned against the leg, leg times, endurance, and wind that is too strong."""

import json
from pathlib import Path

import numpy as np
import pytest

from gcs_plugin.cli.main import main
from orthoswarm.planning.lines.line_spacing import footprint
from orthoswarm.planning.sorties.flight_time import Motion
from tests.kit.flown_area import FlownArea


@pytest.mark.parametrize("crab_deg", [0.0, 8.0, 30.0, 53.0])
@pytest.mark.parametrize("forward", [0.5, 0.8])
def test_turned_pictures_leave_nothing_out_of_the_strip_that_is_counted_on(crab_deg: float, forward: float) -> None:
    rng = np.random.default_rng(3)
    foot = footprint(80.0, np.radians(60.0), forward=forward).turned(np.radians(crab_deg))
    straight = footprint(80.0, np.radians(60.0), forward=forward)
    length = 400.0
    begin, end = -foot.reach_m + foot.overshoot_m, length + foot.reach_m - foot.overshoot_m
    points = np.stack([rng.uniform(-0.5, 0.5, 20_000) * foot.width_m, rng.uniform(begin, end, 20_000)], 1)
    for turn in (crab_deg, -crab_deg):
        seen = np.zeros(len(points), bool)
        for along in np.arange(0.0, length + 1e-9, foot.trigger_m):
            c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
            away = points - [0.0, along]
            x, y = away[:, 0] * c - away[:, 1] * s, away[:, 0] * s + away[:, 1] * c
            seen |= (np.abs(x) <= 0.5 * straight.width_m + 1e-6) & (np.abs(y) <= 0.5 * straight.height_m + 1e-6)
        assert seen.all()
    assert foot.width_m <= straight.width_m and (crab_deg or foot == straight)


def test_ground_speed_is_the_air_speed_turned_into_the_wind() -> None:
    motion = Motion(15.0, wind_m_s=(0.0, -9.0))  # from the north
    courses = np.array([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0]])
    assert motion.ground_speed(courses) == pytest.approx([6.0, 24.0, 12.0])
    assert np.degrees(motion.crab_rad) == pytest.approx(36.87, abs=0.01)
    both = 2.0 / (1.0 / 6.0 + 1.0 / 24.0)
    assert motion.even_speed_m_s == pytest.approx(both)


def _plan(tmp_path: Path, capsys: pytest.CaptureFixture[str], *more: str) -> dict:
    area = FlownArea().area(tmp_path / "a.geojson")
    given = ["--vehicles", "2", "--altitude", "80", "--fov-min", "60", "--out", str(tmp_path / "p"), "--json"]
    assert main(["plan", str(area), *given, *more]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_plan_in_wind_covers_takes_longer_and_keeps_the_endurance(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    still = _plan(tmp_path, capsys, "--speed", "15", "--endurance", "6")
    windy = _plan(tmp_path, capsys, "--speed", "15", "--endurance", "6", "--wind-m-s", "10", "--wind-from", "40")
    assert windy["covered_share"] > 0.999
    assert sum(v["flight_s"] for v in windy["vehicles"]) > 1.1 * sum(v["flight_s"] for v in still["vehicles"])
    assert max(f["time_s"] for v in windy["vehicles"] for f in v["flights"]) <= 360.0


def test_wind_that_leaves_no_speed_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    area = FlownArea().area(tmp_path / "a.geojson")
    given = ["--vehicles", "2", "--altitude", "80", "--fov-min", "60", "--out", str(tmp_path / "p")]
    assert main(["plan", str(area), *given, "--wind-m-s", "12", "--wind-from", "0"]) == 2
    assert "too much for 10 m/s" in capsys.readouterr().err
