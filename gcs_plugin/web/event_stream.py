"""The event stream over a WebSocket: changes as they happen, and each second a heartbeat with the daemon's time."""

import asyncio
import contextlib
import json
import time
from typing import Any, Final

from fastapi import WebSocket, WebSocketDisconnect

from gcs_plugin.daemon.store.event_bus import Events
from orthoswarm import __version__

HEARTBEAT_S: Final = 1.0


async def stream_events(socket: WebSocket, events: Events) -> None:
    """Send events as JSON texts, one per message, until the client disconnects.

    `hello` comes first, `heartbeat` each second; both carry `time`, the daemon's clock in UTC epoch seconds.
    """
    await socket.accept()
    subscription = events.subscribe()
    gone = asyncio.ensure_future(_until_gone(socket))
    news = asyncio.ensure_future(subscription.get())
    try:
        await socket.send_text(_text({"type": "hello", "version": __version__, "time": time.time()}))
        due = time.monotonic() + HEARTBEAT_S
        while not gone.done():
            wait_s = max(0.0, due - time.monotonic())
            await asyncio.wait({news, gone}, timeout=wait_s, return_when=asyncio.FIRST_COMPLETED)
            if time.monotonic() >= due:
                await socket.send_text(_text({"type": "heartbeat", "time": time.time()}))
                due = time.monotonic() + HEARTBEAT_S
            if news.done():
                for event in news.result():
                    await socket.send_text(_text(event))
                news = asyncio.ensure_future(subscription.get())
    except (WebSocketDisconnect, RuntimeError):
        pass
    finally:
        gone.cancel()
        news.cancel()
        events.unsubscribe(subscription)


def _text(event: dict[str, Any]) -> str:
    return json.dumps(event)


async def _until_gone(socket: WebSocket) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
