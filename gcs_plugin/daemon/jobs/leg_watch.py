"""Detects finished legs in flight and asks for their coarse maps; fast enough to be called for every frame.

It also detects when a vehicle falls silent, which may be the end of a leg, or of pictures that arrived late.
"""

import logging
import threading
import time
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from gcs_plugin.config import SORTIE
from gcs_plugin.daemon.stoppable_thread import Background
from gcs_plugin.daemon.store.daemon_events import Events, LegsOver, PictureStored, VehicleSilent
from orthoswarm.model.earth import DEGREE_M
from orthoswarm.trajectory.legs import ended_legs

_LOOK_S: Final = 0.5
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Path:
    """Times and positions of a sortie's pictures since the last leg that was asked for."""

    times: list[float] = field(default_factory=list)
    places: list[tuple[float, float]] = field(default_factory=list)
    heard: float = 0.0
    dirty: bool = False


class LegWatch(Background):
    """Watches the paths of all vehicles, in a thread.

    Args:
        events: told of finished legs, and of a vehicle that falls silent, however few pictures it sent before.

    Attributes:
        silent_s: a vehicle is silent when no picture has arrived for so long, seconds.
    """

    def __init__(self, events: Events, *, silent_s: float) -> None:
        super().__init__("legs")
        self._events, self.silent_s = events, silent_s
        self._lock = threading.Lock()
        self._paths: dict[tuple[str, int], _Path] = {}

    def picture_stored(self, event: PictureStored) -> None:
        """Record a picture that has come; one without a position says nothing of the path."""
        if event.has_fix:
            frame = event.frame
            time_s = event.arrived_s if frame.time_s is None else frame.time_s
            self.add(frame.vehicle, event.sortie, time_s, frame.fix.lat_deg, frame.fix.lon_deg)

    def add(self, vehicle: str, sortie: int, time_s: float, lat_deg: float, lon_deg: float) -> None:
        """Record a picture; any thread."""
        with self._lock:
            path = self._paths.setdefault((vehicle, sortie), _Path())
            path.times.append(time_s)
            path.places.append((lat_deg, lon_deg))
            path.heard, path.dirty = time.monotonic(), True

    def _run(self) -> None:
        while not self._stop.wait(min(_LOOK_S, 0.25 * self.silent_s)):
            now = time.monotonic()
            with self._lock:
                due = [
                    (key, path)
                    for key, path in self._paths.items()
                    if (path.dirty and len(path.times) >= SORTIE.coarse_map_pictures)
                    or 0 < path.heard < now - self.silent_s
                ]
            for key, path in due:
                try:
                    self._look(key, path, now)
                except Exception:  # an error in one path must not end the watch of the others
                    _log.exception("the legs of %s", key[0])

    def _look(self, key: tuple[str, int], path: _Path, now: float) -> None:
        with self._lock:
            order = sorted(range(len(path.times)), key=path.times.__getitem__)
            times = [path.times[k] for k in order]
            places = [path.places[k] for k in order]
            silent = now - path.heard > self.silent_s
            path.dirty = False
            if silent:
                path.heard = 0.0  # reported once
        if silent:
            self._events.publish(VehicleSilent(*key))
        if len(times) < SORTIE.coarse_map_pictures:
            return
        lat, lon = np.array(places).T
        north = (lat - lat[0]) * DEGREE_M
        east = (lon - lon[0]) * DEGREE_M * np.cos(np.radians(lat[0]))
        legs = ended_legs(np.column_stack([east, north]), np.array(times), over=silent)
        if sum(last + 1 - first for first, last in legs) < SORTIE.coarse_map_pictures:
            return
        with self._lock:
            past = set(times[: legs[-1][1] + 1])
            keep = [k for k, t in enumerate(path.times) if t not in past]
            path.times = [path.times[k] for k in keep]
            path.places = [path.places[k] for k in keep]
        self._events.publish(LegsOver(*key, silent))
