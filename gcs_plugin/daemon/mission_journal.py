"""The vehicles' missions in the journal: sorties, completions, and the states of the completion detectors.

A new sortie, a completion with the refinement that it requests, and the detector's state are written in one
transaction before they are acted on, so that a restart continues where the last daemon stopped.
"""

import json
import logging
import sqlite3
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from gcs_plugin.daemon.jobs.job_queue import new_job
from gcs_plugin.daemon.store.journal import Journal, packed, unpacked

if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet_events import FleetEvent
    from gcs_plugin.fleet.vehicle_state import Vehicle

_log = logging.getLogger(__name__)


class MissionJournal:
    """Records what happens to vehicles' missions.

    Args:
        journal: of the workspace.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal = journal

    def found(self, vehicle: "Vehicle", name: str) -> None:
        """Record a detected vehicle; its detector continues from the state stored by an earlier daemon."""
        from gcs_plugin.mission.completion import CompletionDetector

        row = self._journal.one("SELECT state FROM vehicles WHERE id = ?", (packed(name),))
        state = {} if row is None else json.loads(row["state"])
        if state.get("detector") and state["detector"].get("autopilot") == vehicle.autopilot.value:
            try:
                vehicle.detector = CompletionDetector.from_state(state["detector"])
            except (KeyError, TypeError, ValueError):  # of another version
                _log.warning("%s: what was known about its mission cannot be read", name)
        self._journal.write(
            lambda db: db.execute("INSERT OR IGNORE INTO vehicles (id) VALUES (?)", (packed(name),)).rowcount
        )

    def note(self, event: "FleetEvent", vehicle: "Vehicle", name: str, still_flying: Sequence[str]) -> None:
        """Write a mission's event (started, complete, aborted, suspended, resumed).

        A start after a flight opens a sortie; a completion requests the refinement of its sortie.

        Args:
            event: of the fleet. vehicle: which it is about. name: its id. still_flying: ids of the others in the air.
        """
        detector, kind, key = vehicle.detector.state(), event.kind, packed(name)

        def change(db: sqlite3.Connection) -> None:
            db.execute("INSERT OR IGNORE INTO vehicles (id) VALUES (?)", (key,))
            row = db.execute("SELECT sortie, state FROM vehicles WHERE id = ?", (key,)).fetchone()
            sortie, state = int(row["sortie"]), json.loads(row["state"])
            if kind == "started":
                sortie += bool(state.get("flown"))  # a second mission is a sortie of its own
                state["flown"] = True
            state |= {"detector": detector, "mission": kind}
            if kind == "complete":
                detail = {"complete_s": event.time_s, "still_flying": list(still_flying)}
                db.execute(
                    "INSERT INTO completions (vehicle, sortie, detail) VALUES (?, ?, ?)",
                    (key, sortie, json.dumps(detail)),
                )
                new_job("refine", name, sortie, {"trigger": "complete"})(db)
            db.execute("UPDATE vehicles SET sortie = ?, state = ? WHERE id = ?", (sortie, json.dumps(state), key))

        self._journal.write(change)

    def give_up(self, name: str) -> bool:
        """Request the refinement of a silent vehicle's incomplete sortie; False if it sent no picture."""
        key = packed(name)

        def change(db: sqlite3.Connection) -> bool:
            row = db.execute("SELECT sortie FROM vehicles WHERE id = ?", (key,)).fetchone()
            sent = db.execute("SELECT 1 FROM frames WHERE vehicle = ? AND sortie = ?", (key, row["sortie"]))
            if sent.fetchone() is None:
                return False
            new_job("refine", name, int(row["sortie"]), {"trigger": "lost"})(db)
            return True

        return self._journal.write(change)


def completion_rows(journal: Journal) -> list[dict[str, Any]]:
    """All completions as JSON values, oldest first."""
    rows = journal.rows("SELECT * FROM completions ORDER BY id")
    return [{"vehicle": unpacked(r["vehicle"]), "sortie": r["sortie"], **json.loads(r["detail"])} for r in rows]


def note_completion(vehicle: str, sortie: int | None, facts: dict[str, Any]) -> Callable[[sqlite3.Connection], None]:
    """The change that adds facts to the latest completion of a sortie, if there is one."""

    def change(db: sqlite3.Connection) -> None:
        row = db.execute(
            "SELECT id, detail FROM completions WHERE vehicle = ? AND sortie IS ? ORDER BY id DESC LIMIT 1",
            (packed(vehicle), sortie),
        ).fetchone()
        if row is not None:
            detail = json.loads(row["detail"]) | facts
            db.execute("UPDATE completions SET detail = ? WHERE id = ?", (json.dumps(detail), row["id"]))

    return change
