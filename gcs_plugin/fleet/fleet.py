"""The vehicles on the links: finding, losing, routing by system id, streams, dialogues, the completion of missions.

One thread polls it (`poll`, or `run` until `stop` is set); other threads hand in work with `call`. Nothing that a
vehicle could act on is sent unless somebody asked for it: the fleet by itself sends its heartbeat, which announces a
ground station, and asks for streams.
"""

import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Final, TypeVar

from gcs_plugin.fleet.commands import URGENT, Order, Verb
from gcs_plugin.fleet.dialogues import Dialogues
from gcs_plugin.fleet.fleet_events import FleetEvent, mission_event
from gcs_plugin.fleet.link_hub import Hub, Side
from gcs_plugin.fleet.message_rates import Rates, Streams, default_rates
from gcs_plugin.fleet.routes import Route
from gcs_plugin.fleet.separation_watch import SeparationWatch, apart_text, near_text
from gcs_plugin.fleet.telemetry_check import has_place, possible
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Autopilot, Message, dialect, is_autopilot
from gcs_plugin.links.packets import Packet
from gcs_plugin.links.transports import Link, Peer
from gcs_plugin.mission.completion import RELEVANT, CompletionDetector, MissionEvent, Phase
from gcs_plugin.mission.download import MissionDownload
from gcs_plugin.mission.exchange import COMMAND_S, GROUND_STATION, Address, Exchange, Verdict
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
_ASK_WHY_S: Final = 10.0
_SURE_S: Final = 2.5  # older news of a vehicle are not believed against a command that ends its flight
_IDS: Final = {kind.msgname: number for number, kind in dialect.mavlink_map.items()}
_HEARTBEAT, _ACK, _TEXT = _IDS["HEARTBEAT"], _IDS["COMMAND_ACK"], _IDS["STATUSTEXT"]
_DETECTED: Final = frozenset(_IDS[name] for name in RELEVANT)
_REQUESTS: Final = frozenset({_IDS["MISSION_REQUEST"], _IDS["MISSION_REQUEST_INT"]})
_BOOT_CLOCKS: Final = frozenset({_IDS["GLOBAL_POSITION_INT"], _IDS["SYSTEM_TIME"]})
# What a late packet of these says is out of date.
_STATES: Final = frozenset({_HEARTBEAT, _IDS["MISSION_CURRENT"], _IDS["EXTENDED_SYS_STATE"]})
# State that comes again by itself: on a second link it may be late, so it is taken from the one in use.
_REPEATED: Final = frozenset({
    *_STATES, _IDS["GLOBAL_POSITION_INT"], _IDS["ATTITUDE"], _IDS["SYS_STATUS"], _IDS["GPS_RAW_INT"],
    _IDS["EKF_STATUS_REPORT"], _IDS["ESTIMATOR_STATUS"],
})  # fmt: skip
_POSITION: Final = _IDS["GLOBAL_POSITION_INT"]
_SAME_TEXT_S: Final = 1.5
_OVERTAKEN: Final = 64
_PHOTOS: Final = frozenset({_IDS["CAMERA_FEEDBACK"], _IDS["CAMERA_IMAGE_CAPTURED"]})


class Fleet:
    """All vehicles on all links.

    Attributes:
        vehicles: by system id, lost ones included.
        own: our address.
        hub: the links. signed: whether it has a key.
        separation: watches how near vehicles in the air come.
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
        self.own, self.vehicles, self.signed = own, dict[int, Vehicle](), key is not None
        self.hub = Hub(links, own, self._packet, key=key, tlog=tlog, clock=clock, wall=wall)
        self._clock, self._wall = clock, wall
        self._rates = rates or default_rates()
        self._listeners: list[Callable[[FleetEvent], None]] = []
        self._handlers: dict[int, list[Handler]] = {}
        self._taps: list[Callable[[Packet, float], None]] = []
        self._counters: dict[tuple[Peer, int, int], int] = {}
        self._said: dict[tuple[int, str], tuple[float, Route]] = {}
        self._dialogues = Dialogues(self.vehicles, self.hub, clock, signed=self.signed)
        self.separation = SeparationWatch()
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
        self._dialogues.begin(dialogue)
        return dialogue

    def order(self, order: Order) -> Order:
        """Give a command to a vehicle; its outcome is set some time later while the fleet is polled.

        A command is sent only while it is fresh (COMMAND_S after it was given). Pause, RTL and land are never held
        back for doubts about identity or link: with several claimants of one system id they go to all of them, and
        to a lost vehicle on every way on which it was heard.
        """
        now = self._clock()
        if now > order.expires_s:
            text = f"vehicle {order.system}: '{order.verb}' was given {now - order.given_s:.0f} s ago and was not sent"
            return order.end(f"{text}; give it again", Verdict.NOT_SENT)
        try:
            exchange = self._dialogue(order.verb, order.system)
        except OrthoSwarmError as error:
            silent = order.system not in self.vehicles or self.vehicles[order.system].lost
            return order.end(str(error), Verdict.NOT_SENT if silent else Verdict.REFUSED)
        exchange.expires = order.expires_s
        order.exchange = self.begin(exchange)
        return order

    def vehicle(self, system: int) -> Vehicle:
        """A vehicle that can be commanded.

        Raises:
            OrthoSwarmError: it was never heard, is lost, or shares its system id with another.
        """
        vehicle = self._known(system)
        if vehicle.claimants:
            who = ", ".join(vehicle.claimants)
            raise OrthoSwarmError(f"several vehicles use system id {system} ({who}); give each an id of its own")
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
        return self._now("start", system)

    def pause(self, system: int) -> Exchange:
        """Let a vehicle stay where it is."""
        return self._now("pause", system)

    def resume(self, system: int) -> Exchange:
        """Let a vehicle go on with its mission."""
        return self._now("resume", system)

    def rtl(self, system: int) -> Exchange:
        """Let a vehicle fly home and land."""
        return self._now("rtl", system)

    def land(self, system: int) -> Exchange:
        """Let a vehicle land where it is."""
        return self._now("land", system)

    def memory(self) -> dict[int, dict[str, Any]]:
        """Where each vehicle's mission stands, as JSON values by system id; for `remembered` after a restart."""
        return {system: vehicle.detector.state() for system, vehicle in self.vehicles.items()}

    def busy(self, system: int) -> bool:
        """True while a dialogue with a vehicle is under way."""
        return self._dialogues.busy(system)

    def _free(self, system: int) -> Vehicle:
        vehicle = self.vehicle(system)
        if self.busy(system):
            raise OrthoSwarmError(f"vehicle {system} is busy with another request; wait until that has ended")
        return vehicle

    def _now(self, verb: Verb, system: int) -> Exchange:
        """A command that is given at this moment.

        Raises:
            OrthoSwarmError: it cannot be given.
        """
        exchange = self._dialogue(verb, system)
        exchange.expires = self._clock() + COMMAND_S
        return self.begin(exchange)

    def _dialogue(self, verb: Verb, system: int) -> Exchange:
        """What a command comes to, not begun yet.

        Raises:
            OrthoSwarmError: it cannot be given.
        """
        if verb == "start":
            vehicle = self._free(system)
            if vehicle.detector.phase is Phase.ACTIVE and vehicle.armed:
                raise OrthoSwarmError(f"vehicle {system} is flying its mission already")
            check = vehicle.mission is None or not vehicle.detector.knows
            return vehicle.pilot.start(in_air=vehicle.flying, check=check)
        vehicle = self._known(system) if verb in URGENT else self.vehicle(system)
        sure = not vehicle.claimants and self._clock() - vehicle.heard < _SURE_S
        if verb == "pause" and sure and not vehicle.armed:
            raise OrthoSwarmError(f"vehicle {system} is not armed, so there is nothing to pause")
        self._dialogues.make_way(system)
        if verb == "resume":
            return vehicle.pilot.resume(in_mission_mode=vehicle.custom_mode == vehicle.modes.mission)
        return {"pause": vehicle.pilot.pause, "rtl": vehicle.pilot.rtl, "land": vehicle.pilot.land}[verb]()

    def _known(self, system: int) -> Vehicle:
        vehicle = self.vehicles.get(system)
        if vehicle is None:
            known = ", ".join(str(number) for number in sorted(self.vehicles)) or "none"
            raise OrthoSwarmError(f"vehicle {system} is not on the links (heard: {known}); check links and system ids")
        return vehicle

    # --- the loop ---

    def poll(self, timeout_s: float = 0.1) -> None:
        """Wait at most so long for input, handle all there is, and do what time asks for."""
        self.hub.poll(min(timeout_s, min(self._tick_at, self._dialogues.deadline) - self._clock()))
        now = self._clock()
        self._dialogues.tick(now)
        if now >= self._tick_at:
            self._tick_at = now + _TICK_S
            self._tick(now)

    def run(self, stop: threading.Event) -> None:
        """Poll until `stop` is set. Input is taken in small batches, which saves most of the waking up."""
        self._thread = threading.get_ident()
        while not stop.is_set():
            self.poll(0.5)
            if not self._dialogues.jobs:
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
        kind = packet.kind
        late, lost = self._count(vehicle, peer, packet, now)
        if not possible(packet.message):
            vehicle.impossible += 1
            return
        vehicle.heard, vehicle.signs = now, vehicle.signs or packet.signed
        if packet.component == vehicle.address.component:
            route = self._route(vehicle, side, peer, now)
            route.counted(lost)
            beside = kind in _REPEATED and vehicle.routes.stale(route, now)
            self._autopilot_says(vehicle, route, kind, packet.message, now, beside or (late and kind in _STATES))
            if beside:
                return
        elif kind in _PHOTOS:
            vehicle.update(packet.message)
        if kind == _POSITION and not has_place(packet.message):
            return
        for handler in self._handlers.get(kind, ()):
            handler(vehicle, packet.message, utc)

    def _count(self, vehicle: Vehicle, peer: Peer, packet: Packet, now: float) -> tuple[bool, int]:
        """Follow a sender's packet counter: whether others have overtaken a packet (or it is a copy), and what is lost.

        Gives True for an overtaken one, and how many packets were lost just before this one.
        """
        counter = (peer, packet.system, packet.component)
        last, lost = self._counters.get(counter), 0
        vehicle.received += 1
        if last is not None:
            gap = (packet.seq - last - 1) & 0xFF
            if gap >= 256 - _OVERTAKEN and now - vehicle.heard < 1.0:
                return True, 0
            lost = gap if gap < 128 else 0
            vehicle.missed += lost
        self._counters[counter] = packet.seq
        return False, lost

    def _route(self, vehicle: Vehicle, side: Side, peer: Peer, now: float) -> Route:
        """The way on which a packet has come; streams run on the way in use."""
        route, taken_over = vehicle.routes.heard(side, peer, now)
        if taken_over:
            self._taken_over(vehicle, now)
        return route

    def _taken_over(self, vehicle: Vehicle, now: float) -> None:
        if vehicle.route is not None:
            self._event("link", vehicle, f"is commanded over {vehicle.route.address} from now on")
        self._dialogues.send(vehicle.system, vehicle.streams.start(now))

    def _autopilot_says(
        self, vehicle: Vehicle, route: Route, kind: int, message: Message, now: float, stale: bool
    ) -> None:
        if vehicle.lost or not vehicle.streams.started:
            if vehicle.lost:
                vehicle.lost = False
                self._event("regained", vehicle, "is heard again")
            self._dialogues.send(vehicle.system, vehicle.streams.start(now))
        if kind in _BOOT_CLOCKS:
            self._watch_clock(vehicle, route, message.time_boot_ms / 1e3, now)
        if stale:
            return
        vehicle.streams.seen(kind, now)
        vehicle.update(message)
        if kind == _ACK:
            self._dialogues.send(vehicle.system, vehicle.streams.acknowledged(message, now))
        elif kind == _TEXT:
            self._text(vehicle, route, str(message.text).strip("\x00\t "), now)
        if kind in _DETECTED and not (kind in _REQUESTS and message.target_system == self.own.system):
            self._mission_events(vehicle, vehicle.detector.feed(message))
        self._dialogues.feed(vehicle, message, now)

    def _text(self, vehicle: Vehicle, route: Route, text: str, now: float) -> None:
        """Pass a text on once, though it comes on two links."""
        last = self._said.get((vehicle.system, text))
        self._said[vehicle.system, text] = now, route
        if last is not None and last[1] is not route and now - last[0] < _SAME_TEXT_S:
            return
        if len(self._said) > 1000:
            self._said.clear()
        vehicle.says(text, now)
        self._event("text", vehicle, f"says: {text}")

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
        vehicle.pace = route.pace(time_boot_s, now) or vehicle.pace
        if verdict == "mixed":
            vehicle.routes.mixed(now)
            self._compare_routes(vehicle, now)
        elif verdict == "rebooted" and route is vehicle.route:
            self._event("rebooted", vehicle, "has restarted")
            vehicle.mission = None
            self._mission_events(vehicle, vehicle.detector.rebooted())
            self._dialogues.send(vehicle.system, vehicle.streams.start(now))
            self._dialogues.rebooted(vehicle, now)

    def _mission_events(self, vehicle: Vehicle, events: Sequence[MissionEvent]) -> None:
        for event in events:
            kind, text = mission_event(event)
            self._event(kind, vehicle, text)

    def _event(self, kind: str, vehicle: Vehicle, text: str, pair: tuple[int, int] | None = None) -> None:
        words = text if pair else f"vehicle {vehicle.system} {text}"
        event = FleetEvent(kind, vehicle.system, self._wall(), words, pair)
        for listener in self._listeners:
            listener(event)

    # --- time ---

    def _tick(self, now: float) -> None:
        self._watch_separation(now)
        for vehicle in self.vehicles.values():
            if vehicle.lost:
                continue
            self._dialogues.send(vehicle.system, vehicle.streams.tick(now))
            self._ask_why(vehicle, now)
            if now - vehicle.heard > _LOST_S:
                vehicle.lost = True
                self._event("lost", vehicle, f"has been silent for {_LOST_S:.0f} s")
            if len(vehicle.routes.known) > 1 or vehicle.claimants:
                self._compare_routes(vehicle, now)

    def _ask_why(self, vehicle: Vehicle, now: float) -> None:
        """A vehicle that would refuse to arm, and has not said why, is asked for the reasons."""
        if vehicle.prearm_ok is not False or vehicle.armed or now < vehicle.ask_why_at or vehicle.prearm_texts(now):
            return
        vehicle.ask_why_at = now + _ASK_WHY_S
        to, command = vehicle.address, dialect.MAV_CMD_RUN_PREARM_CHECKS
        ask = dialect.MAVLink_command_long_message(to.system, to.component, command, 0, 0, 0, 0, 0, 0, 0, 0)
        self._dialogues.send(vehicle.system, [ask])

    def _watch_separation(self, now: float) -> None:
        new, ended = self.separation.look(self.vehicles.values(), now)
        for near in new:
            self._event("near", self.vehicles[near.other], near_text(near, self.separation), near.pair)
        for pair in ended:
            self._event("apart", self.vehicles[pair[1]], apart_text(pair), pair)

    def _compare_routes(self, vehicle: Vehicle, now: float) -> None:
        """Is it one vehicle on two links, or several vehicles with one system id? Their clocks tell."""
        before = vehicle.claimants
        if vehicle.routes.compare(now):
            self._taken_over(vehicle, now)
        if vehicle.claimants and not before:
            who = ", ".join(vehicle.claimants)
            self._event("conflict", vehicle, f"is several vehicles with one system id ({who}); give each its own")
        elif before and not vehicle.claimants:
            self._event("single", vehicle, "is one vehicle again")
        for route in vehicle.routes.unasked(now):
            self.hub.send(route.side, route.peer, vehicle.streams.ask_clock())
