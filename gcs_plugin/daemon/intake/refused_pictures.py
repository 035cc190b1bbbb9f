"""Counts of pictures that were refused, dropped or left off the map, by cause, with recent ones as problems."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from gcs_plugin.daemon.store.daemon_events import PictureRefused, PictureRejected
from gcs_plugin.daemon.store.event_bus import Events
from orthoswarm.export.product_files import iso_time

CAUSES: Final = {
    "disk": "the workspace's disk is full or gone",
    "pose": "the pose is wrong or missing",
    "picture": "the file is not a picture, or too large",
    "time": "the upload stood still",
    "name": "another picture of the vehicle has the name",
    "place": "the picture's position cannot be on the map",
    "map": "the picture cannot be drawn",
}
_NEWS_S: Final = 600.0


@dataclass(slots=True)
class _Refusals:
    count: int
    vehicle: str
    image: str
    reason: str
    time_s: float


class RefusedPictures:
    """Counts them since the daemon's start; any thread.

    Args:
        events: told of each. clock: UTC epoch seconds.
    """

    def __init__(self, events: Events, clock: Callable[[], float] = time.time) -> None:
        self._events, self._clock = events, clock
        self._lock = threading.Lock()
        self._by_cause: dict[str, _Refusals] = {}

    def note(self, cause: str, reason: str, vehicle: str = "", image: str = "") -> None:
        """Count one.

        Args:
            cause: one of CAUSES. reason: in a sentence. vehicle, image: as far as known.
        """
        with self._lock:
            before = self._by_cause.get(cause)
            count = 1 if before is None else before.count + 1
            self._by_cause[cause] = _Refusals(count, vehicle, image, reason, self._clock())
        self._events.publish(PictureRefused(cause, count, vehicle, image, reason))

    def picture_rejected(self, event: PictureRejected) -> None:
        """Count a stored picture that cannot be on the map."""
        self.note("place" if event.misplaced else "map", event.reason, event.frame.vehicle, event.frame.image)

    def note_name_taken(self, vehicle: str, image: str) -> None:
        """Count a picture whose name another one of the vehicle has; the first one stays."""
        text = f"{vehicle} sent another picture by a name that it used before"
        self.note("name", f"{text}; have its camera or computer count on, and send it again", vehicle, image)

    @property
    def counts(self) -> dict[str, int]:
        """Cause -> how many; every cause is there."""
        with self._lock:
            return {cause: self._by_cause[cause].count if cause in self._by_cause else 0 for cause in CAUSES}

    def rows(self) -> list[dict[str, Any]]:
        """A row per cause with `cause`, `text`, `count` and the last one's `vehicle`, `image`, `reason`, `time`."""
        with self._lock:
            return [
                {
                    "cause": cause, "text": CAUSES[cause], "count": r.count, "vehicle": r.vehicle, "image": r.image,
                    "reason": r.reason, "time": iso_time(r.time_s),
                }
                for cause, r in self._by_cause.items()
            ]  # fmt: skip

    def problems(self) -> list[str]:
        """A sentence for each cause of the last ten minutes."""
        now = self._clock()
        with self._lock:
            recent = [r for r in self._by_cause.values() if now - r.time_s < _NEWS_S]
        return [f"{r.count} picture{'s' * (r.count > 1)} refused or not on the map: {r.reason}" for r in recent]
