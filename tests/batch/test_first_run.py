"""The first run on a machine, which compiles the kernels, gives the same map as the next, which loads them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from llvmlite.binding import get_host_cpu_name

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_first_run_gives_the_map_of_the_next(tmp_path):
    env = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "OMP_NUM_THREADS": "1"}
    env["NUMBA_CPU_NAME"] = get_host_cpu_name()  # not the one that the package has kernels for

    def orthoswarm(*arguments):
        command = [sys.executable, "-m", "gcs_plugin.cli.main", *map(str, arguments)]
        done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

    orthoswarm("twin", "make", "tiny", "--out", "set")
    found = []
    for name in ("first", "next"):
        orthoswarm("mosaic", "set/photos", "--basemap", "set/basemap.tif", "--out", name, "--workers", 1)
        found.append([(tmp_path / name / file).read_bytes() for file in ("frames.jsonl", "orthoimage.tif")])
        assert any((tmp_path / "cache").rglob("*.nbc"))
    assert found[0] == found[1]
