"""What vehicles are called: by their MAVLink system ids, in files and on the map, and by people."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from gcs_plugin.fleet.separation.separation_watch import number_name


@dataclass(frozen=True, slots=True)
class VehicleNames:
    """The names that the settings give.

    Attributes:
        systems: id of a vehicle by its MAVLink system id. titles: what people call it, by its id.
    """

    systems: Mapping[int, str]
    titles: Mapping[str, str]

    def name_of(self, system: int) -> str:
        """The id of a vehicle with a MAVLink system id; no two have the same."""
        name = number_name(system)
        if system not in self.systems and name in self.systems.values():  # the name of another system id
            return f"system-{system}"
        return self.systems.get(system, name)

    def title_of(self, vehicle: str) -> str:
        """What people call a vehicle, empty if nothing else than its id."""
        return self.titles.get(vehicle, "")


def system_in_name(vehicle: str) -> int | None:
    """The MAVLink system id that a vehicle's name stands for (v7: 7), None if it is no such name."""
    found = re.fullmatch(r"v(\d{1,3})", vehicle)
    return int(found[1]) if found and 1 <= int(found[1]) <= 255 else None
