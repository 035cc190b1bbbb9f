"""Work on several threads of one process, for tasks that are mostly in compiled code, which releases the GIL."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from orthoswarm.compute.workers import cores


def on_threads(function: Callable[[Any], Any], arguments: Iterable[Any], count: int | None = None) -> Iterator[Any]:
    """Apply a function to every argument.

    Args:
        function: what to do. arguments: taken as they are needed.
        count: number of threads; None for as many as this process may use cores.

    Returns:
        The results, in the order of the arguments.

    Raises:
        Exception: what the function raises, in place of its result; no more arguments are taken then.
    """
    count = count or cores()
    if count == 1:
        yield from map(function, arguments)
        return
    running: deque[Future[Any]] = deque()
    with ThreadPoolExecutor(count) as pool:
        try:
            for argument in arguments:
                running.append(pool.submit(function, argument))
                if len(running) > count:
                    yield running.popleft().result()
            while running:
                yield running.popleft().result()
        finally:
            for future in running:
                future.cancel()
