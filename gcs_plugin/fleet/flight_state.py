"""The flight state of a vehicle in one word, from its mode, speed, height and mission, for both autopilots."""

import enum
import math
from dataclasses import dataclass
from typing import Any, Final, Protocol

from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.completion import CompletionDetector, Phase
from gcs_plugin.mission.flight_modes import Modes
from gcs_plugin.mission.items import DELAY, LAND, LOITER_UNLIM, RTL, TAKEOFF, VTOL_LAND, WAYPOINT, Mission

STILL_S: Final = 2.5
"""How long a vehicle stands still on its way before that counts as a pause: longer than a turn's stop."""
_STILL_UNKNOWN_S: Final = 8.0
"""The same where its mission is not known: an item may let it wait, and PX4 hovers for some seconds before it lands."""
_SINKS_M_S: Final = 0.3
_SLOW_M_S: Final = 1.0
_LOW_M: Final = 1.5
_RETURNS: Final = frozenset({"RTL", "SMART_RTL", "AUTO_RTL", "QRTL"})
_LANDS: Final = frozenset({"LAND", "QLAND"})
_HOLDS: Final = frozenset({"HOLD", "BRAKE", "LOITER", "POSHOLD", "GUIDED", "QHOVER", "QLOITER"})
_TIMED: Final = frozenset({DELAY, LOITER_UNLIM, int(dialect.MAV_CMD_NAV_LOITER_TIME)})


class Word(enum.Enum):
    """Flight states. FLYING: in the air without a mission; HOLDING: in the air after its mission's end."""

    ON_GROUND = "on ground"
    TAKING_OFF = "taking off"
    ON_MISSION = "on mission"
    PAUSED = "paused"
    RETURNING = "returning"
    LANDING = "landing"
    HOLDING = "holding"
    FLYING = "flying"
    LOST = "lost"
    COMPLETE = "complete"


@dataclass(frozen=True, slots=True)
class FlightState:
    """The flight state of a vehicle.

    Attributes:
        word: the state.
        item: the current mission item, from 1. items: their number; both 0 if unknown.
    """

    word: Word
    item: int = 0
    items: int = 0

    @property
    def text(self) -> str:
        """For people: `on mission 7/13`."""
        counted = self.word in (Word.ON_MISSION, Word.PAUSED) and self.items
        return f"{self.word.value} {self.item}/{self.items}" if counted else self.word.value

    def document(self) -> dict[str, Any]:
        """As JSON values: `state` (the word), `text`, `item`, `items`."""
        return {"state": self.word.value, "text": self.text, "item": self.item, "items": self.items}


class Observed(Protocol):
    """The needed state of a vehicle; see vehicle_state.Vehicle."""

    autopilot: Autopilot
    modes: Modes
    detector: CompletionDetector
    lost: bool
    armed: bool
    custom_mode: int
    velocity_m_s: tuple[float, float, float]
    height_m: float
    landed: str
    mission: Mission | None
    mission_seq: int
    mission_total: int
    paused_in_mission: bool

    @property
    def mode(self) -> str:
        """Its mode in words."""

    @property
    def flying(self) -> bool:
        """True if it is armed and, as far as is known, off the ground."""

    @property
    def still_s(self) -> float:
        """For how long it has been stationary, seconds."""


def flight_state(vehicle: Observed) -> FlightState:
    """The flight state of a vehicle, as far as its messages show."""
    items = vehicle.mission_total
    first = 0 if vehicle.autopilot is Autopilot.ARDUPILOT else 1
    return FlightState(_word(vehicle), min(vehicle.mission_seq + first, items), items)


def _word(vehicle: Observed) -> Word:
    if vehicle.lost:
        return Word.LOST
    if not vehicle.flying:
        done = vehicle.detector.phase is Phase.COMPLETE and not vehicle.armed
        return Word.COMPLETE if done else Word.ON_GROUND
    mode = vehicle.mode
    if mode in _LANDS:
        return Word.LANDING
    if mode in _RETURNS:
        return Word.LANDING if _comes_down(vehicle) else Word.RETURNING
    if mode == "TAKEOFF":
        return Word.TAKING_OFF
    if vehicle.custom_mode == vehicle.modes.mission:
        return _on_mission(vehicle)
    if vehicle.detector.phase is Phase.COMPLETE:
        return Word.HOLDING
    if mode in _HOLDS and vehicle.detector.phase is Phase.SUSPENDED:
        return Word.PAUSED
    if mode in _HOLDS and vehicle.detector.phase is Phase.ACTIVE:
        return Word.ON_MISSION  # it pauses, resumes or ends: PX4's mode and mission state arrive up to a second apart
    return Word.FLYING


def _on_mission(vehicle: Observed) -> Word:
    command, waits = _item(vehicle)
    if command == RTL:
        return Word.LANDING if _comes_down(vehicle) else Word.RETURNING
    if command in (LAND, VTOL_LAND) and _comes_down(vehicle):
        return Word.LANDING
    if command is None and _comes_down(vehicle) and vehicle.landed != "taking off":
        return Word.LANDING
    if vehicle.detector.phase is Phase.COMPLETE:
        return Word.LANDING if _comes_down(vehicle) else Word.HOLDING
    if command == TAKEOFF or vehicle.landed == "taking off":
        return Word.TAKING_OFF
    still_s = _STILL_UNKNOWN_S if command is None else STILL_S
    if vehicle.paused_in_mission or (vehicle.still_s >= still_s and not waits):
        return Word.PAUSED
    return Word.ON_MISSION


def _item(vehicle: Observed) -> tuple[int | None, bool]:
    """The present item's command, and whether it lets the vehicle wait; None where the mission is not known."""
    mission = vehicle.mission
    if mission is None or not 0 <= vehicle.mission_seq < len(mission.items):
        return None, False
    item = mission.items[vehicle.mission_seq]
    return item.command, item.command in _TIMED or (item.command == WAYPOINT and item.params[0] > 0.0)


def _comes_down(vehicle: Observed) -> bool:
    sinks = vehicle.velocity_m_s[2] > _SINKS_M_S and math.hypot(*vehicle.velocity_m_s[:2]) < _SLOW_M_S
    return vehicle.landed == "landing" or sinks
