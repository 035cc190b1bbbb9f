"""A Dask cluster on loopback against the local pool: throughput per core, and what a slow network costs.

    python -m benchmarks.speed.scaling_cluster PHOTOS... --basemap MAP [--workers 1 2 4] [--round-trip-ms 20] [--store]

Needs the extra `cluster`. The same map is made by the local pool and by the cluster with each number of workers;
products are compared, too. With --round-trip-ms every byte between command, scheduler, workers and store arrives half
that later. With --store (extra `cloud`, and moto[s3] with flask and flask-cors) photos and map lie on an S3 server on
loopback, the workers share no folder, and each has a cache of its own.
"""

import argparse
import hashlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.speed.delayed_network import DelayedNetwork, delayed_network

CREDENTIALS = {"AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_DEFAULT_REGION": "us-east-1"}
Variables = dict[str, str]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("--basemap", type=Path, required=True)
    parser.add_argument("--workers", type=int, nargs="+", default=[2])
    parser.add_argument("--round-trip-ms", type=float, default=0.0)
    parser.add_argument("--store", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        network = stack.enter_context(delayed_network(args.round_trip_ms / 1000))
        local = mosaic(args.photos, args.basemap, folder / "local", ["--workers", "1"], {})
        tell("one local process", local)
        photos, basemap, variables = str(args.photos), str(args.basemap), Variables()
        if args.store:
            photos, basemap, variables = filled_store(args, stack, folder, network)
        for count in args.workers:
            out, before = folder / f"cluster{count}", network.bytes_sent
            with ExitStack() as cluster:
                address = started(cluster, folder / f"c{count}", count, network, variables)
                own = {**variables, "ORTHOSWARM_CACHE": str(folder / f"c{count}" / "command")}
                how = ["--cluster", address, "--workers", "1"]
                report = mosaic(photos, basemap, out, how, own)
            same = all(digest(folder / "local" / n) == digest(out / n) for n in ("coarse.tif", "frames.jsonl"))
            tell(f"cluster of {count}", report, (network.bytes_sent - before) / 1e6)
            print("  same products" if same else "  DIFFERENT products", flush=True)


def tell(label: str, report: dict[str, Any], megabytes: float | None = None) -> None:
    """A line about a run: its stages, and what went over the network."""
    count = report["frames"]["used"]
    over = "" if megabytes is None else f", {1000 * megabytes / count:.0f} kB a picture over the network"
    print(
        f"{label}: {count} pictures, {1000 * report['cpu_s'] / count:.1f} CPU ms a picture, "
        f"{report['wall_s']:.1f} s wall{over}"
    )
    print("  " + ", ".join(f"{s['name']} {s['wall_s']:.1f} s" for s in report["stages"]), flush=True)


def filled_store(
    args: argparse.Namespace, stack: ExitStack, folder: Path, network: DelayedNetwork
) -> tuple[str, str, Variables]:
    """An S3 server with the photos and the map; their addresses, and the variables with which it is reached."""
    import fsspec

    port = free_port()
    run(stack, [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)], {})
    wait(lambda: answers(port))
    os.environ.update(CREDENTIALS)
    system = fsspec.filesystem("s3", client_kwargs={"endpoint_url": f"http://127.0.0.1:{port}"})
    system.mkdir("site")
    system.put(f"{args.photos}/", "site/photos", recursive=True)
    system.put_file(str(args.basemap), f"site/{args.basemap.name}")
    variables = {**CREDENTIALS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{network.forward(port)}"}
    return "s3://site/photos", f"s3://site/{args.basemap.name}", variables


def started(stack: ExitStack, folder: Path, count: int, network: DelayedNetwork, variables: Variables) -> str:
    """The address of a new scheduler with workers, each reached through the network."""
    folder.mkdir()
    port = free_port()
    common = [sys.executable, "-m", "dask"]
    run(stack, [*common, "scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"], {})
    wait(lambda: answers(port))
    address = f"tcp://127.0.0.1:{network.forward(port)}"
    for n in range(count):
        own = free_port()
        contact = f"tcp://127.0.0.1:{network.forward(own)}"
        place = ["--listen-address", f"tcp://127.0.0.1:{own}", "--contact-address", contact]
        run(
            stack,
            [*common, "worker", address, *place, "--nthreads", "1", "--no-nanny", "--no-dashboard"],
            {**variables, "ORTHOSWARM_CACHE": str(folder / f"worker{n}")},
        )
    from distributed import Client

    with Client(address, set_as_default=False, timeout=60) as client:
        client.wait_for_workers(count, timeout=180)
    return address


def run(stack: ExitStack, command: list[str], variables: Variables) -> None:
    """A process that ends with the stack."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **variables}  # a nanny would set it
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(command, env=environment, stdout=quiet, stderr=quiet)
    stack.callback(process.wait)
    stack.callback(process.kill)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def answers(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1).close()
    except OSError:
        return False
    return True


def wait(ready: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while not ready():
        if time.monotonic() > end:
            raise SystemExit("a server did not start")
        time.sleep(0.1)


def mosaic(photos: str | Path, basemap: str | Path, out: Path, how: list[str], variables: Variables) -> dict[str, Any]:
    command = [sys.executable, "-m", "gcs_plugin.cli", "mosaic", str(photos), "--basemap", str(basemap)]
    environment = {**os.environ, **variables}
    command += ["--out", str(out), "--json", *how]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment, check=True)
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    main()
