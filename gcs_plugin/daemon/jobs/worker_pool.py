"""Worker processes of the daemon, of low priority, ended with it in any case; and the one that compiles kernels."""

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

from gcs_plugin.daemon.store.daemon_events import Events
from orthoswarm.compute.compile_kernels import MADE_FOR, load_kernels
from orthoswarm.compute.workers import Usage, prepare_worker, spawn_context
from orthoswarm.model.errors import OrthoSwarmError, WorkerStoppedError

Result = TypeVar("Result")

NICE: Final = 5
LAST: Final = 10
"""Priority of what may wait while anything else has work."""
_LOOK_S: Final = 0.5


class WorkerPool:
    """A few processes that run one function at a time each.

    Args:
        count: how many processes. nice: how much lower their priority is than the daemon's (not on Windows).
    """

    def __init__(self, count: int, nice: int = NICE) -> None:
        self.count, self._nice = max(1, count), nice
        self._lock = threading.Lock()
        self._free = threading.BoundedSemaphore(self.count)
        self._reserved = threading.local()
        self._pool: ProcessPoolExecutor | None = None
        self._closed = self._started = False
        self._ended_cpu_s = 0.0

    def warm_up(self) -> None:
        """Start the processes, once, and let them load what a refinement needs."""
        with self._lock:
            if self._started or self._closed:
                return
            self._started = True
        for _ in range(self.count):
            self.submit(_load, 0)

    def submit(self, function: Callable[[Any], Result], item: Any) -> "Future[Result]":
        """Run a module-level function of one picklable argument."""
        with self._lock:
            if self._closed:
                raise OrthoSwarmError("the daemon is stopping; start it again")
            if self._pool is None:
                context = spawn_context()
                self._pool = ProcessPoolExecutor(
                    self.count, mp_context=context, initializer=_prepare, initargs=(self._nice,)
                )
            try:
                return self._pool.submit(function, item)
            except BrokenProcessPool:
                self._pool = None
        return self.submit(function, item)

    @contextmanager
    def reserved(self) -> Iterator[None]:
        """Wait until a process is free, and reserve it for this thread's work.

        Raises:
            OrthoSwarmError: the daemon is stopping.
        """
        while not self._free.acquire(timeout=_LOOK_S):
            if self._closed:
                raise OrthoSwarmError("the daemon is stopping; start it again")
        with self._holding():
            yield

    def run_if_free(self, function: Callable[[Any], Result], item: Any) -> Result | None:
        """As `run`; None, without waiting, if no process is free."""
        if not self._free.acquire(blocking=False):
            return None
        with self._holding():
            return self.run(function, item)

    @contextmanager
    def _holding(self) -> Iterator[None]:
        """This thread's work has the process that was acquired, which is free again afterwards."""
        self._reserved.held = True
        try:
            yield
        finally:
            self._reserved.held = False
            self._free.release()

    def run(self, function: Callable[[Any], Result], item: Any) -> Result:
        """Run a function once a process is free, and wait for it.

        Raises:
            WorkerStoppedError: the process was stopped from outside. Errors of the function are raised here.
        """
        if not getattr(self._reserved, "held", False):
            with self.reserved():
                return self.run(function, item)
        future = self.submit(function, item)
        pool = self._pool
        try:
            return future.result()
        except (BrokenProcessPool, CancelledError):
            with self._lock:
                if self._pool is pool:
                    self._pool = None
            raise WorkerStoppedError("a worker process was stopped from outside, mostly for lack of memory") from None

    def usage(self) -> Usage:
        """CPU time of all its processes so far, and the sum of the peak memory of the live ones."""
        with self._lock:
            living = _used(self._pool)
            return Usage(self._ended_cpu_s + living.cpu_s, living.peak_rss_mb)

    def abandon(self) -> None:
        """Abandon running work at once; new processes start with the next work."""
        with self._lock:
            pool, self._pool = self._pool, None
            self._ended_cpu_s += _used(pool).cpu_s
        if pool is not None:
            _end(pool)

    def close(self) -> None:
        """Stop at once, abandoning running work."""
        with self._lock:
            pool, self._pool, self._closed = self._pool, None, True
        if pool is not None:
            for process in _end(pool):
                process.join(5.0)


def _used(pool: ProcessPoolExecutor | None) -> Usage:
    parts = [_used_by(pid) for pid in list(getattr(pool, "_processes", None) or {})]
    return Usage(sum(part.cpu_s for part in parts), sum(part.peak_rss_mb for part in parts))


def _end(pool: ProcessPoolExecutor) -> list[Any]:
    """Terminate a pool's processes; returns them."""
    processes = list((getattr(pool, "_processes", None) or {}).values())
    for process in processes:
        process.terminate()
    pool.shutdown(wait=False, cancel_futures=True)
    return processes


def _prepare(nice: int) -> None:
    """Prepare a worker of low priority."""
    if hasattr(os, "nice"):
        os.nice(nice)
    prepare_worker()


def _load(_: int) -> None:
    """Import what a refinement needs, and load its kernels, which takes half a second."""
    import gcs_plugin.daemon.jobs.worker_tasks  # noqa: F401
    import orthoswarm.refine.strategy.swarm_refiner  # noqa: F401

    load_kernels("mosaic", "raster", "refine")


def _used_by(pid: int) -> Usage:
    """Usage of another process so far; zero if it has ended, or if the system does not report it (not Linux)."""
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace")
        ran = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        largest = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM:")), 0)
        return Usage((int(ran[11]) + int(ran[12])) / os.sysconf("SC_CLK_TCK"), largest * 1024 / 1e6)
    except (OSError, ValueError, IndexError, AttributeError):
        return Usage()


_COMMAND: Final = (sys.executable, "-m", "orthoswarm.compute.compile_kernels")
_MEANWHILE: Final = "pictures are kept, and drawn and refined as soon as it is done"


class GettingReady:
    """Compiles in another process, which ends with this one.

    Attributes:
        problem: how far it is, in words; empty once the daemon is ready.
    """

    def __init__(self, events: Events) -> None:
        self._events, self.problem = events, ""
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start, unless the installation has its kernels."""
        if MADE_FOR.exists():
            return
        self._process = subprocess.Popen(
            _COMMAND, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        threading.Thread(target=self._follow, args=(self._process,), name="getting ready", daemon=True).start()

    def close(self) -> None:
        """Stop; what is compiled by then stays."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()

    def _follow(self, process: "subprocess.Popen[str]") -> None:
        assert process.stderr is not None
        with process.stderr as lines:
            for line in lines:
                self.problem = f"getting ready, {line.strip()}; {_MEANWHILE}"
                self._events.tell("problem", text=self.problem)
        self.problem = ""
        text = "ready" if process.wait() == 0 else "kernels are compiled when they are needed"
        self._events.tell("problem", text=text)
