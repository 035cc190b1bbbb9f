"""What happens to the vehicles of a fleet, as values and in words."""

from dataclasses import dataclass
from typing import Final

from gcs_plugin.mission.completion import MissionEvent

_WORDS: Final = {
    MissionEvent.STARTED: "has started its mission",
    MissionEvent.SUSPENDED: "has left its mission",
    MissionEvent.RESUMED: "goes on with its mission",
    MissionEvent.COMPLETE: "has completed its mission",
    MissionEvent.ABORTED: "has ended its mission without completing it",
}

Pair = tuple[int, int]
"""System ids of two vehicles, in order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetEvent:
    """Something that happened to a vehicle.

    Attributes:
        kind: `found`, `lost`, `regained`, `rebooted`, `link` (commands go another way), `conflict` (several vehicles
            with one system id), `single` (no longer), `near` (too near another vehicle), `apart` (no longer), `behind`
            (later on its mission than plans allow for), `caught_up` (no longer: it has ended), `text`, or a mission's
            `started`, `suspended`, `resumed`, `complete`, `aborted`.
        system: system id.
        time_s: UTC epoch seconds.
        text: one sentence.
        pair: the two that `near` and `apart` are about.
        severity: of a `text`, MAVLink's MAV_SEVERITY (0 emergency ... 6 information).
    """

    kind: str
    system: int
    time_s: float
    text: str
    pair: Pair | None = None
    severity: int = 6


def mission_event(event: MissionEvent) -> tuple[str, str]:
    """Kind and words of what has happened to a mission."""
    return event.value, _WORDS[event]
