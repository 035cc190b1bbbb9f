"""The operator's work, shared by all pages: the plan with its settings, and marked finds."""

import threading
import time
from collections.abc import Mapping
from datetime import datetime
from typing import Any, Final, TypedDict, cast

from gcs_plugin.daemon.store.daemon_events import Events
from gcs_plugin.daemon.store.journal import Journal
from orthoswarm.export.product_files import iso_time
from orthoswarm.model.errors import InputError, OrthoSwarmError

_PLAN_FIELDS: Final = ("area", "settings", "plan", "vehicles")
_MOST_FINDS: Final = 10_000
_MOST_NOTE: Final = 10_000  # characters


class FindRow(TypedDict, total=False):
    """A marked find; `time`: ISO 8601; `version` from 1; `pictures`: names of those that show it, for an export."""

    id: int
    lat_deg: float
    lon_deg: float
    sigma_m: float | None
    note: str
    time: str | None
    version: int
    pictures: list[str]


class OutdatedError(OrthoSwarmError):
    """The plan or a find was changed by another page meanwhile."""


class ConsoleState:
    """The plan and the finds, stored in the journal."""

    def __init__(self, journal: Journal, events: Events) -> None:
        self._journal, self._events = journal, events
        self._lock = threading.Lock()

    def plan(self) -> dict[str, Any]:
        """The plan: `area` (GeoJSON), `settings`, `plan` (id), `vehicles` (who flies what), `version` from 0."""
        found: dict[str, Any] = self._journal.fact("console_plan") or {}
        return {"version": 0, **dict.fromkeys(_PLAN_FIELDS), **found}

    def put_plan(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Replace the plan; returns it with its new version.

        Args:
            body: the fields of `plan`; `version` is the version that was edited; without it any version is replaced.

        Raises:
            InputError: a field is invalid.
            OutdatedError: the plan has another version now.
        """
        for key in ("area", "settings", "vehicles"):
            if not isinstance(body.get(key), dict | None):
                raise InputError(f"{key} is not a JSON object; send one, or null")
        if not isinstance(body.get("plan"), str | None):
            raise InputError("plan is not the id of a plan; send one, or null")
        with self._lock:
            before, known = self.plan()["version"], body.get("version")
            if known is not None and known != before:
                raise OutdatedError(f"the plan was changed elsewhere (version {before}); load it and change it again")
            plan = {key: body.get(key) for key in _PLAN_FIELDS} | {"version": before + 1}
            self._journal.remember("console_plan", plan)
        self._events.tell("plan", **plan)
        return plan

    def finds(self) -> list[FindRow]:
        """The finds, oldest first."""
        return [cast(FindRow, {"version": 1, **row}) for row in self._finds()["rows"]]

    def _finds(self) -> dict[str, Any]:
        found: dict[str, Any] = self._journal.fact("finds") or {"next": 1, "rows": []}
        return found

    def add_find(self, body: Mapping[str, Any]) -> FindRow:
        """Add a find; returns it with its id; raises InputError: a field is invalid, or there are too many finds."""
        row = _find(body)
        row["time"], row["version"] = _time_of(body), 1
        with self._lock:
            found = self._finds()
            if len(found["rows"]) >= _MOST_FINDS:
                raise InputError(f"there are {_MOST_FINDS} finds; delete some first")
            row = {"id": found["next"], **row}
            self._journal.remember("finds", {"next": found["next"] + 1, "rows": [*found["rows"], row]})
        self._events.tell("finds")
        return row

    def change_find(self, number: int, body: Mapping[str, Any]) -> FindRow | None:
        """Change a find's place and note, not its time; returns it with its new version, None if it does not exist.

        Args:
            number: its id. body: the fields of `add_find`; `version` is the version that was edited; without it any
                version is replaced.

        Raises:
            InputError: a field is invalid.
            OutdatedError: the find has another version now.
        """
        new, known = _find(body), body.get("version")
        with self._lock:
            rows = self.finds()
            before = next((row for row in rows if row["id"] == number), None)
            if before is None:
                return None
            if known is not None and known != before["version"]:
                raise OutdatedError(
                    f"the find was changed elsewhere (version {before['version']}); load it and change it again"
                )
            row = before | new
            row["version"] = before["version"] + 1
            changed = [row if old is before else old for old in rows]
            self._journal.remember("finds", self._finds() | {"rows": changed})
        self._events.tell("finds")
        return row

    def delete_find(self, number: int) -> bool:
        """Delete a find; False if it does not exist."""
        with self._lock:
            found = self._finds()
            rows = [row for row in found["rows"] if row["id"] != number]
            if len(rows) == len(found["rows"]):
                return False
            self._journal.remember("finds", found | {"rows": rows})
        self._events.tell("finds")
        return True


def _find(body: Mapping[str, Any]) -> FindRow:
    """Place and note of a find; raises InputError: a field is invalid."""
    note = body.get("note") or ""
    if not isinstance(note, str) or len(note) > _MOST_NOTE:
        raise InputError(f"note is not a text of at most {_MOST_NOTE} characters; send a shorter one")
    return {
        "lat_deg": number_in(body, "lat_deg", 90.0), "lon_deg": number_in(body, "lon_deg", 180.0),
        "sigma_m": None if body.get("sigma_m") is None else number_in(body, "sigma_m", 1e6), "note": note,
    }  # fmt: skip


def _time_of(body: Mapping[str, Any]) -> str | None:
    """When a find was marked: one that is put back after a deletion keeps its time (ISO 8601); else now."""
    given, now = body.get("time"), time.time()
    if not isinstance(given, str):
        return iso_time(now)
    try:
        at = datetime.fromisoformat(given)
        return iso_time(min(at.timestamp(), now) if at.tzinfo else now)
    except (ValueError, OverflowError):
        raise InputError("time is not a time in ISO 8601; send for example 2026-05-28T20:26:40Z, or none") from None


def number_in(body: Mapping[str, Any], key: str, largest: float) -> float:
    """A number of a request, of either sign. Raises InputError: it is missing, no number, or larger."""
    value = body.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= largest:
        raise InputError(f"{key} is missing or out of range; send a number, at most {largest:g}")
    return float(value)
