"""The only import of pymavlink: MAVLink 2 is selected before it is loaded.

Without MAVLINK20 in the environment pymavlink's `mavutil` speaks MAVLink 1 and knows no message above id 255
(CAMERA_IMAGE_CAPTURED, for one). Modules of this package take `dialect` from here and never import pymavlink on their
own.
"""

import enum
import os
from typing import Any, Final

os.environ["MAVLINK20"] = "1"

from pymavlink.dialects.v20 import ardupilotmega as dialect

# A decoded MAVLink message. pymavlink makes one class for each message at run time, so no finer type exists.
Message = Any

AUTOPILOT_COMPONENT: Final = 1
BROADCAST: Final = 0

# What a system carries besides its autopilot, or on the ground. Some of these name an autopilot in their HEARTBEATs,
# too: many programs on companion computers say "generic".
_NO_VEHICLES: Final = frozenset(
    int(getattr(dialect, f"MAV_TYPE_{name}"))
    for name in (
        "GCS", "ANTENNA_TRACKER", "ONBOARD_CONTROLLER", "GIMBAL", "ADSB", "CAMERA", "CHARGING_STATION", "FLARM",
        "SERVO", "ODID", "BATTERY", "PARACHUTE", "LOG", "OSD", "IMU", "GPS", "WINCH",
    )
)  # fmt: skip
_KNOWN: Final = frozenset({int(dialect.MAV_AUTOPILOT_ARDUPILOTMEGA), int(dialect.MAV_AUTOPILOT_PX4)})

__all__ = [
    "AUTOPILOT_COMPONENT",
    "BROADCAST",
    "Autopilot",
    "Message",
    "command_name",
    "dialect",
    "has_place",
    "is_autopilot",
    "is_vehicle",
]


class Autopilot(enum.Enum):
    """Which of the two mission dialects a vehicle speaks."""

    ARDUPILOT = "ardupilot"
    PX4 = "px4"

    @classmethod
    def of(cls, heartbeat: Message) -> "Autopilot":
        """The dialect that a HEARTBEAT announces; all but ArduPilot are treated like PX4."""
        return cls.ARDUPILOT if heartbeat.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA else cls.PX4

    @property
    def first_seq(self) -> int:
        """Sequence number of the first item of a mission that is flown: 1 on ArduPilot, whose item 0 is home."""
        return 1 if self is Autopilot.ARDUPILOT else 0


def is_autopilot(heartbeat: Message) -> bool:
    """True for the HEARTBEAT of a flight controller; cameras, companions and ground stations send others."""
    return bool(heartbeat.autopilot != dialect.MAV_AUTOPILOT_INVALID and heartbeat.type not in _NO_VEHICLES)


def has_place(position: Message) -> bool:
    """True for a position; autopilots say latitude 0 and longitude 0 until they know where they are."""
    return bool(position.lat or position.lon)


def is_vehicle(heartbeat: Message, component: int) -> bool:
    """True if the sender of a HEARTBEAT, a component of its system, is that vehicle's autopilot.

    Whoever is taken for it gets the commands. Another component than an autopilot's usual one must name one of the two
    that are known here: with type and autopilot "generic" it may be anything.
    """
    return is_autopilot(heartbeat) and (component == AUTOPILOT_COMPONENT or heartbeat.autopilot in _KNOWN)


def command_name(command: int) -> str:
    """A MAV_CMD in words: `NAV_WAYPOINT`, `DO_SET_CAM_TRIGG_DIST`, or `command 1234`."""
    entry = dialect.enums["MAV_CMD"].get(command)
    return str(entry.name).removeprefix("MAV_CMD_") if entry else f"command {command}"
