"""Vehicles and finds to TAK programs as they change: Cursor-on-Target over UDP, TCP or TLS."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

from gcs_plugin.daemon.stoppable_thread import StoppableThread
from orthoswarm.export.tactical.cursor_on_target import TakAddress, TakSender, event
from orthoswarm.export.tactical.places import Place
from orthoswarm.model.errors import OrthoSwarmError

_EVERY_S: Final = 2.0
_FINDS_EVERY: Final = 15  # rounds after which all finds are sent again
_log = logging.getLogger(__name__)


class TakFeed:
    """Sends all vehicles every two seconds, and all finds when one is new or changed and every half minute.

    Attributes:
        problem: why a receiver gets nothing at present, else empty.
    """

    def __init__(self, addresses: Sequence[TakAddress], places: Callable[[], Sequence[Place]]) -> None:
        self._senders = [TakSender(address) for address in addresses]
        self._places = places
        self._thread = StoppableThread(self._run, "tak", join_s=10.0)
        self.problem = ""

    def start(self) -> None:
        """Start sending, if there is a receiver."""
        if self._senders:
            self._thread.start()

    def close(self) -> None:
        """Stop sending."""
        self._thread.close()
        for sender in self._senders:
            sender.close()

    def _run(self, stop: threading.Event) -> None:
        number, known = 0, set[Place]()
        while not stop.wait(_EVERY_S):
            try:
                places = self._places()
            except (OrthoSwarmError, TimeoutError) as error:
                _log.warning("TAK: %s", error)
                continue
            finds = {place for place in places if place.kind == "find"}
            everything = number % _FINDS_EVERY == 0 or not finds <= known
            number, known = number + 1, finds
            now = time.time()
            events = [event(place, now) for place in places if everything or place.kind == "vehicle"]
            self.problem = "; ".join(text for sender in self._senders if (text := _sent(sender, events)))


def _sent(sender: TakSender, events: Sequence[bytes]) -> str:
    """Send all events; returns the reason of a failure, else an empty text."""
    try:
        for one in events:
            sender.send(one)
    except OrthoSwarmError as error:
        return str(error)
    return ""
