"""One job at a time over MAVLink FTP with one vehicle: numbers, repetition, pace; in the links' thread.

The pace follows the delay, as in LEDBAT (RFC 6817), so that a link's other messages are not held up: answers that take
longer than the quickest lately have waited behind others, so the rate falls; it rises slowly otherwise, up to a bound.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gcs_plugin.daemon.flight_coverage.file_download import FtpJob, numbered
from gcs_plugin.links.file_transfer import FRAME_BYTES, FtpPayload
from gcs_plugin.links.mavlink import Message

_AT_ONCE: Final = 4
"""ArduPilot's server holds five requests."""
_PATIENCE: Final = 4.0  # times the quickest answer
_LEAST_PATIENCE_S, _MOST_PATIENCE_S = 0.5, 4.0
_SILENT_S: Final = 12.0
_BUSY_S: Final = 5.0
_LEAST_BYTES_S: Final = 600.0
"""Two packets a second."""
_TARGET_S: Final = 0.1
_MEMORY_S: Final = 30.0
_UP, _DOWN, _LOST = 1.04, 0.75, 0.9


class LinkShare:
    """A rate that follows the delay.

    Args:
        most_bytes_s: upper bound, bytes a second.

    Attributes:
        rate: bytes a second.
    """

    def __init__(self, most_bytes_s: float) -> None:
        self.most, self.rate = most_bytes_s, min(most_bytes_s, 3.0 * _LEAST_BYTES_S)
        self._times: deque[tuple[float, float]] = deque()
        self._room, self._at = 0.0, 0.0
        self._fell_at = 0.0

    def allows(self, size: int, now: float) -> bool:
        """Whether a packet of so many bytes may be asked for now; it counts as asked for if so."""
        burst = max(float(size), 0.1 * self.rate)
        self._room = min(burst, self._room + self.rate * max(0.0, now - self._at))
        self._at = now
        if self._room < size:
            return False
        self._room -= size
        return True

    @property
    def quickest_s(self) -> float:
        """The shortest answer of the last half minute, seconds; a second while none is known."""
        return min((took for _, took in self._times), default=1.0)

    def answered(self, took_s: float, now: float) -> None:
        """An answer has come after so many seconds."""
        while self._times and self._times[0][0] < now - _MEMORY_S:
            self._times.popleft()
        self._times.append((now, took_s))
        if took_s > self.quickest_s + _TARGET_S:
            self._fall(_DOWN, now)
        else:
            self.rate = min(self.most, self.rate * _UP)

    def lost(self, now: float) -> None:
        """An answer has not come."""
        self._fall(_LOST, now)

    def _fall(self, share: float, now: float) -> None:
        if now - self._fell_at >= self.quickest_s + _TARGET_S:  # once for each round of answers
            self._fell_at = now
            self.rate = max(min(_LEAST_BYTES_S, self.most), self.rate * share)


@dataclass(slots=True)
class _Asked:
    payload: FtpPayload
    at: float
    tries: int = 1


@dataclass(slots=True, kw_only=True)
class FtpTalk:
    """A job under way.

    Attributes:
        job: what is done. system, component: with whom. share: the pace. send: sends messages to a system.
        silent: True once the vehicle has not answered for long; what it has sent stays with the job.
    """

    job: FtpJob
    system: int
    component: int
    share: LinkShare
    send: Callable[[int, list[Message]], None]
    began: float
    silent: bool = False
    _number: int = 0
    _asked: dict[int, _Asked] = field(default_factory=dict)
    _heard: float = field(init=False)
    _rest_until: float = 0.0

    def __post_init__(self) -> None:
        """Nothing is heard yet."""
        self._heard = self.began
        self.job.forget_asked()

    @property
    def over(self) -> bool:
        """True once nothing more is to be done."""
        return self.job.done or self.silent

    def answer(self, answer: FtpPayload, now: float) -> None:
        """Process a packet of the vehicle."""
        asked = self._asked.pop((answer.number - 1) & 0xFFFF, None)
        if asked is None:
            return
        self._heard = now
        if asked.tries == 1:
            self.share.answered(now - asked.at, now)
        busy = self.job.busy
        self.job.answered(asked.payload, answer)
        if self.job.busy > busy:
            self._rest_until = now + _BUSY_S

    def step(self, now: float) -> None:
        """Ask for more, and again for what has not come."""
        if self.over or now < self._rest_until:
            return
        if self._asked and now - max(self._heard, self.began) > _SILENT_S:
            self.silent = True
            return
        patience = min(_MOST_PATIENCE_S, max(_LEAST_PATIENCE_S, _PATIENCE * self.share.quickest_s))
        for asked in list(self._asked.values()):
            if now - asked.at > patience and self.share.allows(FRAME_BYTES, now):
                asked.at, asked.tries = now, asked.tries + 1
                self.share.lost(now)
                self._put(asked.payload)
        while len(self._asked) < _AT_ONCE:
            request = self.job.next_request() if self.share.allows(FRAME_BYTES, now) else None
            if request is None:
                return
            self._number = (self._number + 1) & 0xFFFF
            request = numbered(request, self._number)
            self._asked[self._number] = _Asked(request, now)
            self._put(request)

    def pause(self, seconds: float) -> None:
        """Time in which nothing was asked does not count as silence."""
        self._heard += seconds
        for asked in self._asked.values():
            asked.at += seconds

    def _put(self, request: FtpPayload) -> None:
        self.send(self.system, [request.message(self.system, self.component)])
