"""Commands to a vehicle: start, pause, resume, return, land. Each is sent because a person asked for it.

Start is what was measured to work with both autopilots: a mode that can be armed (ArduPilot stays in AUTO after a
mission and refuses to arm there), arm, MAV_CMD_MISSION_START. Before that the mission is read from the vehicle, because
an autopilot that refuses MISSION_START has been armed already by then.
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gcs_plugin.config import COMMAND
from gcs_plugin.links.mavlink import Autopilot, Message, dialect
from gcs_plugin.mission.download import MissionDownload
from gcs_plugin.mission.exchange import NEVER, Address, Exchange, Outcome, Verdict
from gcs_plugin.mission.flight_modes import Modes, mode_params
from gcs_plugin.mission.items import Mission
from gcs_plugin.mission.mission_builder import unflyable

_ACCEPTED: Final = int(dialect.MAV_RESULT_ACCEPTED)
_IN_PROGRESS: Final = int(dialect.MAV_RESULT_IN_PROGRESS)
_UNSUPPORTED: Final = int(dialect.MAV_RESULT_UNSUPPORTED)
_REPEAT_S: Final = 0.5
_AGAIN_S: Final = 1.0
_ANSWER_S: Final = 1.0
_FIRST_S: Final = 2.0  # silence after which the other way is tried
_SETTLED_S: Final = 3.0  # commands of a start that was broken off have arrived or are lost by then
_SHOWN_S: Final = 0.9  # two heartbeats


@dataclass(slots=True)
class Command(Exchange):
    """One COMMAND_LONG, repeated until it is acknowledged or expires.

    Attributes:
        command: MAV_CMD.
        params: parameters 1 to 7, missing ones 0.
        verb: what it does, for messages: "arm".
        insist_s: how long the command is repeated after refusals.
        patience_s: silence after which it gives up, if it does not expire before.
        reasons: the vehicle's texts meanwhile.
    """

    command: int = field(kw_only=True)
    params: tuple[float, ...] = field(default=(), kw_only=True)
    verb: str = field(kw_only=True)
    insist_s: float = field(default=0.0, kw_only=True)
    patience_s: float = field(default=10.0, kw_only=True)
    reasons: list[str] = field(default_factory=list, init=False)
    _began: float = field(default=0.0, init=False)
    _heard: float = field(default=0.0, init=False)
    _sent: int = field(default=0, init=False)

    def start(self, now: float) -> list[Message]:
        """Send it."""
        self._began = self._heard = now
        if now > self.expires:
            self._expired(now)
            return []
        return self._send(now)

    def feed(self, message: Message, now: float) -> list[Message]:
        """Process COMMAND_ACK, and store texts that may contain the reason of a refusal."""
        kind = message.get_type()
        if self.outcome is not None:
            return []
        if kind == "STATUSTEXT" and message.severity <= dialect.MAV_SEVERITY_WARNING:
            text = str(message.text).strip("\x00 ")
            if text and text not in self.reasons:
                self.reasons = [*self.reasons[-2:], text]
        if kind != "COMMAND_ACK" or message.command != self.command or not self._meant(message):
            return []
        self._heard = now
        result = int(message.result)
        if result == _ACCEPTED:
            self._end(True, f"vehicle {self.vehicle.system}: {self.verb} accepted")
        elif result == _IN_PROGRESS:
            self.deadline = now + self.patience_s
        elif now - self._began < self.insist_s and now + _AGAIN_S < self.expires and result != _UNSUPPORTED:
            self.deadline = now + _AGAIN_S
        else:
            self._refuse(result)
        return []

    def tick(self, now: float) -> list[Message]:
        """Send it again, or give up."""
        if self.outcome is not None or now < self.deadline:
            return []
        if now - self._heard >= self.patience_s or now >= self.expires + _ANSWER_S:
            self._expired(now)
            return []
        if now > self.expires:
            self.deadline = self.expires + _ANSWER_S  # the last attempt may still be answered
            return []
        return self._send(now)

    def _meant(self, message: Message) -> bool:
        # Autopilots that do not fill the target leave 0.
        return message.target_system in (0, self.own.system) and message.target_component in (0, self.own.component)

    def _expired(self, now: float) -> None:
        name = f"vehicle {self.vehicle.system}"
        if self.delivered:
            advice = "watch whether it obeys, then give it again or use the radio control"
            self._end(False, f"{name} did not answer to '{self.verb}'; {advice}", Verdict.UNKNOWN)
        elif not self._sent:
            late = now - self.expires + COMMAND.fresh_s
            text = f"{name}: '{self.verb}' was given {late:.0f} s ago and was not sent; give it again"
            self._end(False, text, Verdict.NOT_SENT)
        else:
            text = f"{name}: no link takes '{self.verb}'; use the radio control, or give it again when the link is back"
            self._end(False, text, Verdict.NOT_SENT)

    def _send(self, now: float) -> list[Message]:
        self.deadline = now + _REPEAT_S
        values = (*self.params, *(0.0,) * 7)[:7]
        confirmation, self._sent = min(self._sent, 255), self._sent + 1
        to = self.vehicle
        return [dialect.MAVLink_command_long_message(to.system, to.component, self.command, confirmation, *values)]

    def _refuse(self, result: int) -> None:
        entry = dialect.enums["MAV_RESULT"].get(result)
        name = str(entry.name).removeprefix("MAV_RESULT_").lower().replace("_", " ") if entry else str(result)
        why = "; ".join(self.reasons) or "it gives no reason"
        self._end(False, f"vehicle {self.vehicle.system} refuses to {self.verb} ({name}): {why}")


@dataclass(slots=True)
class Confirm(Exchange):
    """Waits until the vehicle's messages confirm a condition; sends nothing."""

    shown: Callable[[Message], bool] = field(kw_only=True)
    what: str = field(kw_only=True)
    patience_s: float = field(default=15.0, kw_only=True)

    def start(self, now: float) -> list[Message]:
        """Start waiting."""
        self.deadline = now + self.patience_s
        return []

    def feed(self, message: Message, now: float) -> list[Message]:
        """Check a message."""
        if self.outcome is None and self.shown(message):
            self._end(True, f"vehicle {self.vehicle.system} {self.what}")
        return []

    def tick(self, now: float) -> list[Message]:
        """Give up after the time-out."""
        if self.outcome is None and now >= self.deadline:
            text = f"vehicle {self.vehicle.system} accepted, but nothing shows that it {self.what}; look at it"
            self._end(False, text, Verdict.UNKNOWN)
        return []


@dataclass(slots=True)
class CheckMission(Exchange):
    """Reads the mission and says whether the vehicle can start it from the ground.

    Attributes:
        mission: the stored mission, once it is read.
    """

    autopilot: Autopilot = field(kw_only=True)
    in_air: bool = field(default=False, kw_only=True)
    mission: Mission | None = field(default=None, init=False)
    _reading: MissionDownload = field(init=False)

    def __post_init__(self) -> None:
        """Prepare the download."""
        self._reading = MissionDownload(self.vehicle, self.own, patience_s=15.0)

    def start(self, now: float) -> list[Message]:
        """Ask for the mission."""
        self._reading.patience_s = min(15.0, self.expires - now)
        return self._follow(self._reading.start(now))

    def feed(self, message: Message, now: float) -> list[Message]:
        """Take items."""
        return self._follow(self._reading.feed(message, now)) if self.outcome is None else []

    def tick(self, now: float) -> list[Message]:
        """Ask again."""
        return self._follow(self._reading.tick(now)) if self.outcome is None else []

    def _follow(self, messages: list[Message]) -> list[Message]:
        reading = self._reading
        self.deadline = reading.deadline
        if reading.outcome is None:
            return messages
        if reading.items is None:
            self._end(False, reading.outcome.text, Verdict.NOT_SENT)
            return messages
        self.mission = Mission(self.autopilot, tuple(reading.items))
        wrong = unflyable(reading.items, self.autopilot, in_air=self.in_air)
        self._end(not wrong, f"vehicle {self.vehicle.system} {wrong or 'has a mission that it can start'}")
        return messages


@dataclass(slots=True)
class _Several(Exchange):
    """Dialogues one after the other; subclasses decide what the end of one means.

    Attributes:
        steps: the dialogues.
    """

    steps: list[Exchange] = field(kw_only=True)
    _at: int = field(default=0, init=False)

    def start(self, now: float) -> list[Message]:
        """Begin with the first."""
        return self._follow(self._begin(now), now)

    def feed(self, message: Message, now: float) -> list[Message]:
        """Hand a message to the present one."""
        return self._follow(self.steps[self._at].feed(message, now), now) if self.outcome is None else []

    def tick(self, now: float) -> list[Message]:
        """Let time pass for the present one."""
        return self._follow(self.steps[self._at].tick(now), now) if self.outcome is None else []

    def rebooted(self, now: float) -> list[Message]:
        """Tell the present one."""
        return self._follow(self.steps[self._at].rebooted(now), now) if self.outcome is None else []

    @property
    def progress(self) -> float:
        """Share of the steps that are done."""
        return 1.0 if self.outcome is not None else self._at / len(self.steps)

    def _follow(self, messages: list[Message], now: float) -> list[Message]:
        while (outcome := self.steps[self._at].outcome) is not None:
            last = self._at + 1 == len(self.steps)
            if self._ended(outcome, last):
                return messages
            self._at += 1
            messages = messages + self._begin(now)
        self.deadline = self.steps[self._at].deadline
        return messages

    def took(self) -> None:
        """A link has accepted a message of the present dialogue."""
        self.delivered += 1
        self.steps[self._at].took()

    def _begin(self, now: float) -> list[Message]:
        step = self.steps[self._at]
        step.expires = self._step_expires(now)
        return step.start(now)

    def _step_expires(self, now: float) -> float:
        return self.expires

    @abc.abstractmethod
    def _ended(self, outcome: Outcome, last: bool) -> bool:
        """A step has ended: end all and return True, or return False to continue with the next."""


@dataclass(slots=True)
class InOrder(_Several):
    """Steps one after the other; the first that fails ends it.

    Attributes:
        done: text at the end.
        carried: from this step on the vehicle is already executing the command, so later steps may take their own time.
    """

    done: str = field(kw_only=True)
    carried: int = field(default=1000, kw_only=True)

    def _step_expires(self, now: float) -> float:
        return now + COMMAND.fresh_s if self._at >= self.carried and self.expires < NEVER else self.expires

    def _ended(self, outcome: Outcome, last: bool) -> bool:
        if not outcome.ok:
            self._end(False, outcome.text, outcome.verdict)
        elif last:
            self._end(True, f"vehicle {self.vehicle.system} {self.done}")
        return self.outcome is not None


@dataclass(slots=True)
class Start(InOrder):
    """The steps of a start; it is broken off by `BreakOff` only."""


@dataclass(slots=True)
class BreakOff(Exchange):
    """Ends a start whose commands may still be on their way: disarms, and changes the mode, again and again.

    The disarming is not forced, so a vehicle that has left the ground refuses it and obeys the change of mode. An
    acknowledgement may be that of the start, so it ends only when the vehicle's state shows it for `_SETTLED_S`.

    Attributes:
        modes: the autopilot's; mode: the one to end in. autopilot: its dialect.
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
        armed, name = message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED, f"vehicle {self.vehicle.system}"
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
        again, self._sent, to = min(self._sent, 255), self._sent + 1, self.vehicle
        mode = (*mode_params(self.autopilot, self.mode), *(0.0,) * 7)[:7]
        return [
            dialect.MAVLink_command_long_message(
                to.system, to.component, dialect.MAV_CMD_COMPONENT_ARM_DISARM, again, *(0.0,) * 7
            ),
            dialect.MAVLink_command_long_message(to.system, to.component, dialect.MAV_CMD_DO_SET_MODE, again, *mode),
        ]


@dataclass(slots=True)
class OrUndo(_Several):
    """A step, and a dialogue that undoes the previous one if the vehicle refuses this step; the refusal is the outcome.

    Attributes:
        undone: text added if undoing succeeded; left: if it failed.
    """

    undone: str = field(kw_only=True)
    left: str = field(kw_only=True)
    _refusal: str = field(default="", init=False)

    def _step_expires(self, now: float) -> float:
        return self.expires if self._at == 0 else now + COMMAND.fresh_s

    def _ended(self, outcome: Outcome, last: bool) -> bool:
        if last:
            self._end(False, f"{self._refusal}; {self.undone if outcome.ok else self.left}")
        elif outcome.verdict is Verdict.REFUSED:
            self._refusal = outcome.text
        else:
            self._end(outcome.ok, outcome.text, outcome.failure)
        return self.outcome is not None


@dataclass(slots=True)
class Either(_Several):
    """A dialogue, and an alternative if the vehicle refuses the first or does not answer."""

    _unsure: str = field(default="", init=False)

    def _ended(self, outcome: Outcome, last: bool) -> bool:
        if outcome.ok:
            self._end(True, outcome.text)
        elif outcome.verdict is Verdict.UNKNOWN and not last:
            self._unsure = outcome.text
        elif last and self._unsure:
            self._end(False, self._unsure, Verdict.UNKNOWN)
        elif last or outcome.verdict is Verdict.NOT_SENT:
            self._end(False, outcome.text, outcome.verdict)
        return self.outcome is not None


@dataclass(frozen=True, slots=True)
class Pilot:
    """Makes the commands for one vehicle.

    Attributes:
        vehicle: its address; own: ours.
        autopilot: its dialect; modes: its modes.
    """

    vehicle: Address
    own: Address
    autopilot: Autopilot
    modes: Modes

    def set_mode(self, custom_mode: int, insist_s: float = 3.0) -> Command:
        """Change the mode; asked again for so long if it is refused."""
        return Command(
            self.vehicle, self.own, command=dialect.MAV_CMD_DO_SET_MODE,
            params=mode_params(self.autopilot, custom_mode), verb=f"change to {self.modes.name(custom_mode)}",
            insist_s=insist_s,
        )  # fmt: skip

    def start(self, *, in_air: bool = False, armed: bool = False, check: bool = True) -> Exchange:
        """Fly the mission from its beginning: check it, then mode, arm, MISSION_START, and wait until it flies.

        Args:
            in_air: whether it flies. armed: whether it is armed; if not, it is disarmed again when the start is
            refused.
            check: whether its mission has to be read first.
        """
        steps: list[Exchange] = []
        if check:
            steps.append(CheckMission(self.vehicle, self.own, autopilot=self.autopilot, in_air=in_air))
        arm = Command(
            self.vehicle, self.own, command=dialect.MAV_CMD_COMPONENT_ARM_DISARM, params=(1.0,), verb="arm",
            insist_s=COMMAND.fresh_s,
        )  # fmt: skip
        go: Exchange = Command(
            self.vehicle, self.own, command=dialect.MAV_CMD_MISSION_START, verb="start the mission", insist_s=3.0
        )
        if not (in_air or armed):
            disarm = Command(
                self.vehicle, self.own, command=dialect.MAV_CMD_COMPONENT_ARM_DISARM, params=(0.0,), verb="disarm"
            )
            left = "it is still armed: disarm it with the radio control"
            go = OrUndo(self.vehicle, self.own, steps=[go, disarm], undone="it was disarmed again", left=left)
        flies = Confirm(self.vehicle, self.own, shown=self._flies, what="flies its mission")
        steps.append(self.set_mode(self.modes.ready))
        if in_air and self.autopilot is Autopilot.ARDUPILOT:
            # Its MISSION_START goes on at the item at which it left a mission, be that another one; PX4's names item 0.
            first = dialect.MAV_CMD_DO_SET_MISSION_CURRENT
            steps.append(Command(self.vehicle, self.own, command=first, params=(0.0,), verb="begin its mission anew"))
        steps += [arm, go, flies]
        return Start(self.vehicle, self.own, steps=steps, done="flies its mission", carried=len(steps) - 2)

    def pause(self) -> Exchange:
        """Hold position. ArduPilot's own pause works between waypoints only, BRAKE everywhere."""
        ways: list[Exchange] = [self.set_mode(self.modes.hold)]
        if self.autopilot is Autopilot.ARDUPILOT:
            ways.insert(0, self._pause_continue(0.0, "pause"))
        return Either(self.vehicle, self.own, steps=ways)

    def resume(self, *, in_mission_mode: bool) -> Exchange:
        """Continue the mission where it was left."""
        if self.autopilot is Autopilot.ARDUPILOT and in_mission_mode:
            return self._pause_continue(1.0, "resume")
        return self.set_mode(self.modes.mission)

    def rtl(self) -> Exchange:
        """Fly home and land."""
        home = Command(
            self.vehicle, self.own, command=dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH, verb="return to launch",
            patience_s=_FIRST_S,
        )  # fmt: skip
        return Either(self.vehicle, self.own, steps=[home, self.set_mode(self.modes.rtl)])

    def land(self) -> Exchange:
        """Land where it is."""
        down = Command(self.vehicle, self.own, command=dialect.MAV_CMD_NAV_LAND, verb="land", patience_s=_FIRST_S)
        return Either(self.vehicle, self.own, steps=[down, self.set_mode(self.modes.land)])

    def break_off(self, verb: str) -> BreakOff:
        """End a start that is under way by `pause`, `rtl` or `land`; see `BreakOff`."""
        mode = {"pause": self.modes.hold, "rtl": self.modes.rtl, "land": self.modes.land}[verb]
        return BreakOff(self.vehicle, self.own, autopilot=self.autopilot, modes=self.modes, mode=mode)

    def _pause_continue(self, go_on: float, verb: str) -> Command:
        return Command(
            self.vehicle, self.own, command=dialect.MAV_CMD_DO_PAUSE_CONTINUE, params=(go_on,), verb=verb,
            patience_s=_FIRST_S,
        )  # fmt: skip

    def _flies(self, message: Message) -> bool:
        return bool(
            message.get_type() == "HEARTBEAT"
            and message.autopilot != dialect.MAV_AUTOPILOT_INVALID
            and message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
            and message.custom_mode == self.modes.mission
        )
