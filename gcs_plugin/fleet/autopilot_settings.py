"""Settings of an autopilot that the check before a start looks at: its speed, its way home, what it does by itself.

ArduPilot 4.7 renamed some and gave them SI units (ardupilot.org, "Parameter Name Changes"), so both names are asked
for; no autopilot answers about a name that it does not have.
"""

import enum
import math
import struct
from dataclasses import dataclass
from typing import Final

from gcs_plugin.links.mavlink import Autopilot, Message, dialect
from gcs_plugin.mission.exchange import Address


class Setting(enum.Enum):
    """What is set, and its unit."""

    SPEED = "speed of missions, m/s"
    RETURN_HEIGHT = "least height of the way home above home, metres; 0 for the height at which the vehicle is"
    LOW_BATTERY = "action at a low battery"
    NO_STATION = "action where no ground station is heard"
    NO_STATION_EXCEPT = "modes in which it does nothing of that, bits"


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter: its name, what it sets, and the factor to that unit."""

    name: str
    setting: Setting
    scale: float = 1.0


PARAMETERS: Final[dict[Autopilot, tuple[Parameter, ...]]] = {
    Autopilot.ARDUPILOT: (
        Parameter("WP_SPD", Setting.SPEED),
        Parameter("WPNAV_SPEED", Setting.SPEED, 0.01),
        Parameter("RTL_ALT_M", Setting.RETURN_HEIGHT),
        Parameter("RTL_ALT", Setting.RETURN_HEIGHT, 0.01),
        Parameter("BATT_FS_LOW_ACT", Setting.LOW_BATTERY),
        Parameter("FS_GCS_ENABLE", Setting.NO_STATION),
        Parameter("FS_OPTIONS", Setting.NO_STATION_EXCEPT),
    ),
    Autopilot.PX4: (
        Parameter("MPC_XY_VEL_MAX", Setting.SPEED),
        Parameter("RTL_RETURN_ALT", Setting.RETURN_HEIGHT),
        Parameter("COM_LOW_BAT_ACT", Setting.LOW_BATTERY),
        Parameter("NAV_DLL_ACT", Setting.NO_STATION),
        Parameter("COM_DLL_EXCEPT", Setting.NO_STATION_EXCEPT),
    ),
}
"""PX4 flies no faster than MPC_XY_VEL_MAX, whatever is asked for. ArduCopter tries to reach what is asked for, up to
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
    "COM_LOW_BAT_ACT": {0: "", 1: "returns", 2: "lands", 3: "returns when it is critical, lands when it is empty"},
    "NAV_DLL_ACT": {0: "", 1: "holds", 2: "returns", 3: "lands", 5: "terminates its flight", 6: "disarms"},
}  # fmt: skip
"""What a vehicle does by a parameter's value, empty for nothing (ArduCopter 4.7, PX4 1.16)."""
_MISSION_BITS: Final = {"FS_OPTIONS": 1 << 1, "COM_DLL_EXCEPT": 1 << 0}
"""The bit for a mission; FS_OPTIONS has others for other failsafes."""
_INTEGERS: Final = {
    int(dialect.MAV_PARAM_TYPE_UINT8): "<B", int(dialect.MAV_PARAM_TYPE_INT8): "<b",
    int(dialect.MAV_PARAM_TYPE_UINT16): "<H", int(dialect.MAV_PARAM_TYPE_INT16): "<h",
    int(dialect.MAV_PARAM_TYPE_UINT32): "<I", int(dialect.MAV_PARAM_TYPE_INT32): "<i",
}  # fmt: skip


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
    def spares_missions(self) -> bool:
        """Whether, of NO_STATION_EXCEPT, a mission is one of these modes."""
        return bool(int(self.value) & _MISSION_BITS.get(self.name, 0))


def questions(address: Address, autopilot: Autopilot) -> list[Message]:
    """Requests for the settings: all of them each time, since another station may have changed them."""
    return [
        dialect.MAVLink_param_request_read_message(address.system, address.component, parameter.name.encode(), -1)
        for parameter in PARAMETERS[autopilot]
    ]


def answer(message: Message, autopilot: Autopilot) -> tuple[Setting, SetTo] | None:
    """The setting that a PARAM_VALUE gives, None for another parameter or a value that makes no sense."""
    name = str(message.param_id).strip("\x00")
    parameter = next((p for p in PARAMETERS[autopilot] if p.name == name), None)
    if parameter is None:
        return None
    value = parameter.scale * _value(message, autopilot)
    least = 0.0 if parameter.setting is not Setting.SPEED else math.ulp(0.0)
    if not math.isfinite(value) or value < least:
        return None
    return parameter.setting, SetTo(name, value, parameter.scale)


def _value(message: Message, autopilot: Autopilot) -> float:
    """PX4 sends an integer's bytes in the place of the float, ArduPilot its value (MAVLink, parameter encoding)."""
    form = _INTEGERS.get(int(message.param_type))
    if form is None or autopilot is not Autopilot.PX4:
        return float(message.param_value)
    raw = struct.pack("<f", message.param_value)
    return float(struct.unpack_from(form, raw)[0])
