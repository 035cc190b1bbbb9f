"""The operator's commands to vehicles as values with an id, an expiry and an outcome, for every console."""

import itertools
import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from gcs_plugin.config import COMMAND
from gcs_plugin.mission.exchange import Outcome, Verdict

if TYPE_CHECKING:
    from gcs_plugin.mission.exchange import Exchange
    from gcs_plugin.mission.items import Mission
    from gcs_plugin.mission.start_dialogue import Standing

Verb = Literal["start", "pause", "resume", "continue", "rtl", "land"]
VERBS: Final[tuple[Verb, ...]] = get_args(Verb)
"""`resume` ends a pause, whatever was paused; `continue` goes on with a mission that was left, for a return, too."""
URGENT: Final[frozenset[str]] = frozenset({"pause", "rtl", "land"})
"""Commands that bring a flight to its end: no doubt about identity or link ever blocks them."""

_numbers = itertools.count(1)


def new_id() -> str:
    """A unique command id."""
    return f"{os.getpid():x}-{os.urandom(3).hex()}-{next(_numbers)}"


@dataclass(frozen=True, slots=True)
class CommandResult:
    """How a command to one vehicle ended.

    Attributes:
        id: of the command; a command to several vehicles has one id.
        vehicle: its name: v1, or as the operator calls it.
        command: one of VERBS, `upload` or `fence`.
        reason: one sentence; if not done, the reason and what to do.
    """

    id: str
    vehicle: str
    command: str
    outcome: Verdict
    reason: str

    def document(self) -> dict[str, Any]:
        """As JSON values: `id`, `vehicle`, `command`, `outcome` (done, refused, not_sent, unknown), `reason`."""
        return {
            "id": self.id, "vehicle": self.vehicle, "command": self.command, "outcome": self.outcome.value,
            "reason": self.reason,
        }  # fmt: skip


@dataclass(slots=True, eq=False, kw_only=True)
class Order:
    """One command to one vehicle, under way or ended.

    Attributes:
        given_s: when it was given (the fleet's monotonic clock); it is not sent later than COMMAND.fresh_s after that.
        stops: of a start, `Fleet.stops` (0 if none) when it was given: a pause, RTL or land since then makes it void.
        standing: of a start, what the vehicle was when it was given; it is not started if that has changed since.
        mission: of a start, the mission that was checked; it is not started with another one.
        exchange: the dialogue with the vehicle, None if none was started.
    """

    verb: Verb
    system: int
    given_s: float
    stops: int | None = None
    standing: "Standing | None" = None
    mission: "Mission | None" = None
    id: str = field(default_factory=new_id)
    exchange: "Exchange | None" = None
    _ended: Outcome | None = None

    @property
    def expires_s(self) -> float:
        """Time after which it may not be sent."""
        return self.given_s + COMMAND.fresh_s

    @property
    def begun_s(self) -> float | None:
        """Of a start: when the vehicle was first seen on its mission (the fleet's clock), before it had climbed."""
        takes_off = getattr(self.exchange, "takes_off", None)
        return None if takes_off is None else takes_off.begun_s

    @property
    def outcome(self) -> Outcome | None:
        """How it ended, None while it is under way."""
        return self.exchange.outcome if self.exchange is not None else self._ended

    def end(self, text: str, failure: Verdict) -> "Order":
        """End it without a dialogue."""
        self._ended = Outcome(ok=False, text=text, failure=failure)
        return self

    def result(self, name: str = "") -> CommandResult | None:
        """How it ended, None while it is under way."""
        outcome = self.outcome
        if outcome is None:
            return None
        return CommandResult(self.id, name or f"v{self.system}", self.verb, outcome.verdict, outcome.text)
