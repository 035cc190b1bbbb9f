"""What a ground station can do with vehicles, whichever library talks to them."""

import abc
import time
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any

from gcs_plugin.fleet.commands import Verb
from gcs_plugin.fleet.fleet_events import FleetEvent
from gcs_plugin.fleet.takeoff_schedule import TakeoffSchedule
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.exchange import Outcome, Verdict
from gcs_plugin.mission.items import Mission

if TYPE_CHECKING:
    from gcs_plugin.fleet.commands import Order
    from gcs_plugin.fleet.preflight import Check
    from gcs_plugin.mission.track import Airspace

Report = Callable[[str, int, int], None]
Say = Callable[[str], None]


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
    def check(
        self,
        systems: Collection[int],
        missions: Mapping[int, Mission],
        stored: Mapping[int, Mission],
        starts: Mapping[int, float],
        legal_height_m: float,
    ) -> "list[Check]":
        """Check vehicles before their start, with what they say at this moment.

        Args:
            systems: the vehicles. missions: the plan's. stored: what was read from them.
            starts: takeoffs in seconds after the first. legal_height_m: height that may be flown without asking.
        """

    @abc.abstractmethod
    def command(
        self, verb: Verb, delays: Mapping[int, float], say: Say, airspace: "Airspace | None" = None
    ) -> "dict[int, Order]":
        """Give a command to vehicles, and wait for the outcome of each.

        A start that fails holds those that still wait on the ground; one that comes late moves them.

        Args:
            verb: what to do.
            delays: seconds from now for each system id.
            say: called with each outcome, and with what follows from it, at once.
            airspace: the missions that are started, so that later ones can be moved.
        """

    @abc.abstractmethod
    def pump(self, seconds: float) -> None:
        """Take what vehicles say, for so long at most."""

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


def command_all(
    delays: Mapping[int, float],
    begin: "Callable[[int], Order]",
    pump: Callable[[float], None],
    say: Say,
    airspace: "Airspace | None",
) -> "dict[int, Order]":
    """Give one command to each vehicle at its time and wait for all outcomes; see `Backend.command`."""
    schedule = TakeoffSchedule.of(delays, time.monotonic(), airspace)
    orders: dict[int, Order] = {}
    ended: set[int] = set()
    while len(ended) < len(delays):
        for system in schedule.due(time.monotonic()):
            orders[system] = begin(system)
        pump(0.05 if schedule.waiting else 0.2)
        for system, order in list(orders.items()):
            outcome = order.outcome
            if outcome is None or system in ended:
                continue
            ended.add(system)
            say(outcome.text)
            if order.verb != "start":
                continue
            if outcome.ok:
                for text in schedule.started(system, time.monotonic()):
                    say(text)
                continue
            for held in schedule.failed(system):
                ended.add(held)
                text = f"vehicle {held} stays on the ground, because vehicle {system} did not take off"
                orders[held] = type(order)(verb="start", system=held, given_s=time.monotonic(), id=order.id).end(
                    text, Verdict.NOT_SENT
                )
                say(text)
    return orders
