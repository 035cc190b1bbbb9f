"""A start: nothing is armed, and no mission begun, unless the vehicle has just shown what that relies on.

What a station remembers of a vehicle is not what it is now: another station, a remote control, a failsafe or the
vehicle itself may have changed its mode, its mission or its place while a check ran or a takeoff waited. So in the
second before each command to arm its mode, arming, place and mission are read from it, and its mode and arming again
before MISSION_START. A vehicle that obeys another station, or stores its mission, meanwhile is not started. The modes
are what was measured to work with both autopilots: one that can be armed (ArduPilot stays in AUTO after a mission and
refuses to arm there), arm, MAV_CMD_MISSION_START.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Final

from gcs_plugin.config import COMMAND
from gcs_plugin.links.mavlink import Autopilot, Message, dialect, has_place, is_autopilot
from gcs_plugin.mission.command_dialogues import Command, InOrder, Pilot, Several
from gcs_plugin.mission.download import AT_ONCE, MissionDownload
from gcs_plugin.mission.exchange import MISSION, Address, Exchange, Outcome, Verdict, command_long
from gcs_plugin.mission.flight_modes import Modes, mode_params
from gcs_plugin.mission.items import Mission, difference
from gcs_plugin.mission.mission_builder import unflyable
from orthoswarm.model.earth import distance_m

ARMED: Final = int(dialect.MAV_MODE_FLAG_SAFETY_ARMED)
FRESH_S: Final = 1.0  # what was read longer ago is not what the vehicle is now
_OVERTAKEN_S: Final = 1.5  # a heartbeat of before a change of mode may still arrive: they come once a second
MOVED_M: Final = 10.0  # receivers wander by some metres within minutes; plans keep vehicles 10 m apart
_REPEAT_S: Final = 0.5
_OFTEN_S: Final = 0.25  # a command that follows a look may be repeated for a second only: on a lossy link, often
_SETTLED_S: Final = 3.0  # commands of a start that was broken off have arrived or are lost by then
_SHOWN_S: Final = 0.9  # two heartbeats
_CLIMBED_M: Final = 1.5  # above where it stood: it has left the ground (receivers and barometers err by less at rest)
_CLIMB_S: Final = 60.0  # a mission may let it wait on the ground; PX4 takes up to 8 s
_MOVES: Final = frozenset(
    int(getattr(dialect, f"MAV_CMD_{name}"))
    for name in (
        "COMPONENT_ARM_DISARM", "DO_SET_MODE", "MISSION_START", "NAV_RETURN_TO_LAUNCH", "NAV_LAND", "NAV_TAKEOFF",
        "DO_PAUSE_CONTINUE", "DO_REPOSITION", "DO_SET_MISSION_CURRENT",
    )
)  # fmt: skip


def others_command(message: Message, own: Address) -> bool:
    """True if a COMMAND_ACK shows that a vehicle obeys another station."""
    obeyed = message.result in (dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_IN_PROGRESS)
    return bool(message.command in _MOVES and obeyed and message.target_system not in (0, own.system))


def _others_doing(message: Message, own: Address) -> str:
    """What a vehicle's answer to another station shows, in words; empty if nothing that a start must know."""
    kind = message.get_type()
    if kind == "COMMAND_ACK" and others_command(message, own):
        return "has been commanded by another station"
    stores = kind in ("MISSION_REQUEST", "MISSION_REQUEST_INT") and message.mission_type == MISSION
    return "is given a mission by another station" if stores and message.target_system != own.system else ""


def mission_id(message: Message) -> int:
    """The checksum of the stored mission in a MISSION_CURRENT; 0 if the autopilot sends none (ArduPilot).

    The message's class of pymavlink 2.4 does not know this field, which is behind those that it knows.
    """
    payload = message.get_payload() if hasattr(message, "get_payload") else b""
    return int.from_bytes(bytes(payload or b"")[6:10], "little")


@dataclass(frozen=True, slots=True, kw_only=True)
class Standing:
    """What a vehicle was when its start was given; it must still be that when it is armed.

    Attributes:
        place: latitude and longitude in degrees, None if it was not known, or in the air.
        touched: how often others had changed it or commanded it, as far as its messages show (`Vehicle.touched`).
    """

    mode: int
    armed: bool
    place: tuple[float, float] | None
    touched: int


@dataclass(slots=True, kw_only=True)
class Expected:
    """What a vehicle is to hold.

    Attributes:
        in_air: whether it is started in the air.
        mission: the mission that was checked; None for whatever it holds that can be flown.
        known_id: the vehicle's own checksum of that mission, 0 if it has told none.
    """

    autopilot: Autopilot
    in_air: bool
    mission: Mission | None
    known_id: int = 0

    def wrong(self, stored: Mission) -> str:
        """Why the stored mission is not flown, in words; empty if it is the one."""
        if why := unflyable(stored.items, self.autopilot, in_air=self.in_air):
            return why
        found = "" if self.mission is None else difference(self.mission, stored.items)
        return f"no longer holds the mission that was checked ({found}); check it again" if found else ""


@dataclass(slots=True, kw_only=True)
class LastLook(Exchange):
    """Waits until a vehicle shows, all within a second, what the next command relies on; else says what is not so.

    Attributes:
        mode: what it must be in; was: what it may still be in, by a heartbeat of before.
        armed: whether it must be armed.
        place: where it must stand; expected: what it must hold; None where that does not matter.
        mission: what it holds, once that was read here.
    """

    modes: Modes = field(kw_only=True)
    mode: int = field(kw_only=True)
    was: int | None = field(default=None, kw_only=True)
    armed: bool = field(kw_only=True)
    place: tuple[float, float] | None = field(default=None, kw_only=True)
    expected: Expected | None = field(default=None, kw_only=True)
    mission: Mission | None = field(default=None, init=False)
    _reading: MissionDownload | None = field(default=None, init=False)
    _began: float = field(default=0.0, init=False)
    _ask_at: float = field(default=0.0, init=False)
    _beat: float = field(default=-math.inf, init=False)
    _fix: float = field(default=-math.inf, init=False)
    _read: float = field(default=-math.inf, init=False)

    @property
    def seen_s(self) -> float:
        """When all of it was seen, on the caller's clock: the time of what was seen first."""
        return min(self._beat, self._fix, self._read)

    def start(self, now: float) -> list[Message]:
        """Begin to look, and ask for the mission."""
        self._began = now
        if self.place is None:
            self._fix = math.inf
        if self.expected is None:
            self._read = math.inf
        messages = [] if self.expected is None or self.expected.known_id else self._read_again(now)
        return self._judge([*self._ask_state(now), *messages], now)

    def feed(self, message: Message, now: float) -> list[Message]:
        """Look at a message."""
        if self.outcome is not None:
            return []
        kind = message.get_type()
        if kind == "HEARTBEAT" and is_autopilot(message):
            self._state(int(message.custom_mode), bool(message.base_mode & ARMED), now)
        elif kind == "GLOBAL_POSITION_INT" and self.place is not None and has_place(message):
            away = distance_m(message.lat / 1e7, message.lon / 1e7, *self.place)
            if away > MOVED_M:
                self._stays(f"was moved by {away:.0f} m since its start was given")
            self._fix = now
        elif what := _others_doing(message, self.own):
            self._stays(f"{what} since its start was given")
        messages: list[Message] = []
        if kind == "MISSION_CURRENT" and self.expected is not None and self.expected.known_id and not self._reading:
            if mission_id(message) == self.expected.known_id and self.expected.mission is not None:
                self._holds(self.expected.mission, now)
            else:
                messages = self._read_again(now)
        if self._reading is not None:
            messages += self._reading.feed(message, now)
        return self._judge(messages, now)

    def tick(self, now: float) -> list[Message]:
        """Ask again, or give up."""
        if self.outcome is not None:
            return []
        if now >= self.expires:
            missing = ["its mode"] if now - self._beat > FRESH_S else []
            missing += ["its place"] if now - self._fix > FRESH_S else []
            missing += ["its mission"] if now - self._read > FRESH_S else []
            what = " and ".join(missing) or "all of its state within a second"
            text = f"vehicle {self.vehicle.system} did not show {what} in time, so it was not started; give it again"
            self._end(False, text, Verdict.NOT_SENT)
            return []
        messages = [] if now < self._ask_at else self._ask_state(now)
        return self._judge(messages if self._reading is None else [*messages, *self._reading.tick(now)], now)

    def _ask_state(self, now: float) -> list[Message]:
        """Its state comes once a second or less often, on a slow link: what it would tell is asked for."""
        self._ask_at = now + _OFTEN_S
        kinds = [dialect.MAVLINK_MSG_ID_HEARTBEAT]
        if now - self._fix > FRESH_S:
            kinds.append(dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT)
        return [command_long(self.vehicle, dialect.MAV_CMD_REQUEST_MESSAGE, kind) for kind in kinds]

    def _state(self, mode: int, armed: bool, now: float) -> None:
        late = now - self._began < _OVERTAKEN_S and self._beat < self._began
        if mode != self.mode and not (mode == self.was and late):
            self._stays(f"was put into {self.modes.name(mode)} since its start was given")
        elif armed and not self.armed:
            self._stays("was armed by someone else since its start was given")
        elif self.armed and not armed and not late:
            self._stays("was disarmed since its start was given")
        elif mode == self.mode and armed == self.armed:
            self._beat = now

    def _holds(self, mission: Mission, now: float) -> None:
        self._read = now
        if self.expected is not None and (wrong := self.expected.wrong(mission)):
            self._stays(wrong)

    def _stays(self, why: str) -> None:
        self._end(False, f"vehicle {self.vehicle.system} {why}, so it was not started")

    def _read_again(self, now: float) -> list[Message]:
        assert self.expected is not None
        self._reading = MissionDownload(self.vehicle, self.own, window=AT_ONCE[self.expected.autopilot], urgent=True)
        self._reading.pace = self.pace
        return self._reading.start(now)

    def _judge(self, messages: list[Message], now: float) -> list[Message]:
        reading, expected = self._reading, self.expected
        if reading is not None and reading.outcome is not None and expected is not None:
            self._reading = None
            if reading.items is None:
                self._end(False, f"{reading.outcome.text}, so it was not started", Verdict.NOT_SENT)
                return messages
            self.mission = Mission(expected.autopilot, tuple(reading.items))
            self._holds(self.mission, now)
        if self.outcome is not None:
            return messages
        if self.seen_s >= now - FRESH_S:
            self._end(True, f"vehicle {self.vehicle.system} is as it was")
        elif self._reading is None and expected is not None and now - self._read > FRESH_S and not expected.known_id:
            messages = messages + self._read_again(now)
        if self.outcome is None:
            waits = [self.expires, self._ask_at] if self._reading is None else [self.expires, self._reading.deadline]
            self.deadline = min(waits)
        return messages


@dataclass(slots=True)
class Guarded(Exchange):
    """Looks, and gives an order within a second; if the vehicle refuses or does not answer, both again.

    Attributes:
        obeyed: its mode, and whether it is armed, once it has obeyed. mission: what it was seen to hold.
    """

    look: LastLook = field(kw_only=True)
    order: Command = field(kw_only=True)
    obeyed: tuple[int, bool] | None = field(kw_only=True)
    mission: Mission | None = field(default=None, init=False)
    _step: Exchange = field(init=False)
    _ordered: bool = field(default=False, init=False)
    _again_s: float | None = field(default=None, init=False)

    def start(self, now: float) -> list[Message]:
        """Begin to look."""
        return self._follow(self._next(replace(self.look), now), now)

    def feed(self, message: Message, now: float) -> list[Message]:
        """Hand a message on; its acknowledgement may be lost, and its state tells all the same."""
        if self.outcome is not None:
            return []
        if self._ordered and message.get_type() == "HEARTBEAT" and is_autopilot(message):
            mode, name = int(message.custom_mode), f"vehicle {self.vehicle.system}"
            if (mode, bool(message.base_mode & ARMED)) == self.obeyed:
                self._end(True, f"{name}: {self.order.verb} accepted")
                return []
            if self.obeyed and mode not in (self.look.mode, self.obeyed[0]) and isinstance(self._step, Command):
                self._end(False, f"{name} was put into {self.look.modes.name(mode)} meanwhile, so it was not started")
                return []
        if isinstance(self._step, Command):  # what was seen must stay so while the order is repeated
            watch = replace(self.look, was=None)
            asked = watch.feed(message, now)
            if watch.outcome is not None and not watch.outcome.ok:
                self._end(False, watch.outcome.text, watch.outcome.verdict)
                return []
            if asked and watch.expected is not None and watch.expected.known_id:  # another mission, by its checksum
                self._again_s = None
                return self._follow(self._next(replace(self.look, was=None), now), now)
        elif what := _others_doing(message, self.own):
            self._end(False, f"vehicle {self.vehicle.system} {what} meanwhile, so it was not started")
            return []
        return self._follow(self._step.feed(message, now), now) if self._again_s is None else []

    def tick(self, now: float) -> list[Message]:
        """Let time pass."""
        if self.outcome is not None or (self._again_s is not None and now < self._again_s):
            return []
        if self._again_s is not None:
            self._again_s = None
            return self._follow(self._next(replace(self.look, was=None), now), now)
        return self._follow(self._step.tick(now), now)

    def took(self) -> None:
        """A link has accepted a message."""
        self.delivered += 1
        self._step.took()

    def _next(self, step: Exchange, now: float, expires: float = math.inf) -> list[Message]:
        self._step, step.pace, step.expires = step, self.pace, min(expires, self.expires)
        return step.start(now)

    def _follow(self, messages: list[Message], now: float) -> list[Message]:
        while (outcome := self._step.outcome) is not None:
            step = self._step
            if isinstance(step, LastLook):
                self.mission = step.mission or self.mission
                if not outcome.ok:
                    self._end(False, outcome.text, outcome.verdict)
                    return messages
                order = self._next(replace(self.order), now, step.seen_s + FRESH_S)
                messages, self._ordered = messages + order, True
            elif outcome.ok or now + FRESH_S >= self.expires:
                self._end(outcome.ok, outcome.text, outcome.verdict)
                return messages
            elif outcome.verdict is Verdict.REFUSED:  # it may be ready a second later
                self._again_s = self.deadline = now + FRESH_S
                return messages
            else:
                messages = messages + self._next(replace(self.look, was=None), now)
        self.deadline = self._step.deadline
        return messages


@dataclass(slots=True)
class TakesOff(Exchange):
    """Waits until a vehicle flies its mission, and has left the ground; sends nothing.

    Attributes:
        climbs: whether it stands, so that it has to climb.
        begun_s: when it was first seen on its mission, on the caller's clock.
    """

    modes: Modes = field(kw_only=True)
    climbs: bool = field(kw_only=True)
    begun_s: float | None = field(default=None, init=False)
    _from_m: float | None = field(default=None, init=False)

    def start(self, now: float) -> list[Message]:
        """Start waiting."""
        self.deadline = now + _CLIMB_S
        return []

    def feed(self, message: Message, now: float) -> list[Message]:
        """Look at its mode and height."""
        kind = message.get_type()
        if self.outcome is None and kind == "HEARTBEAT" and is_autopilot(message):
            mode, armed = int(message.custom_mode), message.base_mode & ARMED
            name = f"vehicle {self.vehicle.system}"
            if armed and mode == self.modes.mission:
                self.begun_s = now if self.begun_s is None else self.begun_s
                if not self.climbs:
                    self._end(True, f"{name} flies its mission")
            elif self.begun_s is not None or mode != self.modes.ready:
                why = f"is in {self.modes.name(mode)}" if armed else "was disarmed"
                self._end(False, f"{name} {why} and did not take off")
        elif self.outcome is None and kind == "GLOBAL_POSITION_INT":
            up = message.relative_alt / 1e3
            self._from_m = up if self._from_m is None else min(up, self._from_m)
            if self.begun_s is not None and up - self._from_m >= _CLIMBED_M:
                self._end(True, f"vehicle {self.vehicle.system} flies its mission")
        return []

    def tick(self, now: float) -> list[Message]:
        """Give up after the time-out."""
        if self.outcome is None and now >= self.deadline:
            does = "takes off" if self.begun_s is not None else "flies its mission"
            text = f"vehicle {self.vehicle.system} accepted, but nothing shows that it {does}; look at it"
            self._end(False, text, Verdict.UNKNOWN)
        return []


@dataclass(slots=True)
class OrUndo(Several):
    """A step, and a dialogue that undoes the previous one if the vehicle refuses this step; the refusal is the outcome.

    `undone` is added to its text if undoing succeeded, `left` if it failed.
    """

    undone: str = field(kw_only=True)
    left: str = field(kw_only=True)
    _refusal: str = field(default="", init=False)

    def _step_expires(self, now: float) -> float:
        return self.expires if self._at == 0 else now + COMMAND.fresh_s

    def _ended(self, outcome: Outcome, last: bool) -> bool:
        if last:
            self._end(False, f"{self._refusal}; {self.undone if outcome.ok else self.left}")
        elif outcome.verdict in (Verdict.REFUSED, Verdict.NOT_SENT):
            self._refusal = outcome.text
        else:
            self._end(outcome.ok, outcome.text, outcome.failure)
        return self.outcome is not None


@dataclass(slots=True)
class Start(InOrder):
    """The steps of a start, of which `arm` arms and `takes_off` is the last; it is broken off by `BreakOff` only."""

    arm: Guarded = field(kw_only=True)
    takes_off: TakesOff = field(kw_only=True)


def start_mission(pilot: Pilot, standing: Standing, expected: Expected, *, reads: bool = True) -> Start:
    """The dialogue that lets a vehicle fly its mission from the beginning, and ends when it has left the ground.

    Args:
        pilot: of the vehicle. standing: what it was when the start was given. expected: what it is to hold.
        reads: whether its mission is read here; MAVSDK reads it before.
    """
    vehicle, own, modes = pilot.vehicle, pilot.own, pilot.modes
    look = LastLook(vehicle, own, modes=modes, mode=standing.mode, armed=standing.armed)
    steps: list[Exchange] = []
    if standing.mode != modes.ready:
        change, obeyed = replace(pilot.set_mode(modes.ready), repeat_s=_OFTEN_S), (modes.ready, standing.armed)
        steps.append(Guarded(vehicle, own, look=look, order=change, obeyed=obeyed))
    if expected.in_air and pilot.autopilot is Autopilot.ARDUPILOT:
        # Its MISSION_START goes on at the item at which it left a mission, be that another one; PX4's names item 0.
        item, again = dialect.MAV_CMD_DO_SET_MISSION_CURRENT, "begin its mission anew"
        first = Command(vehicle, own, command=item, params=(0.0,), verb=again, repeat_s=_OFTEN_S)
        there = replace(look, mode=modes.ready, was=standing.mode)
        steps.append(Guarded(vehicle, own, look=there, order=first, obeyed=None))
    place, held = None if expected.in_air else standing.place, expected if reads else None
    last = replace(look, mode=modes.ready, was=standing.mode, place=place, expected=held)
    arming, starting = dialect.MAV_CMD_COMPONENT_ARM_DISARM, dialect.MAV_CMD_MISSION_START
    on = Command(vehicle, own, command=arming, params=(1.0,), verb="arm", repeat_s=_OFTEN_S)
    arm = Guarded(vehicle, own, look=last, order=on, obeyed=(modes.ready, True))
    go = Command(vehicle, own, command=starting, verb="start the mission", repeat_s=_OFTEN_S)
    ready = LastLook(vehicle, own, modes=modes, mode=modes.ready, armed=True)
    begin: Exchange = Guarded(vehicle, own, look=ready, order=go, obeyed=(modes.mission, True))
    if not standing.armed:
        disarm = Command(vehicle, own, command=arming, params=(0.0,), verb="disarm")
        left = "it is still armed: disarm it with the radio control"
        begin = OrUndo(vehicle, own, steps=[begin, disarm], undone="it was disarmed again", left=left)
    takes_off = TakesOff(vehicle, own, modes=modes, climbs=not expected.in_air)
    steps += [arm, begin, takes_off]
    done = "flies its mission"
    return Start(vehicle, own, steps=steps, done=done, carried=len(steps) - 2, arm=arm, takes_off=takes_off)


@dataclass(slots=True)
class BreakOff(Exchange):
    """Ends a start whose commands may still be on their way: disarms, and changes to a mode, again and again.

    The disarming is not forced, so a vehicle that has left the ground refuses it and obeys the change of mode. An
    acknowledgement may be that of the start, so it ends only when the vehicle's state shows it for `_SETTLED_S`.
    """

    autopilot: Autopilot = field(kw_only=True)
    modes: Modes = field(kw_only=True)
    mode: int = field(kw_only=True)
    _began: float = field(default=0.0, init=False)
    _sent: int = field(default=0, init=False)
    _since: dict[str, float] = field(default_factory=dict, init=False)

    def start(self, now: float) -> list[Message]:
        """Send both."""
        self._began = now
        return self._send(now)

    def feed(self, message: Message, now: float) -> list[Message]:
        """Look at its state."""
        if self.outcome is not None or message.get_type() != "HEARTBEAT":
            return []
        if message.autopilot == dialect.MAV_AUTOPILOT_INVALID:
            return []
        armed, name = message.base_mode & ARMED, f"vehicle {self.vehicle.system}"
        there = message.custom_mode == self.mode
        shown = ("in air" if there else "") if armed else "on ground"
        self._since = {shown: self._since.get(shown, now)}
        if shown and now - self._began >= _SETTLED_S and now - self._since[shown] >= _SHOWN_S:
            mode = self.modes.name(self.mode)
            text = f"its start was broken off, it is in {mode}" if armed else "its start was broken off, it is disarmed"
            self._end(True, f"{name}: {text}")
        return []

    def tick(self, now: float) -> list[Message]:
        """Send both again, or give up."""
        if self.outcome is not None or now < self.deadline:
            return []
        if now >= self.expires + _SETTLED_S:
            name, verdict = f"vehicle {self.vehicle.system}", Verdict.UNKNOWN if self.delivered else Verdict.NOT_SENT
            text = "does not show that its start is broken off; watch it, and be ready to use the radio control"
            self._end(False, f"{name} {text}", verdict)
            return []
        if now > self.expires:
            self.deadline = self.expires + _SETTLED_S  # it may still show
            return []
        return self._send(now)

    def _send(self, now: float) -> list[Message]:
        self.deadline = now + _REPEAT_S
        again, self._sent = min(self._sent, 255), self._sent + 1
        mode = mode_params(self.autopilot, self.mode)
        return [
            command_long(self.vehicle, dialect.MAV_CMD_COMPONENT_ARM_DISARM, confirmation=again),
            command_long(self.vehicle, dialect.MAV_CMD_DO_SET_MODE, *mode, confirmation=again),
        ]


def break_off(pilot: Pilot, verb: str) -> BreakOff:
    """End a start that is under way by `pause`, `rtl` or `land`; see `BreakOff`."""
    mode = {"pause": pilot.modes.hold, "rtl": pilot.modes.rtl, "land": pilot.modes.land}[verb]
    return BreakOff(pilot.vehicle, pilot.own, autopilot=pilot.autopilot, modes=pilot.modes, mode=mode)
