"""Overlapping neighbours are solved together once both were refined, when nothing more urgent is to be done."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.jobs.job_queue import Jobs
from gcs_plugin.daemon.jobs.neighbours import JointRefinement
from gcs_plugin.daemon.jobs.publisher import Publisher
from gcs_plugin.daemon.jobs.solution_file import read_solution
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.jobs.worker_tasks import without_strays
from gcs_plugin.daemon.layers.layers import MapArea
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.daemon_events import Events
from gcs_plugin.daemon.store.journal import Journal, packed
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.placement import PlacedFrame, Solution
from tests.kit.daemon_kit import StoppedWorkers
from tests.kit.made_up import LIMIT_S, after_job, complete, post, truth
from tests.kit.made_up_ground import made_up_flight, made_up_ground, write_map


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """Frames of two vehicles over the same ground, and the map."""
    folder = tmp_path_factory.mktemp("flights")
    ground = made_up_ground()
    write_map(ground, folder / "map.tif")
    return {v: made_up_flight(ground, folder, v) for v in ("v1", "v2")}, folder / "map.tif"


@pytest.fixture
def daemon(tmp_path, flights, request):
    """A daemon; its parameter is the movement, in pixels, below which a joint refinement is not drawn."""
    settings = Settings(workspace=tmp_path / "w", basemap=flights[1], coarse=False, redraw_px=request.param)
    settings.workspace.mkdir()
    with Daemon(settings) as daemon:
        yield daemon


def solution(daemon, vehicle):
    row = daemon.journal.one("SELECT path FROM solutions WHERE vehicle = ?", (packed(vehicle),))
    return row["path"], read_solution(daemon.settings.workspace / "solutions" / row["path"]).solution


def errors(found, frames):
    """Ground under the pictures' middles against where they were taken (not against the records, which are off)."""
    middle = [119.5, 89.5]
    true = {frame.image: truth(frame) for frame in frames}
    return np.array([np.hypot(*(p.camera.to_ground(middle) - true[p.frame.image])) for p in found.placed])


@pytest.mark.slow
@pytest.mark.parametrize("daemon", [0.0], indirect=True)
def test_the_first_is_solved_again_when_its_neighbour_was_refined(daemon, flights):
    frames, _ = flights
    versions = []
    for count, vehicle in enumerate(frames, 1):
        post(daemon, frames[vehicle])
        complete(daemon, vehicle)
        refined = after_job(daemon, count)[-1]
        assert refined.state == "done", refined.message
        versions.append((solution(daemon, "v1")[0], daemon.layers["fine"].version))
        if count == 1:
            assert not [job for job in daemon.jobs.all() if job.kind == "together"]  # nobody is near
    together = [job for job in daemon.jobs.all() if job.kind == "together"]
    assert [(job.vehicle, job.state, job.detail["neighbours"]) for job in together] == [
        ("v1", "done", 1), ("v2", "done", 1)
    ]  # fmt: skip
    assert all(job.started >= refined.ended for job in together)
    assert versions[1][0] != versions[0][0]  # another solution of v1 stands
    drawn = [job.detail["version"] for job in together]
    assert versions[0][1] < drawn[0] < drawn[1] == versions[1][1]
    for vehicle in frames:
        _, found = solution(daemon, vehicle)
        assert len(found.placed) == len(frames[vehicle])
        assert np.median(errors(found, frames[vehicle])) < 0.3
    assert {row["stage"] for row in daemon.views.frames()} == {"fine"}
    assert {leg["properties"]["state"] for leg in daemon.views.legs()["features"]} == {"matched"}
    assert not [job for job in daemon.jobs.all() if job.state == "failed"]
    assert sorted(path.name for path in (daemon.settings.workspace / "solutions").glob("solution*.part")) == []


@pytest.mark.slow
@pytest.mark.parametrize("daemon", [1e6], indirect=True)
def test_what_lies_well_beside_its_neighbours_is_not_drawn_again(daemon, flights):
    frames, _ = flights
    for count, vehicle in enumerate(frames, 1):
        post(daemon, frames[vehicle])
        complete(daemon, vehicle)
        after_job(daemon, count)
        if count == 1:
            first = solution(daemon, "v1")[0]
    together = [job for job in daemon.jobs.all() if job.kind == "together"]
    assert [job.detail["note"] for job in together] == ["it agrees with its neighbours already"] * 2
    assert solution(daemon, "v1")[0] == first
    kept = {row["path"] for t in ("solutions", "coarse") for row in daemon.journal.rows(f"SELECT path FROM {t}")}
    assert {path.name for path in (daemon.settings.workspace / "solutions").iterdir()} == kept  # nothing is left over


def test_pictures_that_look_far_aside_are_left_out_of_the_refined_map(flights):
    frames, _ = flights
    down = Camera(np.array([0.0, 0.0, 60.0]), rotation_from_angles(0.0, -np.pi / 2, 0.0), Lens(240, 180, 171.0))
    aside = replace(down, rotation=rotation_from_angles(0.0, np.radians(-40.0), 0.0))
    placed = [PlacedFrame(f, aside if k == 5 else down, "fine", 0.1) for k, f in enumerate(frames["v1"])]
    found = Solution(
        vehicle="v1",
        placed=placed,
        dropped={"x.jpg": "damaged"},
        legs=[],
        fov_deg=70.0,
        fov_sigma_deg=1.0,
        terrain=None,
        warnings=["a word"],
    )
    left = without_strays(found)
    assert set(left.dropped) == {"x.jpg", frames["v1"][5].image} and len(left.placed) == len(placed) - 1
    assert len(left.warnings) == 2 and "strongly tilted" in left.warnings[1]
    assert without_strays(replace(found, placed=placed[:5])) == replace(found, placed=placed[:5])


# -- the queue --------------------------------------------------------------------------------------------------------


@pytest.fixture
def journal(tmp_path):
    journal = Journal(tmp_path / "journal.db")
    yield journal
    journal.close()


def ended(jobs, count):
    end = time.monotonic() + LIMIT_S
    while sum(job.state == "done" for job in jobs.all()) < count:
        assert time.monotonic() < end, jobs.all()
        time.sleep(0.01)


def test_neighbours_wait_until_no_refinement_waits_or_runs(journal):
    going, order, beside = threading.Event(), [], []

    def refine(run):
        assert going.wait(240)
        time.sleep(0.1)  # there is a thread that could take the other job
        order.append(run.job.kind)
        return lambda db: None

    def together(run):
        beside.append([other.kind for other in jobs.all() if other.state == "running"])
        order.append(run.job.kind)
        return lambda db: None

    jobs = Jobs(journal, Events(), {"refine": refine, "together": together}, WorkerPool(2), WorkerPool(1))
    jobs.add("together", "v1", 1)
    jobs.add("refine", "v2", 1)
    jobs.add("refine", "v3", 1)
    jobs.start()
    going.set()
    ended(jobs, 3)
    jobs.close()
    assert order == ["refine", "refine", "together"]
    assert beside == [["together"]]


class Rows:
    """A journal that holds two refined sorties at the same place."""

    def one(self, query, values):
        return {"vehicle": values[0], "sortie": 1, "path": "a", "detail": '{"layer": "fine", "bounds": [0, 0, 9, 9]}'}

    def rows(self, query):
        return [self.one("", (packed(v),)) for v in ("v1", "v2")]


class Placed(Publisher):
    """A publisher of an area."""

    def __init__(self, folder):
        self.solutions, self.journal, self.basemap, self._device = folder, Rows(), folder / "map.tif", "auto"

    def area(self):
        return MapArea(32631, 0.1, (0.0, 0.0), (0.0, 0.0, 9.0, 9.0))


def test_a_refinement_that_begins_takes_its_process_and_it_is_done_later(journal, tmp_path):
    workers = StoppedWorkers(lambda task: task.target)
    work = JointRefinement(Placed(tmp_path), least_px=0.1)
    began = threading.Event()

    def refine(run):
        began.set()
        return lambda db: None

    jobs = Jobs(journal, Events(), {"together": work.solve, "refine": refine}, WorkerPool(1), workers)
    job = jobs.add("together", "v1", 1)
    jobs.start()
    assert workers.began.wait(240)
    jobs.add("refine", "v2", 1)
    assert began.wait(240)
    end = time.monotonic() + LIMIT_S
    while workers.asked < 2:  # it is done once more
        assert time.monotonic() < end, jobs.all()
        time.sleep(0.01)
    assert jobs.find(job.id).attempts == 1  # giving way is not a failed attempt
    jobs.give_up()
    workers.abandon()
    jobs.close()
    assert not list(tmp_path.glob("*.pickle"))
