"""Vehicles report on their links when their camera takes a picture: these reports are kept in the journal.

A vehicle is asked again for a report that did not come.

CAMERA_IMAGE_CAPTURED counts the pictures of a camera. A number that is left out was an exposure whose message did not
come: the camera sends it again on MAV_CMD_REQUEST_MESSAGE with that number (MAVLink camera protocol). ArduPilot's
CAMERA_FEEDBACK cannot be asked for.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from gcs_plugin.daemon.store.frame_rows import Exposed, all_exposures, exposures_added
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.separation.separation_watch import VehicleNames
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Message, dialect
from orthoswarm.coverage.missing_pictures import CameraEvent
from orthoswarm.model.geo import LocalGrid

MESSAGES: Final = ("CAMERA_IMAGE_CAPTURED", "CAMERA_FEEDBACK")
_AFTER_2001_S: Final = 1e9
_CAPTURED: Final = int(dialect.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED)
_REQUEST: Final = int(dialect.MAV_CMD_REQUEST_MESSAGE)
_AT_ONCE: Final = 5  # numbers that are asked for in one go
_TRIES: Final = 8  # requests for one number
_AGAIN_S: Final = 2.0
_LONGEST_HOLE: Final = 200
"""A camera whose numbers jump by more has restarted its count."""


class ExposureJournal:
    """Takes camera events from the links' thread; the coverage's thread writes them into the journal and reads them."""

    def __init__(self, journal: Journal, names: VehicleNames) -> None:
        self._journal, self._names = journal, names
        self._fresh: deque[Exposed] = deque()
        self._kinds: dict[int, str] = {}
        self._boot_s: dict[int, float] = {}
        self._last: dict[int, tuple[int, float]] = {}

    def message(self, vehicle: Vehicle, message: Any, utc_s: float) -> None:
        """Process a message of MESSAGES; of a vehicle that sends both kinds, only the kind received first is used."""
        kind, system = message.get_type(), vehicle.system
        if self._kinds.setdefault(system, kind) != kind:
            return
        if kind == "CAMERA_FEEDBACK":
            number, time_s, lat, lon = message.img_idx, message.time_usec * 1e-6, message.lat, message.lng
        elif message.capture_result == 0:
            return  # the camera failed
        else:
            number, lat, lon = message.image_index, message.lat, message.lon
            time_s = self._dated(system, message, utc_s)
        if self._last.get(system) == (number, time_s):
            return  # a repetition
        self._last[system] = number, time_s
        place = (lat * 1e-7, lon * 1e-7) if lat or lon else (None, None)
        taken_s = time_s if time_s > _AFTER_2001_S else utc_s  # a clock without a date: when it came
        self._fresh.append((self._names.name_of(system), int(number), taken_s, *place))

    def _dated(self, system: int, message: Any, utc_s: float) -> float:
        """When a picture was taken; without a date in it, by the time since boot, since an event may come late."""
        boot_s = message.time_boot_ms * 1e-3
        late_s = self._boot_s[system] = min(utc_s - boot_s, self._boot_s.get(system, utc_s))
        dated_s = float(message.time_utc) * 1e-6
        return dated_s if dated_s > _AFTER_2001_S else boot_s + late_s

    def write(self) -> bool:
        """Write the events since the last call; returns whether there were any."""
        rows = [self._fresh.popleft() for _ in range(len(self._fresh))]
        if rows:
            self._journal.write(exposures_added(rows))
        return bool(rows)

    def events(self, grid: LocalGrid) -> list[CameraEvent]:
        """All events in grid coordinates, without heights."""
        found = []
        for vehicle, number, time_s, lat, lon in all_exposures(self._journal):
            place = None if lat is None or lon is None else np.array([*grid.to_grid(lat, lon), 0.0])
            found.append(CameraEvent(vehicle, number, time_s, place))
        return found


@dataclass(slots=True)
class _Camera:
    """What is known of a camera's numbers: the highest, and those left out with tries made and the time of the last."""

    highest: int | None = None
    missing: dict[int, tuple[int, float]] = field(default_factory=dict)


class EventRequests:
    """Asks vehicles' cameras for the events that have not come; runs in the links' thread."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._cameras: dict[tuple[int, int], _Camera] = {}
        fleet.subscribe(self._captured, "CAMERA_IMAGE_CAPTURED")
        fleet.subscribe(self._tick, "HEARTBEAT")

    def _captured(self, vehicle: Vehicle, message: Any, _: float) -> None:
        camera = self._cameras.setdefault((vehicle.system, int(message.get_srcComponent())), _Camera())
        number, highest = int(message.image_index), camera.highest
        camera.missing.pop(number, None)
        if highest is None or not highest - _LONGEST_HOLE <= number <= highest + _LONGEST_HOLE:
            camera.highest, camera.missing = number, {}
            return
        camera.missing |= dict.fromkeys(range(highest + 1, number), (0, 0.0))
        camera.highest = max(highest, number)

    def _tick(self, vehicle: Vehicle, _: Any, utc_s: float) -> None:
        for (system, component), camera in self._cameras.items():
            if system == vehicle.system:
                self._fleet.send(system, _requests(system, component, camera, utc_s))


def _requests(system: int, component: int, camera: _Camera, utc_s: float) -> list[Message]:
    """Commands for a few of the missing events, the oldest first; those asked for often enough are given up."""
    due = [n for n, (_, asked_s) in sorted(camera.missing.items()) if utc_s - asked_s >= _AGAIN_S][:_AT_ONCE]
    for number in due:
        tries = camera.missing[number][0] + 1
        camera.missing[number] = tries, utc_s
        if tries >= _TRIES:
            del camera.missing[number]
    return [
        dialect.MAVLink_command_long_message(system, component, _REQUEST, 0, _CAPTURED, number, 0, 0, 0, 0, 0)
        for number in due
    ]
