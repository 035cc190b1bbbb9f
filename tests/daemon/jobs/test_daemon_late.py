"""Pictures that come after their vehicle was refined, and a vehicle that stood at one spot."""

import time
from dataclasses import replace

import numpy as np
import pytest

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.jobs.job_queue import LegWatch
from gcs_plugin.daemon.jobs.publisher import LayerTurn, Publisher
from gcs_plugin.daemon.jobs.solution_file import read_solution
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.daemon_events import Events, LegsOver, VehicleSilent
from orthoswarm.model.errors import StorageError
from tests.kit.made_up import LIMIT_S, after_job, complete, post, truth


@pytest.fixture
def daemon(tmp_path, flight):
    settings = Settings(workspace=tmp_path / "w", basemap=flight[1], coarse=False, silent_s=0.5)
    settings.workspace.mkdir()
    with Daemon(settings) as daemon:
        yield daemon


def post_at_once(daemon, frames):
    """Send frames without a silence between them, however busy the machine is."""
    watch = daemon.leg_watch
    silent_s, watch.silent_s = watch.silent_s, 3600.0
    post(daemon, frames)
    watch.silent_s = silent_s


def after_all(daemon):
    """Wait until all pictures are refined; gives the refinements."""
    end = time.monotonic() + LIMIT_S
    while set(stages(daemon).values()) != {"fine"}:
        assert time.monotonic() < end, [job.document() for job in daemon.jobs.all()]
        time.sleep(0.05)
    return after_job(daemon, 1)


def stages(daemon):
    return {row["image"]: row["stage"] for row in daemon.views.frames()}


@pytest.mark.slow
def test_a_receiver_without_news_draws_nothing_and_the_refinement_finds_where_it_flew(daemon, flight):
    frames = flight[0][:20]
    here = frames[9].fix  # the receiver tells this place until the seventeenth picture
    held = [replace(f, fix=replace(f.fix, lat_deg=here.lat_deg, lon_deg=here.lon_deg)) for f in frames[10:17]]
    post_at_once(daemon, [*frames[:10], *held, *frames[17:]])
    end = time.monotonic() + LIMIT_S
    while len(rows := daemon.views.frames()) < 20 or any(r["stage"] == "realtime" and not r["on_map"] for r in rows):
        assert time.monotonic() < end
        time.sleep(0.05)
    left = {r["image"]: r for r in rows if not r["on_map"]}
    assert left.keys() == {f.image for f in held if _flown_m(frames, f) > 20.0}
    assert len(left) >= 3
    assert all("told the same place for too long" in row["reason"] for row in left.values())
    assert all(r["sigma_m"] > 4.0 for r in rows if r["image"] in {f.image for f in held} - left.keys())
    complete(daemon)
    (refined,) = after_job(daemon, 1)
    assert refined.state == "done", refined.message
    rows = {r["image"]: r for r in daemon.views.frames()}
    assert {r["stage"] for r in rows.values()} == {"fine"}
    assert all(r["on_map"] and r["reason"] is None for r in rows.values())
    path = daemon.journal.one("SELECT path FROM solutions")["path"]
    for placed in read_solution(daemon.settings.workspace / "solutions" / path).solution.placed:
        own = next(f for f in frames if f.image == placed.frame.image)
        assert np.hypot(*(placed.camera.to_ground([119.5, 89.5]) - truth(own))) < 0.5


def _flown_m(frames, frame):
    """How far the vehicle flew since the tenth picture, by its speed before."""
    speed = np.hypot(*(truth(frames[9]) - truth(frames[8]))) / (frames[9].time_s - frames[8].time_s)
    return speed * (frame.time_s - frames[9].time_s)


@pytest.mark.slow
def test_a_few_late_pictures_are_laid_beside_the_others_and_many_refined_with_them(daemon, flight):
    frames, _ = flight
    late = [frames[k] for k in (5, 15, 16)]
    first = [f for f in frames[:20] if f not in late]
    post(daemon, first)
    complete(daemon)
    (refined,) = after_job(daemon, 1)
    assert refined.state == "done", refined.message
    assert refined.detail["frames"] == 17
    note = daemon.views.completions()
    post_at_once(daemon, late)
    (beside,) = after_all(daemon)[1:]
    assert (beside.state, beside.detail["trigger"], beside.detail["beside"]) == ("done", "late", 3)
    assert daemon.views.completions() == note  # what the completion led to stays as it was
    row = daemon.journal.one("SELECT path FROM solutions")
    placed = {
        p.frame.image: p for p in read_solution(daemon.settings.workspace / "solutions" / row["path"]).solution.placed
    }
    assert len(placed) == 20
    for frame in late:
        one = placed[frame.image]
        assert np.hypot(*(one.camera.to_ground([119.5, 89.5]) - truth(frame))) < 0.5
        assert one.sigma_m < 1.5
        assert not one.weak
    post_at_once(daemon, frames[20:])  # with the three they are more than a handful
    again = after_all(daemon)[-1]
    assert again.state == "done", again.message
    assert "beside" not in again.detail
    assert again.detail["frames"] == 28
    assert not [job for job in daemon.jobs.all() if job.state == "failed"]


@pytest.mark.slow
def test_a_refinement_that_cannot_be_published_leaves_the_former_one(daemon, flight, monkeypatch):
    """Its file stays, as the journal names it, and the new file is not left behind."""
    frames, _ = flight
    post(daemon, frames[:14])
    complete(daemon)
    (refined,) = after_job(daemon, 1)
    assert refined.state == "done", refined.message
    retired = []

    def full(turn, change):
        raise StorageError("the disk is full")

    monkeypatch.setattr(LayerTurn, "publish", full)
    monkeypatch.setattr(Publisher, "retire", lambda _, row: retired.append(row))
    post_at_once(daemon, frames[14:])
    _, late = after_job(daemon, 2)
    assert late.state == "failed" and "disk is full" in late.message
    row = daemon.journal.one("SELECT path FROM solutions")
    files = (daemon.settings.workspace / "solutions").glob("solution-*")
    assert [path.name for path in files] == [row["path"]] and retired == []


@pytest.mark.slow
def test_late_pictures_are_remembered_over_a_restart(tmp_path, flight):
    frames, basemap = flight
    # each daemon ends before it notices the silence
    settings = Settings(workspace=tmp_path / "w", basemap=basemap, coarse=False, silent_s=3600.0)
    settings.workspace.mkdir()
    with Daemon(settings) as daemon:
        post(daemon, frames[:16])
        complete(daemon)
        after_job(daemon, 1)
        post(daemon, frames[16:18])
    with Daemon(settings) as daemon:
        _, beside = after_job(daemon, 2)
        assert beside.detail["beside"] == 2
    with Daemon(settings) as daemon:
        assert len(after_job(daemon, 2)) == 2  # not again


def test_a_vehicle_that_stood_at_one_spot_stays_as_recorded_and_says_so(daemon, flight):
    frames, _ = flight
    rng = np.random.default_rng(3)
    for k in range(12):  # one view, and a receiver that wanders about it
        post(daemon, [replace(frames[7], image=f"{k}.jpg", time_s=1e9 + k)], rng.normal(0.0, 1.0, 2))
    complete(daemon)
    (job,) = after_job(daemon, 1)
    assert job.state == "done", job.message
    assert job.attempts == 1
    assert job.detail["warnings"] == ["v1: all pictures were taken at one spot; they are placed as recorded"]
    assert set(stages(daemon).values()) == {"realtime"}
    (coarse,) = [job for job in daemon.jobs.all() if job.kind == "coarse"]
    assert "lies where its receiver says" in coarse.detail["note"]
    assert not [job for job in daemon.jobs.all() if job.state == "failed"]


def test_silence_is_told_however_few_pictures_came():
    asked, silent = [], []
    events = Events()
    events.on(LegsOver, asked.append)
    events.on(VehicleSilent, silent.append)
    watch = LegWatch(events, silent_s=0.2)
    watch.start()
    for count in (1, 2):
        watch.add("v1", 1, 1e9 + count, 48.0, 11.0)
        end = time.monotonic() + 240
        while len(silent) < count:
            assert time.monotonic() < end
            time.sleep(0.01)
    time.sleep(0.3)
    watch.close()
    assert silent == [VehicleSilent("v1", 1)] * 2  # once for each silence
    assert asked == []
