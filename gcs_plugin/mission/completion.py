"""Detects when a vehicle has flown its mission: a state machine over the messages of one autopilot.

What ArduCopter 4.7 and PX4 send at the end of a mission differs with its last item (docs/vehicles.md has the table of
what was measured). The rules here follow from it:

- `mission_state` 5 (complete) counts only after state 3 (active) was seen, armed, since the last upload or start:
  the flag survives a clear and a new upload.
- ArduCopter never sends 5 for a mission that ends with LAND: there, disarming while LAND is current counts.
- State 3 while disarmed is ArduCopter standing in AUTO after a flight, not a flight.
- Leaving the mission (state 2 or 4) suspends it; disarming a suspended mission ends it without completing it.
- A mission of which places were not reached (`flown_items`), or that was replaced meanwhile, has ended, not completed.
- For firmware without `mission_state`, its mode and MISSION_ITEM_REACHED of the last NAV item are used.

The clock plays no part, so a simulation at any speed and a log read afterwards give the same events.
"""

import dataclasses
import enum
from collections.abc import Mapping
from typing import Any, Final

from gcs_plugin.links.mavlink import Autopilot, Message, dialect, has_place, is_autopilot
from gcs_plugin.mission.flown_items import FlownItems
from gcs_plugin.mission.items import Ending, Mission, ending_of, final_nav


class Phase(enum.Enum):
    """The state of the mission."""

    IDLE = "idle"
    ACTIVE = "active"
    SUSPENDED = "suspended"
    COMPLETE = "complete"
    ABORTED = "aborted"


class MissionEvent(enum.Enum):
    """What has just happened to the mission. COMPLETE comes exactly once for each flown mission."""

    STARTED = "started"
    SUSPENDED = "suspended"
    RESUMED = "resumed"
    COMPLETE = "complete"
    ABORTED = "aborted"


# The message types that the detector uses; others are ignored.
RELEVANT: Final = frozenset({
    "HEARTBEAT", "MISSION_CURRENT", "MISSION_ITEM_REACHED", "EXTENDED_SYS_STATE", "STATUSTEXT",
    "MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_REQUEST", "MISSION_REQUEST_INT", "GLOBAL_POSITION_INT",
})  # fmt: skip

_ACTIVE, _COMPLETE, _PAUSED = 3, 5, 4
_ON_GROUND, _IN_AIR, _TAKEOFF, _LANDING = 1, 2, 3, 4
_ARDUCOPTER_AUTO = 3
_PX4_AUTO_MISSION = (4 << 16) | (4 << 24)
# Number of MISSION_CURRENT with "active" after disarming before the flight counts as aborted:
# the heartbeat and the 10 Hz stream cross each other on the way.
_PATIENCE = 3
# Number of messages without a position after which a mission's end is judged without one.
_JUDGING = 40


@dataclasses.dataclass(slots=True, kw_only=True)
class CompletionDetector:
    """Tracks one vehicle's mission; feed it every message of the vehicle's autopilot in order of arrival.

    Attributes:
        seq: the current item as last reported, None before.
        total: reported number of items, without ArduPilot's home; None if not reported.
        armed: None before the first heartbeat.
        flown: what it has reached of the mission that it flies or flew; None where the mission is not known.
    """

    autopilot: Autopilot
    phase: Phase = Phase.IDLE
    seq: int | None = None
    total: int | None = None
    armed: bool | None = None
    flown: FlownItems | None = None
    _commands: list[int | None] | None = None
    _mission_mode: bool = False
    _has_state: bool | None = None
    _landed: int | None = None
    _airborne: bool = False
    _beats: int = 0
    _landing_seen: bool = False
    _reached: int = -1
    _dropped: bool = False
    _armed_since_drop: int = 0
    _waiting: int = 0
    _disarmed_at_final: bool = False
    _crashed: bool = False
    _proofs: int = 0
    _proofs_needed: int = 1
    _new_total: int | None = None
    _new_total_under_way: bool = False
    _learned: dict[int, int] = dataclasses.field(default_factory=dict)
    _learned_count: int = 0
    _joined: bool = False
    _midway: bool = False
    _judging: int = 0
    _untold: list[MissionEvent] = dataclasses.field(default_factory=list)

    def uploaded(self, mission: Mission | None) -> None:
        """A new mission was stored in the vehicle (None: unknown); earlier states no longer count."""
        self._commands = None if mission is None else [item.command for item in mission.items]
        self.flown = None if mission is None else FlownItems.of(mission)
        self._learned.clear()
        self._learned_count = 0
        self.total = None if mission is None else len(mission) - self.autopilot.first_seq
        self._new_total = None
        self._restart(hot=bool(self.armed))

    def knows_mission(self, mission: Mission) -> None:
        """Set the mission stored in the vehicle; if it is another one than the vehicle began, that has ended."""
        flown, commands = FlownItems.of(mission), list[int | None](item.command for item in mission.items)
        if self.flown is None or self.flown.places != flown.places or self._commands not in (None, commands):
            if self.flown is not None:
                self._replaced()
            self.flown = flown
            if self._midway:  # stored in flight: what lies before its present item was not flown
                self.flown.current(self.autopilot.first_seq)
            if self.seq is not None and self.phase is not Phase.IDLE:
                self.flown.current(self.seq)
        self._commands = commands
        self.total, self._new_total = len(mission) - self.autopilot.first_seq, None

    @property
    def knows(self) -> bool:
        """True while the stored mission is known."""
        return self._commands is not None

    def rebooted(self) -> list[MissionEvent]:
        """The vehicle has rebooted: a running mission has ended without completing."""
        under_way = self.phase in (Phase.ACTIVE, Phase.SUSPENDED)
        self._restart(hot=False)
        self.armed, self.seq, self._landed = None, None, None
        if not under_way:
            return []
        self.phase = Phase.ABORTED
        return [MissionEvent.ABORTED]

    def _replaced(self) -> None:
        """Another mission was stored: one under way has ended, which is told with the next message."""
        if self.phase in (Phase.ACTIVE, Phase.SUSPENDED):
            self._untold.append(MissionEvent.ABORTED)
            self._midway = bool(self.armed)
            self._restart(hot=bool(self.armed))

    def feed(self, message: Message) -> list[MissionEvent]:
        """Process one message; returns the mission's events, mostly none."""
        untold, self._untold = self._untold, []
        if message.get_type() == "GLOBAL_POSITION_INT":
            return untold + self._position(message)
        if self._judging:  # its end was heard; whether that completes the mission, its next position tells
            self._judging -= 1
            return untold + (self._complete() if not self._judging else [])
        return untold + self._events_of(message)

    def _position(self, message: Message) -> list[MissionEvent]:
        if self.flown is not None and self.phase in (Phase.ACTIVE, Phase.SUSPENDED) and has_place(message):
            here = message.lat / 1e7, message.lon / 1e7
            if self.flown.position(message.time_boot_ms / 1e3, *here, counts=self.phase is Phase.ACTIVE):
                self._replaced()  # that item lies elsewhere
                self.uploaded(None)
                untold, self._untold = self._untold, []
                return untold
        return self._complete() if self._judging else []

    def _events_of(self, message: Message) -> list[MissionEvent]:
        match message.get_type():
            case "HEARTBEAT":
                return self._heartbeat(message) if is_autopilot(message) else []
            case "MISSION_CURRENT":
                return self._current(message)
            case "MISSION_ITEM_REACHED":
                return self._item_reached(int(message.seq))
            case "EXTENDED_SYS_STATE":
                return self._extended(int(message.landed_state))
            case "STATUSTEXT":
                self._crashed |= str(message.text).startswith("Crash")
            case "MISSION_COUNT":
                if message.mission_type == dialect.MAV_MISSION_TYPE_MISSION:
                    self._learned, self._learned_count = {}, int(message.count)
            case "MISSION_ITEM_INT":
                self._learn(message)
            case "MISSION_REQUEST" | "MISSION_REQUEST_INT":  # some ground station is uploading
                if message.mission_type == dialect.MAV_MISSION_TYPE_MISSION:
                    self._replaced()
                    self.uploaded(None)
        return []

    @property
    def final_seq(self) -> int | None:
        """Sequence number of the last item that is flown, None where nothing is known about the mission."""
        if self._commands is not None:
            return final_nav(self._commands, self.autopilot.first_seq)
        if self.total:
            return self.total if self.autopilot is Autopilot.ARDUPILOT else self.total - 1
        return None

    @property
    def ending(self) -> Ending:
        """How the mission ends, as far as it is known."""
        return Ending.UNKNOWN if self._commands is None else ending_of(self._commands, self.autopilot.first_seq)

    def state(self) -> dict[str, Any]:
        """Its state as JSON values, so that a restarted program can continue."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        values["autopilot"], values["phase"] = self.autopilot.value, self.phase.value
        values["_learned"] = [[seq, command] for seq, command in self._learned.items()]
        values["flown"] = None if self.flown is None else self.flown.state()
        values["_untold"] = [event.value for event in self._untold]
        return values

    @classmethod
    def from_state(cls, values: Mapping[str, Any]) -> "CompletionDetector":
        """The detector that `state` described."""
        restored = dict(values)
        restored["autopilot"], restored["phase"] = Autopilot(values["autopilot"]), Phase(values["phase"])
        restored["_learned"] = {int(seq): int(command) for seq, command in values["_learned"]}
        flown = values.get("flown")
        restored["flown"] = None if flown is None else FlownItems.from_state(flown)
        restored["_untold"] = [MissionEvent(event) for event in values.get("_untold", ())]
        return cls(**restored)

    @property
    def _at_final(self) -> bool:
        final = self.final_seq
        return final is not None and self.seq is not None and self.seq >= final

    def _restart(self, *, hot: bool) -> None:
        """Forget the flight. `hot`: in the air, where a late packet of the old mission may still say "active"."""
        self.phase = Phase.IDLE
        self._reached, self._waiting, self._proofs, self._armed_since_drop = -1, 0, 0, 0
        self._dropped = self._disarmed_at_final = self._crashed = self._landing_seen = False
        self._proofs_needed = 2 if hot else 1

    def _end(self, phase: Phase, event: MissionEvent) -> list[MissionEvent]:
        self.phase, self._waiting, self._proofs = phase, 0, 0
        self._dropped = self._disarmed_at_final = False
        return [event]

    def _complete(self) -> list[MissionEvent]:
        if self.flown is not None and not self.flown.all_reached:
            first, self._judging = not self._judging, 0
            self.flown.ended()
            if first and not self.flown.all_reached:  # it may have flown them unheard
                self._judging, self.phase = _JUDGING, Phase.ACTIVE
                return []
            if not self.flown.all_reached:
                return self._abort()
        self._judging = 0
        return self._end(Phase.COMPLETE, MissionEvent.COMPLETE)

    def _abort(self) -> list[MissionEvent]:
        return self._end(Phase.ABORTED, MissionEvent.ABORTED)

    # --- what each message says ---

    def _heartbeat(self, message: Message) -> list[MissionEvent]:
        was, self.armed = self.armed, bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        mode = int(message.custom_mode)
        self._mission_mode = mode == (_ARDUCOPTER_AUTO if self.autopilot is Autopilot.ARDUPILOT else _PX4_AUTO_MISSION)
        events: list[MissionEvent] = []
        self._joined = self.armed and (self._joined or was is None)
        self._beats = self._beats + 1 if self.armed else 0
        if self._beats == 2:  # armed again; a single heartbeat may be a late one of the flight before
            if self._waiting:  # how that ended was never heard
                events += self._abort()
            if self.phase in (Phase.COMPLETE, Phase.ABORTED):
                self._restart(hot=False)
            self._airborne = self._landing_seen = self._crashed = self._midway = False
        if self.armed and self._dropped:
            self._armed_since_drop += 1
            if self._armed_since_drop >= 2:  # still flying: the mission was reset, it has not landed
                self._dropped = False
        if not self.armed and was is not False:
            events += self._disarmed()
        if self._has_state is False:
            events += self._judge(_ACTIVE if self._mission_mode else _PAUSED)
        return events

    def _disarmed(self) -> list[MissionEvent]:
        if self.phase is Phase.SUSPENDED or (self.phase is Phase.ACTIVE and self._crashed):
            return self._abort()
        if self.phase is not Phase.ACTIVE:
            return []
        if self.ending is Ending.LAND and (self._at_final or self._dropped):
            return self._complete()
        self._waiting = _PATIENCE
        self._disarmed_at_final = self._at_final
        return []

    def _current(self, message: Message) -> list[MissionEvent]:
        self._follow_total(int(getattr(message, "total", 0)))
        state, seq = int(getattr(message, "mission_state", 0)), int(message.seq)
        was_final = self._at_final
        if self.flown is not None and seq != self.seq and self.phase in (Phase.ACTIVE, Phase.SUSPENDED):
            self.flown.current(seq)
        self.seq = seq
        if was_final and not self._at_final and self.phase is Phase.ACTIVE:
            self._dropped, self._armed_since_drop = True, 0
        if state:
            self._has_state = True
            return self._judge(state)
        self._has_state = bool(self._has_state)
        return [] if self._has_state else self._judge(_ACTIVE if self._mission_mode else _PAUSED)

    def _judge(self, state: int) -> list[MissionEvent]:
        """Interpret a mission state in the present phase."""
        if state == _COMPLETE:
            final = self.final_seq
            proven = self.phase is Phase.SUSPENDED and final is not None and self._reached >= final
            return self._complete() if self.phase is Phase.ACTIVE or proven else []
        if self.phase is Phase.ACTIVE and self.armed is False:
            return self._still_waiting(state)
        if state == _ACTIVE and self.armed:
            return self._flying()
        self._proofs = 0
        if state != _ACTIVE and self.phase is Phase.ACTIVE and state > 0:
            self.phase = Phase.SUSPENDED
            return [MissionEvent.SUSPENDED]
        return []

    def _flying(self) -> list[MissionEvent]:
        if self.phase is Phase.ACTIVE:
            return []
        if self.phase is Phase.SUSPENDED:
            if self._airborne and self._landed == _ON_GROUND:  # PX4 after a failsafe, before it disarms
                return []
            self.phase = Phase.ACTIVE
            return [MissionEvent.RESUMED]
        # After an end in the air a mission counts as flown again only once it is back before its last item.
        ended = self.phase is not Phase.IDLE
        needed = 2 if ended else self._proofs_needed
        self._proofs = 0 if ended and (self._at_final or self._landed == _ON_GROUND) else self._proofs + 1
        if self._proofs < needed:
            return []
        self._restart(hot=False)
        self.phase = Phase.ACTIVE
        if self.flown is not None:
            self.flown = FlownItems(places=self.flown.places, lines=self.flown.lines)
            if not self._joined:  # else it may have flown a part before it was heard
                self.flown.current(self.autopilot.first_seq)
            self.flown.current(self.seq or 0)
        return [MissionEvent.STARTED]

    def _still_waiting(self, state: int) -> list[MissionEvent]:
        """Disarmed while active: the vehicle's next messages show whether that was the end or a crash."""
        if state != _ACTIVE:
            return self._abort()
        landed = self._landing_seen or self._landed is None
        unknown_landing = self.ending is Ending.UNKNOWN and self._disarmed_at_final and landed
        if unknown_landing and not self._at_final:  # back at the first item: ArduCopter's way after LAND
            return self._complete()
        self._waiting -= 1
        return self._abort() if self._waiting <= 0 else []

    def _item_reached(self, seq: int) -> list[MissionEvent]:
        if self.phase not in (Phase.ACTIVE, Phase.SUSPENDED):
            return []
        self._reached = max(self._reached, seq)
        if self.flown is not None:
            self.flown.claims(seq)
        final = self.final_seq
        done = self._has_state is False and self.phase is Phase.ACTIVE and final is not None and seq >= final
        return self._complete() if done and self.ending is not Ending.NEVER else []

    def _extended(self, landed: int) -> list[MissionEvent]:
        if landed == 0:
            return []
        self._landed = landed
        self._airborne |= landed in (_IN_AIR, _TAKEOFF, _LANDING)
        self._landing_seen |= landed == _LANDING and self._at_final
        down = landed == _ON_GROUND and self._airborne and self.phase is Phase.ACTIVE
        if down and self.ending is Ending.LAND and self._at_final and not self._crashed:
            return self._complete()
        return []

    # --- what is in the vehicle ---

    def _follow_total(self, total: int) -> None:
        """Detect that another station has stored another mission (its number of items has changed)."""
        known = self.total is not None and total == self.total
        if self.autopilot is Autopilot.PX4 and self._commands is not None:
            known |= len(self._commands) - total in (0, 1)  # firmware versions count differently
        if not 0 < total < 0xFFFF or known:
            self._new_total = None
        elif self.total is None:
            self.total = total
        elif total != self._new_total:  # a single one may be a late packet
            self._new_total, self._new_total_under_way = total, self.phase is not Phase.IDLE
        else:
            self._commands = None
            self.total, self._new_total = total, None
            if self._new_total_under_way:  # else what has started meanwhile is the new mission
                self._replaced()
                self._restart(hot=bool(self.armed))

    def _learn(self, message: Message) -> None:
        """Learn the commands from a download by any ground station, if they are unknown."""
        if message.mission_type != dialect.MAV_MISSION_TYPE_MISSION or self._commands is not None:
            return
        self._learned[int(message.seq)] = int(message.command)
        count = self._learned_count
        if count and len(self._learned) == count and max(self._learned) == count - 1:
            self._commands = [self._learned[seq] for seq in range(count)]
            self.total = count - self.autopilot.first_seq
