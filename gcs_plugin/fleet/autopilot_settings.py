"""Settings of an autopilot that a check before a start looks at: speed, way home, geofence, what it does by itself.

ArduPilot 4.7 renamed some and gave them SI units (ardupilot.org, "Parameter Name Changes"), so both names are asked
for; no autopilot answers about a name that it does not have.
"""

import enum
import math
import struct
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Final

from gcs_plugin.links.mavlink import Autopilot, Message, dialect
from gcs_plugin.mission.exchange import Address


class Setting(enum.Enum):
    """What is set, and its unit."""

    SPEED = "speed of missions, m/s"
    RETURN_HEIGHT = "least height of the way home above home, metres; 0 for the height at which the vehicle is"
    RETURN_TYPE = "where to and how it returns; 0 for straight home, at a height above it"
    RETURN_SPEED = "speed of the way home, m/s; 0 for the speed of missions"
    RETURN_CLIMB = "how far it climbs at least before it flies home, metres"
    RETURN_CONE = "to how many times its distance from home it climbs at most"
    RALLY_POINTS = "number of places to which it may return instead of home"
    LOW_BATTERY = "action at a low battery"
    NO_STATION = "action where no ground station is heard"
    NO_STATION_EXCEPT = "modes in which it does nothing of that, bits"
    FENCE = "whether it keeps a geofence"
    FENCE_AUTO = "when it switches its geofence on by itself, 0 for never"
    FENCE_KINDS = "limits that its geofence has, bits"
    FENCE_ACTION = "action at its geofence"
    FENCE_OPTIONS = "how its geofence's zones count, bits"
    FENCE_RADIUS = "greatest distance from home, metres"
    FENCE_TOP = "greatest height above home, metres"
    FENCE_FLOOR = "least height above home, metres"
    FENCE_MARGIN = "distance to be kept from its geofence, metres"


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter: its name, what it sets, the factor to that unit, and the least value that has a meaning, in it."""

    name: str
    setting: Setting
    scale: float = 1.0
    least: float = 0.0


_SOME: Final = math.ulp(0.0)
PARAMETERS: Final[dict[Autopilot, tuple[Parameter, ...]]] = {
    Autopilot.ARDUPILOT: (
        Parameter("RTL_ALT_M", Setting.RETURN_HEIGHT),
        Parameter("RTL_ALT", Setting.RETURN_HEIGHT, 0.01),
        Parameter("RTL_ALT_TYPE", Setting.RETURN_TYPE),
        Parameter("RTL_SPEED_MS", Setting.RETURN_SPEED),
        Parameter("RTL_SPEED", Setting.RETURN_SPEED, 0.01),
        Parameter("RTL_CLIMB_MIN_M", Setting.RETURN_CLIMB),
        Parameter("RTL_CLIMB_MIN", Setting.RETURN_CLIMB, 0.01),
        Parameter("RTL_CONE_SLOPE", Setting.RETURN_CONE),
        Parameter("RALLY_TOTAL", Setting.RALLY_POINTS),
        Parameter("FENCE_ENABLE", Setting.FENCE),
        Parameter("FENCE_AUTOENABLE", Setting.FENCE_AUTO),
        Parameter("FENCE_TYPE", Setting.FENCE_KINDS),
        Parameter("FENCE_ACTION", Setting.FENCE_ACTION),
        Parameter("FENCE_OPTIONS", Setting.FENCE_OPTIONS),
        Parameter("FENCE_RADIUS", Setting.FENCE_RADIUS),
        Parameter("FENCE_ALT_MAX", Setting.FENCE_TOP),
        Parameter("FENCE_ALT_MIN", Setting.FENCE_FLOOR, least=-math.inf),
        Parameter("FENCE_MARGIN", Setting.FENCE_MARGIN),
        Parameter("BATT_FS_LOW_ACT", Setting.LOW_BATTERY),
        Parameter("FS_GCS_ENABLE", Setting.NO_STATION),
        Parameter("FS_OPTIONS", Setting.NO_STATION_EXCEPT),
        Parameter("WP_SPD", Setting.SPEED, least=_SOME),
        Parameter("WPNAV_SPEED", Setting.SPEED, 0.01, _SOME),
    ),
    Autopilot.PX4: (
        Parameter("GF_MAX_HOR_DIST", Setting.FENCE_RADIUS),
        Parameter("GF_MAX_VER_DIST", Setting.FENCE_TOP),
        Parameter("RTL_RETURN_ALT", Setting.RETURN_HEIGHT),
        Parameter("RTL_TYPE", Setting.RETURN_TYPE),
        Parameter("MPC_XY_CRUISE", Setting.RETURN_SPEED, least=_SOME),
        Parameter("COM_LOW_BAT_ACT", Setting.LOW_BATTERY),
        Parameter("NAV_DLL_ACT", Setting.NO_STATION),
        Parameter("COM_DLL_EXCEPT", Setting.NO_STATION_EXCEPT),
        Parameter("MPC_XY_VEL_MAX", Setting.SPEED, least=_SOME),
    ),
}
"""They are asked for in this order; a check waits for the last one, so that most of the others have come by then.

PX4 flies no faster than MPC_XY_VEL_MAX, whatever is asked for. ArduCopter tries to reach what is asked for, up to
its greatest lean; its speed of missions is what it has been set up for."""

_ACTIONS: Final[dict[str, dict[int, str]]] = {
    "BATT_FS_LOW_ACT": {
        0: "", 1: "lands", 2: "returns", 3: "returns", 4: "returns the way it came, or lands",
        5: "terminates its flight", 6: "lands by its mission's landing, or returns", 7: "brakes, or lands",
    },
    "FS_GCS_ENABLE": {
        0: "", 1: "returns", 2: "returns, or goes on with its mission", 3: "returns",
        4: "returns the way it came, or lands", 5: "lands", 6: "lands by its mission's landing, or returns",
        7: "brakes, or lands",
    },
    "FENCE_ACTION": {
        0: "", 1: "returns, or lands", 2: "lands", 3: "returns the way it came, or returns", 4: "brakes, or lands",
        5: "returns the way it came, or lands",
    },
    "COM_LOW_BAT_ACT": {0: "", 1: "returns", 2: "lands", 3: "returns when it is critical, lands when it is empty"},
    "NAV_DLL_ACT": {0: "", 1: "holds", 2: "returns", 3: "lands", 5: "terminates its flight", 6: "disarms"},
}  # fmt: skip
"""What a vehicle does by a parameter's value, empty for nothing (ArduCopter 4.7, PX4 1.16)."""
CHECKED: Final = frozenset({
    Setting.RETURN_HEIGHT, Setting.RETURN_TYPE, Setting.SPEED,
    Setting.FENCE, Setting.FENCE_KINDS, Setting.FENCE_ACTION, Setting.FENCE_RADIUS, Setting.FENCE_TOP,
})  # fmt: skip
"""What a check before a start waits for: what it compares with the mission."""
NEWER: Final = frozenset({Setting.RETURN_TYPE})
"""What of that older versions do not have."""
_RETURNS: Final = {
    1: "to its mission's landing or to a rally point, if it has one",
    2: "along the way of its mission",
    3: "to the nearest of home, its mission's landing and rally points",
    4: "along the way of its mission, ahead or back",
    5: "to a rally point",
    6: "home, or to a rally point when its battery is low",
}
"""Where to a PX4 returns by RTL_TYPE (1.17), but for 0: straight home or to the nearest rally point."""
_ALONG: Final = frozenset({2, 4})
"""Those that go along the mission's way, back to home if it has no landing."""
_MISSION_BITS: Final = {"FS_OPTIONS": 1 << 1, "COM_DLL_EXCEPT": 1 << 0}
"""The bit for a mission; FS_OPTIONS has others for other failsafes."""
_INTEGERS: Final = {
    int(dialect.MAV_PARAM_TYPE_UINT8): "<B", int(dialect.MAV_PARAM_TYPE_INT8): "<b",
    int(dialect.MAV_PARAM_TYPE_UINT16): "<H", int(dialect.MAV_PARAM_TYPE_INT16): "<h",
    int(dialect.MAV_PARAM_TYPE_UINT32): "<I", int(dialect.MAV_PARAM_TYPE_INT32): "<i",
}  # fmt: skip
_AT_ONCE, _PAUSE_S = 10, 0.25  # requests, and seconds until the next ones
_ROUNDS, _ANSWER_S = 3, 0.7  # times that each is asked for, and seconds for the answers to the last ones


@dataclass(frozen=True, slots=True)
class SetTo:
    """A setting as a vehicle has it: the parameter's name, its value in the unit of its `Setting`, and its scale."""

    name: str
    value: float
    scale: float = 1.0

    def native(self, value: float) -> float:
        """A value in the unit of the parameter."""
        return value / self.scale

    @property
    def action(self) -> str:
        """What the vehicle does, in words; empty for nothing."""
        known = _ACTIONS.get(self.name, {})
        return known.get(round(self.value), f"does what {self.name} {self.value:g} says")

    @property
    def returns(self) -> str:
        """How a vehicle returns by its RETURN_TYPE, in words; empty for straight home, at a height above it."""
        kind = round(self.value)
        if not kind or (self.name == "RTL_ALT_TYPE" and kind != 1):  # other values count as 0
            return ""
        if self.name == "RTL_ALT_TYPE":
            return "at a height above the ground below it, where it knows that"
        return _RETURNS.get(kind, f"as {self.name} {kind} says")

    @property
    def may_fly_straight(self) -> bool:
        """Whether, of RETURN_TYPE, a vehicle may fly straight home at its RETURN_HEIGHT all the same."""
        return self.name == "RTL_ALT_TYPE" or round(self.value) not in _ALONG

    @property
    def spares_missions(self) -> bool:
        """Whether, of NO_STATION_EXCEPT, a mission is one of these modes."""
        return bool(int(self.value) & _MISSION_BITS.get(self.name, 0))


@dataclass(slots=True)
class Questions:
    """Asks a vehicle for its settings: all of them each time, since another station may have changed them.

    A few are asked for at a time, because ArduPilot drops those that it has no room for (20, GCS_Param.cpp). What has
    not been answered is asked for again: a question or its answer may be lost. An autopilot says nothing about a name
    that it does not have. `asked`: it has been asked for them.
    """

    address: Address
    autopilot: Autopilot
    asked: bool = field(default=False, init=False)
    _open: dict[str, Setting] = field(default_factory=dict, init=False)
    _queue: list[str] = field(default_factory=list, init=False)
    _rounds: int = field(default=0, init=False)
    _next: float = field(default=0.0, init=False)

    def ask(self, now: float) -> list[Message]:
        """Begin anew; returns the first requests, `tick` the others."""
        self.asked = True
        self._open = {parameter.name: parameter.setting for parameter in PARAMETERS[self.autopilot]}
        self._queue, self._rounds = list(self._open), _ROUNDS
        return self._some(now)

    def tick(self, now: float) -> list[Message]:
        """The requests that are due."""
        if not self._open or now < self._next:
            return []
        if not self._queue:
            self._rounds -= 1
            if not self._rounds:
                self._open.clear()
                return []
            self._queue = list(self._open)
        return self._some(now)

    def answered(self, setting: Setting) -> None:
        """A setting has been told."""
        self._open = {name: asked for name, asked in self._open.items() if asked is not setting}
        self._queue = [name for name in self._queue if name in self._open]

    def waits_for(self, settings: Collection[Setting]) -> bool:
        """Whether one of these has not been answered, or some setting not even been asked for yet."""
        return (self._rounds == _ROUNDS and bool(self._queue)) or any(
            asked in settings for asked in self._open.values()
        )

    def _some(self, now: float) -> list[Message]:
        names, self._queue = self._queue[:_AT_ONCE], self._queue[_AT_ONCE:]
        self._next = now + (_PAUSE_S if self._queue else _ANSWER_S)
        to = self.address
        return [
            dialect.MAVLink_param_request_read_message(to.system, to.component, name.encode(), -1) for name in names
        ]


def answer(message: Message, autopilot: Autopilot) -> tuple[Setting, SetTo] | None:
    """The setting that a PARAM_VALUE gives, None for another parameter or a value that makes no sense."""
    name = str(message.param_id).strip("\x00")
    parameter = next((p for p in PARAMETERS[autopilot] if p.name == name), None)
    if parameter is None:
        return None
    value = parameter.scale * _value(message, autopilot)
    if not math.isfinite(value) or value < parameter.least:
        return None
    return parameter.setting, SetTo(name, value, parameter.scale)


def _value(message: Message, autopilot: Autopilot) -> float:
    """PX4 sends an integer's bytes in the place of the float, ArduPilot its value (MAVLink, parameter encoding)."""
    form = _INTEGERS.get(int(message.param_type))
    if form is None or autopilot is not Autopilot.PX4:
        return float(message.param_value)
    raw = struct.pack("<f", message.param_value)
    return float(struct.unpack_from(form, raw)[0])
