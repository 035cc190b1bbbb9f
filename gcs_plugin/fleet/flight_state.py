"""The flight state of a vehicle in one word, from its motion, mode and mission, for both autopilots.

A mode alone says nothing: in LOITER or GUIDED a vehicle stands still, is flown by someone else, or sinks because a
remote control's throttle is low. So a word that means standing still is said only of one that does.
"""

import enum
import math
from dataclasses import dataclass
from typing import Any, Final, Protocol

from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.completion import CompletionDetector, Phase
from gcs_plugin.mission.flight_modes import HOLDS, LANDS, RETURNS, Modes
from gcs_plugin.mission.items import DELAY, LANDINGS, LOITER_TIME, LOITER_UNLIM, RTL, TAKEOFF, WAYPOINT, Mission

STILL_S: Final = 2.5
"""How long a vehicle stands still on its way before that counts as a pause: longer than a turn's stop."""
_SINKS_M_S: Final = 0.3
_SLOW_M_S: Final = 1.0
_SINKING_S: Final = 1.0
"""How long a vehicle sinks where it should not until that is said: gusts and braking move it for less."""
_BRAKES_S: Final = 5.0
"""One that was just put into its mode to hold is still slowing down for so long at most: from 15 m/s at 3 m/s2."""
_TIMED: Final = frozenset({DELAY, LOITER_UNLIM, LOITER_TIME})


class Word(enum.Enum):
    """Flight states. FLYING: moved without its mission; HOLDING: still, without one; DESCENDING: unordered."""

    ON_GROUND = "on ground"
    TAKING_OFF = "taking off"
    ON_MISSION = "on mission"
    PAUSED = "paused"
    RETURNING = "returning"
    LANDING = "landing"
    HOLDING = "holding"
    DESCENDING = "descending"
    FLYING = "flying"
    LOST = "lost"
    COMPLETE = "complete"


@dataclass(frozen=True, slots=True)
class FlightState:
    """The flight state of a vehicle.

    Attributes:
        word: the state.
        item: the current mission item, from 1. items: their number; both 0 if unknown.
        mode: the flight mode that it moves in without its mission; of a pause, the one that it interrupted if that was
            not the mission.
    """

    word: Word
    item: int = 0
    items: int = 0
    mode: str = ""

    @property
    def text(self) -> str:
        """For people: `on mission 7/13`."""
        if self.mode:
            return f"{self.word.value} in {self.mode}"
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
    mission_state: int
    mission_total: int
    paused_in_mission: bool
    way: int | None
    failsafe: bool

    @property
    def severe_text(self) -> str:
        """The last text in which its autopilot reported a fault in this flight, empty if none."""

    @property
    def mode(self) -> str:
        """Its mode in words."""

    @property
    def flying(self) -> bool:
        """True if it is armed and, as far as is known, off the ground."""

    @property
    def still_s(self) -> float:
        """For how long it has been stationary, seconds."""

    @property
    def in_mode_s(self) -> float:
        """For how long it has been in its mode, seconds."""

    @property
    def sinks_s(self) -> float:
        """For how long it has been sinking, seconds."""


def flight_state(vehicle: Observed) -> FlightState:
    """The flight state of a vehicle, as far as its messages show."""
    items = vehicle.mission_total
    word = _word(vehicle)
    mode = vehicle.mode if word in (Word.FLYING, Word.DESCENDING) else ""
    if word is Word.PAUSED and vehicle.way not in (None, vehicle.modes.mission):
        mode = vehicle.modes.name(vehicle.way or 0)
    return FlightState(word, min(vehicle.mission_seq + 1 - vehicle.autopilot.first_seq, items), items, mode)


def danger_of(vehicle: Observed) -> str:
    """What endangers a vehicle in the air by itself, and what to do, in words; empty if nothing does."""
    if vehicle.lost or not vehicle.flying:
        return ""
    if _word(vehicle) is Word.DESCENDING:
        return f"sinks in {vehicle.mode} though nobody ordered it to land: take it over, or send it home"
    if vehicle.failsafe:
        said = f" ({vehicle.severe_text})" if vehicle.severe_text else ""
        return f"is in a failsafe{said}, in {vehicle.mode}: let it return, or take it over"
    return f"says: {vehicle.severe_text}" if vehicle.severe_text else ""


def _word(vehicle: Observed) -> Word:
    if vehicle.lost:
        return Word.LOST
    if not vehicle.flying:
        done = vehicle.detector.phase is Phase.COMPLETE and not vehicle.armed
        return Word.COMPLETE if done else Word.ON_GROUND
    mode = vehicle.mode
    if mode in LANDS:
        return Word.LANDING
    if mode in RETURNS:
        return Word.LANDING if _comes_down(vehicle) else Word.RETURNING
    if mode == "TAKEOFF":
        return Word.TAKING_OFF
    if vehicle.custom_mode == vehicle.modes.mission:
        return _on_mission(vehicle)
    brakes = vehicle.custom_mode == vehicle.modes.hold and vehicle.in_mode_s < _BRAKES_S
    if vehicle.sinks_s >= _SINKING_S and not brakes:
        return Word.DESCENDING
    if mode not in HOLDS or (math.hypot(*vehicle.velocity_m_s[:2]) > _SLOW_M_S and not brakes):
        return Word.FLYING
    if vehicle.detector.phase is Phase.ACTIVE:
        return Word.ON_MISSION  # it pauses, resumes or ends: PX4's mode and mission state arrive up to a second apart
    return Word.PAUSED if _interrupted(vehicle) else Word.HOLDING


def _interrupted(vehicle: Observed) -> bool:
    """Whether one that holds was under way: on a return, or between the ends of its mission."""
    if vehicle.detector.phase is Phase.SUSPENDED:
        return True
    if vehicle.way is not None:
        return vehicle.modes.name(vehicle.way) in RETURNS | LANDS
    begun = vehicle.mission_seq >= 1 or vehicle.mission_state == dialect.MISSION_STATE_PAUSED  # ArduPilot: by its item
    return begun and vehicle.custom_mode == vehicle.modes.hold and vehicle.detector.phase is Phase.IDLE


def _on_mission(vehicle: Observed) -> Word:
    command, waits = _item(vehicle)
    if command == RTL:
        return Word.LANDING if _comes_down(vehicle) else Word.RETURNING
    if vehicle.landed == "landing" or (command in LANDINGS and _comes_down(vehicle)):
        return Word.LANDING
    if vehicle.detector.phase is Phase.COMPLETE:
        return Word.LANDING if _comes_down(vehicle) else Word.HOLDING
    if command == TAKEOFF or vehicle.landed == "taking off":
        return Word.TAKING_OFF
    still = command is not None and vehicle.still_s >= STILL_S and not waits
    return Word.PAUSED if vehicle.paused_in_mission or still else Word.ON_MISSION


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
