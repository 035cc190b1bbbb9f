"""What our station must never do, judged by what was sent, what arrived, and what the vehicles truly did."""

import math
import zlib
from dataclasses import dataclass, field

from gcs_plugin.fleet.flight_state import Word, flight_state
from gcs_plugin.links.mavlink import dialect
from gcs_plugin.links.packets import Framer
from gcs_plugin.mission.exchange import GROUND_STATION
from gcs_plugin.mission.flight_modes import HOLDS, mode_params
from gcs_plugin.mission.items import RTL, MissionItem, difference
from orthoswarm.model.earth import distance_m
from tests.vehicles.safety.two_stations import ARM, OTHER, PAUSE, SET_MODE, START

LOOK_S = 1.0 + 2 * 0.05  # a second, and the steps of time here
FRESH_S = 1.2  # since a stop of others, which may not have been told yet
CHANGE_S = 6.0  # a word may lag so long behind a change, seconds of the vehicle's clock
REQUEST = {int(dialect.MAV_CMD_REQUEST_MESSAGE), int(dialect.MAV_CMD_SET_MESSAGE_INTERVAL)}
_BEATS = {"HEARTBEAT": 3, "EXTENDED_SYS_STATE": 2, "MISSION_CURRENT": 4, "GLOBAL_POSITION_INT": 20}


@dataclass
class Heard:
    """What has arrived from one vehicle: the last of each kind, and its mission item by item."""

    beats: list = field(default_factory=list)  # (time, mode, armed)
    places: list = field(default_factory=list)  # (time, latitude, longitude)
    checksum: tuple = (-math.inf, 0)
    obeys_other: list = field(default_factory=list)  # (time, command)
    stores_other: float = -math.inf  # when it last asked another station for an item
    ordered: list = field(default_factory=list)  # by us: (time, parameters of a mode)
    count: int = 0
    items: dict = field(default_factory=dict)  # seq -> item
    asked: float | None = None  # for its mission
    read: tuple = (-math.inf, -math.inf, ())  # begun, ended, items
    seq: int = 0
    at: float = -math.inf
    counts: dict = field(default_factory=dict)


class Rules:
    """Judges a field while it goes on.

    Attributes:
        broken: what was done wrong, in words. judged: how often each rule was looked at.
    """

    def __init__(self, field):
        self.field, self.broken, self.judged = field, [], dict.fromkeys("12345", 0)
        self.heard = {v.system: Heard() for v in field.vehicles}
        self._since: dict = {}
        self._told = {v.system: 0 for v in field.vehicles}
        self._looked, self._events = -1.0, 0
        self._silent: dict[int, float] = {}
        self._last = {}
        field.fleet.tap(self._arrived)
        self._put = field.world.link.send
        field.world.link.send = self._sent

    def look(self):
        """Once a step."""
        field = self.field
        for vehicle in field.vehicles:
            for told in vehicle.told[self._told[vehicle.system] :]:
                self._obeyed(vehicle, told)
            self._told[vehicle.system] = len(vehicle.told)
        for event in field.world.events[self._events :]:
            if event.kind in ("complete", "aborted"):
                self._ended(next(v for v in field.vehicles if v.system == event.system), event.kind)
        self._events = len(field.world.events)
        if field.now - self._looked >= 0.25:
            self._looked = field.now
            for vehicle in field.vehicles:
                self._word(vehicle)

    def _breaks(self, rule, text):
        self.broken.append(f"{self.field.now:.2f} rule {rule}: {text}")

    # --- what arrives ---

    def _arrived(self, packet, utc):
        heard = self.heard.get(packet.system)
        if heard is None or packet.component != 1:
            return
        message, now = packet.message, self.field.now
        late = now - heard.at < 1.0 and (packet.seq - heard.seq - 1) & 0xFF >= 192
        heard.seq, heard.at = heard.seq if late else packet.seq, now
        kind = message.get_type()
        heard.counts[kind] = heard.counts.get(kind, 0) + 1
        if kind == "HEARTBEAT" and not late:
            heard.beats.append((now, int(message.custom_mode), bool(message.base_mode & 128)))
        elif kind == "GLOBAL_POSITION_INT":
            if heard.places and now - heard.places[-1][0] > 2.0:
                self._silent[packet.system] = now
            heard.places.append((now, message.lat / 1e7, message.lon / 1e7))
        elif kind == "MISSION_CURRENT":
            heard.checksum = now, int.from_bytes(bytes(message.get_payload() or b"")[6:10], "little")
        elif kind == "COMMAND_ACK" and message.target_system == OTHER.system and message.result == 0:
            heard.obeys_other.append((now, int(message.command)))
        elif kind == "MISSION_REQUEST_INT" and message.target_system == OTHER.system:
            heard.stores_other = now
        elif kind == "MISSION_COUNT" and message.target_system == GROUND_STATION.system and message.mission_type == 0:
            heard.count = int(message.count)
        elif kind in ("MISSION_ITEM_INT", "MISSION_ITEM") and message.target_system == GROUND_STATION.system:
            heard.items[int(message.seq)] = MissionItem.of(message)

    # --- rules 1, 2 and 5: what leaves the station ---

    def _sent(self, peer, data, expires=math.inf):
        for packet in Framer().feed(data):
            message, heard = packet.message, self.heard[self.field.vehicles[peer].system]
            match message.get_type():
                case "COMMAND_LONG":
                    self._command(self.field.vehicles[peer], message)
                case "MISSION_REQUEST_LIST" if heard.asked is None and message.mission_type == 0:
                    heard.asked = self.field.now
                case "MISSION_ACK" if message.mission_type == 0:  # it has read all
                    heard.read = heard.asked, self.field.now, [heard.items[seq] for seq in range(heard.count)]
                    heard.asked = None
        return self._put(peer, data, expires)

    def _command(self, vehicle, message):
        command, p1 = int(message.command), message.param1
        if command == SET_MODE:
            values = tuple(getattr(message, f"param{n}") for n in range(1, 4))
            self.heard[vehicle.system].ordered.append((self.field.now, values))
            if values == mode_params(vehicle.autopilot, vehicle.flight.modes.mission):
                self._goes_on(vehicle)
        if command == PAUSE and p1 == 1.0:
            self._goes_on(vehicle)
        if command != START and (command != ARM or p1 != 1.0):
            return
        given = next((g for g in reversed(self.field.given[vehicle.system]) if g.order.outcome is None), None)
        what = f"{'arm' if command == ARM else 'start'} sent to {vehicle.system}"
        if given is None:
            self._breaks(1, f"{what} without a start")
            return
        self._last[vehicle.system] = given
        if command == ARM:
            self._fresh(vehicle, given, what)
        elif given.mission is not None and self.heard[vehicle.system].stores_other > given.at:
            held = vehicle.held_since(self.field.now - 2 * self.field.delay_s)
            if all(difference(given.mission, list(items)) for items in held):
                self._breaks(1, f"{what}, it was heard to be given another mission")
        self._not_stopped(vehicle, given, what)
        self._others_climbed(vehicle, given, what)

    def _fresh(self, vehicle, given, what):
        self.judged["1"] += 1
        heard, standing, now, modes = self.heard[vehicle.system], given.standing, self.field.now, vehicle.flight.modes
        beat = heard.beats[-1] if heard.beats else (-math.inf, 0, False)
        if now - beat[0] > LOOK_S:
            self._breaks(1, f"{what}, its heartbeat is {now - beat[0]:.2f} s old")
        if beat[1:] != (modes.ready, standing.armed):
            self._breaks(1, f"{what}, it is in {modes.name(beat[1])}, armed {beat[2]}")
        for at, mode, armed in heard.beats:
            if at > given.at and (mode not in (modes.ready, standing.mode) or armed != standing.armed):
                self._breaks(1, f"{what}, {now - at:.2f} s ago it was in {modes.name(mode)}, armed {armed}")
                break
        if standing.place is not None:
            at, *place = heard.places[-1] if heard.places else (-math.inf, 0.0, 0.0)
            if now - at > LOOK_S or distance_m(*place, *standing.place) > 10.1:
                metres = distance_m(*place, *standing.place)
                self._breaks(1, f"{what}, its place is {now - at:.2f} s old and {metres:.0f} m away")
        self._holds(vehicle, given, what)

    def _holds(self, vehicle, given, what):
        heard, now, delay = self.heard[vehicle.system], self.field.now, self.field.delay_s
        if given.mission is None:
            return
        begun, ended, items = heard.read
        read = ended >= now - LOOK_S
        wrong = difference(given.mission, items) if read else ""
        if wrong:
            self._breaks(1, f"{what}, it was read to hold another mission: {wrong}")
        checked = now - heard.checksum[0] <= LOOK_S and heard.checksum[1] != 0
        if not read and not checked:
            self._breaks(1, f"{what}, its mission was not read in the last second")
            return
        since = (begun if read else heard.checksum[0]) - 2 * delay - 0.05
        held = vehicle.held_since(since)
        same = any(not difference(given.mission, list(items)) for items in held)
        sums = {zlib.crc32(repr(list(items)).encode()) for items in held}
        if not same or (not read and heard.checksum[1] not in sums):
            self._breaks(1, f"{what}, it held another mission all the time since {now - since:.2f} s ago")

    def _evidence(self, vehicle, stop):
        """When a stop was told to the station: by a change of mode, or by the vehicle's answer to the other one.

        A mode that the station itself had just ordered tells nothing (PX4 stands in HOLD before it is armed).
        """
        heard = self.heard[vehicle.system]
        changes = [(b[0], b[1]) for a, b in zip(heard.beats, heard.beats[1:]) if a[1] != b[1]]
        sent = stop.at + self.field.delay_s
        ours = [at for at, mode in heard.ordered if mode == mode_params(vehicle.autopilot, stop.mode)]
        shown = [at for at, mode in changes if at >= sent and mode == stop.mode != stop.was]
        shown = [at for at in shown if not any(at - CHANGE_S < ordered < at for ordered in ours)]
        shown += [at for at, command in heard.obeys_other if at >= stop.at and command == stop.command]
        return min(shown, default=math.inf)

    def _not_stopped(self, vehicle, given, what):
        self.judged["2"] += 1
        now = self.field.now
        if self.field.fleet.stops.get(vehicle.system, 0) != given.stops:
            self._breaks(2, f"{what}, which was told here to stop after that start was given")
        for stop in vehicle.stops:
            if stop.at > given.at and self._evidence(vehicle, stop) < now:
                told = now - self._evidence(vehicle, stop)
                by, mode = stop.by, vehicle.flight.modes.name(stop.mode)
                self._breaks(
                    2, f"{what}, though {now - stop.at:.2f} s ago {by} stopped it ({mode}), known {told:.2f} s"
                )
                return

    def _others_climbed(self, vehicle, given, what):
        for plan in self.field.plans:
            if plan.orders.get(vehicle.system) is not given.order and given.at != plan.at:
                continue
            mine = plan.planned[vehicle.system]
            self.judged["5"] += 1
            for other in self.field.vehicles:
                if plan.planned.get(other.system, math.inf) < mine and other.system not in plan.cancelled:
                    peak = max((up for at, up in other.heights if at >= plan.at), default=0.0)
                    if peak < 1.0:
                        self._breaks(5, f"{what}, but {other.system} has climbed to {peak:.1f} m only")

    def _goes_on(self, vehicle):
        """A command to go on is not sent once a return of others was told after it was given."""
        given = self.field.went_on.get(vehicle.system, math.inf)
        for stop in vehicle.stops:
            ends = stop.mode in (vehicle.flight.modes.rtl, vehicle.flight.modes.land)
            if ends and given < self._evidence(vehicle, stop) < self.field.now:
                told = self.field.now - self._evidence(vehicle, stop)
                self._breaks(2, f"{vehicle.system} is told to go on, {told:.2f} s after it was known to return")
                return

    # --- rule 2: what a vehicle obeys ---

    def _obeyed(self, vehicle, told):
        """A start that arrives pulls nobody out of a return or landing that has been going on for a while."""
        field, modes = self.field, vehicle.flight.modes
        if told.by != GROUND_STATION.system or not (told.command == START or (told.command == ARM and told.params[0])):
            return
        given = self._last[vehicle.system]
        window = FRESH_S + 2 * field.delay_s + 0.05
        for stop in vehicle.stops:
            old = told.at - stop.at
            if stop.at > given.at and stop.was != stop.mode == told.was and old > window and told.was != modes.ready:
                text = f"{vehicle.system} was launched {old:.2f} s after {stop.by} put it into {modes.name(stop.mode)}"
                self._breaks(2, text)

    # --- rule 3: words ---

    def _word(self, vehicle):
        field, system = self.field, vehicle.system
        known, heard, flight = field.fleet.vehicles[system], self.heard[system], vehicle.flight
        word = flight_state(known).word
        if word is Word.LOST or not heard.places or field.now - heard.places[-1][0] > 2.0 or vehicle.off:
            self._since.pop(system, None)
            return
        self.judged["3"] += 1
        wrong = contradiction(word, known, flight)
        before = self._since.get(system)
        if not wrong or before is None or before[0] != (word, wrong):
            self._since[system] = (word, wrong), field.now, dict(heard.counts)
            return
        _, since, counts = before
        told = all(heard.counts.get(kind, 0) - counts.get(kind, 0) >= number for kind, number in _BEATS.items())
        seen_s = heard.places[-1][0] - since
        if wrong and told and seen_s > CHANGE_S:
            self._breaks(3, f"{system} is '{flight_state(known).text}' for {seen_s:.1f} s, but {wrong}")
            self._since.pop(system)

    # --- rule 4: complete ---

    def _ended(self, vehicle, kind):
        """Complete is a mission whose places were flown over, and one that nobody disturbed is complete."""
        begun = vehicle.path[0][0] if vehicle.path else self.field.now
        if self._silent.get(vehicle.system, -math.inf) >= begun:
            return  # what it did meanwhile nobody can know
        self.judged["4"] += 1
        held = vehicle.held_since(begun)
        if kind == "complete" and all(vehicle.missed(items, 15.5) != 0 for items in held):
            missed = [vehicle.missed(items, 15.5) for items in held]
            self._breaks(4, f"{vehicle.system} is complete, but {missed} places were not flown over")
        told = [t for t in vehicle.told if t.at > begun and t.command not in REQUEST]
        alone = all(t.by == GROUND_STATION.system and t.command == START for t in told) and not vehicle.reboots
        if kind == "aborted" and alone and len(held) == 1 and vehicle.missed(held[0], 12.0) == 0:
            self._breaks(4, f"{vehicle.system} has ended its mission, though it was flown undisturbed")


def contradiction(word, known, flight):
    """What a vehicle's true state says against a word; empty if nothing."""
    motion, modes = flight.motion, flight.modes
    speed, sinks, up = math.hypot(motion.vn, motion.ve), -motion.vu, motion.up
    still = speed < 0.3 and abs(sinks) < 0.2
    item = flight.store.items[flight.seq].command if 0 <= flight.seq < len(flight.store.items) else 0
    in_mission = flight.mode == modes.mission
    match word:
        case Word.PAUSED | Word.HOLDING if speed >= 1.5:
            return "it moves"
        case Word.PAUSED | Word.HOLDING if sinks >= 0.7:
            return "it sinks"
        case Word.PAUSED | Word.HOLDING if up < 0.1:
            return "it stands"
        case Word.ON_GROUND | Word.COMPLETE if up >= 2.0:
            return "it is in the air"
        case Word.DESCENDING if sinks < 0.2:
            return "it does not sink"
        case Word.LANDING if sinks < 0.1:
            return "it does not sink"
        case Word.RETURNING if not (flight.mode == modes.rtl or (in_mission and item == RTL)):
            return f"it is in {modes.name(flight.mode)}"
        case Word.ON_MISSION if not in_mission:
            return f"it is in {modes.name(flight.mode)}"
        case Word.ON_MISSION if still and known.mission is not None:
            return "it stands still"
        case Word.TAKING_OFF if sinks > -0.2:
            return "it does not climb"
        case Word.FLYING if still and known.mode in HOLDS:
            return "it stands still"
        case Word.FLYING | Word.RETURNING | Word.ON_MISSION | Word.TAKING_OFF if up < 0.1:
            return "it stands"
    return ""
