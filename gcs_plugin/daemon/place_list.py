"""Finds and vehicles as places for other programs, and the pictures that show a place."""

from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Any

from gcs_plugin.daemon.jobs.solution_file import read_solution
from gcs_plugin.daemon.jobs.workspace_products import ExportTask, placements, writable
from orthoswarm.export.tactical.places import Place
from orthoswarm.export.tactical.seen_in import sightings
from orthoswarm.model.geo import LocalGrid

_MOST_SIGHTINGS = 24  # pictures of one place


def places_of(
    workspace: str, finds: Iterable[Mapping[str, Any]], vehicles: Iterable[Mapping[str, Any]], now_s: float
) -> list[Place]:
    """The workspace's finds, and the vehicles with a known position.

    Args:
        workspace: its name, which makes ids unique. finds: as ConsoleState gives them. vehicles: rows of
            /api/vehicles. now_s: UTC epoch seconds; a vehicle's place is as old as its last message.
    """
    workspace = writable(workspace)
    found = [
        Place(
            uid=f"orthoswarm-{workspace}-find-{row['id']}", kind="find", name=_name(row), lat_deg=row["lat_deg"],
            lon_deg=row["lon_deg"], sigma_m=row["sigma_m"], note=writable(row["note"]),
            time_s=datetime.fromisoformat(row["time"]).timestamp(), pictures=tuple(row.get("pictures", ())),
        )
        for row in finds
    ]  # fmt: skip
    for row in vehicles:
        if row.get("lat_deg") is None or row.get("lon_deg") is None or "system" not in row:
            continue
        found.append(
            Place(
                uid=f"orthoswarm-{workspace}-{row['id']}", kind="vehicle", name=row.get("name") or row["id"],
                lat_deg=row["lat_deg"], lon_deg=row["lon_deg"], time_s=now_s - float(row.get("silent_s") or 0.0),
                course_deg=row.get("heading_deg"), speed_m_s=row.get("speed_m_s"),
                note=(row.get("flight") or {}).get("text", ""),
            )
        )  # fmt: skip
    return found


def _name(find: Mapping[str, Any]) -> str:
    note = writable(find["note"]).strip()
    return note.splitlines()[0][:60] if note else f"Find {find['id']}"


def pictures_at(task: ExportTask, lat_deg: float, lon_deg: float) -> list[dict[str, Any]]:
    """The pictures that show a place, best first, as JSON values: `vehicle`, `image`, `column`, `row`, `stage`.

    Args:
        task: the workspace's export task. lat_deg, lon_deg: WGS 84.
    """
    solutions = [read_solution(path).solution for path in (*task.coarse, *task.solutions)]
    placed, level = placements(task, solutions)
    east, north = (float(v) for v in LocalGrid(task.epsg).to_grid(lat_deg, lon_deg))
    return [
        {
            "vehicle": s.placed.frame.vehicle, "image": s.placed.frame.image, "column": round(s.column, 1),
            "row": round(s.row, 1), "stage": s.placed.stage,
        }
        for s in sightings(placed, (east, north, level))[:_MOST_SIGHTINGS]
    ]  # fmt: skip
