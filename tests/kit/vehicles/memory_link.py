"""Simulated vehicles on a link in memory, in simulated time: hours of flight in seconds, reproducibly."""

import selectors
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.reception import FleetEvent
from gcs_plugin.links.mavlink import Message
from gcs_plugin.links.packets import Framer
from gcs_plugin.links.signing import Packer
from gcs_plugin.links.transports import NEVER, Link, Peer
from gcs_plugin.mission.completion import MissionEvent
from gcs_plugin.mission.exchange import Address, Exchange, Outcome
from gcs_plugin.sim.simulated_swarm import NO_FAULTS, Channel, Faults
from gcs_plugin.sim.simulated_vehicle import SimVehicle


@dataclass(slots=True)
class VirtualClock:
    """A clock in seconds that is set by hand; utc_0: UTC epoch seconds at 0."""

    now: float = 0.0
    utc_0: float = 1_700_000_000.0

    def __call__(self) -> float:
        """Seconds."""
        return self.now

    def utc(self) -> float:
        """UTC epoch seconds."""
        return self.utc_0 + self.now


class SimLink(Link):
    """A link to simulated vehicles, each a separate peer: up from the ground to the vehicles, and down."""

    def __init__(
        self, vehicles: Sequence[SimVehicle], clock: VirtualClock, up: Faults = NO_FAULTS, down: Faults = NO_FAULTS
    ) -> None:
        super().__init__("simulation")
        self.vehicles, self._clock = list(vehicles), clock
        self.up: Channel[tuple[int, bytes]] = Channel(faults=up)
        self.down: Channel[tuple[int, bytes]] = Channel(faults=down)
        self._packers = [Packer(vehicle.system, 1) for vehicle in self.vehicles]
        self._framers = [Framer() for _ in self.vehicles]

    def open(self, selector: selectors.BaseSelector, now: float) -> None:
        """Does nothing: there is no file descriptor to wait for."""

    def close(self) -> None:
        """Does nothing: there is nothing to close."""

    @property
    def polled(self) -> Any:
        """Always read."""
        return self

    def greet(self) -> list[Peer]:
        """All vehicles."""
        return list(range(len(self.vehicles)))

    def send(self, peer: Peer, data: bytes, expires: float = NEVER) -> bool:
        """Hand bytes to the radio."""
        self.up.put((peer, data), self._clock.now, len(data))
        return True

    def receive(self, source: Any, events: int, now: float) -> Iterator[tuple[Peer, bytes]]:
        """Let the vehicles receive, advance to the present time, and send."""
        for peer, data in self.up.take(now):
            for packet in self._framers[peer].feed(data):
                sender = Address(packet.system, packet.component)
                self._say(peer, self.vehicles[peer].handle(packet.message, sender, now), now)
        for peer, vehicle in enumerate(self.vehicles):
            self._say(peer, vehicle.advance(now), now)
        yield from self.down.take(now)

    def _say(self, peer: int, messages: Sequence[Message], now: float) -> None:
        for message in messages:
            raw = self._packers[peer].pack(message, self._clock.utc())
            self.down.put((peer, raw), now, len(raw))


class World:
    """Simulated vehicles, by system id, and a fleet that watches them, stepped together in virtual time."""

    def __init__(
        self, vehicles: Sequence[SimVehicle], up: Faults = NO_FAULTS, down: Faults = NO_FAULTS, **options: Any
    ) -> None:
        self.clock = VirtualClock()
        self.vehicles = {vehicle.system: vehicle for vehicle in vehicles}
        self.link = SimLink(vehicles, self.clock, up, down)
        self.fleet = Fleet([self.link], clock=self.clock, wall=self.clock.utc, **options)
        self.events: list[FleetEvent] = []
        self.fleet.on_event(self.events.append)

    def __enter__(self) -> "World":
        return self

    def __exit__(self, *_: object) -> None:
        self.fleet.close()

    def until(self, done: Callable[[], bool], limit_s: float = 600.0, step_s: float = 0.02) -> bool:
        """Advance time until a condition holds or the limit; returns whether it holds."""
        end = self.clock.now + limit_s
        while not done() and self.clock.now < end:
            self.clock.now += step_s
            self.fleet.poll(0.0)
        return done()

    def wait(self, seconds: float) -> None:
        """Advance time."""
        self.until(lambda: False, seconds)

    def finish(self, *dialogues: Exchange, limit_s: float = 600.0) -> list[Outcome | None]:
        """Advance time until dialogues have ended; returns their outcomes."""
        self.until(lambda: all(dialogue.outcome is not None for dialogue in dialogues), limit_s)
        return [dialogue.outcome for dialogue in dialogues]

    def meet(self) -> None:
        """Advance time until all vehicles are found and their streams run."""
        self.until(lambda: all(v in self.fleet.vehicles for v in self.vehicles), 30.0)
        self.until(lambda: all(v.lat_deg is not None and v.landed for v in self.fleet.vehicles.values()), 30.0)

    def kinds(self, system: int) -> list[str]:
        """What has happened to a vehicle's mission."""
        missions = {event.value for event in MissionEvent}
        return [event.kind for event in self.events if event.system == system and event.kind in missions]
