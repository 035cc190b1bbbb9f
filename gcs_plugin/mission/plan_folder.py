"""The folder of a plan: the mission file and takeoff time of each vehicle."""

import contextlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoswarm.config import DEFAULT, Config, config_of
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import Apart


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


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanNeeds:
    """What a plan relies on, as far as its report says it.

    Attributes:
        endurance_s: flight time of a full battery that it was made for; None if nobody said it.
        return_height_m: above takeoff, from which a straight way home passes over the ground and what stands on it;
            None for a plan that was made without a height model.
        apart: how far apart it keeps its vehicles; None where it does not say that.
        config: what it was made with, times of flight among it.
    """

    endurance_s: float | None = None
    return_height_m: float | None = None
    apart: Apart | None = None
    config: Config = DEFAULT


NO_NEEDS: Final = PlanNeeds()
"""Nothing is known of a plan, or nothing is planned."""


def plan_needs(folder: Path) -> PlanNeeds:
    """What the plan of a folder relies on; nothing is known where its report cannot be read."""
    try:
        document = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
        minutes, height_m = document.get("endurance_min"), (document.get("over_ground") or {}).get("return_height_m")
        apart = [document.get("separation_m"), document.get("height_step_m")]
    except (OSError, ValueError, AttributeError):
        return PlanNeeds()
    config = DEFAULT
    with contextlib.suppress(InputError):  # of another version, with settings that this one does not have
        config = config_of(document.get("config", {}))
    return PlanNeeds(
        endurance_s=60.0 * minutes if isinstance(minutes, int | float) and minutes > 0 else None,
        return_height_m=float(height_m) if isinstance(height_m, int | float) else None,
        apart=Apart(*map(float, apart)) if all(isinstance(m, int | float) and m > 0 for m in apart) else None,
        config=config,
    )


def number_in(path: Path) -> int | None:
    """The vehicle that a mission file is named after (v3.plan, v3-sortie1.waypoints), None for another name."""
    match = re.fullmatch(r"v(\d{1,3})(?:-sortie1)?", path.stem)
    return int(match[1]) if match and path.suffix in (".plan", ".waypoints") else None
