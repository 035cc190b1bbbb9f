"""A workspace whose refined map was made by another version of the program is refined again from its pictures."""

import logging

import pytest

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.jobs.solution_file import read_solution
from gcs_plugin.daemon.settings import Settings
from tests.kit.made_up import after_job, complete, post
from tests.kit.made_up_ground import made_up_flight, made_up_ground, write_map


@pytest.fixture
def workspace(tmp_path):
    """Settings of a workspace, and the frames of a flight over its map."""
    ground = made_up_ground()
    write_map(ground, tmp_path / "map.tif")
    settings = Settings(workspace=tmp_path / "w", basemap=tmp_path / "map.tif", coarse=False)
    settings.workspace.mkdir()
    return settings, made_up_flight(ground, tmp_path, "v1")[:16]


@pytest.mark.slow
def test_solutions_of_another_version_are_made_again(workspace, caplog):
    settings, frames = workspace
    with Daemon(settings) as daemon:
        post(daemon, frames)
        assert daemon.drawer.wait_drawn("v1", 1, 240.0)
        complete(daemon)
        (first,) = after_job(daemon, 1)
        assert first.state == "done", first.message
        (row,) = daemon.journal.rows("SELECT path FROM solutions")
    file = settings.workspace / "solutions" / row["path"]
    file.write_bytes(b"OrthoSwarm solution 1 of long ago\n" + file.read_bytes())
    with caplog.at_level(logging.WARNING), Daemon(settings) as daemon:
        _, again = after_job(daemon, 2)
        assert again.state == "done", again.message
        assert {frame["stage"] for frame in daemon.views.frames()} == {"fine"}
        (row,) = daemon.journal.rows("SELECT path FROM solutions")
        made = read_solution(settings.workspace / "solutions" / row["path"])
        assert len(made.solution.placed) == len(frames)
        assert daemon.layers["fine"].version > 0
        assert not file.exists()
    assert "1 sorties are refined again" in caplog.text
