"""Work done ahead of its use by a few threads: a task that reads many files would wait for the network at each.

Threads end when nothing is announced any more. What is wanted before its turn is left to the one who wants it.
"""

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from pathlib import Path


class Ahead:
    """Files that are copied ahead.

    Args:
        copy: copies one; raises nothing that matters, since whoever wants the file copies it again and finds out.
    """

    def __init__(self, copy: Callable[[Path], object]) -> None:
        self._copy = copy
        self._lock = threading.Lock()
        self._announced: OrderedDict[Path, None] = OrderedDict()
        self._busy: dict[Path, threading.Event] = {}
        self._threads = 0

    def announce(self, paths: Iterable[Path], threads: int) -> None:
        """Begin to copy files that will be wanted soon, in this order, so many at once."""
        with self._lock:
            self._announced.update((path, None) for path in paths if path not in self._busy)
            more = max(0, min(len(self._announced), threads) - self._threads)
            self._threads += more
        for _ in range(more):
            threading.Thread(target=self._work, daemon=True).start()

    def wait(self, path: Path) -> None:
        """Wait for a file that is being copied; one that has not begun is not copied ahead any more."""
        with self._lock:
            self._announced.pop(path, None)
            busy = self._busy.get(path)
        if busy is not None:
            busy.wait()

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._announced:
                    self._threads -= 1
                    return
                path, _ = self._announced.popitem(last=False)
                done = self._busy[path] = threading.Event()
            try:
                with contextlib.suppress(Exception):
                    self._copy(path)
            finally:
                with self._lock:
                    del self._busy[path]
                done.set()
