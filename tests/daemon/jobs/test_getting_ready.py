"""A daemon whose installation has no compiled kernels serves while they are compiled, and loses nothing by it."""

import sys
import time

import pytest

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.jobs import worker_pool
from gcs_plugin.daemon.settings import Settings
from tests.kit.made_up import LIMIT_S, after_job, complete, post

_COMPILER = """
import pathlib, sys, time
print("compiling the kernels: 3 of 9", file=sys.stderr, flush=True)
while not pathlib.Path(sys.argv[1]).exists():
    time.sleep(0.05)
"""


@pytest.fixture
def compiled(tmp_path, monkeypatch):
    """The file at which the compiler ends."""
    monkeypatch.setattr(worker_pool, "MADE_FOR", tmp_path / "not there")
    monkeypatch.setattr(worker_pool, "_COMMAND", (sys.executable, "-c", _COMPILER, str(tmp_path / "compiled")))
    return tmp_path / "compiled"


def _problems(daemon, wanted: bool) -> list[str]:
    """What the page shows, once it says that it gets ready, or no longer."""
    end = time.monotonic() + LIMIT_S
    while True:
        problems = daemon.problems()
        if any("getting ready" in text for text in problems) == wanted:
            return problems
        assert time.monotonic() < end, problems
        time.sleep(0.05)


def test_what_completes_while_kernels_are_compiled_is_kept_and_refined(tmp_path, flight, compiled):
    frames, basemap = flight
    settings = Settings(workspace=tmp_path / "w", basemap=basemap, coarse=False)
    settings.workspace.mkdir()
    with Daemon(settings) as daemon:
        (text,) = _problems(daemon, True)
        assert "compiling the kernels: 3 of 9" in text and "pictures are kept" in text
        post(daemon, frames[:12])
        complete(daemon)
        compiled.touch()
        assert _problems(daemon, False) == []
        (refined,) = after_job(daemon, 1)
        assert (refined.state, refined.detail["frames"]) == ("done", 12)


def test_a_daemon_that_ends_ends_the_compiler(tmp_path, compiled):
    settings = Settings(workspace=tmp_path / "w")
    settings.workspace.mkdir()
    with Daemon(settings) as daemon:
        process = daemon.getting_ready._process
        assert process.poll() is None
    assert process.poll() is not None
