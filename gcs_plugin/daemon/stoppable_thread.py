"""A thread that works in the background until it is told to stop."""

import threading
from collections.abc import Callable


class StoppableThread:
    """Runs a function in a thread; the function ends when the event that it is given is set.

    Args:
        run: the function. name: of the thread. join_s: how long `close` waits for its end, seconds.
    """

    def __init__(self, run: Callable[[threading.Event], None], name: str, join_s: float = 5.0) -> None:
        self._stop, self._join_s = threading.Event(), join_s
        self._thread = threading.Thread(target=run, args=(self._stop,), name=name, daemon=True)

    def start(self) -> None:
        """Start the thread, once."""
        self._thread.start()

    def close(self) -> None:
        """Ask the function to end and wait for it; does nothing if it was never started."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(self._join_s)
