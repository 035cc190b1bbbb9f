"""A Dask scheduler and workers on loopback, as processes of their own."""

import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

SMALL = {"DASK_DISTRIBUTED__WORKER__MEMORY__TERMINATE": "False", "OMP_NUM_THREADS": "1"}


class Loopback:
    """A scheduler and workers as processes of their own."""

    def __init__(self, folder: Path, **environment):
        self.file = folder / "scheduler.json"
        self.processes = []
        self.port = 0
        root = str(Path(__file__).resolve().parents[3])
        self.environment = {**os.environ, **SMALL, "PYTHONPATH": root, **environment}

    def begin(self, workers):
        self.scheduler()
        for _ in range(workers):
            self.worker()
        self.wait_for_workers(workers)

    def scheduler(self):
        """Start it, at the same address as before if there was one."""
        self.file.unlink(missing_ok=True)
        self.start("scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        self.wait(self.is_known)
        self.port = int(self.address.rpartition(":")[2])

    def start(self, what, *args, within=()):
        command = [*within, sys.executable, "-m", "dask", what, "--scheduler-file", str(self.file), *args]
        quiet = subprocess.DEVNULL
        self.processes.append(subprocess.Popen(command, env=self.environment, stdout=quiet, stderr=quiet))
        return self.processes[-1]

    def worker(self, *within):
        """Start one, within another command (of some words) if there is one."""
        return self.start(
            "worker", "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--no-dashboard", within=within
        )

    @property
    def address(self):
        return json.loads(self.file.read_text())["address"]

    def is_known(self):
        """Whether the scheduler has said its address: its file is there before its content is."""
        with contextlib.suppress(FileNotFoundError, ValueError):
            return bool(self.address)
        return False

    def wait(self, ready, seconds=300):
        end = time.monotonic() + seconds
        while not ready():
            assert time.monotonic() < end, "the cluster did not start"
            time.sleep(0.1)

    def wait_for_workers(self, count):
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=300)

    def close(self):
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.wait(120)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
