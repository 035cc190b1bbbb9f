"""The vehicles on the daemon's links: their state and poses, their missions, commands to them, and their check.

One thread polls the fleet. A new sortie, a completion with the refinement that it requests,
and the state of the completion detector are written to the journal in one transaction before they are acted on, so that
a restart continues where the last daemon stopped.
The HTTP API gets JSON values: of vehicles a `VehicleRow` each, of commands a `CommandResult.document`, of checks a
`CheckRow`.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, Final, cast

from gcs_plugin.daemon.airspace import Fences, Traffic
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.start_checks import CheckRow, StartChecks, WaitingTakeoffs, red_items
from gcs_plugin.daemon.store import sortie_rows
from gcs_plugin.daemon.store.daemon_events import Events, JobEnded, MissionNoted
from gcs_plugin.daemon.store.frame_rows import exposure_times
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.vehicle_names import VehicleRow
from gcs_plugin.fleet.commands import URGENT, VERBS, CommandResult, Order, Verb, new_id
from gcs_plugin.fleet.fence_limits import FenceLimits, fence_limits
from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.flight_state import summary
from gcs_plugin.fleet.preflight import CONTINUED, ITEMS
from gcs_plugin.fleet.reception import FleetEvent
from gcs_plugin.fleet.separation.returns import Returns
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.links.signing import find_key
from gcs_plugin.mission.completion import CompletionDetector, Phase
from gcs_plugin.mission.exchange import Verdict
from gcs_plugin.mission.geofence import FenceZone
from gcs_plugin.mission.items import Mission
from gcs_plugin.mission.plan_folder import NO_NEEDS, PlanNeeds
from gcs_plugin.mission.track import route_points
from orthoswarm.model.errors import InputError, OrthoSwarmError
from telemetry.live.live_poses import LinkPoses, LivePoses

_WATCH_S: Final = 0.5
_SOON_S: Final = 5.0
_OUTCOME_S: Final = 60.0
_TRAIL: Final = 600  # positions of a vehicle on the page
_MOST_TEXTS: Final = 50  # of a vehicle on the page
_COMPLETE_EVERY: Final = 20  # looks after which all rows are sent, not only changed ones
_FAULT: Final = 4  # MAV_SEVERITY_WARNING
_log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class _VehicleRecord:
    """The daemon's own data about a vehicle, besides the fleet's.

    Attributes:
        photos: pictures that it had reported before the daemon was started. holds: the mission of its route, which has
            the number `route`; another mission gets another number.
    """

    id: str
    poses: LivePoses
    photos: int
    holds: Mission | None = None
    route: int = 0
    trail: list[tuple[float, float]] = field(default_factory=list)
    texts: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=_MOST_TEXTS))
    sent: dict[str, Any] = field(default_factory=dict)
    lost_since: float | None = None


class VehicleLinks:
    """The daemon's fleet.

    Attributes:
        fleet: its vehicles and links.
        traffic: other aircraft that vehicles have heard of.
        latest: the rows of `rows`, at most half a second old.
        waiting: the takeoffs that wait, or are being checked.
    """

    def __init__(self, settings: Settings, journal: Journal, events: Events, poses: LinkPoses) -> None:
        """Open the links; the vehicles' poses are stored in `poses`, by their ids.

        Raises:
            InputError: a link cannot be opened.
        """
        self._settings, self._events, self._journal = settings, events, journal
        self.names, self.waiting = settings.names(), WaitingTakeoffs(settings.names())
        self._records: dict[int, _VehicleRecord] = {}
        self._poses = poses
        self._stop, self._silent = threading.Event(), threading.Event()
        self.latest: list[VehicleRow] = []
        self._starting = Counter[int]()
        log = settings.workspace / "telemetry.tlog" if settings.links else None
        self.fleet: Fleet = Fleet(
            settings.links,
            key=find_key() if settings.links else None,
            tlog=log,
            takeoffs=self.waiting,
            names=self.names,
        )
        self.fleet.on_event(self._event)
        self.fleet.subscribe(self._message)
        self._fences = Fences(self.fleet)
        self._checks = StartChecks(self.fleet, self._fences, self.names, self.waiting)
        self._returns = Returns(self.fleet, self._give, self._told, self.names.name_of)
        self.traffic = Traffic()
        self.fleet.subscribe(self.traffic.heard, "ADSB_VEHICLE")
        self._threads = [  # with what ends them: first the one that asks the links
            (threading.Thread(target=self._watch, name="watch", daemon=True), self._stop),
            (threading.Thread(target=self.fleet.run, args=(self._silent,), name="links", daemon=True), self._silent),
        ]

    def start(self) -> None:
        """Begin to listen."""
        for thread, _ in self._threads:
            thread.start()

    def close(self) -> None:
        """Close the links."""
        self._returns.close()
        for thread, ended in self._threads:
            ended.set()
            if thread.ident is not None:
                thread.join(5.0)
        self.fleet.close()

    # -- queries ------------------------------------------------------------------------------------------

    def heard(self) -> list[str]:
        """The ids of all vehicles on the links."""
        return [self.names.name_of(system) for system in sorted(self.fleet.vehicles)]

    def standing(self) -> dict[str, tuple[float, float] | str]:
        """Where vehicles stand on the ground, latitude and longitude in degrees, or why that is not known, by id."""
        known: dict[str, tuple[float, float] | str] = {}
        for system, v in list(self.fleet.vehicles.items()):
            place = "no position yet" if v.lat_deg is None or v.lon_deg is None else (v.lat_deg, v.lon_deg)
            known[self.names.name_of(system)] = "in the air" if v.flying else place
        return known

    def autopilots(self) -> dict[str, str]:
        """The autopilot of each vehicle that was heard, by id."""
        return {self.names.name_of(system): v.autopilot.value for system, v in list(self.fleet.vehicles.items())}

    def rows(self) -> list[VehicleRow]:
        """All vehicles on the links as JSON values."""

        def collect() -> list[VehicleRow]:
            now = time.monotonic()
            return [self._row(vehicle, now) for _, vehicle in sorted(self.fleet.vehicles.items())]

        if not self.fleet.vehicles:
            return []
        takeoffs, returns = self.waiting.rows(), self._returns.waits()
        rows = self.fleet.call(collect).result(5.0)
        for row in rows:
            row["takeoff"], row["returns_after"] = takeoffs.get(row["id"]), returns.get(row["id"])
        return rows

    def routes(self) -> list[dict[str, Any]]:
        """What the vehicles hold, as read from each or written and read back.

        A row has `vehicle`, `route` (its number in the vehicle's row), and `points`: [sequence number of the item,
        longitude, latitude in degrees], in the order of flight.
        """
        held = [(self._records[s], self._records[s].holds) for s in sorted(self._records)]
        return [
            {"vehicle": record.id, "route": record.route, "points": route_points(mission)}
            for record, mission in held
            if mission is not None
        ]

    @staticmethod
    def clock() -> float:
        """Monotonic seconds, by which commands expire: a page that has them says when its command was given."""
        return time.monotonic()

    def commands(
        self,
        verb: str,
        vehicles: Collection[str] | None = None,
        *,
        given_s: float | None = None,
        command_id: str | None = None,
        override: Mapping[str, Collection[str]] | None = None,
    ) -> list[dict[str, Any]]:
        """Give a command to vehicles, to all at once, and wait for the outcome of each.

        Args:
            verb: one of `fleet.commands.VERBS`.
            vehicles: their ids; None for all on the links.
            given_s: when it was given (`clock`); default now. It is not sent later than 5 s after that.
            command_id: id of the command; a new one by default.
            override: names of red preflight items that do not stop a start, by vehicle.

        Returns:
            A row per vehicle: `id`, `vehicle`, `command`, `reason`, `outcome` (done, refused, not_sent, unknown).

        Raises:
            InputError: there is no such command.
        """
        if verb not in VERBS:
            raise InputError(f"there is no command '{verb}'; choose {', '.join(VERBS)}")
        given, number = self.clock() if given_s is None else min(given_s, self.clock()), command_id or new_id()
        names = self.heard() if vehicles is None else list(vehicles)
        for system in list(self.fleet.vehicles):
            if self.names.name_of(system) in names:
                self._returns.cancel(system)
        return self._give(verb, names, given, number, override or {})

    def _give(
        self,
        verb: Verb,
        names: Collection[str],
        given: float | None = None,
        number: str | None = None,
        override: Mapping[str, Collection[str]] = MappingProxyType({}),
    ) -> list[dict[str, Any]]:
        """Give a command, see `commands`; `given` and `number`: default now, and a new one."""
        given, number = self.clock() if given is None else given, number or new_id()
        stops, fleet = dict(self.fleet.stops), self.fleet.vehicles
        standing = {s: v.standing for s, v in list(fleet.items())}
        rows, systems = self._without_command(verb, names, number, override)
        orders = {
            name: Order(
                verb=verb, system=s, given_s=given, stops=stops.get(s, 0), id=number, standing=standing.get(s),
                mission=fleet[s].mission if verb == "start" else None,
            )
            for name, s in systems.items()
        }  # fmt: skip
        for order in orders.values():
            self.fleet.call(partial(self.fleet.order, order))
        end = time.monotonic() + _OUTCOME_S
        while any(order.outcome is None for order in orders.values()) and not self._stop.is_set():
            if time.monotonic() > end:
                break
            time.sleep(0.02)
        for name, order in orders.items():
            result = order.result(name)
            if result is None:
                reason = f"{name} has not answered; watch whether it obeys"
                result = CommandResult(number, name, verb, Verdict.UNKNOWN, reason)
            rows[name] = result.document()
        return [rows[name] for name in names]

    def return_in_turn(self, command_id: str | None = None) -> list[dict[str, Any]]:
        """Return all vehicles on the links, those whose ways home come near each other one after the other.

        Returns:
            A row per vehicle, see `commands`; one that holds until its turn comes has done as it was told.
        """
        return self._returns.begin(
            {self.names.name_of(s): s for s in sorted(self.fleet.vehicles)}, command_id or new_id()
        )

    def _without_command(
        self, verb: str, names: Collection[str], number: str, override: Mapping[str, Collection[str]]
    ) -> tuple[dict[str, dict[str, Any]], dict[str, int]]:
        """The rows of vehicles that need no command, and the system ids of the others."""
        rows: dict[str, dict[str, Any]] = {}
        systems: dict[str, int] = {}

        def end(name: str, outcome: Verdict, reason: str) -> None:
            rows[name] = CommandResult(number, name, verb, outcome, reason).document()

        for name in names:
            try:
                systems[name] = self.fleet.system_of(name)
            except OrthoSwarmError as error:
                end(name, Verdict.NOT_SENT, str(error))
                continue
            if verb in URGENT:
                self.fleet.told_to_stop(systems[name])  # first of all: it makes void what is being checked now
                checked = "its start is cancelled" if self._starting[systems[name]] else ""
                if checked:
                    self.fleet.told_to_stop(systems[name])  # again, for a check that began after the first time
                cancelled = self.waiting.cancel(name, self.fleet) or checked
                under_way = self.fleet.vehicles[systems[name]].armed or self.fleet.starting(systems[name])
                if cancelled and not under_way:
                    end(name, Verdict.DONE, f"{name} stays on the ground: {cancelled}")
                    del systems[name]
        if verb in ("start", "continue"):
            free = () if verb == "start" else set(ITEMS) - CONTINUED
            for row in self._checked(systems):
                red = red_items(row, {*override.get(row["vehicle"], ()), *free})
                if red:
                    was = "started" if verb == "start" else "sent on with its mission"
                    end(row["vehicle"], Verdict.REFUSED, f"{row['vehicle']} was not {was}: {'; '.join(red)}")
                    del systems[row["vehicle"]]
        return rows, systems

    def _checked(self, systems: Mapping[str, int]) -> list[CheckRow]:
        """The check of vehicles that are to start now; a command to stop that comes meanwhile finds them starting."""
        self._starting.update(systems.values())
        try:
            return self.preflight(list(systems))
        finally:
            self._starting.subtract(systems.values())

    def preflight(
        self,
        vehicles: Collection[str] | None = None,
        missions: Mapping[str, Mission] | None = None,
        *,
        starts: Mapping[str, float] | None = None,
        needs: PlanNeeds = NO_NEEDS,
        reread: bool = True,
    ) -> list[CheckRow]:
        """Check vehicles before their start; their missions are read from them first.

        Args:
            vehicles: their ids; None for all on the links.
            missions: the plan's mission of each, by vehicle; without it the vehicle's stored mission is flown.
            starts: takeoff of each in seconds after the first; default all at once.
            needs: of the plan.
            reread: whether missions are read although they were read or written before and nothing changed them since.

        Raises:
            OrthoSwarmError: a vehicle was not heard on any link.
        """
        names = self.heard() if vehicles is None else list(vehicles)
        systems = {self.fleet.system_of(name): name for name in names}
        wanted = {s: missions[name] for s, name in systems.items() if missions and name in missions}
        times = {s: starts[name] for s, name in systems.items() if starts and name in starts}
        return self._checks.check(systems, wanted, times, needs=needs, reread=reread)

    def upload(self, system: int, mission: Mission) -> str:
        """Put a mission into a vehicle, see `Fleet.upload`; returns what has come of it, in words.

        Raises:
            OrthoSwarmError: the vehicle refused, or did not answer.
        """
        return self.finish(self.fleet.call(partial(self.fleet.upload, system, mission)))

    def upload_fence(self, system: int, keep_out: Sequence[FenceZone]) -> str:
        """Put zones to stay out of into a vehicle's geofence, in place of those that it holds; zones to stay in stay.

        Raises:
            OrthoSwarmError: its geofence has not been read, it is in the air, refused, or did not answer.
        """
        held = self._fences.zones().get(system)
        if held is None:
            raise OrthoSwarmError(f"the geofence of vehicle {system} has not been read yet; wait until it is shown")
        zones = [zone for zone in held if zone.kind == "inclusion"] + list(keep_out)
        text = self.finish(self.fleet.call(partial(self.fleet.upload_fence, system, zones)))
        self.fleet.call(partial(self._fences.read_again, system)).result(_SOON_S)
        vehicle = self.fleet.vehicles[system]  # zones of a PX4 count always
        off = vehicle.autopilot is Autopilot.ARDUPILOT and fence_limits(vehicle) == FenceLimits()
        return f"{text}; it keeps to it once FENCE_ENABLE is 1" if off else text

    def finish(self, begun: Future[Any], timeout_s: float = 180.0) -> str:
        """Wait for the end of a dialogue that the fleet begins; returns the final text.

        Raises:
            OrthoSwarmError: the vehicle refused, or did not answer.
        """
        dialogue = begun.result(10.0)
        end = time.monotonic() + timeout_s
        while dialogue.outcome is None:
            if time.monotonic() > end or self._stop.is_set():
                raise OrthoSwarmError(f"vehicle {dialogue.vehicle.system} has not finished in {timeout_s:.0f} s")
            time.sleep(0.02)
        if not dialogue.outcome.ok:
            raise OrthoSwarmError(dialogue.outcome.text)
        return str(dialogue.outcome.text)

    def job_ended(self, event: JobEnded) -> None:
        """Record what the refinement after a completion came to, and who still flew then."""
        job = event.job
        refined = job.kind == "refine" and job.state == "done" and job.vehicle is not None
        if not refined or "published_s" not in job.detail or "beside" in job.detail:
            return
        facts = {
            "refine_started_s": job.detail["refine_started_s"], "refine_ended_s": job.detail["published_s"],
            "layer": job.detail["layer"], "version_before": job.detail["version_before"],
            "version": job.detail["version"], "frames": job.detail["frames"],
            "still_flying_after": [r["id"] for r in self.rows() if r["mission"]["phase"] == "active"],
        }  # fmt: skip
        self._journal.write(sortie_rows.completion_refined(job.whose, facts))
        self._events.tell("completion", vehicle=job.vehicle, sortie=job.sortie, **facts)

    def _told(self, row: dict[str, Any]) -> None:
        self._events.tell("command", **row)

    # -- what vehicles say (in the fleet's thread) ------------------------------------------------------------------

    def _record(self, system: int) -> _VehicleRecord:
        if system not in self._records:
            name = self.names.name_of(system)
            taken = len(exposure_times(self._journal, name))
            self._records[system] = _VehicleRecord(id=name, poses=self._poses.of(name), photos=taken)
        return self._records[system]

    def _message(self, vehicle: Vehicle, message: Any, utc: float) -> None:
        self._record(vehicle.system).poses.feed(message, utc)

    def _event(self, event: FleetEvent) -> None:
        name = self.names.name_of(event.system)
        vehicle = self.fleet.vehicles[event.system]
        record = self._record(event.system)
        try:
            if event.kind == "found":
                self._found(vehicle, name)
            elif event.kind in ("started", "complete", "aborted", "suspended", "resumed"):
                flying = [
                    self.names.name_of(s)
                    for s, v in sorted(self.fleet.vehicles.items())
                    if s != event.system and (v.detector.phase is Phase.ACTIVE or v.flying) and not v.lost
                ]
                completion = {"complete_s": event.time_s, "still_flying": flying}
                self._journal.write(sortie_rows.mission_noted(name, event.kind, vehicle.detector.state(), completion))
                self._events.publish(MissionNoted(name, event.kind))
        except OrthoSwarmError as error:  # the disk is full: flying goes on
            _log.error("%s", error)
        record.lost_since = time.monotonic() if event.kind == "lost" else None
        text, pair = event.text, [self.names.name_of(system) for system in event.pair or ()]
        about: dict[str, Any] = {"vehicle": name, "kind": event.kind, "text": text, "time": event.time_s, "pair": pair}
        if event.kind == "text":
            said = {"text": vehicle.texts[-1], "severity": event.severity, "time": round(event.time_s, 1)}
            record.texts.append(said)
            about |= {"said": said["text"], "severity": said["severity"]}
        grave = event.kind == "danger" or event.severity <= _FAULT
        if grave or event.kind != "text":
            _log.log(logging.WARNING if grave else logging.INFO, "%s", text)
        self._events.tell("vehicle_event", **about)

    def _found(self, vehicle: Vehicle, name: str) -> None:
        """Record a detected vehicle; its detector continues from the state stored by an earlier daemon."""
        detector = sortie_rows.vehicle_state(self._journal, name).get("detector")
        if detector and detector.get("autopilot") == vehicle.autopilot.value:
            try:
                vehicle.detector = CompletionDetector.from_state(detector)
            except (KeyError, TypeError, ValueError):  # of another version
                _log.warning("%s: what was known about its mission cannot be read", name)
        self._journal.write(sortie_rows.vehicle_found(name))

    # -- what time asks for -----------------------------------------------------------------------------------------

    def _watch(self) -> None:
        number = 0
        while not self._stop.wait(_WATCH_S):
            number += 1
            try:
                self.fleet.call(self._fences.look).result(_SOON_S)
                self._publish_rows(complete=number % _COMPLETE_EVERY == 0)
                if self.traffic.changed():
                    self._events.tell("traffic", rows=self.traffic.rows())
                self._give_up_silent()
            except Exception as error:  # an unexpected state of one vehicle must not end the watch
                _log.warning("watching vehicles: %s", str(error) or type(error).__name__)

    def _publish_rows(self, *, complete: bool) -> None:
        """Publish the differences of each vehicle's row since the last time, or complete rows.

        With 96 vehicles complete rows would be most of the traffic to the pages.
        """
        self.latest = self.rows()
        for row in self.latest:
            sent = self._records[row["system"]].sent
            now = {k: v for k, v in row.items() if k not in ("trail", "texts")}
            fresh = now if complete else {k: v for k, v in now.items() if k not in sent or sent[k] != v}
            sent.update(now)
            always = {"id": row["id"], "name": row["name"], "silent_s": row["silent_s"]}
            self._events.tell("vehicle", **fresh | always)

    def _give_up_silent(self) -> None:
        """Refine the incomplete sortie of a vehicle that has been silent for long during its mission."""
        for system, record in list(self._records.items()):
            vehicle = self.fleet.vehicles[system]
            since = record.lost_since
            if since is None or time.monotonic() - since < self._settings.lost_after_s:
                continue
            if vehicle.detector.phase not in (Phase.ACTIVE, Phase.SUSPENDED):
                continue
            given_up = self._journal.write(sortie_rows.sortie_given_up(record.id))
            record.lost_since = None  # after that: if the disk is full, it is tried again
            if given_up:
                _log.info("%s has been silent for long; what it sent is refined", record.id)
                self._events.publish(MissionNoted(record.id, "lost"))

    def _row(self, vehicle: Vehicle, now: float) -> VehicleRow:
        record = self._record(vehicle.system)
        row = cast(VehicleRow, summary(vehicle, now))
        row["id"], row["name"] = record.id, self.names.title_of(record.id)
        near = self.fleet.separation.text(vehicle.system)
        row["alarm"] = "; ".join(text for text in (near, vehicle.danger and f"{record.id} {vehicle.danger}") if text)
        row["behind"] = self.fleet.behind(vehicle.system)
        row["behind_ordered"] = self.fleet.behind_ordered(vehicle.system)
        row["yaw_deg"] = row["heading_deg"]
        if vehicle.lat_deg is not None and vehicle.lon_deg is not None:
            point = (round(vehicle.lon_deg, 7), round(vehicle.lat_deg, 7))
            if not record.trail or record.trail[-1] != point:
                record.trail.append(point)
                del record.trail[:-_TRAIL]
        if record.holds is not vehicle.mission:
            record.holds, record.route = vehicle.mission, record.route + 1
        row["route"] = 0 if record.holds is None else record.route
        row["photos"] += record.photos
        row["fence"] = self._fences.of(vehicle.system)
        row["trail"], row["texts"] = record.trail[-_TRAIL:], list(record.texts)
        return row
