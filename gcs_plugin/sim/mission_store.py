"""The vehicle's side of the mission protocol, as ArduPilot and PX4 implement it."""

import math
from dataclasses import dataclass, field, replace
from typing import Final

from gcs_plugin.links.mavlink import Autopilot, Message, dialect
from gcs_plugin.mission import exchange
from gcs_plugin.mission.exchange import Address
from gcs_plugin.mission.geofence import FENCE
from gcs_plugin.mission.items import FRAME_GLOBAL, GIMBAL_CLAIM, JUMP, TAKEOFF, WAYPOINT, MissionItem
from orthoswarm.config import DEFAULT

_MISSION: Final = dialect.MAV_MISSION_TYPE_MISSION
_FRAMES: Final = frozenset({0, 2, 3, 5, 6, 10, 11})
_FRAMES_PX4: Final = _FRAMES - {10, 11}
_COMMANDS: Final = frozenset({
    16, 17, 18, 19, 20, 21, 22, 82, 84, 85, 92, 93, 94, 112, 114, 115, 177, 178, 179, 181, 183, 189, 195, 197, 201, 203,
    205, 206, 207, 210, 212, 218, 222, 530, 1000, 2000, 2001, 2500, 2501,
})  # fmt: skip
# (requests again after, gives up after) seconds without an item.
_TIMING: Final = {Autopilot.ARDUPILOT: (1.0, 8.0), Autopilot.PX4: (0.25, 5.0)}


@dataclass(slots=True, kw_only=True)
class _Transfer:
    partner: Address
    count: int
    wanted: int
    asked_at: float
    heard_at: float
    items: list[MissionItem] = field(default_factory=list)


@dataclass(slots=True, kw_only=True)
class MissionStore:
    """A vehicle's stored mission, and the protocol that changes it.

    Attributes:
        items: the stored mission; for ArduPilot item 0 is home.
        fence: the items of its geofence; taken as they come, without what missions are checked for.
        generation: rises whenever an upload or a clear has ended, so that the flight logic can notice.
        stored_at: when the last upload ended, in the time of `feed`.
    """

    autopilot: Autopilot
    home: MissionItem
    items: list[MissionItem] = field(default_factory=list)
    fence: list[MissionItem] = field(default_factory=list)
    generation: int = 0
    stored_at: float = -math.inf
    _transfer: _Transfer | None = None
    _fence_transfer: _Transfer | None = None
    _sent_to: Address | None = None
    _sent_at: float = 0.0
    _next_sent: int = 0

    def feed(self, message: Message, sender: Address, now: float) -> list[Message]:
        """Process a message of the mission protocol for this vehicle; returns the answers."""
        if getattr(message, "mission_type", _MISSION) == FENCE:
            return self._fence(message, sender, now)
        if getattr(message, "mission_type", _MISSION) != _MISSION:
            return [self._ack(sender, exchange.UNSUPPORTED, int(message.mission_type))]
        match message.get_type():
            case "MISSION_COUNT":
                return self._count(int(message.count), sender, now)
            case "MISSION_ITEM_INT" | "MISSION_ITEM":
                return self._item(message, sender, now)
            case "MISSION_REQUEST_LIST":
                if self._transfer is not None:
                    return [
                        self._ack(sender, exchange.DENIED if self.autopilot is Autopilot.ARDUPILOT else exchange.ERROR)
                    ]
                if self.autopilot is Autopilot.PX4:
                    self._sent_to, self._sent_at, self._next_sent = sender, now, 0
                return [
                    dialect.MAVLink_mission_count_message(sender.system, sender.component, len(self.items), _MISSION)
                ]
            case "MISSION_REQUEST" | "MISSION_REQUEST_INT":
                return self._hand_out(int(message.seq), sender, now)
            case "MISSION_ACK":
                self._sent_to = None
            case "MISSION_CLEAR_ALL":
                self.clear()
                return [self._ack(sender, exchange.ACCEPTED)]
        return []

    def tick(self, now: float) -> list[Message]:
        """Request a missing item again, and finally give up."""
        transfer = self._transfer
        if transfer is None:
            return []
        again, give_up = _TIMING[self.autopilot]
        if now - transfer.heard_at >= give_up:
            self._transfer = None
            return [self._ack(transfer.partner, exchange.CANCELLED)] if self.autopilot is Autopilot.ARDUPILOT else []
        return self._ask(transfer, now) if now - transfer.asked_at >= again else []

    def rebooted(self) -> None:
        """Forget the dialogue; what was stored stays."""
        self._transfer = self._sent_to = None

    def clear(self) -> None:
        """Forget the mission."""
        self.items, self._transfer = [self.home] if self.autopilot is Autopilot.ARDUPILOT else [], None
        self.generation += 1

    def _hand_out(self, seq: int, to: Address, now: float) -> list[Message]:
        """An item of the mission.

        PX4 hands items out only after a request for the list, in order. It gives up when it hears nothing for a while
        or is asked for another item than the next or the last one; then it ignores further requests silently.
        """
        if self.autopilot is Autopilot.PX4:
            if self._sent_to != to or now - self._sent_at >= _TIMING[Autopilot.PX4][1]:
                return []
            if seq not in (self._next_sent, self._next_sent - 1):
                self._sent_to = None
                return [self._ack(to, exchange.ERROR)]
            self._sent_at, self._next_sent = now, seq + 1
        if seq >= len(self.items) or self._transfer is not None:
            return [self._ack(to, exchange.ERROR)]
        return [self.items[seq].message(seq, to.system, to.component)]

    def _fence(self, message: Message, to: Address, now: float) -> list[Message]:
        transfer = self._fence_transfer
        match message.get_type():
            case "MISSION_REQUEST_LIST":
                return [dialect.MAVLink_mission_count_message(to.system, to.component, len(self.fence), FENCE)]
            case "MISSION_REQUEST" | "MISSION_REQUEST_INT" if message.seq < len(self.fence):
                return [self.fence[message.seq].message(int(message.seq), to.system, to.component, FENCE)]
            case "MISSION_ACK":
                return []
            case "MISSION_CLEAR_ALL" | "MISSION_COUNT" if getattr(message, "count", 0) == 0:
                self.fence = []
                return [self._ack(to, exchange.ACCEPTED, FENCE)]
            case "MISSION_COUNT":
                transfer = _Transfer(partner=to, count=int(message.count), wanted=0, asked_at=now, heard_at=now)
                self._fence_transfer = transfer
            case "MISSION_ITEM_INT" if transfer is not None and message.seq == transfer.wanted:
                transfer.items.append(MissionItem.of(message))
                transfer.wanted += 1
                if transfer.wanted == transfer.count:
                    self.fence, self._fence_transfer = transfer.items, None
                    return [self._ack(to, exchange.ACCEPTED, FENCE)]
            case _:
                return [self._ack(to, exchange.UNSUPPORTED, FENCE)]
        return [dialect.MAVLink_mission_request_int_message(to.system, to.component, transfer.wanted, FENCE)]

    def _count(self, count: int, sender: Address, now: float) -> list[Message]:
        transfer = self._transfer
        if transfer is not None and transfer.partner != sender:
            return [self._ack(sender, exchange.DENIED)]
        if transfer is not None and self.autopilot is Autopilot.PX4:
            return self._ask(transfer, now) if transfer.wanted == 0 else [self._ack(sender, exchange.ERROR)]
        if self._sent_to is not None and now - self._sent_at < _TIMING[Autopilot.PX4][1]:
            return [self._ack(sender, exchange.ERROR)]  # PX4 is still handing its mission out
        if count > DEFAULT.times(self.autopilot.value).most_items:
            return [self._ack(sender, exchange.NO_SPACE)]
        if count == 0:
            self.items = []
            self.generation += 1
            return [self._ack(sender, exchange.ACCEPTED)]
        self._transfer = _Transfer(partner=sender, count=count, wanted=0, asked_at=now, heard_at=now)
        return self._ask(self._transfer, now)

    def _ask(self, transfer: _Transfer, now: float) -> list[Message]:
        transfer.asked_at = now
        to = transfer.partner
        # ArduPilot asks with the old message and wants MISSION_ITEM_INT all the same.
        if self.autopilot is Autopilot.ARDUPILOT:
            return [dialect.MAVLink_mission_request_message(to.system, to.component, transfer.wanted, _MISSION)]
        return [dialect.MAVLink_mission_request_int_message(to.system, to.component, transfer.wanted, _MISSION)]

    def _item(self, message: Message, sender: Address, now: float) -> list[Message]:
        transfer = self._transfer
        if transfer is None or transfer.partner != sender:
            return [self._ack(sender, exchange.ERROR)]
        if message.seq != transfer.wanted:
            return [self._ack(sender, exchange.INVALID_SEQUENCE)]
        item = MissionItem.of(message)
        code = self._check(item, transfer.count)
        if code != exchange.ACCEPTED:
            self._transfer = None
            return [self._ack(sender, code)]
        if self.autopilot is Autopilot.ARDUPILOT:  # written at once, so that a broken upload leaves a mixture
            self._write(transfer.wanted, self._as_stored(item, transfer.wanted))
        else:
            transfer.items.append(replace(item, frame=item.plain_frame))
        transfer.wanted, transfer.heard_at = transfer.wanted + 1, now
        if transfer.wanted < transfer.count:
            return self._ask(transfer, now)
        if self.autopilot is Autopilot.ARDUPILOT:
            del self.items[transfer.count :]
        else:
            self.items = transfer.items
        self._transfer, self.stored_at = None, now
        self.generation += 1
        return [self._ack(sender, exchange.ACCEPTED)]

    def _write(self, seq: int, item: MissionItem) -> None:
        self.items[seq : seq + 1] = [item]

    def _as_stored(self, item: MissionItem, seq: int) -> MissionItem:
        """An item as ArduPilot returns it: see `mission.items.difference`."""
        if seq == 0:
            return self.home
        p1, p2, p3, p4 = (0.0 if math.isnan(value) else float(value) for value in item.params)
        params = (float(int(p1)), 0.0, 0.0, 0.0) if item.command in (WAYPOINT, TAKEOFF) else (p1, p2, p3, p4)
        if not item.has_place:
            return MissionItem(command=item.command, frame=FRAME_GLOBAL, params=params)
        z = round(item.z * 100.0) / 100.0
        return replace(item, frame=item.plain_frame, params=params, z=z, autocontinue=True)

    def _check(self, item: MissionItem, count: int) -> int:
        """MAV_MISSION_RESULT for an item, in the order in which ArduPilot looks at it."""
        ardupilot = self.autopilot is Autopilot.ARDUPILOT
        if item.command not in _COMMANDS and (ardupilot or item.command != GIMBAL_CLAIM):
            return exchange.UNSUPPORTED
        if item.frame not in (_FRAMES if ardupilot else _FRAMES_PX4):
            return exchange.UNSUPPORTED_FRAME
        for index, value in enumerate(item.params):
            if math.isnan(value) and (ardupilot or index == 0):
                return 6 + index
        if item.has_place:
            if abs(item.x) > 900_000_000:
                return 10
            if abs(item.y) > 1_800_000_000:
                return 11
            if not abs(item.z) < 1e6:
                return 12
        if item.command == JUMP and not 1 <= item.params[0] < count:
            return exchange.ERROR
        return exchange.ACCEPTED

    def _ack(self, to: Address, code: int, kind: int = 0) -> Message:
        return dialect.MAVLink_mission_ack_message(to.system, to.component, code, kind)
