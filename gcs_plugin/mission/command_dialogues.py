"""Commands to a vehicle: pause, resume, return, land. Each is sent because a person asked for it."""

import abc
import math
from dataclasses import dataclass, field
from typing import Final

from gcs_plugin.config import COMMAND
from gcs_plugin.links.mavlink import Autopilot, Message, dialect, is_autopilot
from gcs_plugin.mission.exchange import NEVER, Address, Exchange, Outcome, Verdict, command_long
from gcs_plugin.mission.flight_modes import LANDS, RETURNS, Modes, mode_params

_ACCEPTED: Final = int(dialect.MAV_RESULT_ACCEPTED)
_IN_PROGRESS: Final = int(dialect.MAV_RESULT_IN_PROGRESS)
_UNSUPPORTED: Final = int(dialect.MAV_RESULT_UNSUPPORTED)
_ENDS: Final = frozenset({int(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH), int(dialect.MAV_CMD_NAV_LAND)})
_AGAIN_S: Final = 1.0
_ANSWER_S: Final = 1.0
_FIRST_S: Final = 2.0  # silence after which the other way is tried


@dataclass(slots=True, kw_only=True)
class Command(Exchange):
    """One COMMAND_LONG, repeated until it is acknowledged or expires.

    Attributes:
        command: MAV_CMD. verb: what it does, for messages: "arm".
        insist_s: how long the command is repeated after refusals. repeat_s: time between repetitions without an answer.
        patience_s: silence after which it gives up, if it does not expire before.
        reasons: the vehicle's texts meanwhile.
    """

    command: int = field(kw_only=True)
    params: tuple[float, ...] = field(default=(), kw_only=True)
    verb: str = field(kw_only=True)
    insist_s: float = field(default=0.0, kw_only=True)
    patience_s: float = field(default=10.0, kw_only=True)
    repeat_s: float = field(default=0.5, kw_only=True)
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
        if kind != "COMMAND_ACK" or message.command != self.command or not self._for_us(message):
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
        self.deadline = now + self.repeat_s
        again, self._sent = min(self._sent, 255), self._sent + 1
        return [command_long(self.vehicle, self.command, *self.params, confirmation=again)]

    def _refuse(self, result: int) -> None:
        entry = dialect.enums["MAV_RESULT"].get(result)
        name = str(entry.name).removeprefix("MAV_RESULT_").lower().replace("_", " ") if entry else str(result)
        why = "; ".join(self.reasons) or "it gives no reason"
        self._end(False, f"vehicle {self.vehicle.system} refuses to {self.verb} ({name}): {why}")


@dataclass(slots=True)
class GoOn(Command):
    """A command to go on with a mission, void if the vehicle changes from its mode (`was`) to a return or landing."""

    modes: Modes = field(kw_only=True)
    was: int = field(kw_only=True)

    def feed(self, message: Message, now: float) -> list[Message]:
        """Look at its mode, too."""
        if self.outcome is None and message.get_type() == "HEARTBEAT" and is_autopilot(message):
            mode = int(message.custom_mode)
            if mode != self.was and self.modes.name(mode) in RETURNS | LANDS:
                self._end(False, f"vehicle {self.vehicle.system} was put into {self.modes.name(mode)} meanwhile")
        others = message.get_type() == "COMMAND_ACK" and message.target_system not in (0, self.own.system)
        if self.outcome is None and others and message.result == _ACCEPTED and message.command in _ENDS:
            self._end(False, f"vehicle {self.vehicle.system} was sent home, or down, by another station meanwhile")
        return Command.feed(self, message, now)


@dataclass(slots=True)
class Several(Exchange):
    """Dialogues one after the other; subclasses decide what the end of one means."""

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
class InOrder(Several):
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
class Either(Several):
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
    """Makes the commands for one vehicle; `own` is our address."""

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

    def pause(self, *, held: bool = False) -> Exchange:
        """Hold position. ArduPilot's own pause works between waypoints only, BRAKE everywhere.

        A PX4 that is in HOLD already (`held`) may be under way to where another station has sent it. HOLD does not end
        that: it is sent to where it is.
        """
        ways: list[Exchange] = [self.set_mode(self.modes.hold)]
        if held and self.autopilot is Autopilot.PX4:
            here, flag = (math.nan,) * 4, float(dialect.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE)
            stay = dialect.MAV_CMD_DO_REPOSITION
            ways.insert(0, Command(self.vehicle, self.own, command=stay, params=(-1.0, flag, 0.0, *here), verb="hold"))
        if self.autopilot is Autopilot.ARDUPILOT:
            pause = dialect.MAV_CMD_DO_PAUSE_CONTINUE
            ways.insert(0, Command(self.vehicle, self.own, command=pause, verb="pause", patience_s=_FIRST_S))
        return Either(self.vehicle, self.own, steps=ways)

    def go_on(self, mode: int) -> Exchange:
        """Continue the mission where it was left, from a mode."""
        pauses = self.autopilot is Autopilot.ARDUPILOT and mode == self.modes.mission
        params = (1.0, 0.0, 0.0) if pauses else mode_params(self.autopilot, self.modes.mission)
        command = dialect.MAV_CMD_DO_PAUSE_CONTINUE if pauses else dialect.MAV_CMD_DO_SET_MODE
        verb = "resume" if pauses else f"change to {self.modes.name(self.modes.mission)}"
        return GoOn(
            self.vehicle, self.own, command=command, params=params, verb=verb, insist_s=0.0 if pauses else 3.0,
            modes=self.modes, was=mode,
        )  # fmt: skip

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
