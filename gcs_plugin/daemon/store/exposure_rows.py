"""Camera events of the vehicles in the journal."""

import sqlite3
from collections.abc import Sequence

from gcs_plugin.daemon.store.journal import Change, Journal, packed, unpacked

Exposed = tuple[str, int, float, float | None, float | None]
"""Vehicle, number, UTC epoch seconds, latitude and longitude in degrees (None where the camera had no position)."""


def exposures_added(rows: Sequence[Exposed]) -> Change:
    """The change that adds events; those that are known stay."""
    values = [(packed(vehicle), *rest) for vehicle, *rest in rows]

    def change(db: sqlite3.Connection) -> None:
        db.executemany("INSERT OR IGNORE INTO exposures VALUES (?, ?, ?, ?, ?)", values)

    return change


def all_exposures(journal: Journal) -> list[Exposed]:
    """All events, by vehicle and time."""
    rows = journal.rows("SELECT vehicle, number, time, lat, lon FROM exposures ORDER BY vehicle, time")
    return [(unpacked(r["vehicle"]), int(r["number"]), float(r["time"]), r["lat"], r["lon"]) for r in rows]


def exposure_times(journal: Journal, vehicle: str) -> list[tuple[int, float]]:
    """Numbers and times of a vehicle's events."""
    rows = journal.rows("SELECT number, time FROM exposures WHERE vehicle = ?", (packed(vehicle),))
    return [(row["number"], row["time"]) for row in rows]


def exposure_place(journal: Journal, vehicle: str, number: int, time_s: float) -> tuple[float, float] | None:
    """Latitude and longitude of an event (of those with its number the nearest in time), None without a position."""
    row = journal.one(
        "SELECT lat, lon FROM exposures WHERE vehicle = ? AND number = ? AND lat IS NOT NULL ORDER BY ABS(time - ?)",
        (packed(vehicle), number, time_s),
    )
    return None if row is None else (float(row["lat"]), float(row["lon"]))
