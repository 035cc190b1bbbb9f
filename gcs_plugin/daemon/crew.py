"""Worker processes of the daemon: warm, low in priority, and gone when the daemon is gone, however it went."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Final, TypeVar

from orthoswarm.errors import OrthoSwarmError
from orthoswarm.workers import single_threaded

Result = TypeVar("Result")

_NICE: Final = 5


class Crew:
    """A few processes that run one function at a time each.

    Args:
        count: how many processes.
    """

    def __init__(self, count: int) -> None:
        self.count = max(1, count)
        self._lock = threading.Lock()
        self._pool: ProcessPoolExecutor | None = None
        self._closed = False

    def warm_up(self) -> None:
        """Start the processes and let them import what they will need."""
        for _ in range(self.count):
            self.submit(_import_all, 0)

    def submit(self, function: Callable[[Any], Result], item: Any) -> "Future[Result]":
        """Run a module-level function of one picklable argument."""
        with self._lock:
            if self._closed:
                raise OrthoSwarmError("the daemon is stopping; start it again")
            if self._pool is None:
                single_threaded()
                context = multiprocessing.get_context("spawn")
                self._pool = ProcessPoolExecutor(self.count, mp_context=context, initializer=_prepare)
            try:
                return self._pool.submit(function, item)
            except BrokenProcessPool:
                self._pool = None
        return self.submit(function, item)

    def run(self, function: Callable[[Any], Result], item: Any) -> Result:
        """Run a function and wait for it.

        Raises:
            OrthoSwarmError: the process was stopped from outside. What the function raises is raised here.
        """
        try:
            return self.submit(function, item).result()
        except BrokenProcessPool:
            with self._lock:
                self._pool = None
            raise OrthoSwarmError("a worker process was stopped from outside, mostly for lack of memory") from None

    def close(self) -> None:
        """Stop at once; what was under way is given up."""
        with self._lock:
            pool, self._pool, self._closed = self._pool, None, True
        if pool is None:
            return
        processes = list((getattr(pool, "_processes", None) or {}).values())
        for process in processes:
            process.terminate()
        pool.shutdown(wait=True, cancel_futures=True)
        for process in processes:
            process.join(5.0)


def _prepare() -> None:
    """First thing in a worker: the daemon handles signals, and its end is this process's end, too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(_NICE)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import cv2

    cv2.setNumThreads(1)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()  # also wakes up when it was killed
        os._exit(1)


def _import_all(_: int) -> None:
    import gcs_plugin.daemon.work  # noqa: F401
    import orthoswarm.swarm.refine  # noqa: F401
