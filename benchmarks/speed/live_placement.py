"""Where pictures lie when they are first drawn in flight, and how soon that is.

    python -m benchmarks.speed.live_placement TWIN [--vehicles N] [--rate HZ] [--pictures N]

TWIN is a folder of `orthoswarm twin make` (photos/, basemap.tif, truth/frames.csv). Its vehicles, each cut into parts
for more of them, send their pictures at a rate to a daemon (its web server's work is not part of this). Prints a line
of JSON: what `orthoswarm evaluate --live` prints, and the CPU of this process a picture (daemon_ms) and of the
processes that look for vehicles on the basemap (jobs_s).
"""

import argparse
import json
import tempfile
import threading
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

import telemetry
from benchmarks.speed.daemon_refine import record
from gcs_plugin.bench.accuracy import live_errors
from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.intake.posted_pose import parse_pose
from gcs_plugin.daemon.settings import Settings
from orthoswarm.compute.workers import prepare_process
from orthoswarm.model.frame import Frame


def parts(frames: list[Frame], count: int) -> dict[str, list[Frame]]:
    """The flights of a set, each cut into as many parts as give at least `count` vehicles."""
    flown: dict[str, list[Frame]] = defaultdict(list)
    for frame in frames:
        flown[frame.vehicle].append(frame)
    each = -(-count // len(flown))
    out = {}
    for vehicle, own in flown.items():
        for k, part in enumerate(np.array_split(np.arange(len(own)), each)):
            name = f"{vehicle}{'abcdefghijklmnopqrstuvwxyz'[k]}" if each > 1 else vehicle
            out[name] = [replace(own[i], vehicle=name) for i in part]
    return dict(list(out.items())[:count])


def fly(daemon: Daemon, frames: list[Frame], rate_hz: float) -> None:
    """Add one vehicle's pictures at a rate."""
    start = time.monotonic()
    for k, frame in enumerate(frames):
        time.sleep(max(0.0, start + k / rate_hz - time.monotonic()))
        daemon.intake.add(parse_pose(record(frame)), frame.path.read_bytes())


def main() -> None:
    prepare_process()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("twin", type=Path)
    parser.add_argument("--vehicles", type=int, default=3)
    parser.add_argument("--rate", type=float, default=2.0, help="pictures of a vehicle a second")
    parser.add_argument("--pictures", type=int, help="of each vehicle, all by default")
    args = parser.parse_args()
    flown = {
        v: own[: args.pictures]
        for v, own in parts(telemetry.load([args.twin / "photos"]).frames, args.vehicles).items()
    }
    with tempfile.TemporaryDirectory() as scratch:
        settings = Settings(workspace=Path(scratch) / "work", basemap=args.twin / "basemap.tif")
        with Daemon(settings) as daemon:
            began = time.process_time()
            threads = [threading.Thread(target=fly, args=(daemon, own, args.rate)) for own in flown.values()]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            for vehicle in flown:
                daemon.drawer.wait_drawn(vehicle, 1, 30.0)
            cpu_s, jobs_s = time.process_time() - began, daemon.background.usage().cpu_s
        errors = live_errors(settings.workspace, args.twin / "truth" / "frames.csv")
    errors["cpu"] = {"daemon_ms": round(1e3 * cpu_s / sum(map(len, flown.values())), 2), "jobs_s": round(jobs_s, 2)}
    print(json.dumps(errors))


if __name__ == "__main__":
    main()
