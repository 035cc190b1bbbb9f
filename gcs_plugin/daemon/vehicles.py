"""The vehicles on the daemon's links: their state and poses, their sorties, and what follows when one completes.

A fleet is polled by one thread. What must not be forgotten (a new sortie, a completion with the refinement that it
asks for, the completion detector's state) goes to the journal in one transaction before anything is done about it.
"""

import json
import logging
import sqlite3
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.daemon.jobs.job_queue import Jobs, new_job
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.event_bus import Events
from gcs_plugin.daemon.store.journal import Journal, packed, unpacked
from orthoswarm.model.errors import OrthoSwarmError
from telemetry.samples.sample import Sample

if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.fleet.fleet_events import FleetEvent
    from gcs_plugin.fleet.vehicle_state import Vehicle
    from gcs_plugin.mission.download import MissionDownload
    from gcs_plugin.mission.exchange import Exchange
    from gcs_plugin.mission.items import Mission
    from telemetry.live.live_poses import LivePoses

_WATCH_S: Final = 0.5
_TRAIL: Final = 600
_REPLACED: Final = "dropped: the vehicle is complete, its refinement takes its place"
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Kept:
    """What the daemon keeps about a vehicle besides what the fleet knows."""

    id: str
    poses: "LivePoses"
    trail: list[tuple[float, float]] = field(default_factory=list)
    lost_since: float | None = None


class Flock:
    """The daemon's fleet.

    Attributes:
        fleet: its vehicles and links.
    """

    def __init__(self, settings: Settings, journal: Journal, events: Events, jobs: Jobs) -> None:
        """Open the links.

        Raises:
            InputError: a link cannot be opened.
        """
        from gcs_plugin.fleet.fleet import Fleet

        self._settings, self._journal, self._events, self._jobs = settings, journal, events, jobs
        self._names = {v.system: v.id for v in settings.vehicles if v.system is not None}
        self._kept: dict[int, _Kept] = {}
        self._stop = threading.Event()
        self.fleet: Fleet = Fleet(settings.links, tlog=settings.workspace / "telemetry.tlog")
        self.fleet.on_event(self._event)
        self.fleet.subscribe(self._message)
        self._threads = [
            threading.Thread(target=self.fleet.run, args=(self._stop,), name="links", daemon=True),
            threading.Thread(target=self._watch, name="watch", daemon=True),
        ]

    def start(self) -> None:
        """Begin to listen."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Close the links."""
        self._stop.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(5.0)
        self.fleet.close()

    # -- asked by others ------------------------------------------------------------------------------------------

    def name_of(self, system: int) -> str:
        """The id of a vehicle with a MAVLink system id."""
        return self._names.get(system, f"v{system}")

    def system_of(self, vehicle: str) -> int:
        """The MAVLink system id of a vehicle, by its id or that number.

        Raises:
            OrthoSwarmError: it was not heard on any link.
        """
        for system in list(self.fleet.vehicles):
            if vehicle in (self.name_of(system), str(system)):
                return system
        known = ", ".join(self.name_of(system) for system in sorted(self.fleet.vehicles)) or "none"
        raise OrthoSwarmError(f"{vehicle} is not on the links (heard: {known}); check links and system ids")

    def rows(self) -> list[dict[str, Any]]:
        """All vehicles on the links as JSON values."""

        def collect() -> list[dict[str, Any]]:
            now = time.monotonic()
            return [self._row(vehicle, now) for _, vehicle in sorted(self.fleet.vehicles.items())]

        return self.fleet.call(collect).result(5.0)

    def pose_at(self, vehicle: str, time_s: float) -> Sample | None:
        """The pose of a vehicle's camera at a moment (UTC), None where nothing is known then."""
        for kept in list(self._kept.values()):
            if kept.id == vehicle:
                sample = kept.poses.at(time_s)
                return sample if sample.has_position else None
        return None

    def command(self, begin: Callable[["Fleet"], "Exchange"], timeout_s: float = 180.0) -> str:
        """Have a dialogue with a vehicle, to its end; gives what was said at the end.

        Raises:
            OrthoSwarmError: the vehicle refused, or did not answer.
        """
        dialogue = self.fleet.call(lambda: begin(self.fleet)).result(10.0)
        end = time.monotonic() + timeout_s
        while dialogue.outcome is None:
            if time.monotonic() > end or self._stop.is_set():
                raise OrthoSwarmError(f"vehicle {dialogue.vehicle.system} has not finished in {timeout_s:.0f} s")
            time.sleep(0.02)
        if not dialogue.outcome.ok:
            raise OrthoSwarmError(dialogue.outcome.text)
        return dialogue.outcome.text

    def unlike(self, system: int, mission: "Mission") -> str | None:
        """In what the mission that a vehicle holds differs from one, None if it does not.

        Raises:
            OrthoSwarmError: the vehicle does not hand it out.
        """
        from gcs_plugin.mission.comparison import difference

        reads: list[MissionDownload] = []

        def begin(fleet: "Fleet") -> "Exchange":
            reads.append(fleet.download(system))
            return reads[0]

        self.command(begin)
        found = difference(mission, reads[0].items or [])
        return None if found is None else found.text

    # -- what vehicles say (in the fleet's thread) ------------------------------------------------------------------

    def _keep(self, system: int) -> _Kept:
        if system not in self._kept:
            from telemetry.live.live_poses import LivePoses

            name = self.name_of(system)
            self._kept[system] = _Kept(name, LivePoses(name))
        return self._kept[system]

    def _message(self, vehicle: "Vehicle", message: Any, utc: float) -> None:
        kept = self._keep(vehicle.system)
        kept.poses.feed(message, utc)

    def _event(self, event: "FleetEvent") -> None:
        name = self.name_of(event.system)
        vehicle = self.fleet.vehicles[event.system]
        kept = self._keep(event.system)
        try:
            if event.kind == "found":
                self._found(vehicle, name)
            elif event.kind in ("started", "complete", "aborted", "suspended", "resumed"):
                self._journal.write(self._mission_change(event, vehicle, name))
                if event.kind == "complete":
                    self._jobs.drop("coarse", name, _REPLACED)
                self._jobs.wake()
        except OrthoSwarmError as error:  # the disk is full: flying goes on
            _log.error("%s", error)
        kept.lost_since = time.monotonic() if event.kind == "lost" else None
        self._events.publish("vehicle_event", vehicle=name, kind=event.kind, text=event.text, time=event.time_s)
        if event.kind != "text":
            _log.info("%s", event.text)

    def _found(self, vehicle: "Vehicle", name: str) -> None:
        """A vehicle that an earlier daemon followed is followed from where that stopped."""
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

    def _mission_change(
        self, event: "FleetEvent", vehicle: "Vehicle", name: str
    ) -> Callable[[sqlite3.Connection], None]:
        """The change that a mission's event makes."""
        detector, kind, key = vehicle.detector.state(), event.kind, packed(name)
        flying = [self.name_of(s) for s, v in sorted(self.fleet.vehicles.items()) if s != event.system and _flies(v)]

        def change(db: sqlite3.Connection) -> None:
            db.execute("INSERT OR IGNORE INTO vehicles (id) VALUES (?)", (key,))
            row = db.execute("SELECT sortie, state FROM vehicles WHERE id = ?", (key,)).fetchone()
            sortie, state = int(row["sortie"]), json.loads(row["state"])
            if kind == "started":
                sortie += bool(state.get("flown"))  # a second mission is a sortie of its own
                state["flown"] = True
            state |= {"detector": detector, "mission": kind}
            if kind == "complete":
                detail = {"complete_s": event.time_s, "still_flying": flying}
                db.execute(
                    "INSERT INTO completions (vehicle, sortie, detail) VALUES (?, ?, ?)",
                    (key, sortie, json.dumps(detail)),
                )
                new_job("refine", name, sortie, {"trigger": "complete"})(db)
            db.execute("UPDATE vehicles SET sortie = ?, state = ? WHERE id = ?", (sortie, json.dumps(state), key))

        return change

    # -- what time asks for -----------------------------------------------------------------------------------------

    def _watch(self) -> None:
        while not self._stop.wait(_WATCH_S):
            try:
                rows = self.rows()
                for row in rows:
                    self._events.publish("vehicle", **{k: v for k, v in row.items() if k != "trail"})
                self._give_up_silent()
            except Exception as error:  # a vehicle's odd state must not end the watch
                _log.warning("watching vehicles: %s", error)

    def _give_up_silent(self) -> None:
        """A vehicle that has been silent for long in the middle of its mission is refined as far as it came."""
        for system, kept in list(self._kept.items()):
            vehicle = self.fleet.vehicles[system]
            since = kept.lost_since
            if since is None or time.monotonic() - since < self._settings.lost_after_s or not _under_way(vehicle):
                continue
            kept.lost_since = None
            key = packed(kept.id)

            def change(db: sqlite3.Connection, key: str = key, name: str = kept.id) -> bool:
                row = db.execute("SELECT sortie FROM vehicles WHERE id = ?", (key,)).fetchone()
                sent = db.execute("SELECT 1 FROM frames WHERE vehicle = ? AND sortie = ?", (key, row["sortie"]))
                if sent.fetchone() is None:
                    return False
                new_job("refine", name, int(row["sortie"]), {"trigger": "lost"})(db)
                return True

            if self._journal.write(change):
                _log.info("%s has been silent for long; what it sent is refined", kept.id)
                self._jobs.wake()

    def _row(self, vehicle: "Vehicle", now: float) -> dict[str, Any]:
        kept = self._keep(vehicle.system)
        row = vehicle.summary(now) | {"id": kept.id}
        row["yaw_deg"] = row["heading_deg"]
        if vehicle.lat_deg is not None and vehicle.lon_deg is not None:
            point = (round(vehicle.lon_deg, 7), round(vehicle.lat_deg, 7))
            if not kept.trail or kept.trail[-1] != point:
                kept.trail.append(point)
                del kept.trail[:-_TRAIL]
        row["trail"] = kept.trail[-_TRAIL:]
        return row


def _under_way(vehicle: "Vehicle") -> bool:
    from gcs_plugin.mission.completion import Phase

    return vehicle.detector.phase in (Phase.ACTIVE, Phase.SUSPENDED)


def _flies(vehicle: "Vehicle") -> bool:
    from gcs_plugin.mission.completion import Phase

    return vehicle.detector.phase is Phase.ACTIVE and not vehicle.lost


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
