"""What vehicles are called: by their MAVLink system ids, in files and on the map, and by people; and their rows."""

import re
from typing import Any, TypedDict


class TakeoffRow(TypedDict, total=False):
    """A takeoff that waits (`in_s`: seconds from now), or has failed, and why."""

    in_s: float
    failed: str


class VehicleRow(TypedDict, total=False):
    """What is known of a vehicle, as JSON values: of one on the links, of one that sent pictures, or of both.

    On the links it has `Vehicle.summary` and more. `alarm`: what is wrong with how and where it flies, and what to do.
    `behind`: by how much it is behind its plan, in words; `behind_ordered`: because it was paused. `fence`: see
    `Fences.of`. `takeoff` is null where none waits or failed; `returns_after` names those that it waits for until it
    returns, null where it does not wait. `route`: the number of what it holds (`VehicleLinks.routes`), 0 while that is
    not known.
    """

    id: str
    name: str
    system: int
    state: str
    armed: bool
    lat_deg: float | None
    lon_deg: float | None
    yaw_deg: float | None
    heading_deg: float | None
    speed_m_s: float
    silent_s: float
    battery: float | None
    home: list[float] | None
    flight: dict[str, Any]
    mission: dict[str, Any]
    takeoff: TakeoffRow | None
    returns_after: Any
    alarm: str
    behind: str
    behind_ordered: bool
    fence: dict[str, Any] | None
    route: int
    photos: int
    trail: list[tuple[float, float]]
    texts: list[dict[str, Any]]
    sortie: int
    frames: dict[str, int]
    height_m: float | None
    last_frame: str | None
    last_seq: int | None
    came_s: float
    pictures: dict[str, Any]
    can: dict[str, Any]
    poses: dict[str, str]


def system_in_name(vehicle: str) -> int | None:
    """The MAVLink system id that a vehicle's name stands for (v7: 7), None if it is no such name."""
    found = re.fullmatch(r"v(\d{1,3})", vehicle)
    return int(found[1]) if found and 1 <= int(found[1]) <= 255 else None
