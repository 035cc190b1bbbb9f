"""Reception of packets from vehicles: discovery, loss, identity, messages, restarts and routes.

`Fleet` owns one of these and polls it; it sends nothing by itself but requests for streams, for a clock, and for the
reasons why a vehicle would not arm.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from gcs_plugin.config import HEARING
from gcs_plugin.fleet.dialogues import Dialogues
from gcs_plugin.fleet.flight_state import Word, danger_of, flight_state
from gcs_plugin.fleet.heard_messages import HEARD, MESSAGE_IDS, HeardMessage, rates_of
from gcs_plugin.fleet.link_hub import Hub, Side
from gcs_plugin.fleet.message_rates import Streams
from gcs_plugin.fleet.routes import LongText, Route
from gcs_plugin.fleet.separation.separation_watch import SeparationWatch, VehicleNames, apart_text, near_text
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Autopilot, Message, dialect, has_place, is_vehicle
from gcs_plugin.links.packets import Packet
from gcs_plugin.links.transports import Peer
from gcs_plugin.mission.completion import RELEVANT, CompletionDetector, MissionEvent, Phase
from gcs_plugin.mission.exchange import Address, command_long
from gcs_plugin.mission.flight_modes import HOLDS, modes_of
from gcs_plugin.mission.track import Lateness

Handler = Callable[[Vehicle, Message, float], None]

_ASK_WHY_S: Final = 10.0
_HEARTBEAT, _ACK, _TEXT, _POSITION = (
    MESSAGE_IDS[name] for name in ("HEARTBEAT", "COMMAND_ACK", "STATUSTEXT", "GLOBAL_POSITION_INT")
)
_DETECTED: Final = frozenset(MESSAGE_IDS[name] for name in RELEVANT)
_REQUESTS: Final = frozenset({MESSAGE_IDS["MISSION_REQUEST"], MESSAGE_IDS["MISSION_REQUEST_INT"]})
_BOOT_CLOCKS: Final = frozenset({_POSITION, MESSAGE_IDS["SYSTEM_TIME"]})
_OTHER: Final = HeardMessage()
_SAME_TEXT_S: Final = 1.5
_OVERTAKEN: Final = 64  # packets of its sender that a late one may be behind
_PART: Final = 50  # characters of a STATUSTEXT
_PARTS_S: Final = 1.5  # its parts are sent one after the other
_OF_PARTS: Final = frozenset(
    MESSAGE_IDS[name] for name in ("CAMERA_FEEDBACK", "CAMERA_IMAGE_CAPTURED", "GIMBAL_DEVICE_ATTITUDE_STATUS")
)


_WORDS: Final = {
    MissionEvent.STARTED: "has started its mission",
    MissionEvent.RESUMED: "goes on with its mission",
    MissionEvent.COMPLETE: "has completed its mission",
}

Pair = tuple[int, int]
"""System ids of two vehicles, in order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetEvent:
    """Something that happened to a vehicle.

    Attributes:
        system: its MAVLink system id. time_s: UTC epoch seconds. text: what happened, in one sentence.
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


class Reception:
    """Decodes packets and updates the vehicles' states.

    Args:
        vehicles: by system id; found vehicles are added.
        event: called with each event. wall: UTC epoch seconds.

    Attributes:
        separation: watches how near vehicles in the air come.
        handlers: called for messages, by message id. taps: called for packets, undecoded.
    """

    def __init__(
        self, vehicles: dict[int, Vehicle], hub: Hub, *, dialogues: Dialogues, own: Address,
        event: Callable[[FleetEvent], None], wall: Callable[[], float],
        names: VehicleNames,
    ) -> None:  # fmt: skip
        self._vehicles, self._hub, self._dialogues, self._own = vehicles, hub, dialogues, own
        self._publish, self._wall = event, wall
        self._counters: dict[tuple[Side, Peer, int, int], int] = {}
        self._said: dict[tuple[int, str], tuple[float, Route]] = {}
        self._lateness: dict[int, Lateness] = {}
        self.separation = SeparationWatch(names=names)
        self.handlers: dict[int, list[Handler]] = {}
        self.taps: list[Callable[[Packet, float], None]] = []

    def packet(self, side: Side, peer: Peer, packet: Packet, now: float, utc: float) -> None:
        """Process a packet of a peer on a link (`side`); now: monotonic seconds, utc: UTC epoch seconds."""
        for listener in self.taps:
            listener(packet, utc)
        vehicle = self._vehicles.get(packet.system)
        if vehicle is None:
            vehicle = self._found(packet, now)
            if vehicle is None:
                return
        kind, how = packet.kind, HEARD.get(packet.kind, _OTHER)
        late, lost = self._count(vehicle, (side, peer, packet.system, packet.component), packet.seq, now)
        if not how.possible(packet.message):
            vehicle.impossible += 1
            return
        vehicle.signs |= packet.signed
        if packet.component == vehicle.address.component:
            vehicle.heard = now  # a camera or companion that is heard says nothing about it
            route, taken_over = vehicle.routes.heard(side, peer, now)
            if taken_over:
                self._taken_over(vehicle, now)
            route.counted(lost)
            repeated = how.repeated and vehicle.routes.stale(route, now)
            stale = repeated or (late and how.overtaken)
            self._autopilot_says(vehicle, route, kind, message=packet.message, now=now, stale=stale)
            if repeated:
                return
        elif kind in _OF_PARTS:
            vehicle.update(packet.message)
        if kind == _POSITION and not has_place(packet.message):
            return
        for handler in self.handlers.get(kind, ()):
            handler(vehicle, packet.message, utc)

    def _count(self, vehicle: Vehicle, counter: tuple[Side, Peer, int, int], seq: int, now: float) -> tuple[bool, int]:
        """Track a sender's packet counter on a link: autopilots count the packets of each of their ports separately.

        Returns True for an overtaken one (or a copy), and the number of packets lost just before this one.
        """
        last, lost = self._counters.get(counter), 0
        vehicle.received += 1
        if last is not None:
            gap = (seq - last - 1) & 0xFF
            if gap >= 256 - _OVERTAKEN and now - vehicle.heard < 1.0:
                return True, 0
            lost = gap if gap < 128 else 0
            vehicle.missed += lost
        self._counters[counter] = seq
        return False, lost

    def _taken_over(self, vehicle: Vehicle, now: float) -> None:
        """Another route carries commands and streams from now on."""
        if vehicle.route is not None:
            self._event("link", vehicle, f"is commanded over {vehicle.route.address} from now on")
        self._dialogues.send(vehicle.system, vehicle.streams.start(now))

    def _autopilot_says(
        self, vehicle: Vehicle, route: Route, kind: int, *, message: Message, now: float, stale: bool
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
            self._text_part(vehicle, route, message, now)
        if kind in _DETECTED and not (kind in _REQUESTS and message.target_system == self._own.system):
            self._mission_events(vehicle, vehicle.detector.feed(message))
            if vehicle.mission is not None and not vehicle.detector.knows:  # somebody stores another one
                vehicle.mission, vehicle.read_at = None, 0.0
        self._dialogues.feed(vehicle, message, now)

    def _text_part(self, vehicle: Vehicle, route: Route, message: Message, now: float) -> None:
        """Process a STATUSTEXT: a long text is sent in parts of 50 characters with a common number.

        Autopilots number the texts of each of their ports separately. A copy of a part changes nothing.
        """
        number, part, text = int(message.id), int(message.chunk_seq), str(message.text)
        last = route.text
        if last is None or not number or last.number != number or last.parts.get(part, text) != text:
            self._tell(vehicle, route, now)
            last = route.text = LongText(number, int(message.severity), now)
        last.parts.setdefault(part, text)
        if not number or len(text) < _PART:
            self._tell(vehicle, route, now)

    def _tell(self, vehicle: Vehicle, route: Route, now: float) -> None:
        """Pass on a text of which no more parts are expected, with a mark for those that were lost."""
        text = route.text
        if text is not None and not text.told:
            text.told = True
            self._text(vehicle, route, text.joined.strip("\x00\t "), text.severity, now)

    def _text(self, vehicle: Vehicle, route: Route, text: str, severity: int, now: float) -> None:
        """Pass a text on once, even if it arrives on two links."""
        last = self._said.get((vehicle.system, text))
        self._said[vehicle.system, text] = now, route
        if last is not None and last[1] is not route and now - last[0] < _SAME_TEXT_S:
            return
        if len(self._said) > 1000:
            self._said.clear()
        vehicle.says(text, now, severity)
        self._event("text", vehicle, f"says: {text}", severity=severity)

    def _found(self, packet: Packet, now: float) -> Vehicle | None:
        if packet.kind != _HEARTBEAT or not is_vehicle(packet.message, packet.component):
            return None
        heartbeat, address = packet.message, Address(packet.system, packet.component)
        autopilot = Autopilot.of(heartbeat)
        vehicle = Vehicle(
            address=address,
            autopilot=autopilot,
            modes=modes_of(autopilot, heartbeat.type),
            detector=CompletionDetector(autopilot=autopilot),
            streams=Streams(vehicle=address, own=self._own, rates=rates_of(autopilot)),
            heard=now,
            kind=int(heartbeat.type),
        )
        self._vehicles[packet.system] = vehicle
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
            vehicle.restarted()
            self._mission_events(vehicle, vehicle.detector.rebooted())
            self._dialogues.send(vehicle.system, vehicle.streams.start(now))
            self._dialogues.rebooted(vehicle, now)

    def _mission_events(self, vehicle: Vehicle, events: Sequence[MissionEvent]) -> None:
        for event in events:
            vehicle.unbegun &= event is not MissionEvent.STARTED
            vehicle.read_at = 0.0
            kind, text = mission_event(event, vehicle)
            self._event(kind, vehicle, text)

    def _event(self, kind: str, vehicle: Vehicle, text: str, pair: Pair | None = None, severity: int = 6) -> None:
        words = text if pair else f"vehicle {vehicle.system} {text}"
        self._publish(
            FleetEvent(kind=kind, system=vehicle.system, time_s=self._wall(), text=words, pair=pair, severity=severity)
        )

    def tick(self, now: float) -> None:
        """Check for missing messages, and for vehicles that are too close."""
        self._watch_separation(now)
        for vehicle in self._vehicles.values():
            if vehicle.lost:
                continue
            self._watch_times(vehicle)
            self._watch_danger(vehicle)
            self._dialogues.send(vehicle.system, [*vehicle.streams.tick(now), *vehicle.questions.tick(now)])
            self._ask_why(vehicle, now)
            for route in vehicle.routes.known.values():
                if route.text is not None and now - route.text.begun > _PARTS_S:
                    self._tell(vehicle, route, now)
            if now - vehicle.heard > HEARING.lost_s:
                vehicle.lost = True
                self._event("lost", vehicle, f"has been silent for {HEARING.lost_s:.0f} s")
            if len(vehicle.routes.known) > 1 or vehicle.claimants:
                self._compare_routes(vehicle, now)

    def _ask_why(self, vehicle: Vehicle, now: float) -> None:
        """Request the reasons from a vehicle that would refuse to arm and has not stated why."""
        if vehicle.prearm_ok is not False or vehicle.armed or now < vehicle.ask_why_at or vehicle.prearm_texts(now):
            return
        vehicle.ask_why_at = now + _ASK_WHY_S
        self._dialogues.send(vehicle.system, [command_long(vehicle.address, dialect.MAV_CMD_RUN_PREARM_CHECKS)])

    def _watch_separation(self, now: float) -> None:
        new, ended = self.separation.look(self._vehicles.values(), now)
        for near in new:
            self._event("near", self._vehicles[near.other], near_text(near, self.separation), near.pair)
        for pair in ended:
            self._event("apart", self._vehicles[pair[1]], apart_text(pair, self.separation.names), pair)

    def _watch_danger(self, vehicle: Vehicle) -> None:
        """Tell once that a vehicle is in a failsafe, or sinks though nobody ordered it."""
        was, vehicle.danger = vehicle.danger, danger_of(vehicle)
        if vehicle.danger and vehicle.danger != was:
            self._event("danger", vehicle, vehicle.danger)
        elif was and not vehicle.danger:
            self._event("safe", vehicle, "is out of the danger that was told")

    def _watch_times(self, vehicle: Vehicle) -> None:
        """Compare a vehicle on its mission with the times of its plan."""
        watched, mission, phase = self._lateness.get(vehicle.system), vehicle.mission, vehicle.detector.phase
        over = not vehicle.armed or mission is None or phase not in (Phase.ACTIVE, Phase.SUSPENDED)
        if watched is not None and (over or watched.mission is not mission):
            del self._lateness[vehicle.system]
            if watched.behind:
                self._event("caught_up", vehicle, "is no longer behind its plan: it has ended its mission")
            return
        stays = phase is Phase.SUSPENDED or (vehicle.told_to_stay and flight_state(vehicle).word is Word.PAUSED)
        if stays and watched is not None:
            watched.rest(vehicle.time_boot_s)
        if over or stays or mission is None or vehicle.place is None:
            return
        if watched is None:
            watched = self._lateness[vehicle.system] = Lateness(mission)
        was = watched.behind
        watched.look(vehicle.time_boot_s, *vehicle.place, vehicle.height_m)
        if watched.behind and not was:
            self._event("behind", vehicle, self.behind(vehicle.system))
        elif was and not watched.behind:
            self._event("caught_up", vehicle, "is no longer behind its plan")

    def behind(self, system: int) -> str:
        """How far a vehicle is behind its plan, in words; empty if it is not."""
        watched = self._lateness.get(system)
        if watched is None or not watched.behind:
            return ""
        why = " after its pause" if watched.ordered else ""
        text = f"is {watched.late_s:.0f} s late{why}; its plan keeps others apart up to {watched.allowed_s:.0f} s"
        return f"{text}: watch its distances, consider pausing it"

    def behind_ordered(self, system: int) -> bool:
        """Whether a vehicle is behind its plan because it was paused, and for no other reason."""
        watched = self._lateness.get(system)
        return watched is not None and watched.behind and watched.ordered

    def _compare_routes(self, vehicle: Vehicle, now: float) -> None:
        """Decide by the clocks whether one vehicle is on two links, or several vehicles share a system id."""
        before = vehicle.claimants
        if vehicle.routes.compare(now):
            self._taken_over(vehicle, now)
        if vehicle.claimants and not before:
            who = ", ".join(vehicle.claimants)
            self._event("conflict", vehicle, f"is the system id of several vehicles ({who}); give each its own")
        elif before and not vehicle.claimants:
            self._event("single", vehicle, "is one vehicle again")
        for route in vehicle.routes.unasked(now):
            self._hub.send(route.side, route.peer, vehicle.streams.ask_clock())
