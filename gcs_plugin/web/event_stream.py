"""The event stream over a WebSocket: changes as they happen, and each second a heartbeat with the daemon's clocks.

The wall clock can be set while a page is open, which would make every command look as if it came from the future or the
past. So heartbeats also carry a clock that nobody sets, and the run of the daemon in which it counts.
"""

import asyncio
import contextlib
import os
import time
from typing import Any, Final

from fastapi import WebSocket, WebSocketDisconnect

from gcs_plugin.daemon.store.event_bus import Events
from gcs_plugin.web.standstill import clock_with_sleep
from orthoswarm import __version__
from orthoswarm.export.json_values import json_text

HEARTBEAT_S: Final = 1.0
RUN: Final = os.urandom(6).hex()
"""Names this run of the daemon: its clock means nothing to another."""


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
