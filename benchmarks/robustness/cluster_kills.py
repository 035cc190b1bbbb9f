"""Kills of the workers, the scheduler and the command of a cluster run: is the map the same, is anything done twice?

    python -m benchmarks.robustness.cluster_kills PHOTOS... --basemap MAP [--kills 100] [--workers 2] [--seed 1]

Needs the extra `cluster`. First the map is made here without a cluster. Then the same command works on a cluster on
loopback; every few seconds a worker, the scheduler or the command itself is killed (SIGKILL) and started again, until
enough were killed. At the end of each run the products are compared byte for byte, and the stored results of flights
with what they were when they appeared: a flight that is done again writes its result again.
"""

import argparse
import collections
import json
import os
import random
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PRODUCTS = ("realtime.tif", "coarse.tif", "orthoimage.tif", "frames.jsonl")
VICTIMS = ("worker", "worker", "worker", "scheduler", "command")
"""Of five kills three hit a worker: there are more of them."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photos", nargs="+", type=Path)
    parser.add_argument("--basemap", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--most-a-run", type=int, default=5, help="kills in one run, which then comes to its end")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--least-s", type=float, default=1.0, help="shortest time between two kills")
    parser.add_argument("--most-s", type=float, default=6.0, help="longest time between two kills")
    args = parser.parse_args()
    random.seed(args.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [
            sys.executable,
            "-m",
            "gcs_plugin.cli",
            "mosaic",
            *map(str, args.photos),
            "--basemap",
            str(args.basemap),
        ]
        undisturbed = folder / "undisturbed"
        subprocess.run([*command, "--out", str(undisturbed), "--workers", "1"], check=True, capture_output=True)
        kills: collections.Counter[str] = collections.Counter()
        runs = different = again = failures = 0
        with LoopbackCluster(args.workers) as cluster:
            while sum(kills.values()) < args.kills:
                out = folder / f"map{runs}"
                trial = Trial([*command, "--out", str(out), "--cluster", cluster.address], out, cluster)
                trial.run(kills, args)
                runs += 1
                again += trial.done_again
                failures += trial.ended_early
                different += any((out / n).read_bytes() != (undisturbed / n).read_bytes() for n in PRODUCTS)
                print(f"run {runs}: {sum(kills.values())} kills so far, {trial.starts} starts of the command, "
                      f"{different} different maps, {again} flights done again", flush=True)  # fmt: skip
    print(json.dumps({"runs": runs, "kills": dict(kills), "different_maps": different, "flights_done_again": again,
                      "commands_that_asked_to_be_started_again": failures}))  # fmt: skip


class LoopbackCluster:
    """A scheduler at a fixed address and workers, each a process."""

    def __init__(self, workers: int) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.scheduler = self._scheduler()
        self.workers = [self._worker() for _ in range(workers)]

    def kill(self, what: str) -> None:
        """Kill the scheduler or a worker, and start another one in its place."""
        if what == "scheduler":
            end(self.scheduler)
            self.scheduler = self._scheduler()
        else:
            end(self.workers.pop(random.randrange(len(self.workers))))
            self.workers.append(self._worker())

    def revive(self) -> None:
        """Start workers in the place of those that ended, as with the scheduler that they were connected to."""
        self.workers = [w if w.poll() is None else self._worker() for w in self.workers]

    def __enter__(self) -> "LoopbackCluster":
        from distributed import Client

        end_s = time.monotonic() + 120
        while True:
            try:
                with Client(self.address, set_as_default=False, timeout=10) as client:
                    client.wait_for_workers(len(self.workers), timeout=120)
                return self
            except OSError:
                if time.monotonic() > end_s:
                    raise

    def __exit__(self, *_: object) -> None:
        for process in (*self.workers, self.scheduler):
            end(process)

    def _scheduler(self) -> "subprocess.Popen[bytes]":
        return self._start("scheduler", "--host", "127.0.0.1", "--port", str(self.port))

    def _worker(self) -> "subprocess.Popen[bytes]":
        return self._start("worker", self.address, "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny")

    def _start(self, what: str, *options: str) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-m", "dask", what, *options, "--no-dashboard"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        quiet = subprocess.DEVNULL
        return subprocess.Popen(command, env=environment, stdout=quiet, stderr=quiet)


class Trial:
    """A run to its end, with kills.

    Attributes:
        starts: of the command. ended_early: how often it ended with the wish to be started again.
        done_again: flights whose stored result was written more than once.
    """

    def __init__(self, command: list[str], out: Path, cluster: LoopbackCluster) -> None:
        self._command, self._out, self._cluster = command, out, cluster
        self._seen: dict[str, int] = {}
        self.starts = self.ended_early = self.done_again = 0

    def run(self, kills: "collections.Counter[str]", args: argparse.Namespace) -> None:
        """Run the command to its end, killing meanwhile and counting the kills."""
        running, killed = self._begin(), 0
        next_kill = time.monotonic() + random.uniform(args.least_s, args.most_s)
        while True:
            self._watch()
            self._cluster.revive()
            if running.poll() == 0:
                return
            if running.poll() is not None:
                self.ended_early += 1
                running = self._begin()
            if time.monotonic() > next_kill and killed < args.most_a_run:
                killed += 1
                victim = random.choice(VICTIMS)
                kills[victim] += 1
                if victim == "command":
                    end(running)
                    running = self._begin()
                else:
                    self._cluster.kill(victim)
                next_kill = time.monotonic() + random.uniform(args.least_s, args.most_s)
            time.sleep(0.05)

    def _begin(self) -> "subprocess.Popen[bytes]":
        self.starts += 1
        if self.starts > 200:
            raise SystemExit("the command does not come to an end")
        return subprocess.Popen(self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def _watch(self) -> None:
        """Note when each flight's result was written."""
        for path in (self._out / ".work").glob("vehicle*.pickle"):
            try:
                written = path.stat().st_mtime_ns
            except OSError:
                continue
            if self._seen.setdefault(path.name, written) != written:
                self.done_again += 1
                self._seen[path.name] = written


def end(process: "subprocess.Popen[bytes]") -> None:
    process.kill()
    process.wait()


if __name__ == "__main__":
    main()
