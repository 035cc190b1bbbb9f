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

__all__ = ["AUTOPILOT_COMPONENT", "BROADCAST", "Autopilot", "Message", "command_name", "dialect", "is_autopilot"]


class Autopilot(enum.Enum):
    """Which of the two mission dialects a vehicle speaks."""

    ARDUPILOT = "ardupilot"
    PX4 = "px4"

    @classmethod
    def of(cls, heartbeat: Message) -> "Autopilot":
        """The dialect that a HEARTBEAT announces; all but ArduPilot are treated like PX4."""
        return cls.ARDUPILOT if heartbeat.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA else cls.PX4


def is_autopilot(heartbeat: Message) -> bool:
    """True for the HEARTBEAT of a flight controller; cameras, gimbals and ground stations send others."""
    return bool(
        heartbeat.autopilot != dialect.MAV_AUTOPILOT_INVALID
        and heartbeat.type not in (dialect.MAV_TYPE_GCS, dialect.MAV_TYPE_GIMBAL, dialect.MAV_TYPE_CAMERA)
    )


def command_name(command: int) -> str:
    """A MAV_CMD in words: `NAV_WAYPOINT`, `DO_SET_CAM_TRIGG_DIST`, or `command 1234`."""
    entry = dialect.enums["MAV_CMD"].get(command)
    return str(entry.name).removeprefix("MAV_CMD_") if entry else f"command {command}"
