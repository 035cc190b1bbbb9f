"""The file of a mission for a drone that its maker's app flies, and the reading of any mission file."""

import math
from collections.abc import Mapping, Sequence
from typing import Final

from gcs_plugin.mission.makers.drone_route import mission_of, route_of
from gcs_plugin.mission.makers.litchi import is_litchi, litchi_text, parse_litchi
from gcs_plugin.mission.makers.wpml import DjiDrone, parse_wpml, wpml_kmz
from gcs_plugin.mission.mission_files import FileItem, MissionFile, parse_mission

LITCHI: Final = "litchi"
# Drones with their cameras: a Matrice 300 or 350 has a Zenmuse H20, or a P1.
DJI_DRONES: Final[Mapping[str, DjiDrone]] = {
    "m300": DjiDrone("1.0.2", (60, 0), 42, "wide"),
    "m300-p1": DjiDrone("1.0.2", (60, 0), 50),
    "m350": DjiDrone("1.0.2", (89, 0), 42, "wide"),
    "m350-p1": DjiDrone("1.0.2", (89, 0), 50),
    "m30": DjiDrone("1.0.2", (67, 0), 52, "wide"),
    "m30t": DjiDrone("1.0.2", (67, 1), 53, "wide"),
    "m3e": DjiDrone("1.0.2", (77, 0), 66, "wide"),
    "m3t": DjiDrone("1.0.2", (77, 1), 67, "wide"),
    "m4e": DjiDrone("1.0.6", (99, 0), 88, "wide"),
    "m4t": DjiDrone("1.0.6", (99, 1), 89, "wide"),
}
MAKERS: Final[Mapping[str, str]] = {**dict.fromkeys(DJI_DRONES, ".kmz"), LITCHI: ".csv"}
"""What can be named as a vehicle's autopilot, where a maker's app flies it -> suffix of its mission files."""


def maker_file(items: Sequence[FileItem], drone: str, return_height_m: float | None = None) -> bytes:
    """The file of a mission for a drone of `MAKERS`.

    Args:
        items: as `sortie_items` gives them, of either autopilot.
        return_height_m: above takeoff, from which the way home is free; None: as high as the mission flies.

    Raises:
        InputError: the mission has something that these files cannot say, or flies faster than such drones do.
    """
    route = route_of(items)
    if drone == LITCHI:
        return litchi_text(route).encode()
    top_m = max(route.climb_m, *(point.height_m for point in route.points))
    return wpml_kmz(route, DJI_DRONES[drone], math.ceil(return_height_m or top_m))


def read_mission_file(data: bytes, name: str = "the file") -> MissionFile:
    """Read any mission, told by its content: `.plan`, `.waypoints`, DJI's KMZ, Litchi's CSV.

    Raises:
        InputError: it is none of these, or damaged, or says something that no mission item can.
    """
    if data.startswith(b"PK\x03\x04"):
        return mission_of(parse_wpml(data, name), name)
    text = data.decode("utf-8-sig", errors="replace")
    return mission_of(parse_litchi(text, name), name) if is_litchi(text) else parse_mission(text, name)
