"""Compares the mission stored in a vehicle with the one sent, in all that matters in flight.

Autopilots do not store items byte by byte: ArduPilot keeps altitudes in centimetres, the first parameter of many
commands as a whole number, no frame for commands without a place, and no second to fourth parameter of a waypoint;
item 0 is its home. PX4 turns degrees into doubles and back.
"""

import math
from collections.abc import Sequence

from gcs_plugin.mission.items import (
    CHANGE_SPEED,
    DELAY,
    GIMBAL_PITCH,
    JUMP,
    LAND,
    LOITER_UNLIM,
    MOUNT_CONTROL,
    RTL,
    TAKEOFF,
    TRIGGER_DISTANCE,
    VTOL_LAND,
    WAYPOINT,
    Mission,
    MissionItem,
)

# Which of param1 to param4 (0 to 3) affect a command's execution; for other commands all are compared.
_DECISIVE: dict[int, tuple[int, ...]] = {
    WAYPOINT: (0,), TAKEOFF: (), RTL: (), LAND: (), VTOL_LAND: (), LOITER_UNLIM: (),
    DELAY: (0, 1, 2, 3), JUMP: (0, 1), CHANGE_SPEED: (0, 1), TRIGGER_DISTANCE: (0,),
    MOUNT_CONTROL: (0, 1, 2), GIMBAL_PITCH: (0, 1),
}  # fmt: skip
_PLACE_E7 = 2
_ALTITUDE_M = 0.011


def difference(mission: Mission, stored: Sequence[MissionItem]) -> str:
    """The first relevant difference between a mission and the one stored in a vehicle, in words; empty if none."""
    if len(stored) != len(mission):
        return f"{len(stored)} items are stored, not {len(mission)}"
    for seq in range(mission.first_seq, len(stored)):
        text = _item_difference(mission.items[seq], stored[seq])
        if text:
            return f"item {seq} ({mission.items[seq].name}): {text}"
    return ""


def _item_difference(sent: MissionItem, stored: MissionItem) -> str:
    if sent.command != stored.command:
        return f"{stored.name} is stored instead"
    for index in _DECISIVE.get(sent.command, (0, 1, 2, 3)):
        ours, theirs = sent.params[index], stored.params[index]
        if not _same(ours, theirs):
            return f"param{index + 1} is {theirs:g} instead of {ours:g}"
    if not sent.has_place:
        return ""
    if sent.plain_frame != stored.plain_frame:
        return f"its frame is {stored.frame} instead of {sent.frame}"
    if abs(sent.x - stored.x) > _PLACE_E7 or abs(sent.y - stored.y) > _PLACE_E7:
        return (
            f"it lies at {stored.lat_deg:.7f}, {stored.lon_deg:.7f} instead of {sent.lat_deg:.7f}, {sent.lon_deg:.7f}"
        )
    if not abs(sent.z - stored.z) <= _ALTITUDE_M:
        return f"its height is {stored.z:g} m instead of {sent.z:g} m"
    return ""


def _same(ours: float, theirs: float) -> bool:
    a, b = (0.0 if math.isnan(value) else value for value in (ours, theirs))
    return math.isclose(a, b, rel_tol=1e-5, abs_tol=1e-4)
