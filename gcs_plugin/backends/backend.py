"""What a ground station can do with vehicles, whichever library talks to them."""

import abc
from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal

from gcs_plugin.fleet.fleet_events import FleetEvent
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.exchange import Outcome
from gcs_plugin.mission.items import Mission

Verb = Literal["start", "pause", "resume", "rtl"]
Report = Callable[[str, int, int], None]


class Backend(abc.ABC):
    """Vehicles on links. All calls wait until they are done; none does anything to a vehicle that it was not asked for.

    Attributes:
        name: for `--backend`.
        events: all that has happened so far.
    """

    name: str
    events: list[FleetEvent]

    @abc.abstractmethod
    def discover(self, wait_s: float, wanted: Collection[int] = ()) -> list[int]:
        """Look for vehicles: until all wanted ones are found, else until no further one appears; at most so long.

        Args:
            wait_s: longest time.
            wanted: system ids.

        Returns:
            The system ids that were found, in order.
        """

    @abc.abstractmethod
    def autopilot(self, system: int) -> Autopilot:
        """A vehicle's dialect."""

    @abc.abstractmethod
    def summaries(self) -> list[dict[str, Any]]:
        """The state of all vehicles as JSON values."""

    @abc.abstractmethod
    def problems(self) -> list[str]:
        """What is wrong with links, in words."""

    @abc.abstractmethod
    def upload(self, missions: Mapping[int, Mission], report: Report) -> dict[int, Outcome]:
        """Put missions into vehicles, all at once, and read them back.

        Args:
            missions: by system id.
            report: called with what is done, how much of it, out of how much.
        """

    @abc.abstractmethod
    def stored(self, systems: Collection[int], report: Report) -> dict[int, Mission | None]:
        """Read the missions that vehicles hold, all at once; None for one that does not hand it out.

        Args:
            systems: system ids.
            report: as for `upload`.
        """

    @abc.abstractmethod
    def command(self, verb: Verb, delays: Mapping[int, float], report: Report) -> dict[int, Outcome]:
        """Start, pause, resume or bring home vehicles.

        Args:
            verb: what to do.
            delays: seconds from now for each system id.
            report: as for `upload`.
        """

    @abc.abstractmethod
    def watch(self, systems: Collection[int], seconds: float, report: Callable[[FleetEvent], None]) -> bool:
        """Follow missions until each has ended, at most so long.

        Returns:
            True if all have ended.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of the links."""


ENDED = ("complete", "aborted")

_LATE_S = 5.0


def late_start(outcome: Outcome, late_s: float) -> Outcome:
    """A start that came too late for a plan that keeps vehicles apart by time says so."""
    if late_s <= _LATE_S:
        return outcome
    warning = f"it took off {late_s:.0f} s later than planned, so the plan's distances do not hold: watch it"
    return Outcome(True, f"{outcome.text}, but {warning}")
