"""A mission as an autopilot stores it: a list of items, and what kind of item it ends with."""

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from gcs_plugin.links.mavlink import Autopilot, Message, command_name, dialect
from gcs_plugin.mission.exchange import MISSION

FRAME_GLOBAL = int(dialect.MAV_FRAME_GLOBAL)
FRAME_MISSION = int(dialect.MAV_FRAME_MISSION)
FRAME_RELATIVE = int(dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT)
FRAME_TERRAIN = int(dialect.MAV_FRAME_GLOBAL_TERRAIN_ALT)

WAYPOINT = int(dialect.MAV_CMD_NAV_WAYPOINT)
LOITER_UNLIM = int(dialect.MAV_CMD_NAV_LOITER_UNLIM)
LOITER_TIME = int(dialect.MAV_CMD_NAV_LOITER_TIME)
RTL = int(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH)
LAND = int(dialect.MAV_CMD_NAV_LAND)
TAKEOFF = int(dialect.MAV_CMD_NAV_TAKEOFF)
VTOL_LAND = int(dialect.MAV_CMD_NAV_VTOL_LAND)
VTOL_TAKEOFF = int(dialect.MAV_CMD_NAV_VTOL_TAKEOFF)
TAKEOFFS = (TAKEOFF, VTOL_TAKEOFF)
LANDINGS = (LAND, VTOL_LAND)
DELAY = int(dialect.MAV_CMD_NAV_DELAY)
JUMP = int(dialect.MAV_CMD_DO_JUMP)
CHANGE_SPEED = int(dialect.MAV_CMD_DO_CHANGE_SPEED)
TRIGGER_DISTANCE = int(dialect.MAV_CMD_DO_SET_CAM_TRIGG_DIST)
MOUNT_CONTROL = int(dialect.MAV_CMD_DO_MOUNT_CONTROL)
GIMBAL_PITCH = int(dialect.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW)
GIMBAL_CLAIM = int(dialect.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE)

_NAV_LAST = int(dialect.MAV_CMD_NAV_LAST)
_PLAIN_FRAME = {5: 0, 6: 3, 11: 10}
DEG_E7 = 1e7
# Which of param1 to param4 (0 to 3) affect a command's execution; for other commands all are compared.
_DECISIVE: dict[int, tuple[int, ...]] = {
    WAYPOINT: (0,), TAKEOFF: (), RTL: (), LAND: (), VTOL_LAND: (), LOITER_UNLIM: (),
    DELAY: (0, 1, 2, 3), JUMP: (0, 1), CHANGE_SPEED: (0, 1), TRIGGER_DISTANCE: (0,),
    MOUNT_CONTROL: (0, 1, 2), GIMBAL_PITCH: (0, 1),
}  # fmt: skip
_PLACE_E7 = 2
_ALTITUDE_M = 0.011


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionItem:
    """One item as it travels; its place in the list is its sequence number.

    Attributes:
        command: MAV_CMD. frame: MAV_FRAME of x, y, z.
        params: param1 to param4, NaN where the command leaves the choice to the vehicle.
        x, y: latitude and longitude in 1e-7 degrees for a command with a place, else param5 and param6.
        z: altitude in metres of the frame, else param7. autocontinue: go on to the next item by itself.
    """

    command: int
    frame: int = FRAME_RELATIVE
    params: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    x: int = 0
    y: int = 0
    z: float = 0.0
    autocontinue: bool = True

    @classmethod
    def at(
        cls,
        command: int,
        lat_deg: float,
        lon_deg: float,
        height_m: float,
        *,
        params: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
        frame: int = FRAME_RELATIVE,
    ) -> "MissionItem":
        """An item at a place; the height is above the takeoff level unless the frame says otherwise."""
        x, y = round(lat_deg * DEG_E7), round(lon_deg * DEG_E7)
        return cls(command=command, frame=frame, params=params, x=x, y=y, z=height_m)

    @classmethod
    def do(cls, command: int, *params: float) -> "MissionItem":
        """An item without a place: up to four parameters, the rest 0."""
        first, second, third, fourth = (*params, 0.0, 0.0, 0.0, 0.0)[:4]
        return cls(command=command, frame=FRAME_MISSION, params=(first, second, third, fourth))

    @property
    def is_nav(self) -> bool:
        """True for NAV commands: those that the vehicle flies, and reports as reached."""
        return self.command < _NAV_LAST

    @property
    def has_place(self) -> bool:
        """True where x, y, z are latitude, longitude and altitude."""
        entry = dialect.enums["MAV_CMD"].get(self.command)
        return bool(entry is not None and entry.has_location and self.frame != FRAME_MISSION)

    @property
    def plain_frame(self) -> int:
        """Its frame; the _INT frames mean the same as the plain ones, with which autopilots answer."""
        return _PLAIN_FRAME.get(self.frame, self.frame)

    @property
    def place(self) -> tuple[float, float] | None:
        """Latitude and longitude in degrees, of an item with a place; None where both are 0: where the vehicle is."""
        return (self.lat_deg, self.lon_deg) if self.x or self.y else None

    @property
    def lat_deg(self) -> float:
        """Latitude in degrees of an item with a place."""
        return self.x / DEG_E7

    @property
    def lon_deg(self) -> float:
        """Longitude in degrees of an item with a place."""
        return self.y / DEG_E7

    @property
    def name(self) -> str:
        """The command in words."""
        return command_name(self.command)

    def message(self, seq: int, system: int, component: int, mission_type: int = MISSION) -> Message:
        """The MISSION_ITEM_INT that carries it to a vehicle, or from it."""
        return dialect.MAVLink_mission_item_int_message(
            system, component, seq, self.frame, self.command, 0, int(self.autocontinue), *self.params,
            self.x, self.y, self.z, mission_type,
        )  # fmt: skip

    @classmethod
    def of(cls, message: Message) -> "MissionItem":
        """The item in a MISSION_ITEM_INT, or in a MISSION_ITEM with its degrees in floats."""
        params = (float(message.param1), float(message.param2), float(message.param3), float(message.param4))
        on, z = bool(message.autocontinue), float(message.z)
        item = cls(command=message.command, frame=message.frame, params=params, z=z, autocontinue=on)
        x, y = message.x, message.y
        if message.get_type() == "MISSION_ITEM":
            scale = DEG_E7 if item.has_place else 1.0
            x, y = (round((value if math.isfinite(value) else 0.0) * scale) for value in (x, y))
        return replace(item, x=int(x), y=int(y))


class Ending(enum.Enum):
    """How a mission ends; it decides how its completion looks (see `completion`)."""

    RTL = "rtl"
    LAND = "land"
    WAYPOINT = "waypoint"
    NEVER = "never"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Mission:
    """A mission for one vehicle, or its geofence, item by item as it goes on the wire.

    Attributes:
        autopilot: whose dialect it is in.
        items: all items; for ArduPilot item 0 of a mission is home (the vehicle overwrites it), for PX4 it is flown.
        name: for messages to the user. list_type: MAV_MISSION_TYPE, of a mission or of a geofence.
    """

    autopilot: Autopilot
    items: tuple[MissionItem, ...]
    name: str = ""
    list_type: int = MISSION

    @property
    def kind(self) -> str:
        """What it is, in a word."""
        return "mission" if self.list_type == MISSION else "geofence"

    def __len__(self) -> int:
        return len(self.items)

    @property
    def first_seq(self) -> int:
        """Sequence number of the first item that is flown, or that counts."""
        return self.autopilot.first_seq if self.list_type == MISSION else 0

    @property
    def final_seq(self) -> int | None:
        """Sequence number of the last NAV item, None without one."""
        return final_nav([item.command for item in self.items], self.first_seq)

    @property
    def ending(self) -> Ending:
        """How it ends."""
        return ending_of([item.command for item in self.items], self.first_seq)


def final_nav(commands: Sequence[int | None], first_seq: int) -> int | None:
    """Sequence number of the last NAV command at or behind first_seq, None without one."""
    for seq in range(len(commands) - 1, first_seq - 1, -1):
        command = commands[seq]
        if command is not None and command < _NAV_LAST:
            return seq
    return None


def ending_of(commands: Sequence[int | None], first_seq: int) -> Ending:
    """How a list of commands ends; UNKNOWN where the last ones are not known."""
    last = final_nav(commands, first_seq)
    if last is None or any(command is None for command in commands[last:]):
        return Ending.UNKNOWN
    return {
        RTL: Ending.RTL, LAND: Ending.LAND, VTOL_LAND: Ending.LAND, LOITER_UNLIM: Ending.NEVER,
    }.get(commands[last] or 0, Ending.WAYPOINT)  # fmt: skip


def difference(mission: Mission, stored: Sequence[MissionItem]) -> str:
    """The first difference, of what matters in flight, between a mission and the one stored in a vehicle, in words.

    Empty if there is none. Autopilots do not store items byte by byte: ArduPilot keeps altitudes in centimetres, the
    first parameter of many commands as a whole number, no frame for commands without a place, and no second to fourth
    parameter of a waypoint; item 0 is its home. PX4 turns degrees into doubles and back.
    """
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
