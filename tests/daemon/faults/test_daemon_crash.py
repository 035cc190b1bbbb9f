"""Killed at random moments, the daemon loses nothing that it has acknowledged, and does no refinement twice."""

import concurrent.futures
import random
import threading
import time

import httpx
import pytest

from gcs_plugin.daemon.store.picture_store import frame_key
from tests.kit.daemon_kit import line, serving, start, stop


def post_until_gone(served, shots, acknowledged, lock):
    def post(shot):
        try:
            answer = served.send(shot)
        except httpx.TransportError:
            return
        assert answer.status_code in (200, 201), answer.text
        with lock:
            acknowledged[shot.pose["vehicle"], shot.pose["image"]] = shot

    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        list(pool.map(post, shots))


def check(served, workspace, acknowledged):
    rows = served.get("/api/frames").json()
    names = [(row["vehicle"], row["image"]) for row in rows]
    assert len(set(names)) == len(names)
    assert set(acknowledged) <= set(names)
    for (vehicle, image), shot in acknowledged.items():
        digits = frame_key(vehicle, image).hex()
        assert (workspace / "pictures" / digits[:2] / f"{digits}.jpg").read_bytes() == shot.data


def kill_again_and_again(workspace, kills, seed, count=60):
    chance = random.Random(seed)
    shots = [shot for vehicle in ("v1", "v2") for shot in line(count, vehicle, east=0 if vehicle == "v1" else 50)]
    chance.shuffle(shots)
    acknowledged: dict = {}
    lock = threading.Lock()
    asked = 0
    for kill in range(kills):
        served = start(workspace)
        try:
            check(served, workspace, acknowledged)
            left = [s for s in shots if (s.pose["vehicle"], s.pose["image"]) not in acknowledged]
            poster = threading.Thread(target=post_until_gone, args=(served, left, acknowledged, lock))
            poster.start()
            time.sleep(chance.uniform(0.0, 0.6))
            if kill == kills - 1 and served.command("/api/refine", {"vehicle": "v1"}).status_code == 202:
                asked = 1
                time.sleep(chance.uniform(0.0, 3.0))
            served.kill()
            poster.join()
        finally:
            stop(served)
    with serving(workspace) as served:
        check(served, workspace, acknowledged)
        jobs = served.until("/api/jobs", lambda jobs: all(job["state"] in ("done", "failed") for job in jobs))
        # One that was asked for and ended before the kill is followed by one of the pictures that came since then.
        refined = [job for job in jobs if job["kind"] == "refine" and job["detail"].get("trigger") != "late"]
        assert len(refined) == asked, jobs  # not forgotten, and not done twice
        assert all(job["state"] == "done" or "pictures" in job["message"] for job in refined), jobs
        post_until_gone(served, shots, acknowledged, lock)
        assert len(acknowledged) == len(shots)
        served.until("/api/frames", lambda rows: all(row["on_map"] for row in rows))
    return len(acknowledged)


@pytest.mark.slow
def test_nothing_acknowledged_is_lost_when_it_is_killed(tmp_path):
    assert kill_again_and_again(tmp_path / "w", kills=2, seed=int(time.time()), count=30) == 60


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_nothing_acknowledged_is_lost_over_many_kills(tmp_path):
    for seed in range(4):
        kill_again_and_again(tmp_path / f"w{seed}", kills=8, seed=seed)


def test_a_lost_map_is_drawn_again_from_the_pictures(tmp_path):
    import shutil

    workspace = tmp_path / "w"
    shots = line(4)
    with serving(workspace) as served:
        for shot in shots:
            served.send(shot)
        served.until("/api/frames", lambda rows: all(row["on_map"] for row in rows))
    shutil.rmtree(workspace / "layers")
    with serving(workspace) as served:
        served.until("/api/layers", lambda layers: not next(x for x in layers if x["name"] == "realtime")["empty"])
        served.until("/api/frames", lambda rows: all(row["on_map"] for row in rows))
