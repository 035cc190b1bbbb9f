"""Work on a Dask cluster (paper III.E): the second implementation of `workers.Workers`.

Tasks and results travel over the network; pictures, map and output folder do not: every worker must see them under the
same paths, through a shared folder or in a store (docs/cluster.md). A task whose worker dies is repeated by another
one; when the scheduler dies, tasks without a result are sent to the one that takes its place.
"""

import contextlib
import os
import pickle
import re
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TypeVar
from uuid import uuid4

from orthoswarm import __version__
from orthoswarm.compute.workers import Usage, peak_rss_mb, prepare_process
from orthoswarm.model.errors import InputError, RunInterruptedError
from orthoswarm.model.task_runner import Continued, whole

_SAMPLES = 100
"""Paths that a worker is asked for, at most."""
Item = TypeVar("Item")
Result = TypeVar("Result")

_CONNECT_S: Final = 20.0  # to reach a scheduler
_POLL_S: Final = 1.0  # how often the workers are counted while a result is awaited
_PATIENCE_S: Final = 120.0  # a cluster without workers is given up after so long: machines restart within that
_CLUSTER_QUEUE_PER_WORKER: Final = 3  # items sent to a cluster for each worker, so that none waits for the network


class ClusterLostError(RunInterruptedError):
    """A cluster's scheduler or workers are gone, or die at a task."""


@dataclass(slots=True)
class _SentTask:
    """What was sent, to be sent again if the scheduler dies, its future, and the client that it belongs to."""

    payload: bytes
    future: Any
    client: Any


@dataclass(frozen=True, slots=True)
class _PickledOutcome:
    """A pickled result, or the pickled exception, with what its process has used since it started."""

    value: bytes
    raised: bool
    process: str
    cpu_s: float
    rss_mb: float


_begun: set[str] = set()


@dataclass(frozen=True, slots=True)
class _Beginning:
    """What a worker does before its first task of a run."""

    run: str
    begin: Callable[[], None]

    def once(self) -> None:
        """Runs on a worker."""
        if self.run not in _begun:
            self.begin()
            _begun.add(self.run)


class Cluster:
    """The workers of a Dask scheduler; each works on one item at a time.

    Args:
        address: of the scheduler, for example tcp://192.168.1.10:8786.
        shared: files and folders that every worker must see under the same path, with what is in them.
        written: a folder that every worker must write to under the same path; None for none.
        begin: called in each worker before its first task, also in one that comes later.
        patience_s: how long to wait for a worker to come back when all are gone, and for a scheduler.

    Raises:
        InputError: if there is no scheduler, no worker, another version of OrthoSwarm on a worker, or a worker that
            cannot read a shared path or that uses several BLAS threads.
    """

    def __init__(
        self,
        address: str,
        shared: Sequence[Path] = (),
        patience_s: float = _PATIENCE_S,
        *,
        written: Path | None = None,
        begin: Callable[[], None] | None = None,
    ) -> None:
        self._address = address
        self._shared = [str(seen) for path in shared for seen in _samples(path.absolute())]
        self._written = written and written.absolute()
        self._begin = None if begin is None else _Beginning(uuid4().hex, begin)
        self._client = _connect(address)
        self._patience_s = patience_s
        self._cpu_s: dict[str, float] = {}
        self._rss_mb: dict[str, float] = {}
        self._first_cpu_s: dict[str, float] = {}
        try:
            self._check()
        except BaseException:
            self.close()
            raise

    @property
    def count(self) -> int:
        """Number of items processed at the same time: the present workers."""
        return max(1, len(self._workers()))

    def map(self, function: Callable[[Item], Result | Continued[Result]], items: Iterable[Item]) -> Iterator[Result]:
        """See Workers; a task is continued where it began, since there are mostly more flights than workers."""
        source = iter(items)
        queue: deque[_SentTask] = deque()
        try:
            while True:
                wanted = _CLUSTER_QUEUE_PER_WORKER * self.count
                while len(queue) < wanted:
                    for item in source:
                        queue.append(self._submit(function, item))
                        break
                    else:
                        break
                if not queue:
                    return
                outcome = self._outcome(queue)
                queue.popleft()
                yield self._account(outcome)
        finally:
            self._cancel(queue)

    def usage(self) -> Usage:
        """See Workers."""
        cpu = sum(self._cpu_s.values()) - sum(self._first_cpu_s.values())
        return Usage(cpu, sum(self._rss_mb.values()))

    def close(self) -> None:
        """Leave the cluster; its workers stay for others."""
        self._client.close(timeout=5)

    def __enter__(self) -> "Cluster":
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _workers(self) -> dict[str, Any]:
        """The scheduler's workers; none while it is gone."""
        try:
            known: dict[str, Any] = self._client.scheduler_info(n_workers=-1)["workers"]
        except (OSError, RuntimeError, TimeoutError):
            return {}
        return known

    def _submit(self, function: Callable[[Any], Any], item: Any) -> _SentTask:
        payload = pickle.dumps((function, item, self._begin), pickle.HIGHEST_PROTOCOL)
        return _SentTask(payload, self._sent(payload), self._client)

    def _sent(self, payload: bytes) -> Any:
        """The future of a payload; None if the scheduler is gone, which is found out when its result is due."""
        try:
            # A unique key, so that Dask processes equal items separately, as Processes does.
            return self._client.submit(_work, payload, key=f"orthoswarm-{uuid4().hex}", pure=False)
        except (OSError, RuntimeError, TimeoutError):
            return None

    def _cancel(self, queue: Iterable[_SentTask]) -> None:
        """Have unfinished tasks forgotten."""
        for task in queue:
            with contextlib.suppress(OSError, RuntimeError, TimeoutError):
                if task.future is not None:
                    task.future.cancel()

    def _outcome(self, queue: deque[_SentTask]) -> _PickledOutcome:
        """The result of the first task; all are sent again when the scheduler was lost."""
        from distributed import KilledWorker
        from distributed import TimeoutError as Late

        alone_since = None
        while True:
            try:
                if queue[0].future is None:
                    raise CancelledError
                outcome: _PickledOutcome = queue[0].future.result(timeout=_POLL_S)
                return outcome
            except Late:
                if self._workers():
                    alone_since = None
                    continue
                now = time.monotonic()
                alone_since = alone_since or now
                if now - alone_since > self._patience_s:
                    raise ClusterLostError(
                        "all workers of the cluster are gone; start some and run the same command again to go on"
                    ) from None
            except KilledWorker:
                raise ClusterLostError(
                    "several workers died at the same task, mostly for lack of memory; give workers more memory and "
                    "run the same command again to go on"
                ) from None
            except (CancelledError, OSError):  # the scheduler was lost, and with it all that it knew
                if queue[0].client is self._client:  # and not found out before, by tasks of another call
                    self._reconnect()
                for task in queue:
                    task.future, task.client = self._sent(task.payload), self._client

    def _reconnect(self) -> None:
        """Find the scheduler that takes the place of a lost one, with workers.

        Raises:
            ClusterLostError: if there is none within the time.
        """
        end = time.monotonic() + self._patience_s
        while True:
            with contextlib.suppress(Exception):  # a lost connection may end in many ways
                self._client.close(timeout=1)
            try:
                self._client = _connect(self._address)
                while not self._workers() and time.monotonic() < end:
                    time.sleep(_POLL_S)
                self._check()
                return
            except (InputError, OSError) as error:
                if time.monotonic() > end:
                    raise ClusterLostError(
                        f"the cluster was lost ({error}); run the same command again to go on when it is back"
                    ) from None
                time.sleep(_POLL_S)

    def _account(self, outcome: _PickledOutcome) -> Any:
        """A task's value or error, after adding up what its process has used."""
        self._cpu_s[outcome.process] = max(outcome.cpu_s, self._cpu_s.get(outcome.process, 0.0))
        self._rss_mb[outcome.process] = max(outcome.rss_mb, self._rss_mb.get(outcome.process, 0.0))
        value = pickle.loads(outcome.value)
        if outcome.raised:
            raise value
        return value

    def _check(self) -> None:
        if not self._workers():
            at = self._address
            raise InputError(f"the cluster at {at} has no workers; start some with `dask worker {at}`")
        with _marked(self._written) as marker:
            every = self._client.run(_inspect, self._shared, marker)
        for worker, found in every.items():
            version, missing, process, cpu_s, alone = found
            if not alone:  # sums over several threads differ in their last digits, and threads compete for the cores
                raise InputError(
                    f"the worker {worker} uses several threads for sums; start it without --no-nanny, or with "
                    "OMP_NUM_THREADS=1 in its environment"
                )
            if version != __version__:
                raise InputError(
                    f"the worker {worker} has OrthoSwarm {version} and not {__version__}; install the same everywhere"
                )
            if missing:
                raise InputError(
                    f"the worker {worker} does not see {missing[0]}, or may not use it; share it under the same path "
                    "on all machines"
                )
            self._first_cpu_s.setdefault(process, cpu_s)
            self._cpu_s.setdefault(process, cpu_s)


def _connect(address: str) -> Any:
    try:
        import dask
        from distributed import Client
    except ImportError:
        raise InputError("a cluster needs dask.distributed; pip install orthoswarm[cluster]") from None
    if not re.search(r":\d+/?$", address):  # Dask's own message is obscure, and it hangs at exit
        raise InputError(f"{address} is not an address of a Dask scheduler; give one like tcp://192.168.1.10:8786")
    # States of vehicles are megabytes large and must be sent; Dask would warn about each.
    dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GB"})
    try:
        return Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:  # no route, wrong form
        raise InputError(f"there is no Dask scheduler at {address} ({_short(error)}); check the address") from None


def _short(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _work(payload: bytes) -> _PickledOutcome:
    """Runs on a worker."""
    prepare_process()
    function, item, beginning = pickle.loads(payload)
    if beginning is not None:
        beginning.once()
    raised = False
    try:
        value = pickle.dumps(whole(function, item), pickle.HIGHEST_PROTOCOL)
    except Exception as error:  # raised again at its item's turn, as by Processes; Dask would retry some
        value, raised = pickle.dumps(error, pickle.HIGHEST_PROTOCOL), True
    return _PickledOutcome(value, raised, _process(), time.process_time(), peak_rss_mb())


def _samples(path: Path) -> list[Path]:
    """A path and, of a folder, the first file in each of its folders, up to so many.

    The place of a folder that is not shared with a machine may be there, and empty.
    """
    found = [path]
    for here, below, names in os.walk(path):
        below.sort()
        found += [Path(here, name) for name in sorted(names)[:1]]
        if len(found) > _SAMPLES:
            break
    return found


@contextlib.contextmanager
def _marked(folder: Path | None) -> Iterator[str | None]:
    """A new file in a folder, removed afterwards: whoever sees it sees the same folder.

    Raises:
        InputError: if it cannot be written.
    """
    if folder is None:
        yield None
        return
    marker = folder / f".shared-{uuid4().hex}"
    try:
        marker.touch()
    except OSError as error:
        raise InputError(f"{folder} cannot be written ({error.strerror}); choose another folder") from None
    try:
        yield str(marker)
    finally:
        marker.unlink(missing_ok=True)


def _inspect(shared: list[str], marker: str | None) -> tuple[str, list[str], str, float, bool]:
    """Runs on a worker: version, unseen paths, who it is, CPU seconds so far, whether sums keep to one thread."""
    missing = [p for p in shared if not os.path.exists(p)]
    if marker is not None and not (os.path.exists(marker) and os.access(os.path.dirname(marker), os.W_OK)):
        missing.append(os.path.dirname(marker))
    return __version__, missing, _process(), time.process_time(), os.environ.get("OMP_NUM_THREADS") == "1"


def _process() -> str:
    return f"{socket.gethostname()}:{os.getpid()}"
