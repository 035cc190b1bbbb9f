"""A disk that is really full: one clear sentence, nothing half-written under a product's name, and on it goes after."""

import contextlib
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.kit.daemon_kit import exported, line, serving, start, stop

MB = 1 << 20


@pytest.fixture
def small_disk(tmp_path):
    """A function that mounts a file system of so many megabytes in memory; skips where that is not allowed."""
    mounts = []

    def mount(megabytes):
        place = tmp_path / f"disk{len(mounts)}"
        place.mkdir()
        if sys.platform != "linux" or os.geteuid() != 0:
            pytest.skip("mounting a small disk needs root on Linux")
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(place)])
        if done.returncode:
            pytest.skip("a small disk cannot be mounted here")
        mounts.append(place)
        return place

    yield mount
    for place in mounts:
        subprocess.run(["umount", str(place)], check=True)


def fill(disk, leave_bytes):
    """Take the space of a disk but for a rest."""
    ballast = disk / "ballast"
    with ballast.open("ab") as file:
        free = shutil.disk_usage(disk).free - leave_bytes
        for _ in range(max(0, free // MB)):
            file.write(bytes(MB))
    return ballast


def to_the_last_byte(disk):
    """Leave nothing."""
    ballast = fill(disk, MB)
    with contextlib.suppress(OSError), ballast.open("ab", buffering=0) as file:
        while file.write(bytes(4096)):
            pass
    return ballast


PRODUCTS = ("realtime.tif", "coarse.tif", "orthoimage.tif", "footprints.gpkg", "report.json", "report.html")


def whole(path: Path) -> bool:
    """Whether a product can be read to its end."""
    if path.suffix == ".tif":
        import rasterio

        with rasterio.open(path) as raster:
            for window in (w for _, w in raster.block_windows(1)):
                raster.read(window=window)
    elif path.suffix == ".json":
        import json

        json.loads(path.read_text())
    return path.stat().st_size > 0


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A small flight."""
    from tests.daemon.intake.test_picture_sources import tagged

    folder = tmp_path_factory.mktemp("photos") / "v1"
    folder.mkdir()
    for number, shot in enumerate(line(10)):
        (folder / f"DJI_{number:04d}.JPG").write_bytes(tagged(shot))
    return folder


def mosaic(photos, out):
    command = [sys.executable, "-m", "gcs_plugin.cli", "mosaic", str(photos), "--out", str(out), "--workers", "1"]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


def used(folder):
    return sum(f.stat().st_blocks * 512 for f in folder.rglob("*") if f.is_file())


@pytest.mark.slow
def test_a_mosaic_on_a_full_disk_says_so_and_goes_on_when_there_is_room(small_disk, photos):
    disk = small_disk(200)
    first = mosaic(photos, disk / "roomy")
    assert first.returncode == 0, first.stderr
    need = used(disk / "roomy")
    shutil.rmtree(disk / "roomy")
    for share in (0.02, 0.5, 0.9):
        ballast = fill(disk, int(share * need))
        done = mosaic(photos, disk / "out")
        text = done.stderr.strip().splitlines()
        if done.returncode == 0:
            ballast.unlink()
            continue  # it needs less than what it leaves
        assert done.returncode == 1, done.stderr
        assert "Traceback" not in done.stderr
        assert text[-1].startswith("orthoswarm: ") and ("disk" in text[-1] or "space" in text[-1]), text
        for name in PRODUCTS:
            path = disk / "out" / name
            assert not path.exists() or whole(path), name
        assert not [p for p in (disk / "out").rglob("*") if p.suffix == ".part"]
        ballast.unlink()
    last = mosaic(photos, disk / "out")
    assert last.returncode == 0, last.stderr
    for name in PRODUCTS:
        assert whole(disk / "out" / name)


@pytest.mark.slow
def test_a_daemon_on_a_full_disk_refuses_pictures_and_takes_them_when_there_is_room(small_disk):
    disk = small_disk(120)
    shots = line(12)
    with serving(disk / "w") as served:
        for shot in shots[:4]:
            assert served.send(shot).status_code == 201
        served.until("/api/frames", lambda rows: all(row["on_map"] for row in rows))
        ballast = fill(disk, 20 * MB)
        refused = served.send(shots[4])
        assert refused.status_code == 507
        assert "full" in refused.json()["detail"]
        assert len(refused.json()["detail"].split(". ")) == 1
        assert served.get("/healthz").status_code == 200
        assert len(served.get("/api/frames").json()) == 4
        to_the_last_byte(disk)  # jobs and commands are refused, too
        answer = served.command("/api/refine", {"vehicle": "v1"})
        assert answer.status_code in (202, 500, 507), answer.text
        time.sleep(2.0)
        assert served.get("/healthz").status_code == 200
        assert served.get("/api/vehicles").status_code == 200
        ballast.unlink()
        for shot in shots[4:]:
            assert served.send(shot).status_code == 201
        served.until("/api/frames", lambda rows: len(rows) == 12 and all(row["on_map"] for row in rows))
        assert served.command("/api/refine", {"vehicle": "v1"}).status_code == 202
        jobs = served.until("/api/jobs", exported)
        assert [r for r in jobs if r["kind"] == "refine"][-1]["state"] == "done"
        assert [r for r in jobs if r["kind"] == "export"][-1]["state"] == "done"
        assert whole(disk / "w" / "realtime.tif")
    assert not [p for p in (disk / "w").rglob("*") if p.suffix == ".part"]


@pytest.mark.slow
def test_a_folder_whose_daemon_has_no_room_is_read_when_there_is(small_disk, photos, tmp_path):
    disk, card = small_disk(110), tmp_path / "card"
    card.mkdir()
    with serving(disk / "w", "--source", f"v1={card}") as served:
        ballast = fill(disk, 10 * MB)
        for path in sorted(photos.iterdir())[:5]:
            shutil.copy2(path, card / path.name)
        time.sleep(3.0)
        assert served.get("/api/frames").json() == []
        ballast.unlink()
        rows = served.until("/api/frames", lambda rows: len(rows) == 5)
        assert {row["image"] for row in rows} == {path.name for path in sorted(photos.iterdir())[:5]}


@pytest.mark.slow
def test_a_daemon_does_not_begin_on_a_full_disk_without_a_word(small_disk):
    disk = small_disk(8)
    (disk / "w").mkdir()
    ballast = to_the_last_byte(disk)
    with pytest.raises(AssertionError) as told:
        stop(start(disk / "w"))
    assert "Traceback" not in str(told.value)
    assert "serve ended with 1" in str(told.value)
    assert "disk" in str(told.value) or "journal" in str(told.value)
    ballast.unlink()
    with serving(disk / "w") as served:
        assert served.get("/healthz").status_code == 200
