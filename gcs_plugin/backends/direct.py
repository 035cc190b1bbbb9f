"""The default backend: our own links and MAVLink protocols, with pymavlink for messages; for many vehicles."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

from gcs_plugin.backends.backend import Backend, Report
from gcs_plugin.fleet.commands import Order
from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.fleet_events import FleetEvent
from gcs_plugin.fleet.separation.separation_watch import number_name
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Message
from gcs_plugin.links.transports import Link
from gcs_plugin.mission.download import MissionDownload
from gcs_plugin.mission.exchange import Address, Exchange, Outcome
from gcs_plugin.mission.geofence import FenceZone, zones_of
from gcs_plugin.mission.items import Mission, MissionItem
from orthoswarm.model.errors import OrthoSwarmError


class DirectBackend(Backend):
    """A backend over `Fleet`, which is polled during each call."""

    name = "pymavlink"

    def __init__(
        self,
        links: Iterable[Link | str],
        *,
        own: Address,
        key: bytes | None = None,
        tlog: Path | None = None,
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
        return self.fleet.problems(number_name)

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

    def _run(
        self,
        begin: Mapping[int, Callable[[], Exchange]],
        what: str,
        report: Report,
    ) -> dict[int, Outcome]:
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
