"""What is handed to users: the wheel and the source package, installed and run, and the files of others in them."""

import base64
import hashlib
import http.client
import io
import os
import re
import subprocess
import sys
import tarfile
import urllib.request
import venv
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

from orthoswarm import __version__

ROOT = Path(__file__).parents[2]
VENDOR = ROOT / "gcs_plugin/web/static/vendor"
RECORDED = (VENDOR / "README.md").read_text(encoding="utf-8")
FILES = dict(reversed(line.split()) for line in re.findall(r"^- sha256 (.*)$", RECORDED, re.MULTILINE))


def test_the_map_library_has_its_licence_and_is_what_was_recorded():
    assert set(FILES) == {path.name for path in VENDOR.iterdir()} - {"README.md"}
    for name, digest in FILES.items():
        assert hashlib.sha256((VENDOR / name).read_bytes()).hexdigest() == digest
    assert "Redistribution and use in source and binary forms" in (VENDOR / "maplibre-gl-LICENSE.txt").read_text()


@pytest.mark.slow
def test_the_map_library_is_what_its_registry_serves():
    address = re.search(r"https://\S+\.tgz", RECORDED).group()
    try:
        with urllib.request.urlopen(address, timeout=60) as answer:
            package = answer.read()
    except (OSError, http.client.HTTPException) as error:
        pytest.skip(f"{address} cannot be read: {error}")
    digest = base64.b64encode(hashlib.sha512(package).digest()).decode()
    assert f"sha512-{digest}" in RECORDED
    with tarfile.open(fileobj=io.BytesIO(package)) as served:
        for name in FILES:
            inside = "package/LICENSE.txt" if name.endswith(".txt") else f"package/dist/{name}"
            lines = served.extractfile(inside).read().splitlines(keepends=True)
            assert b"".join(line for line in lines if b"sourceMappingURL" not in line) == (VENDOR / name).read_bytes()


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """Wheel and source package of the checkout, as `make wheel` builds them."""
    if find_spec("build") is None or find_spec("hatchling") is None:
        pytest.skip("needs build and hatchling: make test")
    subprocess.run([sys.executable, "-m", "orthoswarm.compute.compile_kernels"], cwd=ROOT, check=True)
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--sdist", "--wheel", "--outdir", folder, ROOT]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,), (source,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return {"wheel": wheel, "source": source}


@pytest.mark.slow
def test_packages_hold_the_program_its_licence_and_its_commit_and_nothing_else(packages):
    with zipfile.ZipFile(packages["wheel"]) as wheel, tarfile.open(packages["source"]) as source:
        names, sources = wheel.namelist(), source.getnames()
        commit = wheel.read("orthoswarm/commit.txt").decode().strip()
        metadata = wheel.read(next(n for n in names if n.endswith(".dist-info/METADATA"))).decode()
    assert re.fullmatch(r"[0-9a-f]{7,}(-dirty)?", commit)
    assert f"\nVersion: {__version__}\n" in metadata and "Requires-Dist: torch>=" in metadata
    assert any(name.startswith("orthoswarm/compute/compiled/") for name in names)
    assert "gcs_plugin/web/static/vendor/maplibre-gl-LICENSE.txt" in names
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"orthoswarm", "telemetry", "gcs_plugin"}
    assert any(name.endswith("/orthoswarm/commit.txt") for name in sources)
    assert any(name.endswith("/LICENSE") for name in sources) and not any(name.endswith(".nbc") for name in sources)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wheel", "source"])
def test_a_package_installs_in_a_fresh_environment_and_runs(packages, kind, tmp_path):
    """The packages that it needs are those of this environment, which the lock pins. The wheel also maps: compiled."""
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    site = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], capture_output=True, text=True
    )
    needed = [path for path in sys.path if path.endswith("site-packages")]
    Path(site.stdout.strip(), "needed.pth").write_text("\n".join(needed))
    install = [python, "-m", "pip", "install", "-qq", "--no-deps", "--no-build-isolation", packages[kind]]
    subprocess.run([*install[:5], "--force-reinstall", *install[5:]], check=True)

    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    orthoswarm = python.with_name("orthoswarm")

    def run(*arguments: object) -> str:
        done = subprocess.run([orthoswarm, *map(str, arguments)], cwd=tmp_path, env=env, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert re.fullmatch(rf"orthoswarm {re.escape(__version__)} \([0-9a-f]{{7,}}(-dirty)?\)\n", run("--version"))
    if kind == "wheel":
        run("twin", "make", "tiny", "--out", "set")
        run("mosaic", "set/photos", "--basemap", "set/basemap.tif", "--out", "out")
        assert (tmp_path / "out/orthoimage.tif").exists()
