"""One job at a time over MAVLink FTP with one vehicle: numbers, repetition, pace; in the links' thread."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gcs_plugin.daemon.flight_coverage.file_download import FtpJob, numbered
from gcs_plugin.daemon.flight_coverage.link_share import LinkShare
from gcs_plugin.links.file_transfer import FRAME_BYTES, FtpPayload
from gcs_plugin.links.mavlink import Message

_AT_ONCE: Final = 4
"""ArduPilot's server holds five requests."""
_PATIENCE: Final = 4.0  # times the quickest answer
_LEAST_PATIENCE_S, _MOST_PATIENCE_S = 0.5, 4.0
_SILENT_S: Final = 12.0
_BUSY_S: Final = 5.0


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
