"""Vehicles, sorties and completions in the journal; and where sorties were placed: in flight (coarse), and refined."""

import json
import sqlite3
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, TypedDict

from gcs_plugin.daemon.store.frame_rows import Whose
from gcs_plugin.daemon.store.job_rows import new_job
from gcs_plugin.daemon.store.journal import (
    Change,
    Journal,
    all_changes,
    fact_change,
    packed,
    statement,
    statements,
    unpacked,
)
from orthoswarm.export.json_values import finite
from orthoswarm.model.bounding_box import BoundingBox

Table = Literal["solutions", "coarse"]
"""Where placed sorties are: the refined ones, and those in flight (or beside a refined one, on the coarse layer)."""
REFINED: Final = ("coarse", "fine")
"""The layers that are published."""


class LegRow(TypedDict, total=False):
    """A placed leg: its pictures, its ends (`line`: longitude and latitude, degrees), how well it lies (or null)."""

    vehicle: str
    images: list[str]
    state: str
    confidence: Any
    sigma_m: Any
    line: list[list[float]]


class SortieDetail(TypedDict, total=False):
    """What the journal keeps of a placed sortie, as JSON values.

    `bounds`: of its ground, metres. `layer`, and how many pictures were `refined`: of a refined one.
    """

    bounds: Any
    legs: list[LegRow]
    fov_deg: float | None
    fov_sigma_deg: float | None
    warnings: list[str]
    cpu_s: float
    wall_s: float
    layer: str
    refined: int


@dataclass(frozen=True, slots=True)
class PlacedSortie:
    """A placed sortie; `path`: its solution file's name."""

    vehicle: str
    sortie: int
    path: str
    detail: SortieDetail

    @property
    def whose(self) -> Whose:
        """Vehicle and sortie."""
        return self.vehicle, self.sortie

    @property
    def bounds(self) -> BoundingBox:
        """Its ground, metres on the area's grid."""
        return BoundingBox(*self.detail["bounds"])


def _placed(row: sqlite3.Row) -> PlacedSortie:
    return PlacedSortie(unpacked(row["vehicle"]), int(row["sortie"]), row["path"], json.loads(row["detail"]))


def placed_sortie(journal: Journal, table: Table, whose: Whose) -> PlacedSortie | None:
    """A placed sortie, None if it was not placed (yet)."""
    row = journal.one(f"SELECT * FROM {table} WHERE vehicle = ? AND sortie = ?", (packed(whose[0]), whose[1]))
    return None if row is None else _placed(row)


def placed_sorties(journal: Journal, table: Table) -> list[PlacedSortie]:
    """All placed sorties."""
    return [_placed(row) for row in journal.rows(f"SELECT * FROM {table} ORDER BY vehicle, sortie")]


def solution_paths(journal: Journal, *tables: Table) -> dict[Whose, str]:
    """Names of the solution files by vehicle and sortie; of one in several tables that of the last."""
    rows = [row for table in tables for row in journal.rows(f"SELECT vehicle, sortie, path FROM {table}")]
    return {(unpacked(row["vehicle"]), int(row["sortie"])): row["path"] for row in rows}


def coarse_only(journal: Journal) -> list[PlacedSortie]:
    """The sorties that were placed in flight and are not refined."""
    refined = solution_paths(journal, "solutions")
    return [row for row in placed_sorties(journal, "coarse") if row.whose not in refined]


def shown_sorties(journal: Journal, layer: str) -> list[PlacedSortie]:
    """The sorties on a layer; refined ones hide those in flight."""
    rows = {row.whose: row for row in placed_sorties(journal, "coarse")} if layer == "coarse" else {}
    rows |= {row.whose: row for row in placed_sorties(journal, "solutions") if row.detail["layer"] == layer}
    return sorted(rows.values(), key=lambda row: (packed(row.vehicle), row.sortie))  # the order of drawing stays


# -- vehicles and completions -----------------------------------------------------------------------------------------


def present_sortie(journal: Journal, vehicle: str) -> int:
    """The number of a vehicle's present sortie."""
    row = journal.one("SELECT sortie FROM vehicles WHERE id = ?", (packed(vehicle),))
    return 1 if row is None else int(row["sortie"])


def vehicle_state(journal: Journal, vehicle: str) -> dict[str, Any]:
    """What is known of a vehicle's mission: `detector`, `mission`, `flown`; empty if it is new."""
    row = journal.one("SELECT state FROM vehicles WHERE id = ?", (packed(vehicle),))
    return {} if row is None else dict(json.loads(row["state"]))


@dataclass(frozen=True, slots=True)
class Sender:
    """A vehicle of the journal: its present sortie, its pictures by stage, the number of the newest."""

    vehicle: str
    sortie: int
    frames: dict[str, int]
    last: int | None


def senders(journal: Journal) -> list[Sender]:
    """The vehicles that were heard or that sent pictures."""
    rows = journal.rows(
        "SELECT v.id, v.sortie, COUNT(f.seq) AS frames, SUM(f.stage = 'fine') AS fine,"
        " SUM(f.stage = 'coarse') AS coarse, SUM(f.stage = 'rejected') AS rejected, MAX(f.seq) AS last"
        " FROM vehicles v LEFT JOIN frames f ON f.vehicle = v.id GROUP BY v.id ORDER BY v.rowid"
    )
    counted = ("frames", "fine", "coarse", "rejected")
    return [Sender(unpacked(r["id"]), r["sortie"], {key: r[key] or 0 for key in counted}, r["last"]) for r in rows]


def is_complete(journal: Journal, whose: Whose) -> bool:
    """Whether a sortie's vehicle has reported that its mission is complete."""
    query = "SELECT 1 FROM completions WHERE vehicle = ? AND sortie = ?"
    return journal.one(query, (packed(whose[0]), whose[1])) is not None


def complete_sorties(journal: Journal) -> list[Whose]:
    """All complete sorties."""
    rows = journal.rows("SELECT DISTINCT vehicle, sortie FROM completions")
    return [(unpacked(row["vehicle"]), int(row["sortie"])) for row in rows]


def completion_rows(journal: Journal) -> list[dict[str, Any]]:
    """All completions as JSON values, oldest first."""
    rows = journal.rows("SELECT * FROM completions ORDER BY id")
    return [{"vehicle": unpacked(r["vehicle"]), "sortie": r["sortie"], **json.loads(r["detail"])} for r in rows]


# -- changes ----------------------------------------------------------------------------------------------------------


def vehicle_found(vehicle: str) -> Change:
    """The change that adds a vehicle."""
    return statement("INSERT OR IGNORE INTO vehicles (id) VALUES (?)", (packed(vehicle),))


def mission_noted(vehicle: str, kind: str, detector: Mapping[str, Any], completion: Mapping[str, Any]) -> Change:
    """The change that records what a mission came to; a start after a flight opens a sortie.

    Args:
        kind: started, complete, aborted, suspended or resumed. detector: its state.
        completion: what is kept of a completion. It opens none but of the kind complete.
    """
    key = packed(vehicle)

    def change(db: sqlite3.Connection) -> None:
        db.execute("INSERT OR IGNORE INTO vehicles (id) VALUES (?)", (key,))
        row = db.execute("SELECT sortie, state FROM vehicles WHERE id = ?", (key,)).fetchone()
        sortie, state = int(row["sortie"]), json.loads(row["state"])
        if kind == "started":
            sortie += bool(state.get("flown"))  # a second mission is a sortie of its own
            state["flown"] = True
        state |= {"detector": detector, "mission": kind}
        if kind == "complete":
            db.execute(
                "INSERT INTO completions (vehicle, sortie, detail) VALUES (?, ?, ?)",
                (key, sortie, json.dumps(completion)),
            )
            new_job("refine", vehicle, sortie, {"trigger": "complete"})(db)
        db.execute("UPDATE vehicles SET sortie = ?, state = ? WHERE id = ?", (sortie, json.dumps(state), key))

    return change


def sortie_given_up(vehicle: str) -> Change:
    """The change that requests the refinement of an incomplete sortie; its result: whether it has a picture."""
    key = packed(vehicle)

    def change(db: sqlite3.Connection) -> bool:
        row = db.execute("SELECT sortie FROM vehicles WHERE id = ?", (key,)).fetchone()
        sent = db.execute("SELECT 1 FROM frames WHERE vehicle = ? AND sortie = ?", (key, row["sortie"]))
        if sent.fetchone() is None:
            return False
        new_job("refine", vehicle, int(row["sortie"]), {"trigger": "lost"})(db)
        return True

    return change


def completion_refined(whose: Whose, facts: Mapping[str, Any]) -> Change:
    """The change that adds facts to the latest completion of a sortie, if there is one."""
    key = packed(whose[0]), whose[1]

    def change(db: sqlite3.Connection) -> None:
        row = db.execute(
            "SELECT id, detail FROM completions WHERE vehicle = ? AND sortie IS ? ORDER BY id DESC LIMIT 1", key
        ).fetchone()
        if row is not None:
            detail = json.loads(row["detail"]) | facts
            db.execute("UPDATE completions SET detail = ? WHERE id = ?", (json.dumps(detail), row["id"]))

    return change


def sortie_refined(placed: PlacedSortie, stages: Mapping[str, tuple[str, float]], lost: Mapping[str, str]) -> Change:
    """The change that records a refined sortie.

    Args:
        stages: image -> stage and sigma in metres of its new placements. lost: image -> why it cannot be used.
    """
    key = packed(placed.vehicle), placed.sortie
    rows = [
        (stage, finite(sigma), *key, packed(image)) for image, (stage, sigma) in stages.items() if image not in lost
    ]
    rejected = [(why, *key, packed(image)) for image, why in lost.items()]
    where = "WHERE vehicle = ? AND sortie = ? AND image = ?"
    return all_changes(
        statements(f"UPDATE frames SET stage = ?, sigma = ?, reason = NULL {where}", rows),
        statements(f"UPDATE frames SET stage = 'rejected', reason = ? {where}", rejected),
        _stands("solutions", placed),
    )


def legs_placed(placed: PlacedSortie, sigmas: Mapping[str, float], lost: Collection[str]) -> Change:
    """The change that records a sortie on the coarse layer.

    Args:
        sigmas: image -> sigma in metres of its new placements. lost: images that could not be drawn.
    """
    key = packed(placed.vehicle), placed.sortie
    rows = [(finite(sigma), *key, packed(image)) for image, sigma in sigmas.items() if image not in lost]
    return all_changes(
        statements(
            "UPDATE frames SET stage = 'coarse', sigma = ? WHERE vehicle = ? AND sortie = ? AND image = ?"
            " AND stage IN ('realtime', 'coarse') AND reason IS NULL",
            rows,
        ),
        _stands("coarse", placed),
    )


def _stands(table: Table, placed: PlacedSortie) -> Change:
    values = packed(placed.vehicle), placed.sortie, placed.path, json.dumps(placed.detail)
    return statement(f"INSERT OR REPLACE INTO {table} VALUES (?, ?, ?, ?)", values)


def solution_replaced(whose: Whose, path: str) -> Change:
    """The change that names another solution file of a refined sortie."""
    values = path, packed(whose[0]), whose[1]
    return statement("UPDATE solutions SET path = ? WHERE vehicle = ? AND sortie = ?", values)


def placements_forgotten(gone: Mapping[Table, Iterable[PlacedSortie]]) -> Change:
    """The change that drops placed sorties, and the layers that show them."""
    changes = [fact_change(layer, None) for layer in REFINED]
    for table, rows in gone.items():
        keys = [(packed(row.vehicle), row.sortie) for row in rows]
        where = "WHERE vehicle = ? AND sortie = ?"
        changes += [
            statements(f"DELETE FROM {table} {where}", keys),
            statements(f"UPDATE frames SET stage = 'realtime' {where} AND stage IN ('coarse', 'fine')", keys),
        ]
    return all_changes(*changes)
