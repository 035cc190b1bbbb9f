"""The messages that a vehicle's state hears: at what rate, which of them may be late, what values they can have.

What the state does with each stands in `vehicle_state`; those that the end of a mission depends on, in
`mission.completion`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from gcs_plugin.links.mavlink import Autopilot, Message, dialect

MESSAGE_IDS: Final = {kind.msgname: number for number, kind in dialect.mavlink_map.items()}
_LOW_M, _HIGH_M = -1_000.0, 20_000.0
_FAST_M_S: Final = 300.0


@dataclass(frozen=True, slots=True, kw_only=True)
class HeardMessage:
    """How a message is heard.

    Attributes:
        hz: rate at which it is asked for; 0 for one that comes by itself.
        optional: not every vehicle has it (a gimbal's attitude): asked for once, and again if it comes and then stops.
        only: the autopilot that has it, None for both. ArduPilot answers a request for a message that it does not have
            with a text to all stations.
        repeated: sent all the time; on a second link it may be late, so only the link in use counts.
        overtaken: a late packet of it is out of date.
        checked: a check before a start looks at it.
        possible: False for values outside their range, or that are not numbers; these never leave the fleet.
    """

    hz: float = 0.0
    optional: bool = False
    only: Autopilot | None = None
    repeated: bool = False
    overtaken: bool = False
    checked: bool = False
    possible: Callable[[Message], bool] = lambda _: True


def _degrees(lat: float, lon: float) -> bool:
    return -90.0 <= lat <= 90.0 and -180.0 <= lon <= 180.0


def _numbers(*values: float) -> bool:
    return all(math.isfinite(value) for value in values)


def _position(m: Message) -> bool:
    speeds = max(abs(m.vx), abs(m.vy), abs(m.vz)) / 100.0
    heights = all(_LOW_M <= value / 1e3 <= _HIGH_M for value in (m.alt, m.relative_alt))
    return _degrees(m.lat / 1e7, m.lon / 1e7) and heights and speeds <= _FAST_M_S


def _attitude(m: Message) -> bool:
    return _numbers(m.roll, m.pitch, m.yaw) and max(abs(m.roll), abs(m.pitch), abs(m.yaw)) <= 2.0 * math.pi + 0.01


def _gps(m: Message) -> bool:
    return _degrees(m.lat / 1e7, m.lon / 1e7)


def _home(m: Message) -> bool:
    return _degrees(m.latitude / 1e7, m.longitude / 1e7) and _LOW_M <= m.altitude / 1e3 <= _HIGH_M


def _feedback(m: Message) -> bool:
    angles = _numbers(m.roll, m.pitch, m.yaw, m.alt_msl, m.alt_rel)
    return angles and _degrees(m.lat / 1e7, m.lng / 1e7) and _LOW_M <= m.alt_msl <= _HIGH_M


def _captured(m: Message) -> bool:
    return _degrees(m.lat / 1e7, m.lon / 1e7) and _LOW_M <= m.alt / 1e3 <= _HIGH_M and _numbers(*m.q)


def _gimbal(m: Message) -> bool:
    return _numbers(*m.q) and 0.5 < math.hypot(*m.q) < 2.0


_HEARD: Final = {
    "HEARTBEAT": HeardMessage(repeated=True, overtaken=True),
    "GLOBAL_POSITION_INT": HeardMessage(hz=10.0, repeated=True, possible=_position),
    "ATTITUDE": HeardMessage(hz=10.0, repeated=True, possible=_attitude),
    "MISSION_CURRENT": HeardMessage(hz=2.0, repeated=True, overtaken=True),
    "EXTENDED_SYS_STATE": HeardMessage(hz=1.0, repeated=True, overtaken=True),
    "SYSTEM_TIME": HeardMessage(hz=1.0),
    "GPS_RAW_INT": HeardMessage(hz=1.0, repeated=True, checked=True, possible=_gps),
    "SYS_STATUS": HeardMessage(hz=1.0, repeated=True, checked=True),
    "GIMBAL_DEVICE_ATTITUDE_STATUS": HeardMessage(hz=10.0, optional=True, possible=_gimbal),
    # Only from a rangefinder that states its limits: a height from a coarse terrain map is worse than none.
    "DISTANCE_SENSOR": HeardMessage(hz=2.0, optional=True),
    "HOME_POSITION": HeardMessage(hz=0.2, optional=True, possible=_home),
    # Each autopilot's message about its filter.
    "EKF_STATUS_REPORT": HeardMessage(hz=1.0, optional=True, only=Autopilot.ARDUPILOT, repeated=True, checked=True),
    "ESTIMATOR_STATUS": HeardMessage(hz=1.0, optional=True, only=Autopilot.PX4, repeated=True, checked=True),
    # Of one battery after the other. ArduPilot's SYS_STATUS shows its first battery, PX4's the emptiest one.
    "BATTERY_STATUS": HeardMessage(hz=1.0, optional=True, only=Autopilot.ARDUPILOT, repeated=True, checked=True),
    "COMMAND_ACK": HeardMessage(),
    "STATUSTEXT": HeardMessage(),
    "MISSION_ITEM_REACHED": HeardMessage(),
    "PARAM_VALUE": HeardMessage(),
    "CAMERA_FEEDBACK": HeardMessage(possible=_feedback),
    "CAMERA_IMAGE_CAPTURED": HeardMessage(possible=_captured),
}
HEARD: Final = {MESSAGE_IDS[name]: how for name, how in _HEARD.items()}
"""By message id; in this order they are asked for."""


def rates_of(autopilot: Autopilot, most_hz: float = math.inf) -> dict[int, float]:
    """What an autopilot is asked for: message id -> Hz, each at most so much."""
    return {k: min(how.hz, most_hz) for k, how in HEARD.items() if how.hz and how.only in (None, autopilot)}
