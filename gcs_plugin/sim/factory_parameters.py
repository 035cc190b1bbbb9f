"""Parameters of simulated autopilots: those that a ground station asks for, as they leave the factory."""

import struct
from collections.abc import Mapping
from typing import Final

from gcs_plugin.links.mavlink import Autopilot, Message, dialect
from gcs_plugin.sim.mission_flight import RTL_HEIGHT_M

_WPNAV_SPEED_M_S: Final = 10.0
"""ArduCopter flies faster if it is asked to and can."""


def factory_parameters(autopilot: Autopilot, top_m_s: float) -> dict[str, float]:
    """The parameters by name; integers are those that the autopilot keeps as such.

    Args:
        autopilot: the dialect. top_m_s: the speed that a PX4 does not exceed.
    """
    if autopilot is Autopilot.PX4:
        return {
            "MPC_XY_VEL_MAX": top_m_s, "RTL_RETURN_ALT": RTL_HEIGHT_M, "RTL_TYPE": 0, "NAV_DLL_ACT": 0,
            "GF_MAX_HOR_DIST": 0.0, "GF_MAX_VER_DIST": 0.0,
        }  # fmt: skip
    return {
        "WPNAV_SPEED": 100.0 * _WPNAV_SPEED_M_S, "RTL_ALT": 100.0 * RTL_HEIGHT_M, "RTL_ALT_TYPE": 0, "FS_GCS_ENABLE": 0,
        "FENCE_ENABLE": 0, "FENCE_AUTOENABLE": 0, "FENCE_TYPE": 7, "FENCE_ACTION": 1, "FENCE_RADIUS": 300.0,
        "FENCE_ALT_MAX": 100.0, "FENCE_ALT_MIN": -10.0, "FENCE_MARGIN": 2.0,
    }  # fmt: skip


def parameter_answer(known: Mapping[str, float], name: str, autopilot: Autopilot) -> list[Message]:
    """The value of a parameter; an autopilot does not answer about one that it has not."""
    if name not in known:
        return []
    value, kind = known[name], int(dialect.MAV_PARAM_TYPE_REAL32)
    if isinstance(value, int):
        kind = int(dialect.MAV_PARAM_TYPE_INT32)
        value = struct.unpack("<f", struct.pack("<i", value))[0] if autopilot is Autopilot.PX4 else value
    return [dialect.MAVLink_param_value_message(name.encode(), value, kind, len(known), 0)]
