"""The tones of all refined sorties are balanced together once nothing more urgent is to be done."""

import threading
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.jobs.job_queue import Preempted, RunningJob
from gcs_plugin.daemon.jobs.neighbours import ToneBalance, ToneTask, balance_tones
from gcs_plugin.daemon.jobs.publisher import Publisher
from gcs_plugin.daemon.jobs.solution_file import SolutionFile, gains_of, read_solution
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.daemon_events import Events
from gcs_plugin.daemon.store.journal import packed
from orthoswarm.model.placement import Solution, Terrain
from orthoswarm.mosaic.render_passes import thumbnail
from tests.kit import mosaic_scene as scene
from tests.kit.daemon_kit import StoppedWorkers
from tests.kit.made_up import after_job, complete, post
from tests.kit.made_up_ground import made_up_flight, made_up_ground, write_map

TONES = {"west": 1.0, "middle": 0.85, "east": 0.75}


def three_strips():
    """Thumbnails and solutions of three vehicles side by side, each with another exposure."""
    rng = np.random.default_rng(2)
    flights = {}
    for number, (vehicle, tone) in enumerate(TONES.items()):
        flight = scene.Flight()
        for line in range(3):
            for along in range(10):
                east, north = 56.0 * number + 16.0 * line, 12.0 * along
                yaw, roll, pitch = rng.normal(0, 4, 3)
                view = scene.camera(east, north, 35.0, yaw_deg=yaw, roll_deg=roll, pitch_deg=pitch - 90)
                flight.take(view, vehicle=vehicle, gain=np.full(3, tone))
        small = {name: thumbnail(picture) for name, picture in flight.pictures.items()}
        solution = Solution(
            vehicle=vehicle, placed=flight.frames, dropped={}, legs=[], fov_deg=83.0, fov_sigma_deg=1.0,
            terrain=Terrain.flat(0.1 * number),
        )  # fmt: skip
        flights[vehicle] = (solution, small)
    return flights


def drawn_one_after_the_other(flights, folder, order):
    """Solution files with the tones as each vehicle gets them when it completes."""
    done = []
    for vehicle in order:
        solution, small = flights[vehicle]
        done.append(SolutionFile(solution, small, gains_of(solution, small, done)))
    paths = [folder / f"{vehicle}.pickle" for vehicle in order]
    for sortie, path in zip(done, paths):
        sortie.write(path)
    return paths


def tones(paths):
    """Log of exposure times factor in the pictures' middles, vehicle -> (N, 3); alike where the tones are even."""
    files = [read_solution(path) for path in paths]
    return {
        f.solution.vehicle: np.log([TONES[f.solution.vehicle] * gain[:, 0] for gain in f.gains.values()]) for f in files
    }


def test_vehicles_that_were_drawn_apart_get_the_tone_of_the_one_between_them(tmp_path):
    old = drawn_one_after_the_other(three_strips(), tmp_path, ["west", "east", "middle"])
    new = [path.with_name(f"new {path.name}") for path in old]
    changes, count, cpu_s = balance_tones(ToneTask(solutions=old, targets=new))
    assert count == 90 and cpu_s > 0.0
    assert [path.exists() for path in new] == [change > 0.015 for change in changes]
    now = [path if path.exists() else before for path, before in zip(new, old)]
    before, after = ({v: t.mean(0) for v, t in tones(paths).items()} for paths in (old, now))
    assert np.abs(before["west"] - before["east"]).max() > 0.1
    assert np.abs(after["west"] - after["east"]).max() < 0.03
    middles = [np.median(np.concatenate(list(tones(paths).values())), axis=0) for paths in (old, now)]
    assert np.abs(middles[1] - middles[0]).max() < 0.06  # the map as a whole keeps its brightness
    again = [path.with_name(f"again {path.name}") for path in old]
    changes, *_ = balance_tones(ToneTask(solutions=now, targets=again))
    assert max(changes) < 0.015 and not any(path.exists() for path in again)  # nothing is drawn for nothing


def test_a_vehicle_that_follows_its_neighbour_leaves_it_as_it_is(tmp_path):
    old = drawn_one_after_the_other(three_strips(), tmp_path, ["west", "middle", "east"])
    changes, *_ = balance_tones(ToneTask(solutions=old, targets=[tmp_path / f"{k}" for k in range(3)]))
    assert max(changes) < 0.03


@pytest.fixture
def dark_and_bright(tmp_path):
    """Two flights over the same ground, the second one's pictures darker, and the map."""
    ground = made_up_ground()
    write_map(ground, tmp_path / "map.tif")
    flights = {vehicle: made_up_flight(ground, tmp_path, vehicle) for vehicle in ("v1", "v2")}
    for frame in flights["v2"]:
        cv2.imwrite(str(frame.path), (0.8 * cv2.imread(str(frame.path))).astype(np.uint8))
    return flights, tmp_path / "map.tif"


@pytest.mark.slow
def test_the_daemon_draws_again_what_changes(tmp_path, dark_and_bright):
    flights, basemap = dark_and_bright
    settings = Settings(workspace=tmp_path / "w", basemap=basemap, coarse=False, redraw_px=1e6)
    settings.workspace.mkdir()
    with Daemon(settings) as daemon:
        for count, vehicle in enumerate(flights, 1):
            post(daemon, flights[vehicle])
            complete(daemon, vehicle)
            after_job(daemon, count)
        first, second = [job for job in daemon.jobs.all() if job.kind == "tones"]
        assert first.detail["note"] == "there is one vehicle only"
        assert second.state == "done" and second.detail["frames"] == 56
        # As after a run in which the two were drawn without knowledge of each other: all of v2 a tenth too bright.
        path = settings.workspace / "solutions" / solution_path(daemon, "v2")
        sortie = read_solution(path)
        SolutionFile(sortie.solution, sortie.thumbnails, {k: 1.1 * g for k, g in sortie.gains.items()}).write(path)
        version = daemon.layers["fine"].version
        daemon.jobs.add("tones")
        after_job(daemon, 2)
        job = [job for job in daemon.jobs.all() if job.kind == "tones"][-1]
        assert job.state == "done" and job.detail["drawn"] >= 1, job
        assert daemon.layers["fine"].version > version
        assert solution_path(daemon, "v2") != path.name or job.detail["drawn"] == 1
        gains = [
            np.array(
                [
                    g[:, 0]
                    for g in read_solution(settings.workspace / "solutions" / solution_path(daemon, v)).gains.values()
                ]
            )
            for v in flights
        ]
        assert np.log(gains[1].mean() / gains[0].mean()) == pytest.approx(-np.log(0.8), abs=0.03)
        assert {row["stage"] for row in daemon.views.frames()} == {"fine"}
        assert [job.kind for job in daemon.jobs.all() if job.state == "failed"] == []


def solution_path(daemon, vehicle):
    return daemon.journal.one("SELECT path FROM solutions WHERE vehicle = ?", (packed(vehicle),))["path"]


class Refined:
    """A journal with two refined sorties."""

    def rows(self, query):
        detail = '{"layer": "fine", "bounds": [0, 0, 9, 9]}'
        return [{"vehicle": packed(v), "sortie": 1, "path": v, "detail": detail} for v in ("v1", "v2")]


class Shown(Publisher):
    """A publisher of two refined sorties."""

    def __init__(self, folder):
        self.solutions, self.journal, self.refined = folder, Refined(), "fine"


def test_it_gives_way_to_a_refinement_and_leaves_nothing_behind(tmp_path):
    workers, found = StoppedWorkers(lambda task: task.targets[0]), []
    running = RunningJob(SimpleNamespace(detail={}, document=dict), workers, threading.Event(), Events())

    def run():
        try:
            ToneBalance(Shown(tmp_path)).balance(running)
        except Preempted:
            found.append("gave way")

    thread = threading.Thread(target=run)
    thread.start()
    assert workers.began.wait(240)
    running.give_way()
    thread.join(240)
    assert found == ["gave way"] and not list(tmp_path.glob("*.pickle"))
    with pytest.raises(Preempted):
        running.run(len, "")  # nor is anything begun any more
