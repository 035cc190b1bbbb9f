"""A vehicle's refusal of a mission, in words: which item, which field, why."""

from dataclasses import dataclass
from typing import Final

from gcs_plugin.links.mavlink import dialect
from gcs_plugin.mission.items import Mission

ACCEPTED: Final = int(dialect.MAV_MISSION_ACCEPTED)
ERROR: Final = int(dialect.MAV_MISSION_ERROR)
UNSUPPORTED_FRAME: Final = int(dialect.MAV_MISSION_UNSUPPORTED_FRAME)
UNSUPPORTED: Final = int(dialect.MAV_MISSION_UNSUPPORTED)
NO_SPACE: Final = int(dialect.MAV_MISSION_NO_SPACE)
INVALID: Final = int(dialect.MAV_MISSION_INVALID)
INVALID_SEQUENCE: Final = int(dialect.MAV_MISSION_INVALID_SEQUENCE)
DENIED: Final = int(dialect.MAV_MISSION_DENIED)
CANCELLED: Final = int(dialect.MAV_MISSION_OPERATION_CANCELLED)

_PARAMETER = {6: "param1", 7: "param2", 8: "param3", 9: "param4", 10: "latitude", 11: "longitude", 12: "altitude"}


@dataclass(frozen=True, slots=True)
class Refusal:
    """A negative MISSION_ACK.

    Attributes:
        code: MAV_MISSION_RESULT.
        item: sequence number of the refused item, None if the complete mission is refused.
        field: the refused field, empty if none.
        reason: one sentence without the vehicle's name.
    """

    code: int
    item: int | None
    field: str
    reason: str


def explain(code: int, mission: Mission, item: int | None) -> Refusal:
    """Put a negative MISSION_ACK into words.

    Args:
        code: MAV_MISSION_RESULT of the acknowledgement.
        mission: the uploaded mission.
        item: the last item sent, None if the vehicle had not requested one yet.
    """
    if code == DENIED:
        return Refusal(code, None, "", "another ground station is uploading to it; wait until that has ended")
    if code == NO_SPACE:
        return Refusal(code, None, "", f"its memory does not hold {len(mission)} items; split the mission into sorties")
    if code == CANCELLED:
        return Refusal(code, None, "", "it gave up because items did not arrive; come closer or try again")
    if item is None or item >= len(mission):
        return Refusal(code, None, "", f"it refused the mission ({_result_name(code)})")
    what = f"item {item} ({mission.items[item].name})"
    if code == UNSUPPORTED:
        return Refusal(code, item, "command", f"{what} is a command that it does not know; leave it out")
    if code == UNSUPPORTED_FRAME:
        frame = dialect.enums["MAV_FRAME"].get(mission.items[item].frame)
        name = frame.name if frame else mission.items[item].frame
        return Refusal(
            code, item, "frame", f"{what} has a frame that it does not accept ({name}); use heights over home"
        )
    if code in _PARAMETER:
        name, value = _PARAMETER[code], _value(mission, item, code)
        return Refusal(code, item, name, f"{what} has an unacceptable {name} ({value}); correct it")
    if code == INVALID:
        return Refusal(code, item, "", f"{what} has an unacceptable value; check its parameters")
    return Refusal(code, item, "", f"it refused {what} ({_result_name(code)}); check that item, a jump's target too")


def _value(mission: Mission, item: int, code: int) -> str:
    it = mission.items[item]
    if code <= 9:
        return f"{it.params[code - 6]:g}"
    if code == 12:
        return f"{it.z:g}"
    raw = it.x if code == 10 else it.y
    return f"{raw / 1e7:.7f}" if it.has_place else str(raw)


def _result_name(code: int) -> str:
    entry = dialect.enums["MAV_MISSION_RESULT"].get(code)
    return str(entry.name) if entry else f"result {code}"
