"""Parallel tasks: in this process, or in several processes of this machine (paper III.E).

A task is a function of one item. Results are returned in the order of the items, so that they do not depend on the
number and speed of workers. Every item is pickled, also for tasks in this process, so that a function that changes its
argument always changes a copy: pass paths and small arrays. Frames, which nobody changes, are not copied within a
process.
"""

import contextlib
import copyreg
import ctypes
import gc
import io
import math
import multiprocessing
import multiprocessing.resource_tracker
import os
import pickle
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sized
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from multiprocessing.context import BaseContext, SpawnContext
from types import TracebackType
from typing import Any, Final, Generic, Protocol, TypeVar

from orthoswarm.model.errors import WorkerStoppedError
from orthoswarm.model.frame import Frame
from orthoswarm.model.task_runner import Continued, whole

Item = TypeVar("Item")
Result = TypeVar("Result")

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
_importing = threading.Lock()

_ALONE_MPX: Final = 20.0
"""Pictures of no more megapixels together are mapped in one process where the user names no number of workers: each
other process takes 1.1 to 2 s to start, 65 photos of 640 x 480 pixels 5 s (measured on two cores)."""
_QUEUE_PER_PROCESS: Final = 4  # items begun or done ahead of the one that is waited for, for each process
_IDLE_SHARE: Final = 0.1  # tasks are halved where more of the work would be idle (halves cost 5 % of CPU)
_TRIM_AFTER_S: Final = 0.5  # after a task that took more CPU seconds unused memory goes back to the system


def prepare_process() -> None:
    """First thing in a process that computes: before numpy is imported, and before any thread or process is started.

    BLAS, OpenMP and OpenCV get one thread each, since small matching calls take ten times as long otherwise; settings
    that the user made in the environment stay.

    OpenCV is imported here, while no other thread runs. A second thread that imports it at the same time gets a partly
    initialised module. Its import also puts its own folder, which contains a module `typing`, first on the path; a
    process spawned meanwhile by another thread inherits this path and fails at its first import.
    """
    for name in _THREAD_VARIABLES:
        os.environ.setdefault(name, "1")
    with _importing:
        import cv2
    cv2.setNumThreads(1)


def spawn_context() -> SpawnContext:
    """The multiprocessing context of workers: spawn, since forking a process with threads can hang."""
    prepare_process()
    return multiprocessing.get_context("spawn")


def cheapest_context() -> BaseContext:
    """The multiprocessing context of workers that start now: fork if this process has one thread, else spawn.

    A forked worker shares what this process has imported and read: a spawned one imports everything again (0.8 s of
    CPU, 160 MB). Only a thread other than the forking one can leave a lock that is never released, so fork is safe
    where the system counts one thread, those of libraries included.
    """
    context = spawn_context()
    return multiprocessing.get_context("fork") if _threads() == 1 else context


def _threads() -> int | None:
    """Threads of this process, those of libraries included; None where the system does not tell."""
    try:
        return len(os.listdir("/proc/self/task"))
    except OSError:
        return None


@dataclass(frozen=True, slots=True)
class Usage:
    """Resources that the other processes have used so far.

    Attributes:
        cpu_s: their CPU seconds (user and system).
        peak_rss_mb: sum of their largest resident sizes, megabytes.
    """

    cpu_s: float = 0.0
    peak_rss_mb: float = 0.0


def usage_of(*pools: "Workers | None") -> Callable[[], Usage]:
    """A function that gives the resources used by several pools together."""

    def together() -> Usage:
        used = [pool.usage() for pool in pools if pool is not None]
        return Usage(sum(u.cpu_s for u in used), sum(u.peak_rss_mb for u in used))

    return together


class Workers(Protocol):
    """Interface of everything that maps a function over items."""

    @property
    def count(self) -> int:
        """Number of items processed at the same time."""

    def map(self, function: Callable[[Item], Result | Continued[Result]], items: Iterable[Item]) -> Iterator[Result]:
        """Results in the order of the items; items are taken as workers become free.

        Raises:
            WorkerStoppedError: if a worker died. What the function raises is raised at its item's turn.
        """

    def usage(self) -> Usage:
        """Resources used by the workers outside this process since they started."""

    def close(self) -> None:
        """Stop the workers; unfinished items are abandoned."""


class Serial:
    """Everything in this process, one item after the other."""

    count = 1

    def map(self, function: Callable[[Item], Result | Continued[Result]], items: Iterable[Item]) -> Iterator[Result]:
        """See Workers."""
        return (_alone(function, item) for item in items)

    def usage(self) -> Usage:
        """See Workers."""
        return Usage()

    def close(self) -> None:
        """See Workers."""


class Processes:
    """Several processes on this machine; the calling process is one of them.

    The others start with the first map of several items, see `cheapest_context`.

    Args:
        count: number of items processed at the same time, the calling process included (2 starts one more process).
    """

    def __init__(self, count: int) -> None:
        self.count = max(1, count)
        self._pool: ProcessPoolExecutor | None = None
        self._cpu_s: dict[int, float] = {}
        self._rss_mb: dict[int, float] = {}

    def map(self, function: Callable[[Item], Result | Continued[Result]], items: Iterable[Item]) -> Iterator[Result]:
        """See Workers."""
        if self.count == 1:
            yield from (_alone(function, item) for item in items)
            return
        source = iter(items)
        first = list(islice(source, 2))
        if len(first) < 2:  # no other process need start, nor hold what this one has imported and read
            yield from (_alone(function, item) for item in first)
            return
        if not self._halves_pay(items):
            function = partial(whole, function)
        source = chain(first, source)
        ahead = _QUEUE_PER_PROCESS * self.count
        queue: deque[_Place[Result]] = deque()
        try:
            while True:
                self._fill(queue, function, source, ahead)
                if not queue:
                    return
                if queue[0].complete:
                    yield self._account(queue.popleft().future)
                elif (place := _continued(queue)) is not None:
                    self._go_on(place, _here)
                elif len(queue) < ahead and (more := list(islice(source, 1))):
                    queue.append(_Place(_here(function, more[0])))  # rather than wait, do one here
                else:
                    wait([place.future for place in queue if not place.future.done()], return_when=FIRST_COMPLETED)
        finally:
            for place in queue:
                place.future.cancel()

    def _halves_pay(self, items: Iterable[Item]) -> bool:
        """Whether processes would be idle for long at the end if each item were one task.

        Halves are copied between processes with all that they need: 5 % more CPU and 120 MB at 32 flights.
        """
        if not isinstance(items, Sized) or len(items) <= self.count:
            return False
        rounds = math.ceil(len(items) / self.count)
        return rounds * self.count / len(items) > 1.0 + _IDLE_SHARE

    def _fill(
        self,
        queue: "deque[_Place[Result]]",
        function: Callable[[Item], Result | Continued[Result]],
        source: Iterator[Item],
        ahead: int,
    ) -> None:
        """Submit work to the other processes: first continuations of tasks, if a process is free, then new items.

        One item more than there are other processes is under way, so that none has to wait for its next one.
        """

        def busy() -> int:
            return sum(not place.future.done() for place in queue)

        while busy() < self.count - 1 and (place := _continued(queue)) is not None:
            self._go_on(place, self._submitted)
        while busy() < self.count and len(queue) < ahead and (more := list(islice(source, 1))):
            queue.append(_Place(self._submitted(function, more[0])))

    def _go_on(self, place: "_Place[Result]", begin: Callable[..., "Future[_Outcome[Any]]"]) -> None:
        """Begin the continuation of a place's task."""
        continued = self._account(place.future)
        place.future = begin(continued.function, continued.item)

    def _submitted(self, function: Callable[[Any], Any], item: Any) -> "Future[_Outcome[Any]]":
        try:
            return self._started().submit(_measured, function, item)
        except BrokenProcessPool as error:  # told at its item's turn, as if the task had begun
            failed: Future[_Outcome[Any]] = Future()
            failed.set_exception(error)
            return failed

    def fit(self, pixels: int) -> None:
        """Work in this process alone from now on where pictures have too few pixels for others, see `_ALONE_MPX`."""
        if pixels <= _ALONE_MPX * 1e6:
            self.count = 1

    def usage(self) -> Usage:
        """See Workers."""
        return Usage(sum(self._cpu_s.values()), sum(self._rss_mb.values()))

    def close(self) -> None:
        """See Workers."""
        if self._pool is not None:
            children = list(getattr(self._pool, "_processes", None) or {})
            self._pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                if process.pid in children:
                    process.terminate()
            self._pool = None

    def __enter__(self) -> "Processes":
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self.count - 1, mp_context=cheapest_context(), initializer=prepare_worker)
        return self._pool

    def _account(self, future: "Future[_Outcome[Any]]") -> Any:
        try:
            outcome = future.result()
        except BrokenProcessPool:
            self.close()
            raise WorkerStoppedError(
                "a worker process was stopped from outside, mostly for lack of memory; run again with fewer --workers"
            ) from None
        if outcome.pid != os.getpid():
            self._cpu_s[outcome.pid] = max(outcome.cpu_s, self._cpu_s.get(outcome.pid, 0.0))
            self._rss_mb[outcome.pid] = max(outcome.rss_mb, self._rss_mb.get(outcome.pid, 0.0))
        return outcome.value


@dataclass(frozen=True, slots=True)
class _Outcome(Generic[Result]):
    """A result with what its process has used since it started."""

    value: Result
    pid: int
    cpu_s: float
    rss_mb: float


@dataclass(slots=True)
class _Place(Generic[Result]):
    """An item's place in the order of the results, with the task that it has come to."""

    future: "Future[_Outcome[Result | Continued[Result]]]"

    @property
    def continuation(self) -> "Continued[Result] | None":
        """What the task that has ended is to be continued by, if it is."""
        if not self.future.done() or self.future.exception() is not None:
            return None
        value = self.future.result().value
        return value if isinstance(value, Continued) else None

    @property
    def complete(self) -> bool:
        """Whether its result, or its error, is there."""
        return self.future.done() and self.continuation is None


def _continued(queue: "Iterable[_Place[Result]]") -> "_Place[Result] | None":
    """The first place whose task is to be continued."""
    return next((place for place in queue if place.continuation is not None), None)


def _measured(function: Callable[[Item], Result], item: Item) -> _Outcome[Result]:
    value = _tidily(function, item)
    return _Outcome(value, os.getpid(), time.process_time(), peak_rss_mb())


def _tidily(function: Callable[[Item], Result], item: Item) -> Result:
    """Apply a function, and after a long one return unused memory to the system, since it piles up over many tasks."""
    begun = time.process_time()
    value = function(item)
    if time.process_time() - begun > _TRIM_AFTER_S:
        trim_memory()
    return value


def trim_memory() -> None:
    """Return unused heap memory to the system (glibc only)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def _own(item: Item) -> Item:
    """A private copy, as another process would receive it, but with the same frames.

    A frame with its fix and its path takes as long to copy as the arrays of a picture's whole solution.
    """
    frames: list[Frame] = []

    def number(frame: Frame) -> tuple[Callable[[int], Frame], tuple[int]]:
        frames.append(frame)
        return _frame_of_copy, (len(frames) - 1,)

    written = io.BytesIO()
    pickler = pickle.Pickler(written, pickle.HIGHEST_PROTOCOL)
    pickler.dispatch_table = {**copyreg.dispatch_table, Frame: number}
    pickler.dump(item)
    _copying.frames = frames
    try:
        copy: Item = pickle.loads(written.getbuffer())
    finally:
        _copying.frames = []
    return copy


_copying = threading.local()
"""The frames of the copy that this thread is making."""


def _frame_of_copy(number: int) -> Frame:
    """A frame of the copy that this thread is making."""
    frame: Frame = _copying.frames[number]
    return frame


def _alone(function: Callable[[Item], Result | Continued[Result]], item: Item) -> Result:
    """A whole task in this process; its halves need no copies between them."""
    return _as_elsewhere(partial(whole, function), item)


def _as_elsewhere(function: Callable[[Item], Result], item: Item) -> Result:
    """Apply a function in this process as in another one: argument and result are pickled copies."""
    return _own(_tidily(function, _own(item)))


def _here(function: Callable[[Item], Result], item: Item) -> "Future[_Outcome[Result]]":
    future: Future[_Outcome[Result]] = Future()
    try:
        future.set_result(_Outcome(_as_elsewhere(function, item), os.getpid(), 0.0, 0.0))
    except Exception as error:
        future.set_exception(error)
    return future


@contextlib.contextmanager
def starting_processes() -> Iterator[None]:
    """Processes that are started within it never see Ctrl-C; this one sees afterwards what came meanwhile.

    On Windows they have to ignore the signal themselves.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    multiprocessing.resource_tracker.ensure_running()  # starting it later would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def prepare_worker() -> None:
    """First thing in a worker process: its parent handles Ctrl-C, and it ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a forked one has its parent's handler
    gc.freeze()  # collections leave what a forked one shares with its parent untouched, and so shared
    end_with_parent()
    prepare_process()


def end_with_parent() -> None:
    """End this process as soon as its parent ends, even if killed; a pool's workers would wait for ever."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def follow() -> None:
        parent.join()  # also wakes up when it was killed
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def workers(count: int | None = None) -> Serial | Processes:
    """Workers for a number of simultaneous items; None for one per core."""
    count = count or cores()
    return Serial() if count == 1 else Processes(count)


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def peak_rss_mb() -> float:
    """Largest resident size of this process so far, megabytes (10^6 bytes); 0 where the system does not tell."""
    try:
        # Not ru_maxrss: that is inherited from the process that started this one.
        with open("/proc/self/status", encoding="ascii", errors="replace") as status:
            for line in status:
                if line.startswith("VmHWM:"):
                    return int(line.split()[1]) * 1024 / 1e6
    except OSError:
        pass
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(largest if sys.platform == "darwin" else largest * 1024) / 1e6
