"""`orthoswarm plan --wait`: vehicles stay at the end of their last line, no longer than their endurance allows."""

import json
from pathlib import Path
from typing import Any

import pytest

from gcs_plugin.cli.main import main
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.mission_builder import read_mission
from gcs_plugin.mission.mission_files import NAV_LOITER_TIME, NAV_RTL, parse_mission
from gcs_plugin.mission.track import flight_seconds
from tests.kit.flown_area import CORNER, FlownArea


def _planned(tmp_path: Path, capsys: pytest.CaptureFixture[str], *more: object) -> dict[str, Any]:
    flown = FlownArea()
    start = ",".join(f"{v:.7f}" for v in flown.grid.to_geographic(CORNER - 100.0))
    given = ["plan", flown.area(tmp_path / "a.geojson"), "--vehicles", 2, "--altitude", 80, "--fov-min", 60]
    given += ["--out", tmp_path / "p", "--start", start, "--json", *more]
    assert main([*map(str, given)]) == 0
    out: dict[str, Any] = json.loads(capsys.readouterr().out)
    return out


def test_the_wait_is_in_the_mission_before_the_way_home_and_in_its_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = _planned(tmp_path, capsys)
    waiting = _planned(tmp_path, capsys, "--wait", 4)
    for before, row in zip(plain["vehicles"], waiting["vehicles"], strict=True):
        assert row["flights"][0]["wait_s"] == 240.0
        assert row["flight_s"] == pytest.approx(before["flight_s"] + 240.0, abs=20.0)  # other ways home may be taken
        items = parse_mission((tmp_path / "p" / f"{row['id']}.plan").read_text()).items
        commands = [i.command for i in items]
        wait = items[commands.index(NAV_LOITER_TIME)]
        assert wait.params[0] == 240.0 and commands[-1] == NAV_RTL
        assert 206 not in commands[commands.index(NAV_LOITER_TIME) :]  # no picture after it
        # What is checked for separation before the start stays there as long.
        mission = read_mission(tmp_path / "p" / f"{row['id']}.waypoints", Autopilot.ARDUPILOT)
        assert flight_seconds(mission) == pytest.approx(row["flight_s"], abs=25.0)


def test_no_vehicle_waits_longer_than_its_endurance_allows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = _planned(tmp_path, capsys)
    longest = max(row["flight_s"] for row in plain["vehicles"])
    minutes = (longest + 90.0) / 60.0
    rows = _planned(tmp_path, capsys, "--wait", 10, "--endurance", minutes)["vehicles"]
    waits = [row["flights"][-1]["wait_s"] for row in rows]
    assert all(0.0 < wait < 600.0 for wait in waits)
    assert all(row["flights"][-1]["time_s"] <= 60.0 * minutes + 0.1 for row in rows)


def test_a_wait_that_means_nothing_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = FlownArea()
    given = ["plan", flown.area(tmp_path / "a.geojson"), "--vehicles", 1, "--altitude", 80, "--fov-min", 60]
    given += ["--out", tmp_path / "p", "--end", "hover", "--wait", 5]
    assert main([*map(str, given)]) == 2
    assert "hovers" in capsys.readouterr().err
