"""What is wrong with the links and who speaks on them, in words."""

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet import Fleet


def fleet_problems(fleet: "Fleet", name_of: Callable[[int], str]) -> list[str]:
    """Broken links, rejected packets, vehicles that sign and those that share a system id; from any thread.

    Args:
        fleet: the vehicles and their links. name_of: the id of a vehicle by its system id.
    """
    hub, vehicles = fleet.hub, list(fleet.vehicles.values())
    problems = [f"{side.link.name}: {side.link.problem}" for side in hub.sides if side.link.problem]
    if hub.rejected:
        problems.append(f"{hub.rejected} packets had no valid signature; check the signing key")
    problems += [
        f"{name_of(v.system)} signs its messages and ignores unsigned ones; give its key in ORTHOSWARM_SIGNING_KEY_FILE"
        for v in vehicles if v.signs and not fleet.signed
    ]  # fmt: skip
    shared = [(v.system, ", ".join(v.claimants)) for v in vehicles if v.claimants]
    return problems + [f"several vehicles use the system id of {name_of(system)}: {who}" for system, who in shared]
