"""The folder of a plan: the mission file and takeoff time of each vehicle."""

import json
import re
from pathlib import Path

from orthoswarm.model.errors import InputError


def read_plan_folder(folder: Path, sortie: int) -> dict[int, tuple[Path, float]]:
    """Mission file and takeoff time (seconds after the swarm's start) for each vehicle of a plan's folder.

    Args:
        folder: as `orthoswarm plan` writes it; without its report, files named v1.plan or v1.waypoints and so on.
        sortie: which flight, from 1; vehicles with fewer flights are left out.

    Raises:
        InputError: there is no such plan or flight.
    """
    report = folder / "plan.json"
    flights: dict[int, tuple[Path, float]] = {}
    most = 1
    try:
        document = json.loads(report.read_text(encoding="utf-8")) if report.exists() else None
        for vehicle in document["vehicles"] if document else []:
            most = max(most, len(vehicle["flights"]))
            if sortie <= len(vehicle["flights"]):
                flight = vehicle["flights"][sortie - 1]
                flights[int(str(vehicle["id"]).removeprefix("v"))] = (
                    folder / flight["files"][0],
                    float(flight["start_s"]),
                )
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        raise InputError(
            f"{report} is not the report of a plan; plan again with: orthoswarm plan ... --out {folder}"
        ) from None
    if document is None:
        for path in sorted(folder.glob("*")):
            number = number_in(path)
            if number is not None and (number not in flights or path.suffix == ".plan"):
                flights[number] = (path, 0.0)
    if sortie < 1 or not flights:
        why = (
            f"has no sortie {sortie} (there are {most})"
            if document
            else "holds no missions named v1.plan, v2.plan, ..."
        )
        raise InputError(f"{folder} {why}; plan with: orthoswarm plan ... --out {folder}")
    return flights


def plan_endurance_s(folder: Path) -> float | None:
    """Flight time of a full battery that a plan was made for, seconds; None if its report does not say it."""
    try:
        minutes = json.loads((folder / "plan.json").read_text(encoding="utf-8")).get("endurance_min")
    except (OSError, ValueError, AttributeError):
        return None
    return 60.0 * minutes if isinstance(minutes, int | float) and minutes > 0 else None


def number_in(path: Path) -> int | None:
    """The vehicle that a mission file is named after (v3.plan, v3-sortie1.waypoints), None for another name."""
    match = re.fullmatch(r"v(\d{1,3})(?:-sortie1)?", path.stem)
    return int(match[1]) if match and path.suffix in (".plan", ".waypoints") else None
