"""What is refined is soon in the products, they are written no oftener than needed, and can be waited for."""

import sqlite3
import threading

import pytest

from gcs_plugin.cli.main import main
from gcs_plugin.daemon.jobs.job_queue import Jobs
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.store.daemon_events import Events, JobEnded
from gcs_plugin.daemon.store.journal import Journal, wrote_refined
from tests.kit.daemon_kit import exported, line, serving

LIMIT_S = 240.0


def test_what_a_refinement_has_changed_is_written_before_other_work_and_after_refinements_that_wait(tmp_path):
    journal, order, over = Journal(tmp_path / "journal.db"), [], threading.Event()

    def handler(run):
        job = run.job
        order.append((job.kind, job.vehicle, job.detail.get("after")))
        return lambda db: None

    events, kinds = Events(), ("refine", "together", "coarse", "tones", "export")
    jobs = Jobs(journal, events, dict.fromkeys(kinds, handler), WorkerPool(1), WorkerPool(1))
    events.on(JobEnded, lambda event: over.set() if not jobs.open() else None)
    jobs.add("export", formats=["kmz"])
    for kind, vehicle in (("coarse", "v1"), ("together", "v1"), ("tones", None)):
        jobs.add(kind, vehicle, **({"after": "refine"} if kind == "coarse" else {}))
    for _ in range(2):  # of two refinements: one is enough
        jobs.add("export", formats=["cog"], after="refine")
    jobs.add("refine", "v2", 1)
    jobs.start()
    assert over.wait(LIMIT_S)
    jobs.close()
    journal.close()
    assert order == [
        ("refine", "v2", None), ("export", None, "refine"), ("export", None, None), ("coarse", "v1", "refine"),
        ("together", "v1", None), ("tones", None, None),
    ]  # fmt: skip


def test_a_refinement_is_written_at_once_and_not_again_where_nothing_has_changed(tmp_path, capsys):
    workspace = tmp_path / "w"
    with serving(workspace) as served:
        for shot in line(6):
            assert served.send(shot).status_code == 201
        served.until("/api/frames", lambda rows: all(row["on_map"] for row in rows))
        assert not wrote_refined(workspace)
        served.command("/api/refine", {"vehicle": "v1"})
        jobs = served.until("/api/jobs", exported)
        ortho = workspace / "orthoimage.tif"
        written = ortho.stat().st_mtime_ns
        assert wrote_refined(workspace)  # beside the daemon
        refined, tones = (next(job for job in jobs if job["kind"] == kind) for kind in ("refine", "tones"))
        first, last = (job for job in jobs if job["kind"] == "export")
        assert refined["ended"] <= first["started"] <= first["ended"] <= tones["started"] <= last["started"]
        assert first["detail"]["files"] == last["detail"]["files"] == {"cog": ortho.name, "gpkg": "footprints.gpkg"}
        assert "note" not in first["detail"] and "has everything" in last["detail"]["note"]
        number = served.command("/api/export", {"formats": ["cog"]}).json()["id"]  # who asks for it gets it
        served.until("/api/jobs", lambda jobs: any(job["id"] == number and job["state"] == "done" for job in jobs))
        assert ortho.stat().st_mtime_ns > written
    assert wrote_refined(workspace)
    assert main(["evaluate", str(ortho), "--reference", str(ortho), "--wait", "0"]) == 0
    assert f"waiting until {ortho} is there" in capsys.readouterr().err


@pytest.fixture
def workspace(tmp_path):
    """A daemon's workspace with an orthoimage, and a function that changes its jobs."""
    Journal(tmp_path / "journal.db").close()
    (tmp_path / "orthoimage.tif").write_bytes(b"a picture")

    def change(query):
        with sqlite3.connect(tmp_path / "journal.db") as db:
            db.execute(query)
        db.close()

    return tmp_path, change


def add(kind, state, started="NULL", ended="NULL"):
    return (
        "INSERT INTO jobs (kind, state, created, started, ended, detail)"
        f" VALUES ('{kind}', '{state}', 1.0, {started}, {ended}, '{{}}')"
    )


def test_the_products_hold_all_that_is_refined_only_if_written_after_it(workspace):
    folder, change = workspace
    assert not wrote_refined(folder)
    change(add("export", "done", 5.0, 6.0))
    assert not wrote_refined(folder)  # nothing was refined
    change(add("refine", "running", 7.0))
    assert not wrote_refined(folder)
    change("UPDATE jobs SET state = 'done', ended = 10.0 WHERE kind = 'refine'")
    assert not wrote_refined(folder)  # it was written before
    change(add("export", "running", 11.0))
    assert not wrote_refined(folder)
    change("UPDATE jobs SET state = 'done', ended = 12.0 WHERE state = 'running'")
    assert wrote_refined(folder)
    change(add("refine", "queued"))
    assert not wrote_refined(folder)


def test_waiting_for_an_orthoimage_ends_with_one_sentence(workspace, tmp_path, capsys):
    folder, _ = workspace
    reference = folder / "orthoimage.tif"

    def told(code, *arguments):
        assert main(["evaluate", *map(str, arguments)]) == code
        return capsys.readouterr().err

    said = told(1, folder, "--reference", reference, "--wait", "0")
    assert "waited 0 s until" in said and "waiting until" in said
    assert "absent.tif does not exist" in told(2, folder, "--reference", tmp_path / "absent.tif", "--wait")
    assert "absent does not exist" in told(2, tmp_path / "absent", "--reference", reference, "--wait")
    assert "0 or more seconds" in told(2, folder, "--reference", reference, "--wait", "nan")
    assert "'soon'" in told(2, folder, "--reference", reference, "--wait", "soon")


def test_an_orthoimage_without_a_daemon_is_waited_for_until_it_is_there(tmp_path, capsys):
    (tmp_path / "map.tif").write_bytes(b"no picture")
    ortho = tmp_path / "orthoimage.tif"
    writer = threading.Timer(0.1, ortho.write_bytes, (b"no picture",))
    writer.start()
    assert main(["evaluate", str(tmp_path), "--reference", str(tmp_path / "map.tif"), "--wait", "240"]) == 2
    writer.join()
    assert "does not exist" not in capsys.readouterr().err and ortho.exists()
