"""The job queue and its worker processes: full disks, busy workers, solution files of other versions."""

import pickle
import threading
import time

import pytest

from gcs_plugin.daemon.jobs.job_queue import Jobs
from gcs_plugin.daemon.jobs.solution_file import SolutionFile, SolutionFileError, is_readable, read_solution
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.store.daemon_events import Events, JobEnded
from gcs_plugin.daemon.store.frame_rows import add_frame, late_frames
from gcs_plugin.daemon.store.journal import Journal
from orthoswarm.model.errors import DiskFullError, OrthoSwarmError, StorageError, WorkerStoppedError
from orthoswarm.model.placement import Solution

LIMIT_S = 240.0


class FillingJournal(Journal):
    """A journal on a disk that is full while `full` is set."""

    def __init__(self, path):
        self.full, self.refused = threading.Event(), threading.Event()
        super().__init__(path)

    def write(self, change):
        if self.full.is_set():
            self.refused.set()
            raise DiskFullError("the disk is full; free some space")
        return super().write(change)


@pytest.fixture
def journal(tmp_path):
    journal = FillingJournal(tmp_path / "journal.db")
    yield journal
    journal.close()


def until(is_so):
    end = time.monotonic() + LIMIT_S
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.01)


def nothing(run):
    return lambda db: None


def test_the_end_of_a_job_is_written_when_the_disk_has_room_again(journal):
    def fill(run):
        journal.full.set()
        return lambda db: None

    ended = []
    events = Events()
    jobs = Jobs(journal, events, {"refine": fill}, WorkerPool(1), WorkerPool(1))
    events.on(JobEnded, lambda event: ended.append((event.job.kind, event.job.state, jobs.open("refine"))))
    job = jobs.add("refine", "v1", 1)
    jobs.start()
    assert journal.refused.wait(LIMIT_S)
    until(lambda: "disk is full" in jobs.problem)
    assert [row.state for row in jobs.all()] == ["running"]  # nobody is told that it is done before it is
    assert ended == []
    journal.full.clear()
    until(lambda: ended)
    jobs.close()
    assert ended == [("refine", "done", 0)]
    assert jobs.find(job.id).state == "done"
    assert jobs.problem == ""


def test_a_failure_is_written_when_the_disk_has_room_again(journal):
    def fail(run):
        journal.full.set()
        raise OrthoSwarmError("no pictures")

    jobs = Jobs(journal, Events(), {"refine": fail}, WorkerPool(1), WorkerPool(1))
    job = jobs.add("refine", "v1", 1)
    jobs.start()
    assert journal.refused.wait(LIMIT_S)
    journal.full.clear()
    until(lambda: jobs.find(job.id).state == "failed")
    jobs.close()
    assert jobs.find(job.id).message == "no pictures"


def test_only_a_lost_worker_is_tried_again_whatever_the_message_says(journal):
    tries = []

    def handler(run):
        tries.append(run.job.vehicle)
        if run.job.vehicle == "v1":
            raise WorkerStoppedError("gone")
        raise OrthoSwarmError("a picture named 'stopped from outside' is damaged")

    jobs = Jobs(journal, Events(), {"refine": handler}, WorkerPool(1), WorkerPool(1))
    one, other = jobs.add("refine", "v1", 1), jobs.add("refine", "v2", 1)
    jobs.start()
    until(lambda: all(jobs.find(job.id).state == "failed" for job in (one, other)))
    jobs.close()
    assert (tries.count("v1"), tries.count("v2")) == (3, 1)


def test_a_refinement_begins_while_others_wait_and_the_background_is_busy(journal):
    """One slot, a background job and two refinements that wait for pictures: the third one begins all the same."""
    go, began = threading.Event(), []

    def handler(run):
        began.append(run.job.vehicle)
        assert go.wait(LIMIT_S)
        return lambda db: None

    jobs = Jobs(journal, Events(), {"refine": handler, "export": handler}, WorkerPool(1), WorkerPool(1))
    jobs.start()
    jobs.add("export")
    until(lambda: began == [None])
    for vehicle in ("v1", "v2", "v3"):
        jobs.add("refine", vehicle, 1)
    until(lambda: set(began) == {None, "v1", "v2", "v3"})
    go.set()
    jobs.close()


def test_an_export_waits_for_a_refinement_and_so_holds_its_result(journal):
    go, order = threading.Event(), []

    def refine(run):
        assert go.wait(LIMIT_S)
        order.append("refine")
        return lambda db: None

    def export(run):
        order.append("export")
        return lambda db: None

    jobs = Jobs(journal, Events(), {"refine": refine, "export": export}, WorkerPool(1), WorkerPool(1))
    jobs.start()
    running = jobs.add("refine", "v1", 1)
    until(lambda: jobs.find(running.id).state == "running")
    asked = jobs.add("export", formats=["pack"])
    time.sleep(0.3)
    assert jobs.find(asked.id).state == "queued"
    go.set()
    until(lambda: jobs.find(asked.id).state == "done")
    assert order == ["refine", "export"]
    jobs.close()


def test_a_number_that_no_job_can_have_finds_none(journal):
    jobs = Jobs(journal, Events(), {}, WorkerPool(1), WorkerPool(1))
    assert [jobs.find(number) for number in (0, -1, 2**63, 2**63 - 1)] == [None] * 4


# -- worker processes -------------------------------------------------------------------------------------------------


def test_a_process_is_reserved_only_once_it_is_free():
    pool = WorkerPool(1)
    order = []

    def second():
        with pool.reserved():
            order.append("second")

    with pool.reserved():
        thread = threading.Thread(target=second)
        thread.start()
        pool.run(time.sleep, 0.2)  # what this thread runs uses the process that it has reserved
        order.append("first")
    thread.join(LIMIT_S)
    pool.close()
    assert order == ["first", "second"]


def test_who_waits_for_a_process_is_released_when_the_daemon_stops():
    pool = WorkerPool(1)
    found = []

    def wait():
        try:
            with pool.reserved():
                found.append("a process")
        except OrthoSwarmError as error:
            found.append(str(error))

    with pool.reserved():
        thread = threading.Thread(target=wait)
        thread.start()
        pool.close()
        thread.join(LIMIT_S)
    assert found == ["the daemon is stopping; start it again"]


# -- solution files ---------------------------------------------------------------------------------------------------


def solution():
    return Solution(vehicle="v1", placed=[], dropped={}, legs=[], fov_deg=70.0, fov_sigma_deg=1.0, terrain=None)


def test_a_solution_file_comes_back_as_it_was_written(tmp_path):
    SolutionFile(solution()).write(tmp_path / "a.pickle")
    assert is_readable(tmp_path / "a.pickle")
    assert read_solution(tmp_path / "a.pickle").solution.vehicle == "v1"


def test_solution_files_of_other_versions_and_damaged_ones_are_refused_in_a_sentence(tmp_path):
    path = tmp_path / "a.pickle"
    SolutionFile(solution()).write(path)
    good = path.read_bytes()
    for data, word in (
        (pickle.dumps(solution()), "another version"),
        (b"", "another version"),
        (good.replace(b"solution 2", b"solution 1", 1), "another version"),
        (good[:-9], "damaged"),
        (good[:90] + b"\xff" * 9, "damaged"),
    ):
        path.write_bytes(data)
        with pytest.raises(SolutionFileError, match=rf"a\.pickle .*{word}.*refine its vehicle again"):
            read_solution(path)
    path.unlink()
    with pytest.raises(SolutionFileError, match="gone"):
        read_solution(path)


def test_a_journal_on_a_full_disk_says_so_by_its_type(tmp_path):
    journal = Journal(tmp_path / "journal.db")
    journal.write(lambda db: db.execute("PRAGMA max_page_count = 1").fetchone())  # SQLite's own way to be full

    def grow(db):
        for _ in range(2000):
            db.execute("INSERT INTO meta VALUES (hex(randomblob(8)), hex(randomblob(2000)))")

    with pytest.raises(StorageError):
        journal.write(grow)
    journal.close()


@pytest.mark.parametrize("set_s", [-86_400.0, 0.0, 86_400.0], ids=["back", "kept", "forward"])
def test_what_is_late_does_not_depend_on_the_clock(journal, monkeypatch, set_s):
    """A clock that is set during a mission neither hides pictures that came after a refinement nor counts others."""

    def come(*images):
        for image in images:
            journal.write(add_frame(image.encode(), "v1", image, time_s=1e9, path=image, size=(640, 480), pose={}))

    ended, events = [], Events()
    events.on(JobEnded, lambda event: ended.append(event.job.id))
    jobs = Jobs(journal, events, {"refine": nothing}, WorkerPool(1), WorkerPool(1))
    come("a", "b")
    jobs.add("refine", "v1", 1, trigger="lost")
    jobs.start()
    until(lambda: ended)
    assert late_frames(journal, "v1", 1) == 0
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + set_s)
    come("b", "c", "d")
    assert late_frames(journal, "v1", 1) == 2
    jobs.add("refine", "v1", 1, trigger="late")
    until(lambda: len(ended) == 2)
    assert late_frames(journal, "v1", 1) == 0
    jobs.close()


def test_pictures_that_were_late_for_an_earlier_version_are_late_still(journal):
    """Its journal says only when a refinement began."""
    for image, came_s in (("a", 10.0), ("b", 20.0), ("c", 30.0)):
        journal.write(add_frame(image.encode(), "v1", image, time_s=1e9, path=image, size=(640, 480), pose={}))
        journal.write(lambda db, s=came_s, i=image: db.execute("UPDATE frames SET arrived = ? WHERE path = ?", (s, i)))
    job = Jobs(journal, Events(), {"refine": nothing}, WorkerPool(1), WorkerPool(1)).add(
        "refine", "v1", 1, trigger="lost", refine_started_s=15.0
    )
    journal.write(lambda db: db.execute("UPDATE jobs SET state = 'done', started = 5.0 WHERE id = ?", (job.id,)))
    assert late_frames(journal, "v1", 1) == 2


def test_a_refinement_that_was_interrupted_is_not_queued_beside_itself(journal):
    begun, go_on = threading.Event(), threading.Event()

    def wait(run):
        begun.set()
        assert go_on.wait(LIMIT_S)
        return lambda db: None

    jobs = Jobs(journal, Events(), {"refine": wait}, WorkerPool(1), WorkerPool(1))
    jobs.start()
    first = jobs.add("refine", "v1", 1)
    assert begun.wait(LIMIT_S)
    journal.write(lambda db: db.execute("UPDATE jobs SET state = 'queued' WHERE id = ?", (first.id,)))  # a restart
    assert jobs.add("refine", "v1", 1).id == first.id
    go_on.set()
    jobs.close()
