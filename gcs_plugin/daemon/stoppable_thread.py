"""Parts that work in the background in a thread of their own."""

import threading


class Background:
    """A part with a thread, which does `_run` until `_stop` is set.

    Args:
        name: of the thread. join_s: how long `close` waits for its end, seconds; None for as long as it takes.
    """

    def __init__(self, name: str, join_s: float | None = 5.0) -> None:
        self._stop, self._join_s = threading.Event(), join_s
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread, once."""
        self._thread.start()

    def close(self) -> None:
        """Ask the thread to end and wait for it; does nothing if it was never started."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(self._join_s)

    def _run(self) -> None:
        raise NotImplementedError
