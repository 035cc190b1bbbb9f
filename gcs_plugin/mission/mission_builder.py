"""Builds the mission items for one autopilot from a plan or a mission file.

ArduPilot's item 0 is home, which it overwrites: a list without it loses its takeoff. PX4's item 0 is flown: a list with
home in front is refused at MISSION_START. ArduPilot refuses NaN in a parameter; PX4 reads a yaw of 0 as "turn north",
so there it is NaN: nose along the path. A jump's target in files counts from home, as ArduPilot does; PX4's is one
less. A gimbal is turned by other commands in each (`mission_files.gimbal_items`).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission import items as mav
from gcs_plugin.mission import mission_files
from gcs_plugin.mission.items import Mission, MissionItem
from gcs_plugin.mission.makers.maker_files import read_mission_file
from orthoswarm.config.autopilot import ARDUPILOT
from orthoswarm.model.errors import InputError

_WITH_YAW: Final = frozenset({mav.WAYPOINT, mav.TAKEOFF, mav.LAND, mav.LOITER_TIME})


def build_mission(
    autopilot: Autopilot,
    items: Iterable[mission_files.FileItem],
    home: tuple[float, float, float] | None = None,
    name: str = "",
) -> Mission:
    """The mission for one autopilot of items without home.

    Args:
        items: what is flown, in order.
        home: latitude, longitude (degrees) and altitude (metres) of home; only ArduPilot's item 0 needs it, and the
            vehicle overwrites it with its own.
        name: for messages.

    Raises:
        InputError: nothing to fly, an invalid position, or more items than the autopilot can store.
    """
    spoken: mission_files.Autopilot = "px4" if autopilot is Autopilot.PX4 else "ardupilot"
    flown = [_wire(item, autopilot) for item in mission_files.with_gimbal_items_of(spoken, items)]
    if not flown:
        raise InputError(f"{name or 'the mission'} has no items; plan one with: orthoswarm plan")
    if autopilot is Autopilot.ARDUPILOT:
        first = next((item.place for item in flown if item.has_place and item.place), (0.0, 0.0))
        flown.insert(0, MissionItem.at(mav.WAYPOINT, *(home or (*first, 0.0)), frame=mav.FRAME_GLOBAL))
    mission = Mission(autopilot, tuple(flown), name)
    _check(mission)
    return mission


def unflyable(items: Sequence[MissionItem], autopilot: Autopilot, *, in_air: bool) -> str:
    """Why a stored mission cannot be started, in words; empty if it can."""
    flown = [item for item in items[autopilot.first_seq :] if item.is_nav]
    if not flown:
        return "has no mission; upload one first"
    if not in_air and flown[0].command not in mav.TAKEOFFS:
        return f"has a mission that begins with {flown[0].name} instead of a takeoff; upload one that takes off"
    return ""


def read_mission(path: Path, autopilot: Autopilot) -> Mission:
    """The mission in a file of any kind (see `read_mission_file`), for one autopilot whichever it was written for.

    Raises:
        InputError: the file cannot be read or is not a mission.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the name") from None
    parsed = read_mission_file(data, path.name)
    return build_mission(autopilot, parsed.items, parsed.home, path.name)


def _wire(item: mission_files.FileItem, autopilot: Autopilot) -> MissionItem:
    placed = MissionItem.at(item.command, item.lat_deg, item.lon_deg, item.alt_m, params=item.params, frame=item.frame)
    if not placed.has_place:
        x, y = (int(value) if math.isfinite(value) else 0 for value in (item.lat_deg, item.lon_deg))
        placed = replace(placed, x=x, y=y)
        # its param5 to 7 are unused; files may have leftovers of other items there
        if item.command == mav.TRIGGER_DISTANCE:
            placed = MissionItem.do(item.command, *item.params)
    unset = 0.0 if autopilot is Autopilot.ARDUPILOT else math.nan  # one object: missions read twice are equal
    params = [unset if math.isnan(value) else value for value in placed.params]
    if autopilot is Autopilot.PX4 and item.command in _WITH_YAW and not params[3]:
        params[3] = math.nan
    if autopilot is Autopilot.PX4 and item.command == mav.JUMP:
        params[0] -= 1.0
    frame = mav.FRAME_MISSION if not placed.has_place and placed.frame == mav.FRAME_GLOBAL else placed.frame
    z = placed.z if math.isfinite(placed.z) else 0.0
    return replace(
        placed, params=(params[0], params[1], params[2], params[3]), frame=frame, z=z, autocontinue=item.autocontinue
    )


def _check(mission: Mission) -> None:
    name = mission.name or "the mission"
    most = ARDUPILOT.most_items
    if mission.autopilot is Autopilot.ARDUPILOT and len(mission) > most:
        raise InputError(f"{name} has {len(mission)} items, ArduPilot holds {most}; plan more sorties or vehicles")
    for seq, item in enumerate(mission.items):
        if item.has_place and not (abs(item.lat_deg) <= 90.0 and abs(item.lon_deg) <= 180.0):
            where = f"{item.lat_deg:g}, {item.lon_deg:g}"
            raise InputError(f"{name}: item {seq} ({item.name}) lies at {where}, which is not a place; correct it")
        if item.command == mav.JUMP and not mission.first_seq <= item.params[0] < len(mission):
            target = item.params[0] + 1 - mission.first_seq
            raise InputError(f"{name}: item {seq} jumps to item {target:g}, which it does not have; correct it")
        if not math.isfinite(item.z) or abs(item.z) >= 1e6:
            raise InputError(f"{name}: item {seq} ({item.name}) has the height {item.z:g} m; correct it")
