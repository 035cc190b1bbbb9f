"""After the products of a refinement are written they are compared with the basemap, and pages can show it."""

import httpx
import pytest

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.jobs.job_queue import JobRequests, Jobs
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.daemon_events import Events, JobEnded
from gcs_plugin.daemon.store.job_rows import Job
from gcs_plugin.daemon.store.journal import Journal
from tests.kit.daemon_kit import serving
from tests.kit.made_up import after_job, complete, post
from tests.kit.made_up_ground import made_up_flight, made_up_ground, write_map


@pytest.mark.slow
def test_a_refinement_on_the_basemap_is_compared_with_it(tmp_path):
    ground = made_up_ground()
    write_map(ground, tmp_path / "map.tif")
    frames = made_up_flight(ground, tmp_path, "v1")
    settings = Settings(workspace=tmp_path / "w", basemap=tmp_path / "map.tif", coarse=False)
    settings.workspace.mkdir()
    with Daemon(settings) as daemon:
        assert daemon.changes.document()["version"] == 0 and daemon.changes.picture(0.5) is None
        post(daemon, frames)
        complete(daemon, "v1")
        after_job(daemon, 1, last="change")
        jobs = daemon.jobs.all()
        compared = [job for job in jobs if job.kind == "change"]
        assert compared and all(job.state == "done" for job in compared), [job.message for job in compared]
        assert compared[0].started >= min(job.ended for job in jobs if job.kind == "export")
        assert [job for job in compared if "note" not in job.detail] == [compared[0]]  # once for the same products
        document = daemon.changes.document()
        picture, version = daemon.changes.picture(0.5)
        assert document["version"] == version > 0 and len(document["corners"]) == 4
        # the map shows what the flight saw, but for a seam of the orthoimage or two
        assert document["changed_share"] < 0.1 and document["not_visible_share"] < 0.9
        assert picture.startswith(b"\x89PNG") and daemon.changes.picture(0.9)[0] != b""
        assert 'id="change"' in (settings.workspace / "report.html").read_text(encoding="utf-8")
        for name in ("change.tif", "change.gpkg", "change.json", "ground.tif"):
            assert (settings.workspace / name).stat().st_size > 100


def test_a_comparison_is_asked_for_once_new_products_are_written_and_only_with_a_basemap(tmp_path):
    asked = {}
    for compare in (True, False):
        journal, events = Journal(tmp_path / f"{compare}.db"), Events()
        jobs = Jobs(journal, events, {}, WorkerPool(1), WorkerPool(1))
        requests = JobRequests(journal, jobs, coarse=False, basemap=compare)
        for detail in ({"after": "all"}, {"after": "all", "note": "the last one has everything"}, {}):
            ended = Job(
                id=1, kind="export", vehicle=None, sortie=None, state="done", progress=1.0, message="", created=0.0,
                started=0.0, ended=1.0, attempts=1, detail=detail,
            )  # fmt: skip
            requests.job_ended(JobEnded(ended))
            if "after" not in detail:
                continue
            asked[compare, len(detail)] = sum(job.kind == "change" for job in jobs.all())
        jobs.close()
        journal.close()
    assert asked == {(True, 1): 1, (True, 2): 1, (False, 1): 0, (False, 2): 0}  # equal ones that wait are one


def test_without_a_comparison_the_page_is_told_so(tmp_path):
    with serving(tmp_path / "w") as served:
        assert served.get("/api/change").json() == {"version": 0, "objects": [], "corners": None}
        assert httpx.get(f"{served.url}/api/change.png", headers=served.auth).status_code == 404
        assert httpx.get(f"{served.url}/api/change.png?from=2", headers=served.auth).status_code == 422
