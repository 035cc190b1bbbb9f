"""The daemon's one bus: events go to the parts that asked for them, in the publisher's thread, and to open pages.

A page that is slow does not hold anyone up.
"""

import asyncio
import contextlib
import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Final, TypeVar

from gcs_plugin.daemon.store.daemon_events import Event, Note

Happened = TypeVar("Happened", bound=Event)
_log = logging.getLogger(__name__)
_MOST_WAITING: Final = 2000  # events of one page; it is told that it missed some


class Subscription:
    """One page's queue; one that falls far behind is told to reload everything instead."""

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
    """Hands events to the parts that asked for them, and to the open pages."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pages: set[Subscription] = set()
        self._handlers: dict[type[Event], list[Callable[[Any], None]]] = {}

    def on(self, kind: type[Happened], handler: Callable[[Happened], None]) -> None:
        """Call a function with each event of a kind, before the daemon starts.

        It runs in the thread that publishes, after those that asked before; what it raises, the publisher gets.
        """
        self._handlers.setdefault(kind, []).append(handler)

    def publish(self, event: Event) -> None:
        """Hand an event to its handlers and all pages; any thread."""
        if event.page:
            with self._lock:
                pages = list(self._pages)
            for page in pages:
                page.put({"type": event.page, **event.values()})
        for handler in self._handlers.get(type(event), ()):
            handler(event)

    def say(self, text: str) -> None:
        """Tell the operator something, in the log too."""
        _log.info("%s", text)
        self.publish(Note(text))

    def subscribe(self) -> Subscription:
        """Start listening, in the running event loop; for a page."""
        subscription = Subscription(asyncio.get_running_loop())
        with self._lock:
            self._pages.add(subscription)
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """Stop listening."""
        with self._lock:
            self._pages.discard(subscription)
