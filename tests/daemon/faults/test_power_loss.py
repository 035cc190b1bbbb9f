"""The machine loses power at a random moment: what was acknowledged is there at the next start, and nothing runs twice.

Twice over: on any machine a copy of the workspace in which whatever was never synced is cut short or gone; and, where a
disk of our own may be mounted, the disk's image as it was at that moment, so that the file system's own promises count.
"""

import contextlib
import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from gcs_plugin.daemon.web_plans import Plans
from gcs_plugin.web.guard import take_token
from orthoswarm.model.errors import InputError
from tests.daemon.faults.test_daemon_crash import check, post_until_gone
from tests.daemon.on_links import OnLinks
from tests.kit.daemon_kit import exported, line, serving, start, stop, tile_over
from tests.kit.vehicles.sim_cameras import square

# Loaded by every interpreter of the daemon: notes what was synced, and how long it was then.
SPY = """
import os
_log = os.environ.get("SYNC_LOG")
if _log:
    _fsync, _replace = os.fsync, os.replace
    def note(*words):
        with open(_log, "a") as file:
            file.write("\\t".join(words) + "\\n")
    def fsync(fd):
        _fsync(fd)
        path = os.readlink(f"/proc/self/fd/{fd if isinstance(fd, int) else fd.fileno()}")
        note("sync", path, str(os.path.getsize(path) if os.path.isfile(path) else 0))
    def replace(a, b, **more):
        _replace(a, b, **more)
        note("move", os.path.realpath(a), os.path.realpath(b))
    os.fsync, os.replace = fsync, replace
"""


@contextlib.contextmanager
def halted(served):
    """The daemon and its workers stand still, in the middle of whatever they were doing."""
    pids = [served.process.pid, *children(served.process.pid)]
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
    try:
        while not all(map(stands_still, pids)):  # what is writing stops only when its system call is done
            time.sleep(0.01)
        yield
    finally:
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


def stands_still(pid):
    """Whether every thread of a process is stopped, or it is gone."""
    with contextlib.suppress(OSError):
        stats = [(task / "stat").read_text() for task in Path(f"/proc/{pid}/task").iterdir()]
        return all(stat.rpartition(")")[2].split()[0] in "TtZX" for stat in stats)
    return not Path(f"/proc/{pid}").exists()


def children(pid):
    found = []
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in map(int, (task / "children").read_text().split()):
                found += [child, *children(child)]
    return found


def synced_sizes(log: Path) -> dict[str, int]:
    """How much of each file had been synced, by the name that it has now."""
    sizes: dict[str, int] = {}
    for text in log.read_text().splitlines() if log.exists() else []:
        kind, path, last = text.split("\t")
        if kind == "sync":
            sizes[path] = int(last)
        elif path in sizes:
            sizes[last] = sizes.pop(path)
    return sizes


def copy_as_a_dead_disk_holds_it(workspace, copy, synced, chance):
    """Copy; files (but SQLite's, which syncs by itself) keep what was synced, and of the rest a random part."""
    lost = 0
    for path in sorted(workspace.rglob("*")):
        target = copy / path.relative_to(workspace)
        if path.is_dir():
            target.mkdir(parents=True, exist_ok=True)
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
        kept = synced.get(os.path.realpath(path), 0)
        size = target.stat().st_size
        if path.name.startswith("journal.db") or kept >= size:
            continue
        lost += 1
        if kept == 0 and chance.random() < 0.3:
            target.unlink()
        else:
            os.truncate(target, chance.randint(kept, size))
            if chance.random() < 0.5:
                os.truncate(target, size)  # the length was written, the content was not
    wal = copy / "journal.db-wal"
    if wal.exists():  # a torn write behind what was synced
        with wal.open("ab") as file:
            file.write(chance.randbytes(chance.randint(1, 5000)))
    return lost


def after_a_power_cut(workspace):
    """What another start of the machine looks like to the daemon."""
    with contextlib.closing(sqlite3.connect(workspace / "journal.db")) as db, db:
        db.execute("UPDATE meta SET value = '\"an earlier start\"' WHERE key = 'boot'")


def goes_on(workspace, acknowledged, asked, shots):
    """A daemon on the copy has everything that was acknowledged, and does every job once."""
    after_a_power_cut(workspace)
    with serving(workspace) as served:
        check(served, workspace, acknowledged)
        jobs = served.until("/api/jobs", lambda jobs: all(job["state"] in ("done", "failed") for job in jobs))
        refined = [job for job in jobs if job["kind"] == "refine"]
        assert len(refined) == asked, jobs
        assert all(job["state"] == "done" for job in refined), jobs
        ids = [job["id"] for job in jobs]
        assert len(set(ids)) == len(ids)
        lock = threading.Lock()
        known = dict(acknowledged)
        post_until_gone(served, shots, known, lock)
        assert len(known) == len(shots)
        served.until("/api/frames", lambda rows: len(rows) == len(shots) and all(row["on_map"] for row in rows))
        layers = {row["name"]: row for row in served.get("/api/layers").json()}
        assert not layers["realtime"]["empty"]
        if asked:
            (plan,) = served.get("/api/plans").json()
            folder = workspace / "plans" / plan["id"]
            assert (folder / "v1.waypoints").read_text().count("\n") > 5
            assert "mission" in json.loads((folder / "v1.plan").read_text())
            assert not layers["coarse"]["empty"]  # drawn again by a job, if it had been drawn before
            jobs = served.until("/api/jobs", exported)
            assert [job["state"] for job in jobs if job["kind"] == "export"][-1] == "done", jobs
        assert served.get("/healthz").json()["problems"] == []


def fly_until(served, shots, acknowledged, *, lock, chance, refine):
    """Post for a random while; gives how many refinements were acknowledged, and the thread that goes on posting."""
    asked = 0
    if refine:
        body = {"area": square(150), "vehicles": 1, "altitude_m": 60, "fov_min_deg": 65}
        assert served.command("/api/plans", body).status_code == 201
        first = [shot for shot in shots if shot.pose["vehicle"] == "v1"]
        post_until_gone(served, first, acknowledged, lock)
        answer = served.command("/api/refine", {"vehicle": "v1"})
        assert answer.status_code == 202, answer.text
        asked = 1
    else:
        post_until_gone(served, shots[:6], acknowledged, lock)
        served.until("/api/frames", lambda rows: any(row["on_map"] for row in rows))  # something that is never synced
    poster = threading.Thread(target=post_until_gone, args=(served, shots, acknowledged, lock))
    poster.start()
    time.sleep(chance.uniform(0.0, 6.0 if refine else 1.5))
    return asked, poster


def make_shots(count):
    return [shot for n, vehicle in enumerate(("v1", "v2")) for shot in line(count, vehicle, east=50.0 * n)]


def cut_on_a_copy(tmp_path, monkeypatch, seed, refine, count=12):
    chance = random.Random(seed)
    (tmp_path / "spy").mkdir()
    (tmp_path / "spy" / "sitecustomize.py").write_text(SPY)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "spy"), os.getcwd()]))
    monkeypatch.setenv("SYNC_LOG", str(tmp_path / "synced"))
    workspace, shots = tmp_path / "w", make_shots(count)
    acknowledged: dict = {}
    lock = threading.Lock()
    served = start(workspace)
    try:
        asked, poster = fly_until(served, shots, acknowledged, lock=lock, chance=chance, refine=refine)
        with lock, halted(served):
            known = dict(acknowledged)
            copy = tmp_path / "dead"
            lost = copy_as_a_dead_disk_holds_it(workspace, copy, synced_sizes(tmp_path / "synced"), chance)
        poster.join()
    finally:
        stop(served)
    assert lost > 0  # something was not synced, or this would test nothing
    monkeypatch.delenv("SYNC_LOG")
    goes_on(copy, known, asked, shots)
    return len(known), lost


@pytest.mark.slow
@pytest.mark.parametrize("damaged", [False, True])
def test_a_refined_layer_is_drawn_again_after_a_power_cut_or_when_its_canvas_is_damaged(tmp_path, damaged):
    workspace, shots = tmp_path / "w", line(6)
    z, x, y = tile_over(shots[2].camera)
    tile = f"/tiles/coarse/{z}/{x}/{y}.png"
    with serving(workspace) as served:
        post_until_gone(served, shots, {}, threading.Lock())
        assert served.command("/api/refine", {"vehicle": "v1"}).status_code == 202
        served.until("/api/jobs", refined_and_exported)
        before = served.get(tile).content
    if damaged:
        for canvas in (workspace / "layers").glob("coarse-*/canvas.json"):
            canvas.write_bytes(canvas.read_bytes()[:20])
    else:
        after_a_power_cut(workspace)
        with contextlib.closing(sqlite3.connect(workspace / "journal.db")) as db, db:
            db.execute("UPDATE meta SET value = 'false' WHERE key = 'clean'")
    with serving(workspace) as served:
        jobs = served.until("/api/jobs", lambda rows: any(r["kind"] == "redraw" and r["state"] == "done" for r in rows))
        assert [r["kind"] for r in jobs].count("refine") == 1
        assert served.get(tile).content == before
    with serving(workspace) as served:
        assert [r["kind"] for r in served.get("/api/jobs").json()].count("redraw") == 1  # once is enough
        assert served.get(tile).content == before


def refined_and_exported(rows):
    kinds = {row["kind"] for row in rows}
    return {"refine", "export"} <= kinds and all(row["state"] == "done" for row in rows)


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="watches what is synced through /proc")
def test_a_power_cut_loses_no_acknowledged_picture(tmp_path, monkeypatch):
    print(cut_on_a_copy(tmp_path, monkeypatch, seed=int(time.time()), refine=False))


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="watches what is synced through /proc")
@pytest.mark.parametrize("seed", range(6))
def test_a_power_cut_during_a_refinement_neither_forgets_nor_repeats_it(tmp_path, monkeypatch, seed):
    print(cut_on_a_copy(tmp_path, monkeypatch, seed=seed, refine=True))


# -- a disk of our own ----------------------------------------------------------------------------------------------


@pytest.fixture
def disk(tmp_path):
    """A small ext4 file system in an image file, mounted; skips where that is not allowed."""
    image, mount = tmp_path / "disk.img", tmp_path / "disk"
    if sys.platform != "linux" or os.geteuid() != 0 or shutil.which("mkfs.ext4") is None:
        pytest.skip("mounting a disk image needs root on Linux")
    mount.mkdir()
    with image.open("wb") as file:
        file.truncate(400 << 20)
    made = subprocess.run(["mkfs.ext4", "-q", "-F", str(image)], capture_output=True, text=True)
    if made.returncode or not mounted(image, mount):
        pytest.skip("a disk image cannot be mounted here")
    yield image, mount
    subprocess.run(["umount", str(mount)], check=True)


def mounted(image, mount):
    done = subprocess.run(["mount", "-o", "loop", str(image), str(mount)], capture_output=True, text=True)
    return done.returncode == 0


def written(mount):
    """How many writes the disk under a mount has seen."""
    device = next(text.split()[0] for text in Path("/proc/mounts").read_text().splitlines() if f" {mount} " in text)
    return Path(f"/sys/block/{Path(device).name}/stat").read_text().split()[4]


def cut_on_a_disk(disk, tmp_path, seed, refine, count=12):
    image, mount = disk
    chance = random.Random(seed)
    workspace, shots = mount / "w", make_shots(count)
    acknowledged: dict = {}
    lock = threading.Lock()
    served = start(workspace)
    dead = tmp_path / "dead.img"
    try:
        asked, poster = fly_until(served, shots, acknowledged, lock=lock, chance=chance, refine=refine)
        with lock, halted(served):
            known = dict(acknowledged)
            for _ in range(20):  # until the kernel wrote nothing meanwhile: a picture of one moment
                before = written(mount)
                subprocess.run(["cp", "--sparse=always", str(image), str(dead)], check=True)
                if written(mount) == before:
                    break
            else:
                pytest.skip("the disk never stands still")
        poster.join()
    finally:
        stop(served)
    again = tmp_path / "again"
    again.mkdir()
    assert mounted(dead, again)
    try:
        goes_on(again / "w", known, asked, shots)
    finally:
        subprocess.run(["umount", str(again)], check=True)
    return len(known)


@pytest.mark.slow
def test_a_disk_that_lost_power_holds_what_was_acknowledged(disk, tmp_path):
    print(cut_on_a_disk(disk, tmp_path, seed=int(time.time()), refine=False))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_disk_that_lost_power_during_a_refinement_holds_it_once(disk, tmp_path, seed):
    print(cut_on_a_disk(disk, tmp_path, seed=seed, refine=True))


# -- parts --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("left", [b"", b"\0" * 33, b"\n"])
def test_a_token_that_a_power_cut_has_emptied_is_made_anew(left, tmp_path):
    path = tmp_path / "token"
    path.write_bytes(left)
    token = take_token(path)
    assert len(token) > 20
    assert take_token(path) == token
    assert path.stat().st_mode & 0o077 == 0
    path.write_text("short")  # somebody's own, and too easy to guess
    with pytest.raises(InputError):
        take_token(path)


def test_a_plan_that_was_not_written_to_its_end_is_not_offered(tmp_path):
    for name, text in (("plan-1", '{"covered_share": 1.0}'), ("plan-2", '{"covered'), ("plan-3", "")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "plan.json").write_text(text)
    assert [plan["id"] for plan in Plans(tmp_path, None, OnLinks()).all()] == ["plan-1"]
