"""What a wheel carries is enough: an installation with the compiled kernels, even a read-only one, compiles nothing."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
COMPILED = Path("orthoswarm/compute/compiled")
# Says at the end of the process which kernels of the product were compiled in it.
_WATCH = """
import sys
from numba.core import event

class Compiled(event.Listener):
    def on_start(self, at):
        kernel = at.data["dispatcher"].py_func
        if kernel.__module__.startswith("orthoswarm."):
            print("COMPILED", kernel.__module__, kernel.__qualname__, at.data["args"])
    def on_end(self, at):
        pass

event.register("numba:compile", Compiled())
from gcs_plugin.cli.main import main
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The packages and the compiled kernels in another folder, as `pip install` puts them from a wheel."""
    subprocess.run([sys.executable, "-m", "orthoswarm.compute.compile_kernels"], cwd=ROOT, check=True)
    folder = tmp_path_factory.mktemp("installed")
    for package in ("orthoswarm", "telemetry", "gcs_plugin"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def _compiled(installed: Path, folder: Path, code: str) -> list[str]:
    """The kernels that a program compiled, in an environment without other caches."""
    env = os.environ | {"PYTHONPATH": str(installed), "NUMBA_CACHE_DIR": str(folder / "cache"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", _WATCH + code], cwd=folder, env=env, capture_output=True, text=True, errors="replace"
    )
    assert done.returncode == 0, done.stderr
    return [line for line in done.stdout.splitlines() if line.startswith("COMPILED")]


_ALL_OF_IT = """
import json, sys
from pathlib import Path
sys.path.insert(2, {root!r})  # behind the installation, before other packages named tests
from tests.kit.made_up_ground import draw_something, refine_something

if __name__ == "__main__":
    def call(*words):
        assert main([str(word) for word in words]) == 0, words
    def box(west, south, east, north):
        return [[west, south], [east, south], [east, north], [west, north], [west, south]]
    call("twin", "make", "tiny", "--out", "set")
    photos = sorted(Path("set/photos").rglob("*.JPG"))
    call("mosaic", "set/photos", "--basemap", "set/basemap.tif", "--out", "dense", "--workers", 1)
    call("mosaic", *photos[::3], "--basemap", "set/basemap.tif", "--out", "sparse", "--workers", 1)
    call("coverage", "dense", "--area", "set/plan.geojson", "--out", "coverage")
    call("export", "dense", "--to", "mbtiles")
    # Around holes, so many that cells between them are not ordered exactly.
    holes = [box(9.001 + 0.002 * k, 47.002, 9.002 + 0.002 * k, 47.004) for k in range(4)]
    polygon = {"type": "Polygon", "coordinates": [box(9.0, 47.0, 9.01, 47.006), *holes]}
    Path("area.geojson").write_text(json.dumps(polygon))
    for method in ("columns", "bcd", "tmstc"):
        call("plan", "area.geojson", "--vehicles", 3, "--altitude", 60, "--fov-min", 60, "--start", "46.999,9.0",
             "--endurance", 12, "--method", method, "--out", method)
    draw_something(Path("."))
    refine_something()
    assert not {"torch", "kornia"} & set(sys.modules), "only learned matchers need networks"
""".replace("{root!r}", repr(str(ROOT)))


@pytest.mark.slow
def test_nothing_is_compiled_in_an_installation_that_carries_the_kernels(installed, tmp_path):
    compiled = _compiled(installed, tmp_path, _ALL_OF_IT)
    assert compiled == [], "add these to orthoswarm/compute/signatures.txt:\n" + "\n".join(compiled)


_ONE = """
import numpy as np
from orthoswarm.canvas import overviews
out = overviews.reduce_rgba(np.full((8, 8, 4), 255, np.uint8), 2)
print("SUM", out.sum())
"""


def test_a_kernel_that_changed_is_compiled_again_and_the_others_are_not(installed, tmp_path):
    copy = shutil.copytree(installed, tmp_path / "changed")
    assert _compiled(copy, tmp_path, _ONE) == []
    source = copy / "orthoswarm/canvas/overviews.py"
    source.write_text(source.read_text() + "\n# changed\n")
    assert len(_compiled(copy, tmp_path, _ONE)) >= 1
    assert _compiled(copy, tmp_path, _ONE) == []  # from NUMBA_CACHE_DIR


def test_what_the_package_lacks_is_compiled_into_it_although_it_was_compiled_when_it_was_called(installed, tmp_path):
    copy = shutil.copytree(installed, tmp_path / "lacking")
    shutil.rmtree(copy / COMPILED / "canvas")
    assert len(_compiled(copy, tmp_path, _ONE)) >= 1
    env = os.environ | {"PYTHONPATH": str(copy), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    subprocess.run([sys.executable, "-m", "orthoswarm.compute.compile_kernels"], cwd=copy, env=env, check=True)
    assert any((copy / COMPILED / "canvas").rglob("*.nbc"))


def test_a_read_only_installation_uses_its_kernels(installed, tmp_path):
    copy = shutil.copytree(installed, tmp_path / "read_only")
    folders = [copy, *(folder for folder in copy.rglob("*") if folder.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    try:
        assert _compiled(copy, tmp_path, _ONE) == []
    finally:
        for folder in folders:
            folder.chmod(0o755)


def test_a_wheel_says_for_what_its_kernels_are(installed):
    made_for = json.loads((installed / COMPILED / "made_for.json").read_text())
    assert made_for["python"] == list(sys.version_info[:2])
    assert any((installed / COMPILED).rglob("*.nbc"))
