"""Flight modes: what an autopilot's custom mode number means, and which one does what here."""

from dataclasses import dataclass
from typing import Final

from gcs_plugin.links.mavlink import Autopilot, dialect

HOLDS: Final = frozenset({"HOLD", "BRAKE", "LOITER", "POSHOLD", "GUIDED", "QHOVER", "QLOITER"})
"""Modes in which a vehicle stays where it is, unless a pilot or another station moves it."""
RETURNS: Final = frozenset({"RTL", "SMART_RTL", "AUTO_RTL", "QRTL"})
LANDS: Final = frozenset({"LAND", "QLAND"})


def _px4(main: int, sub: int = 0) -> int:
    return (main << 16) | (sub << 24)


@dataclass(frozen=True, slots=True, kw_only=True)
class Modes:
    """The modes of one kind of vehicle, and all that have a name here.

    Attributes:
        ready: stays put and lets itself be armed, before a mission is started.
        hold: stays where it is in the air, whatever the sticks say.
        land: lands where it is; where there is no such mode, rtl.
    """

    mission: int
    ready: int
    hold: int
    rtl: int
    land: int
    names: dict[int, str]

    def name(self, custom_mode: int) -> str:
        """A mode in words."""
        return self.names.get(custom_mode, f"mode {custom_mode}")


_COPTER: Final = Modes(mission=3, ready=4, hold=17, rtl=6, land=9, names={
    0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE", 9: "LAND",
    11: "DRIFT", 13: "SPORT", 14: "FLIP", 15: "AUTOTUNE", 16: "POSHOLD", 17: "BRAKE", 18: "THROW", 20: "GUIDED_NOGPS",
    21: "SMART_RTL", 22: "FLOWHOLD", 23: "FOLLOW", 27: "AUTO_RTL",
})  # fmt: skip
_PLANE: Final = Modes(mission=10, ready=15, hold=12, rtl=11, land=11, names={
    0: "MANUAL", 5: "FBWA", 6: "FBWB", 7: "CRUISE", 10: "AUTO", 11: "RTL", 12: "LOITER", 13: "TAKEOFF", 15: "GUIDED",
    17: "QSTABILIZE", 18: "QHOVER", 19: "QLOITER", 20: "QLAND", 21: "QRTL",
})  # fmt: skip
_ROVER: Final = Modes(mission=10, ready=15, hold=4, rtl=11, land=4, names={
    0: "MANUAL", 1: "ACRO", 3: "STEERING", 4: "HOLD", 5: "LOITER", 10: "AUTO", 11: "RTL", 12: "SMART_RTL", 15: "GUIDED",
})  # fmt: skip
_PX4: Final = Modes(mission=_px4(4, 4), ready=_px4(4, 3), hold=_px4(4, 3), rtl=_px4(4, 5), land=_px4(4, 6), names={
    _px4(1): "MANUAL", _px4(2): "ALTCTL", _px4(3): "POSCTL", _px4(4, 2): "TAKEOFF", _px4(4, 3): "HOLD",
    _px4(4, 4): "MISSION", _px4(4, 5): "RTL", _px4(4, 6): "LAND", _px4(4, 8): "FOLLOW", _px4(5): "ACRO",
    _px4(6): "OFFBOARD", _px4(7): "STABILIZED",
})  # fmt: skip
_PLANES: Final = frozenset({1, *range(19, 26)})
_ROVERS: Final = frozenset({int(dialect.MAV_TYPE_GROUND_ROVER), int(dialect.MAV_TYPE_SURFACE_BOAT)})


_HOVERS: Final = frozenset({
    int(dialect.MAV_TYPE_GENERIC), int(dialect.MAV_TYPE_QUADROTOR), int(dialect.MAV_TYPE_COAXIAL),
    int(dialect.MAV_TYPE_HELICOPTER), int(dialect.MAV_TYPE_HEXAROTOR), int(dialect.MAV_TYPE_OCTOROTOR),
    int(dialect.MAV_TYPE_TRICOPTER), int(dialect.MAV_TYPE_DODECAROTOR), int(dialect.MAV_TYPE_DECAROTOR),
})  # fmt: skip


def why_no_missions(vehicle_type: int) -> str:
    """Why a vehicle of this type (MAV_TYPE) is given no missions, in words; empty for those that hover."""
    if vehicle_type in _HOVERS:
        return ""
    entry = dialect.enums["MAV_TYPE"].get(vehicle_type)
    name = str(entry.name).removeprefix("MAV_TYPE_").lower().replace("_", " ") if entry else f"type {vehicle_type}"
    return (
        f"is not a multirotor ({name}); missions here turn on the spot and hover, so none is uploaded or started; "
        "pause, rtl and land are sent to it"
    )


def modes_of(autopilot: Autopilot, vehicle_type: int) -> Modes:
    """The modes of a vehicle from its HEARTBEAT's type."""
    if autopilot is Autopilot.PX4:
        return _PX4
    return _PLANE if vehicle_type in _PLANES else _ROVER if vehicle_type in _ROVERS else _COPTER


def mode_params(autopilot: Autopilot, custom_mode: int) -> tuple[float, float, float]:
    """Parameters 1 to 3 of MAV_CMD_DO_SET_MODE: ArduPilot takes the number whole, PX4 in two parts."""
    enabled = float(dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
    if autopilot is Autopilot.PX4:
        return enabled, float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24 & 0xFF)
    return enabled, float(custom_mode), 0.0
