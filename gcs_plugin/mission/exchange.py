"""A dialogue with one vehicle as a state machine: messages and the time go in, messages come out.

The caller (the fleet, or a test with its own clock) calls `start` once, `feed` for each message of the vehicle's
autopilot, and `tick` at `deadline` at the latest, sends the returned messages, and stops when `outcome` is set.
Times are seconds of any clock that does not go backwards. Nothing here waits, so one thread serves a hundred vehicles.
"""

import abc
import enum
from dataclasses import dataclass, field
from typing import Final

from gcs_plugin.links.mavlink import AUTOPILOT_COMPONENT, BROADCAST, Message, dialect

NEVER: Final = float("inf")
MISSION: Final = int(dialect.MAV_MISSION_TYPE_MISSION)

# MAV_MISSION_RESULT
ACCEPTED: Final = int(dialect.MAV_MISSION_ACCEPTED)
ERROR: Final = int(dialect.MAV_MISSION_ERROR)
UNSUPPORTED_FRAME: Final = int(dialect.MAV_MISSION_UNSUPPORTED_FRAME)
UNSUPPORTED: Final = int(dialect.MAV_MISSION_UNSUPPORTED)
NO_SPACE: Final = int(dialect.MAV_MISSION_NO_SPACE)
INVALID: Final = int(dialect.MAV_MISSION_INVALID)
INVALID_SEQUENCE: Final = int(dialect.MAV_MISSION_INVALID_SEQUENCE)
DENIED: Final = int(dialect.MAV_MISSION_DENIED)
CANCELLED: Final = int(dialect.MAV_MISSION_OPERATION_CANCELLED)


@dataclass(frozen=True, slots=True)
class Address:
    """A MAVLink node: a system id and a component id."""

    system: int
    component: int = AUTOPILOT_COMPONENT


# The usual address of a ground station; ArduPilot's failsafe watches system 255 unless it is told otherwise.
GROUND_STATION: Final = Address(255, 190)


class Verdict(enum.Enum):
    """The outcome of a command.

    DONE: the vehicle acknowledged it. REFUSED: the vehicle or the station refused it. NOT_SENT: nothing left the
    station. UNKNOWN: it was sent and not answered, so that the vehicle may or may not obey.
    """

    DONE = "done"
    REFUSED = "refused"
    NOT_SENT = "not_sent"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """How an exchange ended.

    Attributes:
        text: one sentence for the user.
        item, field, code: of a refused mission: the item's sequence number (None if it is about something else), its
            field (empty if none), and the vehicle's MAV_MISSION_RESULT.
        failure: kind of failure, if it is not ok.
    """

    ok: bool
    text: str
    item: int | None = None
    field: str = ""
    code: int | None = None
    failure: Verdict = Verdict.REFUSED

    @property
    def verdict(self) -> Verdict:
        """DONE, or the kind of failure."""
        return Verdict.DONE if self.ok else self.failure


def command_long(to: Address, command: int, *params: float, confirmation: int = 0) -> Message:
    """A COMMAND_LONG; parameters that are not given are 0."""
    values = (*params, *(0.0,) * 7)[:7]
    return dialect.MAVLink_command_long_message(to.system, to.component, command, confirmation, *values)


@dataclass(slots=True)
class Exchange(abc.ABC):
    """The common part of all dialogues.

    Attributes:
        vehicle: its address. own: our address; replies to others are ignored.
        outcome: None until it has ended.
        deadline: when `tick` wants to be called next.
        expires: after this time nothing that starts the command may be sent.
        pace: seconds of the vehicle's clock in one of ours (a simulation may run fast); its time-outs are its own.
        delivered: messages that a link accepted; counted by the caller.
    """

    vehicle: Address
    own: Address = GROUND_STATION
    outcome: Outcome | None = field(default=None, init=False)
    deadline: float = field(default=NEVER, init=False)
    expires: float = field(default=NEVER, init=False)
    pace: float = field(default=1.0, init=False)
    delivered: int = field(default=0, init=False)

    @abc.abstractmethod
    def start(self, now: float) -> list[Message]:
        """Start; returns the messages to send."""

    @abc.abstractmethod
    def feed(self, message: Message, now: float) -> list[Message]:
        """Process a message of the vehicle; returns the messages to send."""

    @abc.abstractmethod
    def tick(self, now: float) -> list[Message]:
        """Process the passing of time; returns the messages to send."""

    def rebooted(self, now: float) -> list[Message]:
        """The vehicle has rebooted; returns the messages to send. Most dialogues just repeat their requests."""
        return []

    def cancel(self, why: str) -> None:
        """End it without success; nothing more is sent."""
        if self.outcome is None:
            sent = Verdict.UNKNOWN if self.delivered else Verdict.NOT_SENT
            self._end(False, f"vehicle {self.vehicle.system}: {why}", sent)

    def took(self) -> None:
        """A link has accepted a message of this exchange."""
        self.delivered += 1

    @property
    def mission_type(self) -> int:
        """Which list of the mission protocol this is about (MAV_MISSION_TYPE)."""
        return MISSION

    @property
    def message_expires(self) -> float:
        """Time after which its present message may no longer be sent."""
        return self.expires

    @property
    def leaves_mode(self) -> bool:
        """Whether a transfer of a mission is still changing the vehicle's mode."""
        return False

    def _for_us(self, message: Message) -> bool:
        """Whether an answer is; autopilots that do not fill the target leave 0, as those do that say it to all."""
        ours = message.target_system in (self.own.system, BROADCAST)
        return ours and message.target_component in (self.own.component, BROADCAST)

    def _mission_kind(self, message: Message) -> str:
        """The type of a message of the mission protocol that is meant for us while this is under way, else empty."""
        kind = str(message.get_type())
        if self.outcome is not None or not kind.startswith("MISSION_") or not hasattr(message, "target_system"):
            return ""
        if getattr(message, "mission_type", MISSION) != self.mission_type:
            return ""
        return kind if self._for_us(message) else ""

    def _end(self, ok: bool, text: str, failure: Verdict = Verdict.REFUSED) -> None:
        self.outcome, self.deadline = Outcome(ok=ok, text=text, failure=failure), NEVER


@dataclass(slots=True)
class RoundTrip:
    """Time to wait for an answer before repeating a request: a few round-trip times, longer after silence.

    Attributes:
        wait_s: the time to wait now.
        longest_s: the longest wait; a vehicle gives a dialogue up after a few seconds of its own clock.
    """

    wait_s: float = 0.7
    longest_s: float = 2.0
    _usual_s: float = 0.7
    _smooth_s: float | None = None

    def answered(self, took_s: float, *, asked_again: bool) -> None:
        """An answer arrived; after repeated requests it is ambiguous which one it answers, so it is not measured."""
        if not asked_again:
            self._smooth_s = took_s if self._smooth_s is None else 0.8 * self._smooth_s + 0.2 * took_s
            self._usual_s = max(0.2, 4.0 * self._smooth_s)
        self.wait_s = min(self.longest_s, self._usual_s)

    def missed(self) -> None:
        """No answer arrived in time."""
        self.wait_s = min(self.longest_s, 1.4 * self.wait_s)
