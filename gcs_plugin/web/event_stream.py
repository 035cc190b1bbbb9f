"""The event stream over a WebSocket: changes as they happen, and each second a heartbeat with the daemon's clocks.

The wall clock can be set while a page is open, which would make every command look as if it came from the future or the
past. So heartbeats also carry a clock that nobody sets, and the run of the daemon in which it counts.

A `Standstill` detects that the process was suspended: stopped, swapped out, or the laptop was closed. Requests that
arrived meanwhile are read at once afterwards, and carry no sign of their age.
"""

import asyncio
import contextlib
import os
import time
from collections.abc import Callable
from typing import Any, Final

from fastapi import WebSocket, WebSocketDisconnect

from gcs_plugin.daemon.store.daemon_events import Events
from orthoswarm import __version__
from orthoswarm.export.json_values import json_text

_TICK_S: Final = 0.25
STILL_S: Final = 3.0
_AFTER_S: Final = 1.0
HEARTBEAT_S: Final = 1.0
RUN: Final = os.urandom(6).hex()
"""Names this run of the daemon: its clock means nothing to another."""


def clock_with_sleep() -> float:
    """Seconds that also pass while the machine sleeps, where the system has such a clock (Linux)."""
    boot = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic() if boot is None else time.clock_gettime(boot)


class Standstill:
    """Watches the event loop in which `run` runs; `clock`: seconds."""

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


def clocks() -> dict[str, Any]:
    """What a client dates its commands with: `time` (UTC epoch seconds), `clock_s` (never set), `run`."""
    return {"time": time.time(), "clock_s": clock_with_sleep(), "run": RUN}


async def stream_events(socket: WebSocket, events: Events) -> None:
    """Send events as JSON texts, one per message, until the client disconnects.

    `hello` comes first, `heartbeat` each second; both carry the values of `clocks`.
    """
    await socket.accept()
    subscription = events.subscribe()
    gone = asyncio.ensure_future(_until_gone(socket))
    news = asyncio.ensure_future(subscription.get())
    try:
        await socket.send_text(json_text({"type": "hello", "version": __version__} | clocks()))
        due = time.monotonic() + HEARTBEAT_S
        while not gone.done():
            wait_s = max(0.0, due - time.monotonic())
            await asyncio.wait({news, gone}, timeout=wait_s, return_when=asyncio.FIRST_COMPLETED)
            if time.monotonic() >= due:
                await socket.send_text(json_text({"type": "heartbeat"} | clocks()))
                due = time.monotonic() + HEARTBEAT_S
            if news.done():
                for event in news.result():
                    await socket.send_text(json_text(event))
                news = asyncio.ensure_future(subscription.get())
    except (WebSocketDisconnect, RuntimeError):
        pass
    finally:
        gone.cancel()
        news.cancel()
        events.unsubscribe(subscription)


async def _until_gone(socket: WebSocket) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
