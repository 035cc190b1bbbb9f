"""What the daemon keeps of pictures until their sortie is refined: used for the same result, then removed."""

import contextlib
import os
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.jobs.publisher import frames_of
from gcs_plugin.daemon.jobs.solution_file import read_solution
from gcs_plugin.daemon.jobs.sortie_refinement import SortieRefinement
from gcs_plugin.daemon.jobs.worker_tasks import near
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.picture_store import KeptPictures
from orthoswarm.raster.basemap import Basemap
from orthoswarm.refine.strategy.swarm_refiner import SwarmRefiner
from tests.kit.made_up import LIMIT_S, after_job, complete, post


def settings_of(tmp_path, flight, **others):
    settings = Settings(workspace=tmp_path / "w", basemap=flight[1], **others)
    settings.workspace.mkdir(exist_ok=True)
    return settings


def kept(daemon):
    """The files that are kept; folders may be removed meanwhile, which ends a walk by `rglob` with an error."""
    return [Path(at, name) for at, _, names in os.walk(daemon.settings.workspace / "kept") for name in names]


def tracks(daemon):
    return {path.name for path in kept(daemon) if path.suffix == ".tracks"}


def size(path):
    with contextlib.suppress(FileNotFoundError):  # it has its final name by now
        return path.stat().st_size
    return 0


def until(true):
    end = time.monotonic() + LIMIT_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def solutions(daemon):
    """Camera positions and sigmas by picture, as bytes: of the daemon's solution, and of one by the refiner alone."""
    row = daemon.journal.one("SELECT path FROM solutions")
    found = read_solution(daemon.settings.workspace / "solutions" / row["path"]).solution
    frames, _ = frames_of(daemon.journal, daemon.store, SimpleNamespace(vehicle="v1", sortie=1))
    area = daemon.drawer.area
    basemap = Basemap.open(daemon.settings.basemap, area.epsg, near(frames, area.epsg))
    alone = SwarmRefiner(area.epsg, np.array(area.origin)).refine(frames, [], basemap)
    return [{p.frame.image: (p.camera.position.tobytes(), p.sigma_m) for p in s.placed} for s in (found, alone)]


def test_a_sortie_is_followed_while_its_last_pictures_may_come(tmp_path, flight, monkeypatch):
    dropped, drop = [], KeptPictures.drop
    with Daemon(settings_of(tmp_path, flight, coarse=False, silent_s=LIMIT_S)) as daemon:

        def noted_drop(*which):
            dropped.append(tracks(daemon))
            drop(*which)

        monkeypatch.setattr(KeptPictures, "drop", noted_drop)
        post(daemon, flight[0])
        until(lambda: daemon.drawer.area is not None)  # the first picture begins the map
        complete(daemon)
        (job,) = after_job(daemon, 1)
        assert job.state == "done", job.message
        assert job.detail["follow_cpu_s"] > 0.0
        assert len(dropped[0]) == 1  # what was followed served the refinement
        found, alone = solutions(daemon)
        assert len(found) == 28
        assert found == alone
        assert kept(daemon) == []


@pytest.mark.slow
def test_a_vehicle_that_is_silent_before_it_completes_is_followed_then(tmp_path, flight):
    # longer than the daemon may take for one picture while it starts its processes: silent once
    with Daemon(settings_of(tmp_path, flight, silent_s=3.0)) as daemon:
        post(daemon, flight[0])
        until(lambda: any(job.ended and "follow_cpu_s" in job.detail for job in daemon.jobs.all()))
        followed = tracks(daemon)
        assert len(followed) == 1
        seen = set()
        complete(daemon)

        def refined():
            seen.update(tracks(daemon))
            return any(job.kind == "refine" and job.ended for job in daemon.jobs.all())

        until(refined)
        assert seen <= followed  # their refinement asks for the same, and makes no others
        found, alone = solutions(daemon)
        assert len(found) == 28
        assert found == alone


def test_a_picture_that_comes_meanwhile_is_refined_with_the_others(tmp_path, flight, monkeypatch):
    with Daemon(settings_of(tmp_path, flight, coarse=False, silent_s=LIMIT_S)) as daemon:
        last = [flight[0][27:]]

        wait = SortieRefinement.wait_drawn

        def last_comes(work, run):
            if last:
                post(daemon, last.pop())
            wait(work, run)

        monkeypatch.setattr(SortieRefinement, "wait_drawn", last_comes)
        post(daemon, flight[0][:27])
        complete(daemon)
        (job,) = after_job(daemon, 1)
        assert job.state == "done", job.message
        assert job.detail["frames"] == 28
        found, alone = solutions(daemon)
        assert found == alone


@pytest.mark.slow
def test_what_legs_left_is_not_needed_after_a_restart(tmp_path, flight):
    with Daemon(settings_of(tmp_path, flight, silent_s=0.5)) as daemon:
        post(daemon, flight[0][:20])
        until(lambda: sum(map(size, kept(daemon))) >= 14 * 240 * 180)
    with Daemon(settings_of(tmp_path, flight, coarse=False, silent_s=LIMIT_S)) as daemon:
        assert kept(daemon) == []
        post(daemon, flight[0][20:])
        complete(daemon)
        (job,) = after_job(daemon, 1)
        assert job.state == "done", job.message
        found, alone = solutions(daemon)
        assert found == alone


def test_folders_take_no_more_than_is_allowed_and_one_for_a_vehicle(tmp_path, flight):
    frames = flight[0]
    kept = KeptPictures(tmp_path / "kept", 240 * 180 * 30 / 1e6)
    assert kept.of(("v1", 1), frames[:20]) == kept.of(("v1", 1), frames)
    assert kept.of(("v2", 1), frames[:3]) is None
    second = kept.of(("v1", 2), frames[:20])
    assert second is not None and second.is_dir()
    assert kept.of(("v2", 1), frames[:3]) not in (None, second)
    assert len(list((tmp_path / "kept").iterdir())) == 2
    kept.drop(("v1", 2))
    kept.drop(("v1", 2))
    assert not second.exists()
    assert kept.of(("v2", 1), frames) is not None


def test_nothing_is_kept_on_a_disk_that_is_nearly_full(tmp_path, flight):
    kept = KeptPictures(tmp_path / "kept", 1500.0, free_mb=1e12)
    assert kept.of(("v1", 1), flight[0]) is None
    assert list((tmp_path / "kept").iterdir()) == []
