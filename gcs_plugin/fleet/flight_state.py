"""The flight state of a vehicle in one word, from its motion, mode and mission, for both autopilots.

A mode alone says nothing: in LOITER or GUIDED a vehicle stands still, is flown by someone else, or sinks because a
remote control's throttle is low. So a word that means standing still is said only of one that does.
"""

import enum
import math
from dataclasses import dataclass
from typing import Any, Final

from gcs_plugin.config import HEARING
from gcs_plugin.fleet.heard_messages import MESSAGE_IDS
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import dialect
from gcs_plugin.mission.completion import Phase
from gcs_plugin.mission.flight_modes import HOLDS, LANDS, RETURNS
from gcs_plugin.mission.items import DELAY, LANDINGS, LOITER_TIME, LOITER_UNLIM, RTL, TAKEOFF, WAYPOINT

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


def flight_state(vehicle: Vehicle) -> FlightState:
    """The flight state of a vehicle, as far as its messages show."""
    items = vehicle.mission_total
    word = _word(vehicle)
    mode = vehicle.mode if word in (Word.FLYING, Word.DESCENDING) else ""
    if word is Word.PAUSED and vehicle.way not in (None, vehicle.modes.mission):
        mode = vehicle.modes.name(vehicle.way or 0)
    return FlightState(word, min(vehicle.mission_seq + 1 - vehicle.autopilot.first_seq, items), items, mode)


def danger_of(vehicle: Vehicle) -> str:
    """What endangers a vehicle in the air by itself, and what to do, in words; empty if nothing does."""
    if vehicle.lost or not vehicle.flying:
        return ""
    if _word(vehicle) is Word.DESCENDING:
        return f"sinks in {vehicle.mode} though nobody ordered it to land: take it over, or send it home"
    if vehicle.failsafe:
        said = f" ({vehicle.severe_text})" if vehicle.severe_text else ""
        return f"is in a failsafe{said}, in {vehicle.mode}: let it return, or take it over"
    return f"says: {vehicle.severe_text}" if vehicle.severe_text else ""


def _word(vehicle: Vehicle) -> Word:
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


def _interrupted(vehicle: Vehicle) -> bool:
    """Whether one that holds was under way: on a return, or between the ends of its mission."""
    if vehicle.detector.phase is Phase.SUSPENDED:
        return True
    if vehicle.way is not None:
        return vehicle.modes.name(vehicle.way) in RETURNS | LANDS
    begun = vehicle.mission_seq >= 1 or vehicle.mission_state == dialect.MISSION_STATE_PAUSED  # ArduPilot: by its item
    return begun and vehicle.custom_mode == vehicle.modes.hold and vehicle.detector.phase is Phase.IDLE


def _on_mission(vehicle: Vehicle) -> Word:
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


def _item(vehicle: Vehicle) -> tuple[int | None, bool]:
    """The present item's command, and whether it lets the vehicle wait; None where the mission is not known."""
    mission = vehicle.mission
    if mission is None or not 0 <= vehicle.mission_seq < len(mission.items):
        return None, False
    item = mission.items[vehicle.mission_seq]
    return item.command, item.command in _TIMED or (item.command == WAYPOINT and item.params[0] > 0.0)


def _comes_down(vehicle: Vehicle) -> bool:
    sinks = vehicle.velocity_m_s[2] > _SINKS_M_S and math.hypot(*vehicle.velocity_m_s[:2]) < _SLOW_M_S
    return vehicle.landed == "landing" or sinks


def summary(vehicle: Vehicle, now: float) -> dict[str, Any]:
    """The state of a vehicle as JSON values, for `fleet list --json` and the web map.

    `battery_s` and `gps_s` are the whole seconds since when the battery's state and the receiver's (`gps_fix`,
    `satellites`) have not been reported: 0 while they come, None if they never came. `faults` are those of its
    stream: `lost_share` of its packets lately, `damaged` packets of its link, `impossible` messages, both dropped.
    """
    return {
        "id": vehicle.id,
        "system": vehicle.system,
        "autopilot": vehicle.autopilot.value,
        "link": vehicle.route.side.link.name if vehicle.route else "",
        "state": "lost" if vehicle.lost else "conflict" if vehicle.claimants else "found",
        "links": [route.address for route in vehicle.routes.fresh(now)],
        "claimants": list(vehicle.claimants),
        "flight": flight_state(vehicle).document(),
        "silent_s": round(now - vehicle.heard, 1),
        "armed": vehicle.armed,
        "mode": vehicle.mode,
        "landed": vehicle.landed,
        "lat_deg": vehicle.lat_deg,
        "lon_deg": vehicle.lon_deg,
        "height_m": round(vehicle.height_m, 2),
        "alt_m": None if vehicle.alt_m is None else round(vehicle.alt_m, 1),
        "heading_deg": None if vehicle.heading_rad is None else round(math.degrees(vehicle.heading_rad), 1),
        "speed_m_s": round(math.hypot(*vehicle.velocity_m_s[:2]), 2),
        "climb_m_s": round(-vehicle.velocity_m_s[2], 1),
        "roll_deg": None if vehicle.roll_rad is None else round(math.degrees(vehicle.roll_rad)),
        "pitch_deg": None if vehicle.pitch_rad is None else round(math.degrees(vehicle.pitch_rad)),
        "gimbal_pitch_deg": None if vehicle.gimbal_pitch_deg is None else round(vehicle.gimbal_pitch_deg),
        "battery": vehicle.battery,
        "battery_s": _old_s(vehicle.battery_age_s(now)),
        "gps_s": _old_s(vehicle.streams.age_s(MESSAGE_IDS["GPS_RAW_INT"], now)),
        "gps_fix": vehicle.gps_fix,
        "satellites": vehicle.satellites,
        "mission": {"phase": vehicle.detector.phase.value, "item": vehicle.mission_seq, "items": vehicle.mission_total},
        "photos": vehicle.photos,
        "home": None if vehicle.home is None else [round(vehicle.home[0], 7), round(vehicle.home[1], 7)],
        "received": vehicle.received,
        "missed": vehicle.missed,
        "faults": {
            "lost_share": round(vehicle.route.loss, 2) if vehicle.route else 0.0,
            "damaged": vehicle.route.damaged if vehicle.route else 0,
            "impossible": vehicle.impossible,
        },
    }


def _old_s(age_s: float | None) -> int | None:
    """The age of a value in whole seconds, 0 while it is renewed: rows change, and are sent, only if it matters."""
    return None if age_s is None else 0 if age_s < HEARING.lost_s else int(age_s)
