"""How long after COMPLETE a vehicle's refined pixels are on the map, and what was done for it before.

    python -m benchmarks.speed.complete_to_pixels out/twin [--rate 8] [--pictures N]

The folder is one that `orthoswarm twin make` wrote (photos/, basemap.tif). The first vehicle's pictures come at a rate,
as in flight, so that its legs are placed; its mission is complete with its last picture, and other vehicles' pictures
go on coming at 2 a second each. Prints a line of JSON:

on_map_s    seconds from COMPLETE to the refined pixels
waited_s    of these, until the solution began: 0.7 s in which no more picture may come
solve_s     the solution; draw_s: drawing and publishing it
follow_cpu_s, solve_cpu_s    CPU seconds of tracking while waiting, and of the solution
flight_cpu_s    CPU seconds of the processes that place legs, until COMPLETE
legs_placed     how often legs were placed in flight
"""

import argparse
import json
import tempfile
import threading
import time
from pathlib import Path

from benchmarks.speed.daemon_refine import record
from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.intake.posted_pose import parse_pose
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.sortie_rows import present_sortie
from orthoswarm.compute.workers import prepare_process
from orthoswarm.model.frame import Frame

BESIDE_HZ = 2.0


def fly(daemon: Daemon, frames: list[Frame], rate_hz: float, stop: threading.Event) -> None:
    """Add pictures at a rate until told to stop."""
    start = time.monotonic()
    for k, frame in enumerate(frames):
        if stop.wait(max(0.0, start + k / rate_hz - time.monotonic())):
            return
        daemon.intake.add(parse_pose(record(frame)), frame.path.read_bytes())


def complete(daemon: Daemon, vehicle: str) -> dict[str, float]:
    """Complete a vehicle's sortie, as its mission does, and wait for the refined pixels."""
    flight_cpu_s = daemon.background.usage().cpu_s
    asked = time.time()
    number = daemon.jobs.add("refine", vehicle, present_sortie(daemon.journal, vehicle), trigger="complete").id
    while (job := next(job for job in daemon.jobs.all() if job.id == number)).state not in ("done", "failed"):
        time.sleep(0.05)
    if job.state == "failed":
        raise SystemExit(job.message)
    detail = job.detail
    began = detail["refine_started_s"]
    placed = [other for other in daemon.jobs.all() if other.kind == "coarse" and "solve_cpu_s" in other.detail]
    return {
        "pictures": detail["frames"],
        "on_map_s": round(detail["published_s"] - asked, 2),
        "waited_s": round(began - asked, 2),
        "solve_s": detail["solve_s"],
        "draw_s": round(detail["published_s"] - began - detail["solve_s"], 2),
        "follow_cpu_s": detail.get("follow_cpu_s", 0.0),
        "solve_cpu_s": detail["solve_cpu_s"],
        "flight_cpu_s": round(flight_cpu_s, 2),
        "legs_placed": sum("after" not in other.detail for other in placed),
    }


def main() -> None:
    prepare_process()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("twin", type=Path)
    parser.add_argument("--rate", type=float, default=8.0, help="pictures of the first vehicle a second")
    parser.add_argument("--pictures", type=int, help="of the first vehicle, all by default")
    args = parser.parse_args()
    import telemetry

    vehicles: dict[str, list[Frame]] = {}
    for frame in telemetry.load([args.twin / "photos"]).frames:
        vehicles.setdefault(frame.vehicle, []).append(frame)
    first, *others = sorted(vehicles)
    own = vehicles[first][: args.pictures]
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(workspace=Path(folder) / "w", basemap=args.twin / "basemap.tif")
        with Daemon(settings) as daemon:
            stop = threading.Event()
            beside = [threading.Thread(target=fly, args=(daemon, vehicles[name], BESIDE_HZ, stop)) for name in others]
            for thread in beside:
                thread.start()
            fly(daemon, own, args.rate, stop)
            print(json.dumps(complete(daemon, first)), flush=True)
            stop.set()
            for thread in beside:
                thread.join()


if __name__ == "__main__":
    main()
