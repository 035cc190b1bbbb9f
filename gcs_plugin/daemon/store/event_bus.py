"""Events from the daemon to listeners: published from any thread, without waiting for slow listeners."""

import asyncio
import contextlib
import threading
from collections import deque
from typing import Any, Final

_MOST_WAITING: Final = 2000  # events of one listener; it is told that it missed some


class Subscription:
    """One listener's queue.

    If it falls far behind, the oldest events are dropped and it is told to reload everything.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop, self._bell = loop, asyncio.Event()
        self._waiting: deque[dict[str, Any]] = deque(maxlen=_MOST_WAITING)
        self._missed = False

    def put(self, event: dict[str, Any]) -> None:
        """Add an event; any thread."""
        if len(self._waiting) == _MOST_WAITING:
            self._missed = True
        self._waiting.append(event)
        with contextlib.suppress(RuntimeError):  # the event loop has ended
            self._loop.call_soon_threadsafe(self._bell.set)

    async def get(self) -> list[dict[str, Any]]:
        """All events since the last call; waits for at least one."""
        while not self._waiting:
            self._bell.clear()
            if not self._waiting:
                await self._bell.wait()
        if self._missed:
            self._missed = False
            self._waiting.clear()
            return [{"type": "resync"}]
        news = []
        while self._waiting:
            news.append(self._waiting.popleft())
        return news


class Events:
    """Passes events to all listeners."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._listeners: set[Subscription] = set()

    def publish(self, kind: str, /, **fields: Any) -> None:
        """Pass an event to all listeners; any thread."""
        with self._lock:
            listeners = list(self._listeners)
        for listener in listeners:
            listener.put({"type": kind, **fields})

    def subscribe(self) -> Subscription:
        """Start listening, in the running event loop."""
        subscription = Subscription(asyncio.get_running_loop())
        with self._lock:
            self._listeners.add(subscription)
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """Stop listening."""
        with self._lock:
            self._listeners.discard(subscription)
