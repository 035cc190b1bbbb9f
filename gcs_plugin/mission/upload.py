"""Putting a mission into a vehicle, and making sure that it is there.

The vehicle leads: MISSION_COUNT makes it ask for one item after the other, in its own time, and it acknowledges at the
end (https://mavlink.io/en/services/mission.html). An item that brings no further request is sent once more before the
vehicle asks again: ArduPilot takes a second for that. Every one of these messages may be lost, doubled or late, so
neither an acknowledgement nor its absence is trusted: the mission is read back and compared. ArduPilot's store is not
atomic; after a refusal or a time-out it holds a mixture of the old and the new mission, which must never count as a
success.

What the acknowledgements mean in practice (measured): 13 (invalid sequence) answers a duplicate and is not the end; 1
(error) answers a copy of the last item although the mission is stored, and PX4 while it is busy; 14 (denied) says that
another ground station is uploading; 15 (cancelled) that the vehicle has waited too long.
"""

import enum
from dataclasses import dataclass, field, replace
from typing import Final

from gcs_plugin.links.mavlink import Autopilot, Message, dialect
from gcs_plugin.mission import exchange
from gcs_plugin.mission.download import MissionDownload
from gcs_plugin.mission.exchange import MISSION, Exchange, RoundTrip, Verdict
from gcs_plugin.mission.items import Mission, difference

_PARAMETER = {6: "param1", 7: "param2", 8: "param3", 9: "param4", 10: "latitude", 11: "longitude", 12: "altitude"}
# Vehicles repeat a request every 0.25 s (PX4) or 1 s (ArduPilot): a silence of several intervals is more than packet
# loss.
_COUNT_AGAIN_S: Final = 1.0
_SILENCE_S: Final = 4.0
_LAST_SILENCE_S: Final = 3.0
_AFTER_REFUSAL_S: Final = 0.3
_DENIED_AGAIN_S: Final = 1.5
_DOUBT_S: Final = 1.5
_CLEARS: Final = 6
# How often the stored mission may differ after a complete upload before that is reported.
_MIXTURES: Final = 4
# Copies of one request within this time are the network's; a vehicle that misses an item waits longer.
_SAME_REQUEST_S: Final = 0.03


@dataclass(frozen=True, slots=True)
class Refusal:
    """A negative MISSION_ACK (`code`), and why in one sentence without the vehicle's name."""

    code: int
    item: int | None
    field: str
    reason: str


class UploadStage(enum.Enum):
    """The state of an upload."""

    LEAVE = "leaving the mission's mode"
    COUNT = "announced"
    ITEMS = "sending"
    PAUSE = "waiting"
    VERIFY = "reading back"
    CLEAR = "clearing"
    DONE = "done"


@dataclass(slots=True)
class MissionUpload(Exchange):
    """One upload of a mission or a geofence; its outcome is ok only if what is read back from the vehicle is this one.

    Attributes:
        patience_s: silence after which it gives up.
        attempts: number of restarts (time-outs of the vehicle, reboots, a different stored mission).
        leave: a change of mode before anything is sent, for a vehicle that would fly items as they arrive.
        refusal: the vehicle's refusal in words, where the outcome is one.
    """

    mission: Mission = field(kw_only=True)
    patience_s: float = field(default=30.0, kw_only=True)
    attempts: int = field(default=12, kw_only=True)
    leave: Exchange | None = field(default=None, kw_only=True)
    stage: UploadStage = field(default=UploadStage.PAUSE, init=False)
    refusal: Refusal | None = field(default=None, init=False)
    _begun: int = field(default=0, init=False)
    _heard_at: float = field(default=0.0, init=False)
    _served: int = field(default=-1, init=False)
    _ahead: int = field(default=-1, init=False)
    _answered: dict[int, float] = field(default_factory=dict, init=False)
    _trip: RoundTrip = field(default_factory=RoundTrip, init=False)
    _repeated: bool = field(default=False, init=False)
    _silence_ends: float = field(default=0.0, init=False)
    _refused: Refusal | None = field(default=None, init=False)
    _doubt: Refusal | None = field(default=None, init=False)
    _denied: Refusal | None = field(default=None, init=False)
    _mixed: str = field(default="", init=False)
    _mixtures: int = field(default=0, init=False)
    _touched: bool = field(default=False, init=False)
    _reading: MissionDownload | None = field(default=None, init=False)
    _clears: int = field(default=0, init=False)

    def start(self, now: float) -> list[Message]:
        """Announce the mission."""
        self._heard_at = now
        self._trip.longest_s = 2.0 / max(1.0, self.pace)
        if self.leave is not None:
            self.stage = UploadStage.LEAVE
            return self._follow(self.leave, self.leave.start(now), now)
        return self._announce(now)

    def feed(self, message: Message, now: float) -> list[Message]:
        """Process requests, acknowledgements and, while reading back, items."""
        if self.stage is UploadStage.LEAVE and self.leave is not None and self.outcome is None:
            return self._follow(self.leave, self.leave.feed(message, now), now)
        kind = self._mission_kind(message)
        if self.stage is UploadStage.CLEAR:
            if kind == "MISSION_ACK" and message.type == exchange.ACCEPTED:
                self._unknown(" and was cleared")
            return []
        if kind in ("MISSION_REQUEST", "MISSION_REQUEST_INT"):
            return self._requested(int(message.seq), now)
        if kind == "MISSION_ACK":
            return self._acknowledged(int(message.type), message, now)
        if self._reading is not None:
            return self._read(self._reading.feed(message, now), now)
        return []

    def tick(self, now: float) -> list[Message]:
        """Repeat, start again, or give up."""
        if self.outcome is not None or now < self.deadline:
            return []
        if self.stage is UploadStage.LEAVE and self.leave is not None:
            return self._follow(self.leave, self.leave.tick(now), now)
        if self.stage is UploadStage.CLEAR:
            return self._clear(now)
        if self._reading is not None:
            return self._read(self._reading.tick(now), now)
        if now - self._heard_at > self.patience_s:
            self.refusal = self._denied
            if self._denied:
                self._fail(f"denied the upload: {self._denied.reason}")
            else:
                self._fail("did not answer; check the link and its system id", Verdict.UNKNOWN)
            return []
        if self._doubt is not None:
            return self._nack(self._doubt, now)
        if self.stage is UploadStage.ITEMS and now < self._silence_ends:
            return self._repeat(now)
        if self.stage is UploadStage.ITEMS and self._all_sent:
            return self._verify(now)
        if self.stage is UploadStage.COUNT:
            self.deadline = now + _COUNT_AGAIN_S
            return [self._count_message()]
        return self._announce(now)

    def rebooted(self, now: float) -> list[Message]:
        """Start again: a rebooted vehicle has dropped the upload, and perhaps stored half of it."""
        return [] if self.outcome is not None else self._announce(now)

    def took(self) -> None:
        """A link has accepted a message."""
        self.delivered += 1
        if self.stage is UploadStage.LEAVE and self.leave is not None:
            self.leave.took()

    @property
    def mission_type(self) -> int:
        """See Exchange."""
        return self.mission.list_type

    @property
    def announced(self) -> bool:
        """Whether the vehicle was told of the mission, so that it may have dropped what it held."""
        return self._begun > 0

    @property
    def message_expires(self) -> float:
        """See Exchange: a change of mode expires, a mission does not."""
        return self.leave.expires if self.leave is not None and self.leaves_mode else self.expires

    @property
    def leaves_mode(self) -> bool:
        """See Exchange."""
        return self.stage is UploadStage.LEAVE

    # --- sending ---

    def _follow(self, leave: Exchange, messages: list[Message], now: float) -> list[Message]:
        """Announce the mission once the vehicle has left its mission's mode."""
        self.deadline, outcome = leave.deadline, leave.outcome
        if outcome is None:
            return messages
        if outcome.ok:
            return messages + self._announce(now)
        self.stage = UploadStage.DONE
        self._end(
            False, f"{outcome.text}; it was sent no mission, since it would fly items as they come", outcome.failure
        )
        return messages

    def _count_message(self) -> Message:
        to = self.vehicle
        return dialect.MAVLink_mission_count_message(to.system, to.component, len(self.mission), self.mission_type)

    def _announce(self, now: float) -> list[Message]:
        self._begun += 1
        if self._begun > self.attempts:
            self._fail(
                self._mixed or f"did not take the {self.mission.kind} in {self.attempts} attempts; check the link"
            )
            return []
        self.stage, self._reading, self._doubt = UploadStage.COUNT, None, None
        self._served, self._ahead, self._repeated = -1, -1, False
        self._answered.clear()
        self.deadline = now + _COUNT_AGAIN_S
        return [self._count_message()]

    def _pause(self, now: float, wait_s: float) -> list[Message]:
        self.stage, self._reading, self._doubt, self.deadline = UploadStage.PAUSE, None, None, now + wait_s
        return []

    def _requested(self, seq: int, now: float) -> list[Message]:
        if seq >= len(self.mission) or self.stage is UploadStage.PAUSE or (self.stage is UploadStage.COUNT and seq > 0):
            return []  # for another upload, or late from one before
        self._heard_at, self._touched, self._denied, self._doubt = now, True, None, None
        if now - self._answered.get(seq, -1.0) < _SAME_REQUEST_S:
            return []
        if self._reading is None:
            self.stage = UploadStage.ITEMS
            if self._served < seq <= self._ahead + 1:  # a vehicle asks in order; further ahead is a late copy
                if seq > 0:
                    self._trip.answered(now - self._answered.get(seq - 1, now), asked_again=self._repeated)
                self._served, self._ahead, self._repeated = seq, max(seq, self._ahead), False
            self._silence_ends = now + (_LAST_SILENCE_S if self._all_sent else _SILENCE_S)
            self.deadline = min(now + self._trip.wait_s, self._silence_ends)
        self._answered[seq] = now
        return [self._item(seq)]

    def _item(self, seq: int) -> Message:
        return self.mission.items[seq].message(seq, self.vehicle.system, self.vehicle.component, self.mission_type)

    @property
    def _all_sent(self) -> bool:
        return self._served == len(self.mission) - 1

    def _repeat(self, now: float) -> list[Message]:
        """Send the last item once more: either it was lost, or the request that should have followed it."""
        self._repeated = True
        self._trip.missed()
        self.deadline = min(now + self._trip.wait_s, self._silence_ends)
        return [self._item(self._served)]

    def _acknowledged(self, code: int, message: Message, now: float) -> list[Message]:
        if code != exchange.DENIED:
            self._heard_at = now
        if self._reading is not None:
            if code == exchange.CANCELLED:  # it was still waiting for an item
                return self._announce(now)
            return self._read(self._reading.feed(message, now), now)
        if (
            code == exchange.INVALID_SEQUENCE
            and self.stage is UploadStage.ITEMS
            and self._repeated
            and not self._all_sent
        ):
            self._ahead = self._served + 1
            return [self._item(self._ahead)]  # it has that one, so it waits for the next
        if self.stage is UploadStage.PAUSE or code == exchange.INVALID_SEQUENCE:
            return []
        if self.stage is UploadStage.COUNT:
            return self._answered_count(code, now)
        if code == exchange.ACCEPTED:
            return self._verify(now) if self._all_sent else []
        if code == exchange.CANCELLED:
            return self._announce(now)
        refusal = explain(code, self.mission, self._served)
        if code == exchange.ERROR:
            # About this item, about a copy of it, or about an upload that the vehicle has given up: further
            # requests, or what is stored, will tell.
            self._doubt = None if self._repeated else refusal
            if self._all_sent:
                return self._verify(now)
            self.deadline = now + _DOUBT_S
            return []
        return self._nack(refusal, now)

    def _answered_count(self, code: int, now: float) -> list[Message]:
        """An acknowledgement before the first request: about the count, or a late one from an upload before."""
        if code in (exchange.NO_SPACE, exchange.DENIED):
            return self._nack(explain(code, self.mission, None), now)
        if code == exchange.ERROR:
            return self._pause(now, _COUNT_AGAIN_S)
        return self._verify(now) if code == exchange.ACCEPTED and not self.mission.items else []

    def _nack(self, refusal: Refusal, now: float) -> list[Message]:
        if refusal.code == exchange.DENIED:
            self._denied = refusal
            self._begun -= self.stage is UploadStage.COUNT  # waiting for another ground station is not an attempt
            return self._pause(now, _DENIED_AGAIN_S)
        if self._refused is not None and (self._refused.code, self._refused.item) == (refusal.code, refusal.item):
            self.refusal = refusal
            self._fail(f"refused the {self.mission.kind}: {refusal.reason}")
            return []
        self._refused, self._doubt = refusal, None
        # Once may be a late acknowledgement of an upload before; twice is an answer.
        return self._pause(now, _AFTER_REFUSAL_S)

    # --- reading back ---

    def _verify(self, now: float) -> list[Message]:
        self.stage = UploadStage.VERIFY
        self._reading = MissionDownload(self.vehicle, self.own, patience_s=self.patience_s, list_type=self.mission_type)
        self._reading.pace = self.pace
        return self._read(self._reading.start(now), now)

    def _read(self, messages: list[Message], now: float) -> list[Message]:
        reading = self._reading
        assert reading is not None
        self.deadline = reading.deadline
        if reading.outcome is None:
            return messages
        self._heard_at = now
        if reading.items is None and self.mission_type != MISSION:
            self._unknown()  # any fence protects more than none
            return messages
        if reading.items is None:
            self._reading, self.stage, self._clears = None, UploadStage.CLEAR, 0
            return messages + self._clear(now)
        wrong = difference(self.mission, reading.items)
        if not wrong:
            self.stage = UploadStage.DONE
            self._end(
                True,
                f"vehicle {self.vehicle.system} holds the {self.mission.kind}: {len(self.mission)} items, read back",
            )
            return messages
        if self._doubt is not None:
            return messages + self._nack(self._doubt, now)
        self._mixtures += 1
        self._mixed = f"holds another {self.mission.kind} than was sent: {wrong}; upload again before flying"
        if self._mixtures >= _MIXTURES:
            self._fail(self._mixed)
        else:
            self._pause(now, _AFTER_REFUSAL_S)
        return messages

    def _clear(self, now: float) -> list[Message]:
        """A mission that cannot be read back must not be flown: clear it."""
        self._clears += 1
        if self._clears > _CLEARS:
            self._unknown(" and was told to clear it, and did not answer")
            return []
        self.deadline = now + _COUNT_AGAIN_S
        to = self.vehicle
        return [dialect.MAVLink_mission_clear_all_message(to.system, to.component, self.mission_type)]

    def _unknown(self, then: str = "") -> None:
        self.stage = UploadStage.DONE
        name = f"vehicle {self.vehicle.system}: its {self.mission.kind}"
        text = f"{name} could not be read back{then}; what it holds is not known: upload again"
        self._end(False, text, Verdict.UNKNOWN)

    def _fail(self, text: str, failure: Verdict = Verdict.REFUSED) -> None:
        self.stage = UploadStage.DONE
        # ArduPilot writes items as they come; `_mixed` says by itself what it then holds.
        mixture = self._touched and self.mission.autopilot is Autopilot.ARDUPILOT and text != self._mixed
        two = f"two {self.mission.kind}s"
        warning = f"; it may now hold a mixture of {two}, so upload again before flying" if mixture else ""
        self._end(False, f"vehicle {self.vehicle.system} {text}{warning}", failure)
        if (why := self.refusal) is not None and self.outcome is not None:
            self.outcome = replace(self.outcome, item=why.item, field=why.field, code=why.code)


def explain(code: int, mission: Mission, item: int | None) -> Refusal:
    """Put a negative MISSION_ACK into words.

    Args:
        code: its MAV_MISSION_RESULT. mission: the uploaded one.
        item: the last item sent, None if the vehicle had not requested one yet.
    """
    if code == exchange.DENIED:
        return Refusal(code, None, "", "another ground station is uploading to it; wait until that has ended")
    if code == exchange.NO_SPACE:
        less = "split the mission into sorties" if mission.list_type == MISSION else "draw zones with fewer corners"
        return Refusal(code, None, "", f"its memory does not hold {len(mission)} items; {less}")
    if code == exchange.CANCELLED:
        return Refusal(code, None, "", "it gave up because items did not arrive; come closer or try again")
    if item is None or item >= len(mission):
        return Refusal(code, None, "", f"it refused the {mission.kind} ({_result_name(code)})")
    what = f"item {item} ({mission.items[item].name})"
    if code == exchange.UNSUPPORTED:
        return Refusal(code, item, "command", f"{what} is a command that it does not know; leave it out")
    if code == exchange.UNSUPPORTED_FRAME:
        frame = dialect.enums["MAV_FRAME"].get(mission.items[item].frame)
        name = frame.name if frame else mission.items[item].frame
        return Refusal(
            code, item, "frame", f"{what} has a frame that it does not accept ({name}); use heights over home"
        )
    if code in _PARAMETER:
        name, value = _PARAMETER[code], _value(mission, item, code)
        return Refusal(code, item, name, f"{what} has an unacceptable {name} ({value}); correct it")
    if code == exchange.INVALID:
        return Refusal(code, item, "", f"{what} has an unacceptable value; check its parameters")
    return Refusal(code, item, "", f"it refused {what} ({_result_name(code)}); check that item, a jump's target too")


def _value(mission: Mission, item: int, code: int) -> str:
    it = mission.items[item]
    if code <= 9:
        return f"{it.params[code - 6]:g}"
    if code == 12:
        return f"{it.z:g}"
    raw = it.x if code == 10 else it.y
    return f"{raw / 1e7:.7f}" if it.has_place else str(raw)


def _result_name(code: int) -> str:
    entry = dialect.enums["MAV_MISSION_RESULT"].get(code)
    return str(entry.name) if entry else f"result {code}"
