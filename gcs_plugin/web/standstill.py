"""Detects that the process was suspended: stopped, swapped out, or the laptop was closed.

Requests that arrived meanwhile are read at once afterwards, and carry no sign of their age.
"""

import asyncio
import time
from collections.abc import Callable
from typing import Final

_TICK_S: Final = 0.25
STILL_S: Final = 3.0
_AFTER_S: Final = 1.0


def clock_with_sleep() -> float:
    """Seconds that also pass while the machine sleeps, where the system has such a clock (Linux)."""
    boot = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic() if boot is None else time.clock_gettime(boot)


class Standstill:
    """Watches the event loop in which `run` runs.

    Args:
        clock: seconds.
    """

    def __init__(self, clock: Callable[[], float] = clock_with_sleep) -> None:
        self._clock = clock
        self._ticked: float | None = None
        self._length_s, self._ended = 0.0, float("-inf")

    def tick(self) -> None:
        """Note that the loop runs."""
        now = self._clock()
        if self._ticked is not None and now - self._ticked > STILL_S:
            self._length_s, self._ended = now - self._ticked, now
        self._ticked = now

    def length_s(self) -> float:
        """Length of a suspension that ended at most a second ago, seconds; 0 without one."""
        now = self._clock()
        if self._ticked is not None and now - self._ticked > STILL_S:
            return now - self._ticked  # requests waiting in the socket are read before the next tick
        return self._length_s if now - self._ended < _AFTER_S else 0.0

    async def run(self) -> None:
        """Tick until cancelled."""
        while True:
            self.tick()
            await asyncio.sleep(_TICK_S)
