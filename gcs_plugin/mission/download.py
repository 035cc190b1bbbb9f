"""Reading the mission, or the geofence, out of a vehicle: REQUEST_LIST, COUNT, REQUEST_INT and ITEM_INT in turn."""

import itertools
from dataclasses import dataclass, field
from typing import Final

from gcs_plugin.links.mavlink import Autopilot, Message, dialect
from gcs_plugin.mission.exchange import ACCEPTED, DENIED, MISSION, UNSUPPORTED, Exchange, RoundTrip, Verdict
from gcs_plugin.mission.items import MissionItem

AT_ONCE: Final = {Autopilot.ARDUPILOT: 8, Autopilot.PX4: 1}
"""Items that are asked for at once: PX4 hands out one after the other only."""
_BUSY_S: Final = 1.0
_SOON_S: Final = 0.5  # a start is void after 5 s
_FORGOTTEN: Final = 9
"""Unanswered requests for one item after which the reading begins anew: PX4 forgets a transfer (and the acknowledgement
that says so may be lost), and then ignores requests for items silently. With 30 % loss each way one in 400 items meets
so many by chance."""


@dataclass(slots=True)
class MissionDownload(Exchange):
    """Asks for a few items at a time (PX4 hands them out one by one, in order) and again until it has them all.

    Attributes:
        patience_s: silence after which it gives up. urgent: whether it asks again sooner, as somebody waits to arm.
        list_type: MAV_MISSION_TYPE of the list: the mission, or the geofence.
        background: nobody waits for it; any other request to the vehicle ends it.
        window: how many items are asked for at once: a slow link costs a round trip a window; 1 for PX4.
        items: the stored list, None until it is complete.
    """

    patience_s: float = 30.0
    list_type: int = MISSION
    background: bool = False
    window: int = 1
    urgent: bool = False
    items: list[MissionItem] | None = field(default=None, init=False)
    _count: int | None = field(default=None, init=False)
    _got: dict[int, MissionItem] = field(default_factory=dict, init=False)
    _trip: RoundTrip = field(default_factory=RoundTrip, init=False)
    _under_way: set[int] = field(default_factory=set, init=False)
    _asked_at: float = field(default=0.0, init=False)
    _asked_again: bool = field(default=False, init=False)
    _unanswered: int = field(default=0, init=False)
    _heard_at: float = field(default=0.0, init=False)
    _asks_list: bool = field(default=True, init=False)
    _refused: int = field(default=ACCEPTED, init=False)

    def start(self, now: float) -> list[Message]:
        """Request the list."""
        self._heard_at = now
        self._trip.longest_s = (_SOON_S if self.urgent else 2.0) / max(1.0, self.pace)
        self._trip.wait_s = min(self._trip.wait_s, self._trip.longest_s)
        return self._restart(now)

    def feed(self, message: Message, now: float) -> list[Message]:
        """Process MISSION_COUNT, items and refusals."""
        kind = self._mission_kind(message)
        if kind == "MISSION_COUNT":
            return self._counted(int(message.count), now)
        if kind in ("MISSION_ITEM_INT", "MISSION_ITEM"):
            return self._received(message, now)
        if kind == "MISSION_ACK" and message.type == UNSUPPORTED and self.list_type != MISSION:
            self._end(False, f"vehicle {self.vehicle.system} keeps no such list")
        elif kind == "MISSION_ACK" and message.type != ACCEPTED:
            # Busy with an upload, or it has dropped our download: start again a little later.
            self._refused, self._asks_list = int(message.type), True
            self.deadline = now + (_BUSY_S if message.type == DENIED else _BUSY_S / max(1.0, self.pace))
        return []

    def tick(self, now: float) -> list[Message]:
        """Repeat unanswered requests."""
        if self.outcome is not None or now < self.deadline:
            return []
        if now - self._heard_at > self.patience_s:
            why = ", another ground station is using it" if self._refused == DENIED else ""
            text = f"vehicle {self.vehicle.system} did not send its mission{why}; check the link"
            self._end(False, text, Verdict.UNKNOWN)
            return []
        self._trip.missed()
        self._unanswered += 1
        self._asks_list |= self._unanswered >= _FORGOTTEN
        return self._ask(now, again=True)

    def rebooted(self, now: float) -> list[Message]:
        """Start again: the vehicle has dropped the download."""
        return self._restart(now)

    @property
    def mission_type(self) -> int:
        """See Exchange."""
        return self.list_type

    def _restart(self, now: float) -> list[Message]:
        self._count = None
        self._got.clear()
        self._asks_list = True
        return self._ask(now, again=False)

    def _ask(self, now: float, *, again: bool) -> list[Message]:
        self._asked_at, self._asked_again = now, again
        self.deadline = now + self._trip.wait_s
        to, twice = self.vehicle, 2 if again and self.urgent else 1  # the link loses packets, and somebody waits
        if self._count is None or self._asks_list:
            self._under_way.clear()
            return [dialect.MAVLink_mission_request_list_message(to.system, to.component, self.list_type)] * twice
        if again:
            self._under_way.clear()
        missing = (seq for seq in range(self._count) if seq not in self._got and seq not in self._under_way)
        wanted = list(itertools.islice(missing, max(0, self.window - len(self._under_way))))
        self._under_way.update(wanted)
        wanted *= twice
        return [dialect.MAVLink_mission_request_int_message(to.system, to.component, s, self.list_type) for s in wanted]

    def _heard(self, now: float) -> None:
        self._heard_at, self._unanswered = now, 0
        self._trip.answered(now - self._asked_at, asked_again=self._asked_again)

    def _counted(self, count: int, now: float) -> list[Message]:
        if self._count == count and self._got and not self._asks_list:  # a copy of the first answer
            return []
        self._heard(now)
        if self._asks_list or self._count != count:  # PX4 begins with item 0 after each request for the list
            self._got.clear()
        self._count, self._asks_list = count, False
        return self._ask(now, again=False) if count else self._finish()

    def _received(self, message: Message, now: float) -> list[Message]:
        seq = int(message.seq)
        if self._count is None or seq >= self._count or seq in self._got:
            return []
        self._heard(now)
        self._got[seq] = MissionItem.of(message)
        self._under_way.discard(seq)
        return self._ask(now, again=False) if len(self._got) < self._count else self._finish()

    def _finish(self) -> list[Message]:
        self.items = [self._got[seq] for seq in range(self._count or 0)]
        self._end(True, f"{len(self.items)} items were read from vehicle {self.vehicle.system}")
        to = self.vehicle
        return [dialect.MAVLink_mission_ack_message(to.system, to.component, ACCEPTED, self.list_type)]
