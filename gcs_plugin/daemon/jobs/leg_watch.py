"""Notices, while vehicles fly, when a leg is over, and asks for its coarse map; cheap enough for every frame.

It notices, too, when a vehicle falls silent: that may be the end of a leg, and of pictures that came late.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from orthoswarm.refine.flight.finished_legs import ended_legs

FEWEST: Final = 10
"""New pictures of legs that are over, before a coarse map of them is worth its while."""
_LOOK_S: Final = 0.5
_SILENT_S: Final = 8.0
_METRES_A_DEGREE: Final = 111_320.0
_log = logging.getLogger(__name__)

Ask = Callable[[str, int, bool], None]


@dataclass(slots=True)
class _Path:
    """Where a sortie's pictures were taken since the last leg that was asked for."""

    times: list[float] = field(default_factory=list)
    places: list[tuple[float, float]] = field(default_factory=list)
    heard: float = 0.0
    dirty: bool = False


class LegWatch:
    """Watches the paths of all vehicles, in a thread.

    Args:
        ask: called with vehicle, sortie and whether it has fallen silent, when legs are over.
        silent: called with vehicle and sortie when no picture has come for 8 s, however few came before.
    """

    def __init__(self, ask: Ask, silent: Callable[[str, int], None] = lambda vehicle, sortie: None) -> None:
        self._ask, self._silent = ask, silent
        self._lock = threading.Lock()
        self._paths: dict[tuple[str, int], _Path] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="legs", daemon=True)

    def start(self) -> None:
        """Begin to watch."""
        self._thread.start()

    def close(self) -> None:
        """Watch no more."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(5.0)

    def add(self, vehicle: str, sortie: int, time_s: float, lat_deg: float, lon_deg: float) -> None:
        """A picture has come; any thread."""
        with self._lock:
            path = self._paths.setdefault((vehicle, sortie), _Path())
            path.times.append(time_s)
            path.places.append((lat_deg, lon_deg))
            path.heard, path.dirty = time.monotonic(), True

    def _run(self) -> None:
        while not self._stop.wait(_LOOK_S):
            now = time.monotonic()
            with self._lock:
                due = [
                    (key, path)
                    for key, path in self._paths.items()
                    if (path.dirty and len(path.times) >= FEWEST) or 0 < path.heard < now - _SILENT_S
                ]
            for key, path in due:
                try:
                    self._look(key, path, now)
                except Exception:  # whatever one path looks like, the others are watched on
                    _log.exception("the legs of %s", key[0])

    def _look(self, key: tuple[str, int], path: _Path, now: float) -> None:
        with self._lock:
            order = sorted(range(len(path.times)), key=path.times.__getitem__)
            times = [path.times[k] for k in order]
            places = [path.places[k] for k in order]
            silent = now - path.heard > _SILENT_S
            path.dirty = False
            if silent:
                path.heard = 0.0  # told once
        if silent:
            self._silent(*key)
        if len(times) < FEWEST:
            return
        lat, lon = np.array(places).T
        north = (lat - lat[0]) * _METRES_A_DEGREE
        east = (lon - lon[0]) * _METRES_A_DEGREE * np.cos(np.radians(lat[0]))
        legs = ended_legs(np.column_stack([east, north]), np.array(times), over=silent)
        if sum(last + 1 - first for first, last in legs) < FEWEST:
            return
        with self._lock:
            past = set(times[: legs[-1][1] + 1])
            keep = [k for k, t in enumerate(path.times) if t not in past]
            path.times = [path.times[k] for k in keep]
            path.places = [path.places[k] for k in keep]
        self._ask(key[0], key[1], silent)
