"""Throughput per core: a Dask cluster on loopback against the local pool, with the same number of processes.

    python -m benchmarks.speed.scaling_cluster PHOTOS... --basemap MAP [--processes 2]

Needs the extra `cluster`. Both make the same map, one after the other; products are compared, too.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photos", nargs="+", type=Path)
    parser.add_argument("--basemap", type=Path, required=True)
    parser.add_argument("--processes", type=int, default=2)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        local = mosaic(args, folder / "local", ["--workers", str(args.processes)])
        file = folder / "scheduler.json"
        common = ["--scheduler-file", str(file), "--host", "127.0.0.1"]
        processes = [start("scheduler", *common, "--port", "0", "--no-dashboard")]
        try:
            while not file.exists():
                time.sleep(0.2)
            for _ in range(args.processes):
                processes.append(start("worker", *common, "--nthreads", "1", "--no-nanny", "--no-dashboard"))
            address = json.loads(file.read_text())["address"]
            wait_for_workers(address, args.processes)
            cluster = mosaic(args, folder / "cluster", ["--cluster", address])
        finally:
            for process in processes:
                process.kill()
                process.wait()
        same = all(
            digest(folder / "local" / n) == digest(folder / "cluster" / n) for n in ("coarse.tif", "frames.jsonl")
        )
    for label, report in (("local pool", local), ("cluster", cluster)):
        count = report["frames"]["used"]
        print(f"{label}: {count / report['cpu_s']:.1f} pictures per core-second, {report['wall_s']:.1f} s wall")
    print("same products" if same else "DIFFERENT products")


def start(what: str, *options: str) -> subprocess.Popen:
    quiet = subprocess.DEVNULL
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}  # a nanny would set it
    command = [sys.executable, "-m", "dask", what, *options]
    return subprocess.Popen(command, env=environment, stdout=quiet, stderr=quiet)


def wait_for_workers(address: str, count: int) -> None:
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(count, timeout=120)


def mosaic(args: argparse.Namespace, out: Path, how: list[str]) -> dict:
    command = [sys.executable, "-m", "gcs_plugin.cli", "mosaic", *map(str, args.photos), "--basemap", str(args.basemap)]
    done = subprocess.run([*command, "--out", str(out), "--json", *how], stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    main()
