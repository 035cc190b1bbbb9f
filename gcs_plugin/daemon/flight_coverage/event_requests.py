"""Camera events that a link has lost are asked for again (MAVLink camera protocol).

CAMERA_IMAGE_CAPTURED counts the pictures of a camera. A number that is left out was an exposure whose message did not
come: the camera sends it again on MAV_CMD_REQUEST_MESSAGE with that number. ArduPilot's CAMERA_FEEDBACK cannot be asked
for.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.links.mavlink import Message, dialect

if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.fleet.vehicle_state import Vehicle

_CAPTURED: Final = int(dialect.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED)
_REQUEST: Final = int(dialect.MAV_CMD_REQUEST_MESSAGE)
_AT_ONCE: Final = 5  # numbers that are asked for in one go
_TRIES: Final = 8  # requests for one number
_AGAIN_S: Final = 2.0
_LONGEST_HOLE: Final = 200
"""A camera whose numbers jump by more has restarted its count."""


@dataclass(slots=True)
class _Camera:
    """What is known of a camera's numbers: the highest, and those left out with tries made and the time of the last."""

    highest: int | None = None
    missing: dict[int, tuple[int, float]] = field(default_factory=dict)


class EventRequests:
    """Asks vehicles' cameras for the events that have not come; runs in the links' thread.

    Args:
        fleet: the vehicles.
    """

    def __init__(self, fleet: "Fleet") -> None:
        self._fleet = fleet
        self._cameras: dict[tuple[int, int], _Camera] = {}
        fleet.subscribe(self._captured, "CAMERA_IMAGE_CAPTURED")
        fleet.subscribe(self._tick, "HEARTBEAT")

    def _captured(self, vehicle: "Vehicle", message: Any, _: float) -> None:
        camera = self._cameras.setdefault((vehicle.system, int(message.get_srcComponent())), _Camera())
        number, highest = int(message.image_index), camera.highest
        camera.missing.pop(number, None)
        if highest is None or not highest - _LONGEST_HOLE <= number <= highest + _LONGEST_HOLE:
            camera.highest, camera.missing = number, {}
            return
        camera.missing |= dict.fromkeys(range(highest + 1, number), (0, 0.0))
        camera.highest = max(highest, number)

    def _tick(self, vehicle: "Vehicle", _: Any, utc_s: float) -> None:
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
