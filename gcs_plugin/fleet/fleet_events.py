"""What happens to the vehicles of a fleet, as values and in words."""

from dataclasses import dataclass
from typing import Final

from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.mission.completion import MissionEvent
from gcs_plugin.mission.flight_modes import HOLDS

_WORDS: Final = {
    MissionEvent.STARTED: "has started its mission",
    MissionEvent.RESUMED: "goes on with its mission",
    MissionEvent.COMPLETE: "has completed its mission",
}

Pair = tuple[int, int]
"""System ids of two vehicles, in order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetEvent:
    """Something that happened to a vehicle, with UTC epoch seconds, in one sentence.

    Attributes:
        kind: `found`, `lost`, `regained`, `rebooted`, `link` (commands go another way), `conflict` (several vehicles
            with one system id), `single` (no longer), `near` (too near another vehicle), `apart` (no longer), `behind`
            (later on its mission than plans allow for), `caught_up` (no longer), `danger` (`Vehicle.danger`), `safe`
            (no longer), `text`, or a mission's `started`, `suspended`, `resumed`, `complete`, `aborted`.
        pair: the two that `near` and `apart` are about.
        severity: of a `text`, MAVLink's MAV_SEVERITY (0 emergency ... 6 information).
    """

    kind: str
    system: int
    time_s: float
    text: str
    pair: Pair | None = None
    severity: int = 6


def mission_event(event: MissionEvent, vehicle: Vehicle) -> tuple[str, str]:
    """Kind and words of what has happened to a vehicle's mission."""
    if event is MissionEvent.ABORTED:
        flown = vehicle.detector.flown
        return event.value, f"has ended its mission: {flown.text if flown else 'it was not completed'}"
    if event is MissionEvent.SUSPENDED:
        return event.value, _left(vehicle)
    return event.value, _WORDS[event]


def _left(vehicle: Vehicle) -> str:
    """Why a vehicle is off its mission, as far as its mode tells; that may come a second later than its mission's."""
    if vehicle.failsafe:
        return "has left its mission in a failsafe"
    if vehicle.custom_mode == vehicle.modes.mission:
        return "has interrupted its mission"
    return f"has {'paused' if vehicle.mode in HOLDS else 'left'} its mission and is in {vehicle.mode}"
