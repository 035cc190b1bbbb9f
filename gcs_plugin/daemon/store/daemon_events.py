"""What has happened, as the daemon's parts tell each other and the pages.

An event with a `page` name goes to the open pages as well, as JSON: `type` and its `values`, which pages and other
programs rely on; what pages alone are told is a `Told`. Which part hears which event stands in one table, in
`gcs_plugin.daemon.daemon`. The one bus, `Events`, hands them over in the publisher's thread; a page that is slow does
not hold anyone up.
"""

import asyncio
import contextlib
import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Final, Literal, TypeVar

from gcs_plugin.daemon.store.job_rows import Job
from orthoswarm.model.frame import Frame
from orthoswarm.model.placement import PlacedFrame, Solution
from orthoswarm.raster.picture_quality import PictureQuality


@dataclass(frozen=True, slots=True)
class Event:
    """Something that has happened."""

    page: ClassVar[str] = ""

    def values(self) -> Mapping[str, Any]:
        """What pages are told of it, as JSON values."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureStored(Event):
    """A picture is safe on the disk and in the journal.

    Attributes:
        seq: its number. arrived_s: UTC epoch seconds. has_fix: whether it has a valid position.
        count: how many of this vehicle have come since the daemon's start, with this one.
    """

    seq: int
    frame: Frame
    arrived_s: float
    sortie: int
    has_fix: bool
    count: int


@dataclass(frozen=True, slots=True)
class PictureDrawn(Event):
    """A picture is on the real-time layer, as recorded; `quality` is None for one that is too small to be judged."""

    placed: PlacedFrame
    quality: PictureQuality | None


@dataclass(frozen=True, slots=True)
class PictureRejected(Event):
    """A stored picture cannot be on the map; `misplaced`: because of its position."""

    frame: Frame
    reason: str
    misplaced: bool


@dataclass(frozen=True, slots=True)
class AreaChanged(Event):
    """The map's area began, was extended or moved; `epsg` is its grid."""

    epsg: int


@dataclass(frozen=True, slots=True)
class DrawingRestarted(Event):
    """All pictures are undrawn again, by the journal."""


@dataclass(frozen=True, slots=True)
class _SortieEvent(Event):
    """Something about a vehicle's sortie."""

    vehicle: str
    sortie: int


@dataclass(frozen=True, slots=True)
class FirstPicturesCame(_SortieEvent):
    """There are enough pictures of a sortie to look for them on the basemap."""


@dataclass(frozen=True, slots=True)
class VehicleLookedFor(_SortieEvent):
    """A sortie's pictures were looked for on the basemap.

    Attributes:
        solution: their refinement, with its state; None where they were not found. epsg: of the grid on which it lies.
    """

    epsg: int
    solution: Solution | None


@dataclass(frozen=True, slots=True)
class LegsOver(_SortieEvent):
    """Legs of a sortie are finished; `silent`: because its vehicle has fallen silent."""

    page: ClassVar[str] = "legs"
    silent: bool


@dataclass(frozen=True, slots=True)
class VehicleSilent(_SortieEvent):
    """No picture of a vehicle has come for a while."""


@dataclass(frozen=True, slots=True)
class CardRead(Event):
    """A vehicle's folder has stopped changing after new pictures."""

    vehicle: str


@dataclass(frozen=True, slots=True)
class MissionNoted(Event):
    """What a vehicle's mission came to is in the journal, with the refinement that it asks for; `kind`: see there."""

    vehicle: str
    kind: str


@dataclass(frozen=True, slots=True)
class JobEnded(Event):
    """A job's end is in the journal."""

    job: Job


@dataclass(frozen=True, slots=True)
class LayerPublished(Event):
    """A sortie is on the next generation of a refined layer, which has replaced the one before."""

    page: ClassVar[str] = "layer"
    layer: str
    version: int
    vehicle: str | None
    sortie: int | None


PageKind = Literal[
    "command", "completion", "coverage", "finds", "frame", "holds", "job", "layer", "log", "note", "overload", "people",
    "plan", "points", "problem", "refused", "requests", "traffic", "vehicle", "vehicle_event",
]  # fmt: skip
"""What pages alone are told: outcomes of commands and of refinements after completions, gaps, finds, pictures as they
are drawn or refused, surveyed points, who has which vehicle, jobs, pixels of the real-time layer, sentences for the
operator, other aircraft, changed values of a vehicle's row, and events of the fleet."""


@dataclass(frozen=True, slots=True)
class Told(Event):
    """Something that no part of the daemon acts on, for pages."""

    page: PageKind = "note"  # type: ignore[misc]
    told: Mapping[str, Any] = field(default_factory=dict)

    def values(self) -> Mapping[str, Any]:
        """What they are told, as JSON values."""
        return self.told


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

    def tell(self, page: PageKind, /, **values: Any) -> None:
        """Tell pages something, as JSON values; any thread."""
        self.publish(Told(page, values))

    def say(self, text: str) -> None:
        """Tell the operator a sentence, in the log too."""
        _log.info("%s", text)
        self.tell("note", text=text)

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
