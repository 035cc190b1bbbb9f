"""The vehicles on the links: finding, losing, routing by system id, streams, dialogues, the completion of missions.

One thread polls it (`poll`, or `run` until it is told to stop); other threads hand in work with `call`. Nothing that a
vehicle could act on is sent unless somebody asked for it: the fleet by itself sends its heartbeat, which announces a
ground station, and asks for streams.
"""

import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Final, TypeVar

from gcs_plugin.fleet.fleet_events import FleetEvent, mission_event
from gcs_plugin.fleet.link_hub import Hub, Side
from gcs_plugin.fleet.message_rates import Rates, Streams, default_rates
from gcs_plugin.fleet.vehicle_state import Route, Vehicle
from gcs_plugin.links.mavlink import Autopilot, Message, dialect, is_autopilot
from gcs_plugin.links.packets import Packet
from gcs_plugin.links.transports import Link, Peer
from gcs_plugin.mission.completion import RELEVANT, CompletionDetector, MissionEvent, Phase
from gcs_plugin.mission.control import CheckMission, InOrder
from gcs_plugin.mission.download import MissionDownload
from gcs_plugin.mission.exchange import GROUND_STATION, NEVER, Address, Exchange
from gcs_plugin.mission.flight_modes import modes_of
from gcs_plugin.mission.items import Mission
from gcs_plugin.mission.upload import MissionUpload
from orthoswarm.model.errors import OrthoSwarmError

Result = TypeVar("Result")
Dialogue = TypeVar("Dialogue", bound=Exchange)
Handler = Callable[[Vehicle, Message, float], None]

_LOST_S: Final = 5.0
_TICK_S: Final = 0.25
_BATCH_S: Final = 0.04
_IDS: Final = {kind.msgname: number for number, kind in dialect.mavlink_map.items()}
_HEARTBEAT, _ACK, _TEXT = _IDS["HEARTBEAT"], _IDS["COMMAND_ACK"], _IDS["STATUSTEXT"]
_DETECTED: Final = frozenset(_IDS[name] for name in RELEVANT)
_REQUESTS: Final = frozenset({_IDS["MISSION_REQUEST"], _IDS["MISSION_REQUEST_INT"]})
_BOOT_CLOCKS: Final = frozenset({_IDS["GLOBAL_POSITION_INT"], _IDS["SYSTEM_TIME"]})
# What a late packet of these says has been said better since.
_STATES: Final = frozenset({_HEARTBEAT, _IDS["MISSION_CURRENT"], _IDS["EXTENDED_SYS_STATE"]})
_OVERTAKEN: Final = 64
_PHOTOS: Final = frozenset({_IDS["CAMERA_FEEDBACK"], _IDS["CAMERA_IMAGE_CAPTURED"]})


class Fleet:
    """All vehicles on all links.

    Attributes:
        vehicles: by system id, lost ones included.
        own: our address.
        hub: the links.
    """

    def __init__(
        self,
        links: Iterable[Link | str],
        *,
        own: Address = GROUND_STATION,
        rates: Rates | None = None,
        key: bytes | None = None,
        tlog: Path | None = None,
        remembered: Mapping[int, Mapping[str, Any]] | None = None,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        """Open the links.

        Args:
            links: links or their addresses (`links.parse_link`).
            own: our address; another one than that of a ground station beside us.
            rates: what vehicles are asked to send; 10 Hz of position and attitude unless said.
            key: signing key; with it only signed packets are believed.
            tlog: telemetry log to append to.
            remembered: what `memory` said before a restart of this program, so that no completion is missed or doubled.
            clock: seconds that never go back.
            wall: UTC epoch seconds.

        Raises:
            InputError: a link cannot be opened.
        """
        self.own, self.vehicles = own, dict[int, Vehicle]()
        self.hub = Hub(links, own, self._packet, key=key, tlog=tlog, clock=clock, wall=wall)
        self._clock, self._wall = clock, wall
        self._rates = rates or default_rates()
        self._listeners: list[Callable[[FleetEvent], None]] = []
        self._handlers: dict[int, list[Handler]] = {}
        self._taps: list[Callable[[Packet, float], None]] = []
        self._counters: dict[tuple[Peer, int, int], int] = {}
        self._jobs: list[Exchange] = []
        self._remembered = dict(remembered or {})
        self._tick_at = 0.0
        self._thread: int | None = None

    def close(self) -> None:
        """Close links and log."""
        self.hub.close()

    def __enter__(self) -> "Fleet":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- who listens ---

    def on_event(self, listener: Callable[[FleetEvent], None]) -> None:
        """Call a function with each event, in the polling thread."""
        self._listeners.append(listener)

    def subscribe(self, handler: Handler, *names: str) -> None:
        """Call handler(vehicle, message, UTC seconds of arrival) for messages of these names, in the polling thread.

        Messages of all components of a vehicle count, its camera's and gimbal's, too. No names: every message.
        """
        for number in [_IDS[name] for name in names] or _IDS.values():
            self._handlers.setdefault(number, []).append(handler)

    def tap(self, listener: Callable[[Packet, float], None]) -> None:
        """Call a function with every packet and the UTC seconds of its arrival, undecoded."""
        self._taps.append(listener)

    # --- what is asked for ---

    def begin(self, dialogue: Dialogue) -> Dialogue:
        """Start a dialogue; its outcome is set some time later while the fleet is polled."""
        self._jobs.append(dialogue)
        self._send(dialogue.vehicle.system, dialogue.start(self._clock()))
        self._reap()
        return dialogue

    def vehicle(self, system: int) -> Vehicle:
        """A vehicle that can be commanded.

        Raises:
            OrthoSwarmError: it was never heard, is lost, or shares its system id with another.
        """
        vehicle = self.vehicles.get(system)
        if vehicle is None:
            known = ", ".join(str(number) for number in sorted(self.vehicles)) or "none"
            raise OrthoSwarmError(f"vehicle {system} is not on the links (heard: {known}); check links and system ids")
        if vehicle.twins:
            raise OrthoSwarmError(f"two vehicles use system id {system}; give one of them another id")
        if vehicle.lost:
            raise OrthoSwarmError(f"vehicle {system} is lost; wait until it is heard again")
        return vehicle

    def upload(self, system: int, mission: Mission) -> MissionUpload:
        """Put a mission into a vehicle and read it back.

        Raises:
            OrthoSwarmError: the vehicle is not there, is flying its mission, or is busy with another upload or start.
        """
        vehicle = self._free(system)
        if vehicle.detector.phase is Phase.ACTIVE and vehicle.armed:
            raise OrthoSwarmError(f"vehicle {system} is flying its mission; pause it or let it return first")
        if mission.autopilot is not vehicle.autopilot:
            kind = vehicle.autopilot.value
            raise OrthoSwarmError(
                f"vehicle {system} is {kind}, but the mission was built for {mission.autopilot.value}"
            )
        vehicle.mission = None
        vehicle.detector.uploaded(None)
        return self.begin(MissionUpload(vehicle.address, self.own, mission=mission))

    def download(self, system: int) -> MissionDownload:
        """Read the mission of a vehicle."""
        return self.begin(MissionDownload(self._free(system).address, self.own))

    def start(self, system: int) -> Exchange:
        """Let a vehicle fly its mission from the beginning: check, mode, arm, MISSION_START."""
        vehicle = self._free(system)
        if vehicle.detector.phase is Phase.ACTIVE and vehicle.armed:
            raise OrthoSwarmError(f"vehicle {system} is flying its mission already")
        check = vehicle.mission is None or not vehicle.detector.knows
        return self.begin(vehicle.pilot.start(in_air=vehicle.in_air and vehicle.armed, check=check))

    def pause(self, system: int) -> Exchange:
        """Let a vehicle stay where it is."""
        return self.begin(self._urgent(system).pilot.pause())

    def resume(self, system: int) -> Exchange:
        """Let a vehicle go on with its mission."""
        vehicle = self._urgent(system)
        return self.begin(vehicle.pilot.resume(in_mission_mode=vehicle.custom_mode == vehicle.modes.mission))

    def rtl(self, system: int) -> Exchange:
        """Let a vehicle fly home and land."""
        return self.begin(self._urgent(system).pilot.rtl())

    def memory(self) -> dict[int, dict[str, Any]]:
        """Where each vehicle's mission stands, as JSON values by system id; for `remembered` after a restart."""
        return {system: vehicle.detector.state() for system, vehicle in self.vehicles.items()}

    def busy(self, system: int) -> bool:
        """True while a dialogue with a vehicle is under way."""
        return any(job.vehicle.system == system for job in self._jobs)

    def _free(self, system: int) -> Vehicle:
        vehicle = self.vehicle(system)
        if self.busy(system):
            raise OrthoSwarmError(f"vehicle {system} is busy with another request; wait until that has ended")
        return vehicle

    def _urgent(self, system: int) -> Vehicle:
        """A vehicle for a command that goes before a start under way (an upload may go on)."""
        vehicle = self.vehicle(system)
        for job in self._jobs:
            if job.vehicle.system == system and not isinstance(job, (MissionUpload, MissionDownload)):
                job.cancel("another command came in between")
        self._reap()
        return vehicle

    # --- the loop ---

    def poll(self, timeout_s: float = 0.1) -> None:
        """Wait at most so long for input, handle all there is, and do what time asks for."""
        jobs = min((job.deadline for job in self._jobs), default=NEVER)
        self.hub.poll(min(timeout_s, min(self._tick_at, jobs) - self._clock()))
        now = self._clock()
        for job in list(self._jobs):
            if now >= job.deadline:
                self._send(job.vehicle.system, job.tick(now))
        self._reap()
        if now >= self._tick_at:
            self._tick_at = now + _TICK_S
            self._tick(now)

    def run(self, stop: threading.Event) -> None:
        """Poll until told to stop. Input is taken in small batches, which saves most of the waking up."""
        self._thread = threading.get_ident()
        while not stop.is_set():
            self.poll(0.5)
            if not self._jobs:
                time.sleep(_BATCH_S)
        self._thread = None

    def run_until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Poll until something is so, or for so long; returns whether it is."""
        end = self._clock() + timeout_s
        while not done():
            left = end - self._clock()
            if left <= 0.0:
                return False
            self.poll(min(left, 0.5))
        return True

    def call(self, work: Callable[[], Result]) -> "Future[Result]":
        """Have the polling thread do something; from any thread."""
        future: Future[Result] = Future()

        def do() -> None:
            try:
                future.set_result(work())
            except BaseException as error:  # handed to whoever asked
                future.set_exception(error)

        if self._thread == threading.get_ident():
            do()
        else:
            self.hub.post(do)
        return future

    # --- what vehicles say ---

    def _packet(self, side: Side, peer: Peer, packet: Packet, now: float, utc: float) -> None:
        for listener in self._taps:
            listener(packet, utc)
        vehicle = self.vehicles.get(packet.system)
        if vehicle is None:
            vehicle = self._found(packet, now)
            if vehicle is None:
                return
        late = self._count(vehicle, peer, packet, now)
        vehicle.heard = now
        kind = packet.kind
        if packet.component == vehicle.address.component:
            self._autopilot_says(vehicle, side, peer, kind, packet.message, now, late and kind in _STATES)
        elif kind in _PHOTOS:
            vehicle.update(packet.message)
        for handler in self._handlers.get(kind, ()):
            handler(vehicle, packet.message, utc)

    def _count(self, vehicle: Vehicle, peer: Peer, packet: Packet, now: float) -> bool:
        """Keep the books of a sender's packet counter; True for a packet that others have overtaken, or a copy."""
        counter = (peer, packet.system, packet.component)
        last = self._counters.get(counter)
        vehicle.received += 1
        if last is not None:
            gap = (packet.seq - last - 1) & 0xFF
            if gap >= 256 - _OVERTAKEN and now - vehicle.heard < 1.0:
                return True
            vehicle.missed += gap if gap < 128 else 0
        self._counters[counter] = packet.seq
        return False

    def _autopilot_says(
        self, vehicle: Vehicle, side: Side, peer: Peer, kind: int, message: Message, now: float, stale: bool
    ) -> None:
        route = vehicle.routes.get((side, peer))
        if route is None:
            route = vehicle.routes[side, peer] = Route(side, peer, now)
        route.heard = now
        if vehicle.route is None or now - vehicle.route.heard > 2.0:
            vehicle.route = route
        if vehicle.lost or not vehicle.streams.started:
            if vehicle.lost:
                vehicle.lost = False
                self._event("regained", vehicle, "is heard again")
            self._send(vehicle.system, vehicle.streams.start(now))
        vehicle.streams.seen(kind, now)
        if stale:
            return
        vehicle.update(message)
        if kind in _BOOT_CLOCKS:
            self._watch_clock(vehicle, route, message.time_boot_ms / 1e3, now)
        elif kind == _ACK:
            self._send(vehicle.system, vehicle.streams.acknowledged(message, now))
        elif kind == _TEXT:
            self._event("text", vehicle, f"says: {vehicle.texts[-1]}")
        if kind in _DETECTED and not (kind in _REQUESTS and message.target_system == self.own.system):
            self._mission_events(vehicle, vehicle.detector.feed(message))
        if self._jobs:
            for job in list(self._jobs):
                if job.vehicle == vehicle.address and job.outcome is None:
                    self._send(vehicle.system, job.feed(message, now))
            self._reap()

    def _found(self, packet: Packet, now: float) -> Vehicle | None:
        if packet.kind != _HEARTBEAT or not is_autopilot(packet.message):
            return None
        heartbeat, address = packet.message, Address(packet.system, packet.component)
        autopilot = Autopilot.of(heartbeat)
        vehicle = Vehicle(
            address, autopilot, modes_of(autopilot, heartbeat.type), CompletionDetector(autopilot),
            Streams(address, self.own, self._rates), heard=now, kind=int(heartbeat.type),
        )  # fmt: skip
        before = self._remembered.pop(packet.system, None)
        if before is not None and before.get("autopilot") == autopilot.value:
            vehicle.detector = CompletionDetector.from_state(before)
        self.vehicles[packet.system] = vehicle
        self._event("found", vehicle, f"was found ({autopilot.value})")
        return vehicle

    def _watch_clock(self, vehicle: Vehicle, route: Route, time_boot_s: float, now: float) -> None:
        verdict = route.clock.feed(time_boot_s, now)
        route.boot, route.boot_at = now - time_boot_s, now
        if verdict == "mixed":
            self._twins(vehicle)
        elif verdict == "rebooted" and route is vehicle.route:
            self._event("rebooted", vehicle, "has restarted")
            vehicle.mission = None
            self._mission_events(vehicle, vehicle.detector.rebooted())
            self._send(vehicle.system, vehicle.streams.start(now))
            for job in list(self._jobs):
                if job.vehicle == vehicle.address and job.outcome is None:
                    self._send(vehicle.system, job.rebooted(now))

    def _twins(self, vehicle: Vehicle) -> None:
        if not vehicle.twins:
            vehicle.twins = True
            self._event("conflict", vehicle, "is two vehicles with one system id; give one of them another id")

    def _mission_events(self, vehicle: Vehicle, events: Sequence[MissionEvent]) -> None:
        for event in events:
            kind, text = mission_event(event)
            self._event(kind, vehicle, text)

    def _event(self, kind: str, vehicle: Vehicle, text: str) -> None:
        event = FleetEvent(kind, vehicle.system, self._wall(), f"vehicle {vehicle.system} {text}")
        for listener in self._listeners:
            listener(event)

    # --- time ---

    def _tick(self, now: float) -> None:
        for vehicle in self.vehicles.values():
            if vehicle.lost:
                continue
            self._send(vehicle.system, vehicle.streams.tick(now))
            if now - vehicle.heard > _LOST_S:
                vehicle.lost = True
                self._event("lost", vehicle, f"has been silent for {_LOST_S:.0f} s")
            if len(vehicle.routes) > 1:
                self._compare_routes(vehicle, now)

    def _compare_routes(self, vehicle: Vehicle, now: float) -> None:
        """Is it one vehicle on two links, or two vehicles with one system id? Their clocks tell."""
        fresh = [route for route in vehicle.routes.values() if now - route.heard < 2.0]
        boots = [route.boot for route in fresh if route.boot is not None and now - route.boot_at < 1.5]
        if boots and max(boots) - min(boots) > 3.0:
            self._twins(vehicle)
        for route in fresh:
            if route is not vehicle.route and now - route.boot_at > 1.5 and now - route.asked_at > 3.0:
                route.asked_at = now
                self.hub.send(route.side, route.peer, vehicle.streams.ask_clock())

    def _reap(self) -> None:
        """Take out the dialogues that have ended, and remember what they have shown."""
        for job in self._jobs:
            self._note_mission(job)
        if any(job.outcome is not None for job in self._jobs):
            self._jobs = [job for job in self._jobs if job.outcome is None]

    def _note_mission(self, job: Exchange) -> None:
        vehicle = self.vehicles.get(job.vehicle.system)
        if vehicle is None:
            return
        if isinstance(job, MissionUpload) and job.outcome is not None and job.outcome.ok:
            vehicle.mission = job.mission
            vehicle.detector.uploaded(job.mission)
            return
        mission = None
        if isinstance(job, MissionDownload) and job.items is not None:
            mission = Mission(vehicle.autopilot, tuple(job.items))
        elif isinstance(job, InOrder) and isinstance(job.steps[0], CheckMission):
            mission = job.steps[0].mission
        if mission is not None and (vehicle.mission != mission or not vehicle.detector.knows):
            vehicle.mission = mission
            vehicle.detector.knows_mission(mission)

    def _send(self, system: int, messages: Sequence[Message]) -> None:
        if not messages:
            return
        vehicle = self.vehicles.get(system)
        if vehicle is None or vehicle.route is None:
            return
        for message in messages:
            self.hub.send(vehicle.route.side, vehicle.route.peer, message)
