"""What a simulated flight is made of: MAVLink's states, the tasks of a vehicle, and its pictures."""

import enum
from dataclasses import dataclass

from gcs_plugin.sim.multirotor import VehiclePose


class Landed(enum.IntEnum):
    """MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class MissionState(enum.IntEnum):
    """MISSION_STATE."""

    NONE = 1
    NOT_STARTED = 2
    ACTIVE = 3
    PAUSED = 4
    COMPLETE = 5


class Task(enum.Enum):
    """The vehicle's present task."""

    STAND = "stand"
    HOLD = "hold"
    ITEM = "item"
    CLIMB_HOME = "climb home"
    GO_HOME = "go home"
    DESCEND = "descend"
    STEERED = "steered"


@dataclass(frozen=True, slots=True)
class TakenPicture:
    """A picture that the vehicle has taken.

    Attributes:
        index: counts from 0.
        time_s: seconds since boot.
        pose: the vehicle's true pose.
        lat_deg: latitude by its receiver; lon_deg: longitude.
    """

    index: int
    time_s: float
    pose: VehiclePose
    lat_deg: float
    lon_deg: float
