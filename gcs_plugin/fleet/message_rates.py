"""Requests messages of a vehicle, again if they stop.

Each message is asked for by MAV_CMD_SET_MESSAGE_INTERVAL: ArduPilot sends nothing without it, PX4 sends 50 Hz of
everything. Acknowledgements do not say which message they are about, so one is asked for at a time.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from gcs_plugin.fleet.heard_messages import HEARD
from gcs_plugin.links.mavlink import Message, dialect
from gcs_plugin.mission.exchange import Address, command_long

_COMMAND: Final = int(dialect.MAV_CMD_SET_MESSAGE_INTERVAL)
_ANSWER_S: Final = 0.7
_TRIES: Final = 4  # requests for one stream
_CHECK_S: Final = 1.0
_WINDOW_S: Final = 5.0
_BACKOFF_S: Final = (3.0, 60.0)


@dataclass(slots=True, kw_only=True)
class _Stream:
    hz: float
    optional: bool
    count: int = 0
    last: float | None = None
    again_at: float = 0.0
    backoff_s: float = _BACKOFF_S[0]


@dataclass(slots=True, kw_only=True)
class Streams:
    """Keeps the streams of one vehicle running. Not a dialogue that ends, so driven by `seen`, `acknowledged`, `tick`.

    Attributes:
        vehicle: whom to ask; own: who asks. rates: what to ask for, message id -> Hz.
        deadline: when `tick` wants to be called.
        refused: messages that the vehicle does not have.
    """

    vehicle: Address
    own: Address
    rates: Mapping[int, float]
    deadline: float = 0.0
    refused: set[int] = field(default_factory=set)
    _streams: dict[int, _Stream] = field(default_factory=dict)
    _queue: list[int] = field(default_factory=list)
    _asking: int | None = None
    _tries: int = 0
    _window: float = 0.0

    @property
    def started(self) -> bool:
        """True once everything has been requested."""
        return bool(self._streams)

    def start(self, now: float) -> list[Message]:
        """Request everything (again after a reboot, or when a vehicle is found again)."""
        before = self._streams
        self._streams = {
            kind: _Stream(
                hz=hz,
                optional=HEARD[kind].optional,
                again_at=now + _BACKOFF_S[0],
                last=before[kind].last if kind in before else None,
            )
            for kind, hz in self.rates.items()
        }
        self.refused.clear()
        self._queue, self._asking, self._window = list(self.rates), None, now
        return self._next(now)

    def seen(self, kind: int, now: float) -> None:
        """A message has arrived."""
        stream = self._streams.get(kind)
        if stream is not None:
            stream.count += 1
            stream.last = now

    def age_s(self, kind: int, now: float) -> float | None:
        """Seconds since a message came last, None if it never has."""
        stream = self._streams.get(kind)
        return None if stream is None or stream.last is None else max(0.0, now - stream.last)

    @property
    def ready_to_check(self) -> bool:
        """True once each message that a check before a start looks at has come, or was refused."""
        asked = [kind for kind in self._streams if HEARD[kind].checked]
        return all(self._streams[kind].last is not None or kind in self.refused for kind in asked)

    def acknowledged(self, message: Message, now: float) -> list[Message]:
        """Process a COMMAND_ACK."""
        if message.command != _COMMAND or self._asking is None or message.target_system not in (0, self.own.system):
            return []
        if message.result not in (dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_IN_PROGRESS):
            self.refused.add(self._asking)
        return self._next(now)

    def tick(self, now: float) -> list[Message]:
        """Repeat a request, and check from time to time that all messages arrive at their rates."""
        if now < self.deadline or not self._streams:
            return []
        if self._asking is not None:
            return self._ask(now) if self._tries < _TRIES else self._next(now)
        self._look(now)
        return self._next(now)

    def ask_clock(self) -> Message:
        """A request for the vehicle's clock, once a second, for a link besides the one in use."""
        return command_long(self.vehicle, _COMMAND, dialect.MAVLINK_MSG_ID_SYSTEM_TIME, 1e6)

    def _next(self, now: float) -> list[Message]:
        self._tries = 0
        self._asking = self._queue.pop(0) if self._queue else None
        if self._asking is None:
            self.deadline = now + _CHECK_S
            return []
        return self._ask(now)

    def _ask(self, now: float) -> list[Message]:
        kind = self._asking
        assert kind is not None
        self._tries += 1
        self.deadline = now + _ANSWER_S
        return [command_long(self.vehicle, _COMMAND, kind, 1e6 / self._streams[kind].hz)]

    def _look(self, now: float) -> None:
        """Queue requests for messages that have stopped or whose rate another ground station has changed."""
        whole_window = now - self._window >= _WINDOW_S
        for kind, stream in self._streams.items():
            if (stream.optional and stream.last is None) or now < stream.again_at:
                continue
            stopped = stream.last is None or now - stream.last > max(3.0, 4.0 / stream.hz)
            if stream.optional and not stopped:
                continue  # at whatever rate it comes
            rate = stream.count / (now - self._window) if whole_window else stream.hz
            if stopped or not 0.4 * stream.hz <= rate <= 2.0 * stream.hz + 1.0:
                self._queue.append(kind)
                stream.again_at = now + stream.backoff_s
                stream.backoff_s = min(_BACKOFF_S[1], 2.0 * stream.backoff_s)
            elif whole_window:
                stream.backoff_s = _BACKOFF_S[0]
        if whole_window:
            self._window = now
            for stream in self._streams.values():
                stream.count = 0
