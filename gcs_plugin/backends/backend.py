"""Vehicles as the command line sees them: the interface, and the default backend, our own links and protocols."""

import abc
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from gcs_plugin.config import HEARING
from gcs_plugin.fleet.commands import Order, Verb
from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.flight_state import Word, flight_state, summary
from gcs_plugin.fleet.preflight import Check, preflight_all
from gcs_plugin.fleet.reception import FleetEvent
from gcs_plugin.fleet.separation.takeoff_schedule import TakeoffSchedule
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Autopilot, Message
from gcs_plugin.links.transports import Link
from gcs_plugin.mission.download import MissionDownload
from gcs_plugin.mission.exchange import Address, Exchange, Outcome, Verdict
from gcs_plugin.mission.geofence import FenceZone, zones_of
from gcs_plugin.mission.items import Mission, MissionItem
from gcs_plugin.mission.plan_folder import NO_NEEDS, PlanNeeds
from gcs_plugin.mission.start_dialogue import Standing
from gcs_plugin.mission.track import Airspace
from orthoswarm.model.errors import OrthoSwarmError

Report = Callable[[str, int, int], None]
Say = Callable[[str], None]


class Backend(abc.ABC):
    """Vehicles on links. Calls block until they are done; a vehicle is changed only by `upload` and `command`.

    Attributes:
        name: for `--backend`. events: all so far.
    """

    name: str
    events: list[FleetEvent]

    @abc.abstractmethod
    def vehicles(self) -> Mapping[int, Vehicle]:
        """The vehicles that were found, by system id."""

    @abc.abstractmethod
    def vehicle(self, system: int) -> Vehicle:
        """One of them; raises InputError: it was not found."""

    @abc.abstractmethod
    def is_known(self, vehicle: Vehicle) -> bool:
        """Whether a vehicle has reported its state, so that there is no more to wait for."""

    def look(self) -> None:  # noqa: B027 (most backends have nothing to do)
        """Look for further vehicles, where `pump` does not find them by itself."""

    def discover(self, wait_s: float, wanted: Collection[int] = ()) -> list[int]:
        """Wait for vehicles: until all wanted ones are found, without `wanted` until no further one appears.

        Returns:
            The system ids that were found, in order.
        """
        end, found, since = time.monotonic() + wait_s, -1, 0.0
        while time.monotonic() < end:
            self.look()
            self.pump(0.1)
            vehicles = self.vehicles()
            if len(vehicles) != found:
                found, since = len(vehicles), time.monotonic()
            if not all(self.is_known(vehicle) for vehicle in vehicles.values()):
                continue
            if wanted and all(system in vehicles for system in wanted):
                break
            if not wanted and found and time.monotonic() - since > HEARING.all_found_s:
                break
        return sorted(self.vehicles())

    def hear_states(self, systems: Collection[int], wait_s: float) -> None:
        """Wait until vehicles have reported what a check before a start looks at: what is not known is not wrong."""
        end = time.monotonic() + wait_s
        while not all(self.vehicles()[s].ready_to_check for s in systems):
            left = end - time.monotonic()
            if left <= 0.0:
                return
            self.pump(min(left, 0.1))

    def autopilot(self, system: int) -> Autopilot:
        """The type of a vehicle's autopilot."""
        return self.vehicle(system).autopilot

    def summaries(self) -> list[dict[str, Any]]:
        """The state of all vehicles as JSON values."""
        now = time.monotonic()
        return [summary(vehicle, now) for _, vehicle in sorted(self.vehicles().items())]

    @abc.abstractmethod
    def problems(self) -> list[str]:
        """Problems of the links, one sentence each."""

    @abc.abstractmethod
    def upload(self, missions: Mapping[int, Mission], report: Report) -> dict[int, Outcome]:
        """Upload missions, by system id, to all vehicles at the same time, and read them back.

        `report` is called with a name of the step, the number of finished vehicles and their total.
        """

    @abc.abstractmethod
    def stored(self, systems: Collection[int], report: Report) -> dict[int, Mission | None]:
        """Download the missions of vehicles, all at the same time; None for a vehicle that does not answer."""

    @abc.abstractmethod
    def zones(self, systems: Collection[int], report: Report) -> dict[int, tuple[FenceZone, ...]]:
        """Download the zones of geofences; without those of vehicles that do not answer."""

    def check(
        self,
        systems: Collection[int],
        missions: Mapping[int, Mission],
        stored: Mapping[int, Mission],
        starts: Mapping[int, float],
        legal_height_m: float,
        *,
        needs: PlanNeeds = NO_NEEDS,
        zones: Mapping[int, tuple[FenceZone, ...]] | None = None,
    ) -> list[Check]:
        """Preflight check of vehicles with their present telemetry; for the values see `preflight_all`."""
        vehicles = {s: self.vehicle(s) for s in systems}
        return preflight_all(
            vehicles, missions, stored, starts, time.monotonic(),
            needs=needs, legal_height_m=legal_height_m, zones=zones,
        )  # fmt: skip

    @abc.abstractmethod
    def order(self, order: Order) -> Order:
        """Give a command to a vehicle; its outcome is set some time later, during `pump`."""

    @abc.abstractmethod
    def send(self, system: int, messages: Sequence[Message]) -> None:
        """Send messages to a vehicle without waiting for answers."""

    def command(
        self,
        verb: Verb,
        delays: Mapping[int, float],
        say: Say,
        airspace: Airspace | None = None,
        *,
        standing: Mapping[int, Standing] | None = None,
        missions: "Mapping[int, Mission] | None" = None,
        pump: Callable[[float], None] | None = None,
    ) -> dict[int, Order]:
        """Send a command to vehicles, each so many seconds from now, and wait for the outcome of each.

        A failed start cancels the takeoffs that are still due; a late one delays them.

        Args:
            say: called at once with each outcome and its consequences.
            airspace: the missions that are started, so that takeoffs that are still due can be delayed.
            standing, missions: of a start, what the vehicles were when it was given, and what was checked.
            pump: processes messages meanwhile; default `self.pump`.
        """

        def begin(system: int) -> Order:
            then, mission = (standing or {}).get(system), (missions or {}).get(system)
            order = Order(verb=verb, system=system, given_s=time.monotonic(), standing=then, mission=mission)
            return self.order(order)

        return command_all(delays, begin, pump or self.pump, say, airspace)

    @abc.abstractmethod
    def pump(self, seconds: float) -> None:
        """Process messages of vehicles for at most so many seconds."""

    def watch(self, systems: Collection[int], seconds: float, report: Callable[[FleetEvent], None]) -> bool:
        """Follow missions until each has ended and no vehicle flies home any more, for at most so many seconds.

        PX4 ends a mission when its RTL begins, up to a minute before it has landed.

        Returns:
            True if all have ended.
        """
        end, reported = time.monotonic() + seconds, 0
        while True:
            for event in self.events[reported:]:
                if event.system in systems or not systems:
                    report(event)
            reported = len(self.events)
            ended = {event.system for event in self.events if event.kind in ("complete", "aborted")}
            vehicles = self.vehicles()
            followed = set(systems) or set(vehicles)
            words = {flight_state(vehicle).word for system, vehicle in vehicles.items() if system in followed}
            if followed and followed <= ended and not words & {Word.RETURNING, Word.LANDING}:
                return True
            if time.monotonic() >= end:
                return False
            self.look()
            self.pump(0.2)

    @abc.abstractmethod
    def close(self) -> None:
        """Close the links."""


def command_all(
    delays: Mapping[int, float],
    begin: Callable[[int], Order],
    pump: Callable[[float], None],
    say: Say,
    airspace: Airspace | None,
) -> dict[int, Order]:
    """Send one command to each vehicle at its time and wait for all outcomes; see `Backend.command`."""
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
                now = time.monotonic()
                for text in schedule.started(system, now, "vehicle {}".format, order.begun_s):
                    say(text)
                continue
            for cancelled in schedule.failed(system):
                ended.add(cancelled)
                text = f"vehicle {cancelled} stays on the ground, because vehicle {system} did not take off"
                unsent = Order(verb="start", system=cancelled, given_s=time.monotonic(), id=order.id)
                orders[cancelled] = unsent.end(text, Verdict.NOT_SENT)
                say(text)
    return orders


class DirectBackend(Backend):
    """A backend over `Fleet`, which is polled during each call."""

    name = "pymavlink"

    def __init__(
        self, links: Iterable[Link | str], *, own: Address, key: bytes | None = None, tlog: Path | None = None
    ) -> None:
        self.fleet = Fleet(links, own=own, key=key, tlog=tlog)
        self.events: list[FleetEvent] = []
        self.fleet.on_event(self.events.append)

    def vehicles(self) -> Mapping[int, Vehicle]:
        """The fleet's vehicles."""
        return self.fleet.vehicles

    def vehicle(self, system: int) -> Vehicle:
        """One of them."""
        return self.fleet.vehicle(system)

    def is_known(self, vehicle: Vehicle) -> bool:
        """Whether it has answered what the fleet asks at first."""
        return vehicle.reported and bool(vehicle.landed)

    def problems(self) -> list[str]:
        """See `Fleet.problems`."""
        return self.fleet.problems()

    def upload(self, missions: Mapping[int, Mission], report: Report) -> dict[int, Outcome]:
        """All uploads at the same time."""
        begin = {s: (lambda s=s, m=m: self.fleet.upload(s, m)) for s, m in missions.items()}
        return self._run(begin, "upload", report)

    def stored(self, systems: Collection[int], report: Report) -> dict[int, Mission | None]:
        """All downloads at the same time."""
        items = self._downloaded(self.fleet.download, systems, report)
        return {s: Mission(self.fleet.vehicles[s].autopilot, items[s]) if s in items else None for s in systems}

    def zones(self, systems: Collection[int], report: Report) -> dict[int, tuple[FenceZone, ...]]:
        """All downloads at the same time."""
        found = self._downloaded(self.fleet.read_fence, systems, report)
        return {system: tuple(zones_of(items)) for system, items in found.items()}

    def _downloaded(
        self, download: Callable[[int], MissionDownload], systems: Collection[int], report: Report
    ) -> dict[int, tuple[MissionItem, ...]]:
        """The lists that vehicles give, without those that do not."""
        jobs: dict[int, MissionDownload] = {}

        def begin(system: int) -> Exchange:
            jobs[system] = download(system)
            return jobs[system]

        self._run({system: partial(begin, system) for system in systems}, "read", report)
        return {system: tuple(job.items) for system, job in jobs.items() if job.items is not None}

    def order(self, order: Order) -> Order:
        """Give a command."""
        return self.fleet.order(order)

    def send(self, system: int, messages: Sequence[Message]) -> None:
        """Send on the vehicle's best link."""
        self.fleet.send(system, messages)

    def pump(self, seconds: float) -> None:
        """Poll the fleet."""
        self.fleet.poll(seconds)

    def close(self) -> None:
        """Close the fleet."""
        self.fleet.close()

    def _run(self, begin: Mapping[int, Callable[[], Exchange]], what: str, report: Report) -> dict[int, Outcome]:
        """Begin all exchanges and poll until each has ended."""
        outcomes: dict[int, Outcome] = {}
        jobs: dict[int, Exchange] = {}
        for system, start in begin.items():
            try:
                jobs[system] = start()
            except OrthoSwarmError as error:
                outcomes[system] = Outcome(ok=False, text=str(error))
        while len(outcomes) < len(begin):
            self.fleet.poll(0.2)
            for system, job in jobs.items():
                if job.outcome is not None and system not in outcomes:
                    outcomes[system] = job.outcome
            report(what, len(outcomes), len(begin))
        return outcomes
