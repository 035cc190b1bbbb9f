"""Range checks of messages: impossible values (a latitude of 95 degrees) never leave the fleet."""

import math
from collections.abc import Callable
from typing import Final

from gcs_plugin.links.mavlink import Message, dialect

_LOW_M, _HIGH_M = -1_000.0, 20_000.0
_FAST_M_S: Final = 300.0


def possible(message: Message) -> bool:
    """False for a message with values outside their range, or that are not numbers."""
    check = _CHECKS.get(message.get_msgId())
    return check is None or check(message)


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


_CHECKS: Final[dict[int, Callable[[Message], bool]]] = {
    int(dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT): _position,
    int(dialect.MAVLINK_MSG_ID_ATTITUDE): _attitude,
    int(dialect.MAVLINK_MSG_ID_GPS_RAW_INT): _gps,
    int(dialect.MAVLINK_MSG_ID_HOME_POSITION): _home,
    int(dialect.MAVLINK_MSG_ID_CAMERA_FEEDBACK): _feedback,
    int(dialect.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED): _captured,
    int(dialect.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS): _gimbal,
}
