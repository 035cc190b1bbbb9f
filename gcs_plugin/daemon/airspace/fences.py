"""The vehicles' geofences: read from each when it is heard, and again now and then while it is on the ground."""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from orthoswarm.model.errors import OrthoSwarmError

if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.mission.download import MissionDownload
    from gcs_plugin.mission.geofence import FenceZone

_AT_ONCE: Final = 4  # fences that are read at a time, so that links stay free
_AGAIN_S: Final = 60.0
_FAILED_S: Final = 15.0


@dataclass(slots=True)
class _Fence:
    """What is known of a vehicle's fence.

    Attributes:
        read: under way. due: when to read (again), monotonic. document: for the vehicle's row.
        zones: the same; both None until it was read.
    """

    due: float
    read: "MissionDownload | None" = None
    document: dict[str, Any] | None = None
    zones: "tuple[FenceZone, ...] | None" = None


class Fences:
    """Reads geofences, a few vehicles at once; whatever an operator asks for comes first and breaks the reading off."""

    def __init__(self, fleet: "Fleet", clock: Callable[[], float] = time.monotonic) -> None:
        self._fleet, self._clock = fleet, clock
        self._fences: dict[int, _Fence] = {}

    def look(self) -> None:
        """Take what has been read and begin what is due; in the fleet's thread."""
        from gcs_plugin.mission.geofence import zones_of

        now = self._clock()
        for fence in self._fences.values():
            if fence.read is None or fence.read.outcome is None:
                continue
            if fence.read.items is not None:
                fence.zones = tuple(zones_of(fence.read.items))
                zones = [zone.document() for zone in fence.zones]
                if fence.document is None or fence.document["zones"] != zones:
                    fence.document = {"zones": zones, "read_s": round(time.time(), 1)}
            fence.due = now + (_AGAIN_S if fence.read.outcome.ok else _FAILED_S)
            fence.read = None
        under_way = sum(fence.read is not None for fence in self._fences.values())
        for system, vehicle in self._fleet.vehicles.items():
            fence = self._fences.setdefault(system, _Fence(now))
            known_in_air = vehicle.armed and fence.document is not None
            if under_way < _AT_ONCE and fence.read is None and now >= fence.due and not known_in_air:
                with contextlib.suppress(OrthoSwarmError):  # lost, or busy with something else
                    fence.read = self._fleet.read_fence(system)
                    under_way += 1

    def zones(self) -> "dict[int, tuple[FenceZone, ...]]":
        """The zones of each vehicle whose fence has been read, by system id; from any thread."""
        return {s: fence.zones for s, fence in list(self._fences.items()) if fence.zones is not None}

    def of(self, system: int) -> dict[str, Any] | None:
        """A vehicle's geofence: `zones`, and `read_s`, when they were first read (epoch seconds); None before that."""
        fence = self._fences.get(system)
        return None if fence is None else fence.document
