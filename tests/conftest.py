"""Where tests find real data: ORTHOSWARM_TEST_DATA, else ../shared/data beside the checkout."""

import json
import os
import re
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from orthoswarm.compute.workers import prepare_process

prepare_process()  # before numpy comes: sums depend on the number of BLAS threads, and so would results

# Tests start hundreds of interpreters: where an environment keeps no bytecode, each would compile the packages anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Machines differ and are shared: a slow example is not a failure. A gate tries the same examples each time.
settings.register_profile("unhurried", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("unhurried")

ROOT = Path(__file__).resolve().parent.parent
ROOMS_IN_REAL_TIME = {"vehicles", "daemon", "page", "cli"}
ROOMS_WITH_PROCESSES = {"daemon", "page"}  # browsers and daemons work beside the tests, which mostly wait for them
IN_REAL_TIME = re.compile(r"\b(SimSwarm|serving|standing|subprocess|socket|threading|time\.sleep)\b")
"""What files name that wait for vehicles, servers or browsers: they run one after the other (see the Makefile)."""


@cache
def waits(file: str) -> bool:
    """True for a file of tests, by its path from the root, that run in real time; others compute."""
    if file.split("/")[1] not in ROOMS_IN_REAL_TIME:
        return False
    return bool(IN_REAL_TIME.search((ROOT / file).read_text(encoding="utf-8")))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Which tests stay in one process where there are several: files that share what they made, and real time.

    By place: marks of groups reach xdist 3.8 under pytest 9 no longer.
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByPlace(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.split("::")[0]
            if not waits(file):
                return file
            room = file.split("/")[1]
            return room if room in ROOMS_WITH_PROCESSES else "vehicles"

    return ByPlace(config, log) if config.getvalue("dist") == "loadgroup" else None


def data_root() -> Path:
    return Path(os.environ.get("ORTHOSWARM_TEST_DATA", ROOT.parent / "shared" / "data"))


@pytest.fixture(scope="session")
def real_data():
    """A function from a folder name of the real data to its path; skips the test where it is absent."""

    def find(name: str) -> Path:
        path = data_root() / name
        if not path.exists():
            pytest.skip(f"real data '{name}' is not at {path.parent}; set ORTHOSWARM_TEST_DATA")
        return path

    return find


@pytest.fixture(scope="session")
def golden_poses():
    path = Path(__file__).parent / "data" / "golden_poses.json"
    return json.loads(path.read_text())["poses"]
