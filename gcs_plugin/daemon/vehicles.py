"""The vehicles on the daemon's links: their state and poses, their sorties, and the jobs after a completion.

A fleet is polled by one thread. State that must survive a restart is written to the journal first, see
`mission_journal`.

For the HTTP API and the page, all in JSON values:

- `commands(verb, vehicles)` gives a row a vehicle: `id`, `vehicle`, `command`, `outcome` (`done`, `refused`,
  `not_sent`, `unknown`), `reason`. Verbs are those of `fleet.commands`; no vehicles named: all on the links at once.
- `preflight(...)` gives a row a vehicle: `vehicle`, `state` and `items`, each with `name` (of
  `fleet.preflight.ITEMS`), `state` (`ok`, `warning`, `red`) and `reason`. A red item stops `start` unless it is
  overridden by its name.
- `flight_state(vehicle)`, and `flight` in each row of `rows()`: `state` (`on ground`, `taking off`, `on mission`,
  `paused`, `returning`, `landing`, `holding`, `flying`, `descending`, `lost`, `complete`), `text` (`on mission 7/13`),
  `item` and `items`.
- `alarm` in each row of `rows()`: what is wrong with how and where it flies, and what to do; empty if nothing is.
- `behind` in each row of `rows()`: by how much it is behind its plan, in words; empty if it is not.
- `fence` in each row of `rows()`: the geofence that the vehicle holds, see `Fences.of`.
- `clock()` is the monotonic clock by which commands expire: a page that gets it from the event stream can state when
  its command was given, so that a delayed one is not executed late.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.daemon.airspace.fences import Fences
from gcs_plugin.daemon.airspace.traffic import Traffic
from gcs_plugin.daemon.jobs.job_queue import Jobs
from gcs_plugin.daemon.mission_journal import MissionJournal
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.start_checks import StartChecks, red_items
from gcs_plugin.daemon.store.event_bus import Events
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.fleet.commands import CommandResult
from gcs_plugin.fleet.separation.returns import Returns
from gcs_plugin.fleet.separation.separation_watch import apart_text, near_text, number_name
from gcs_plugin.mission.exchange import Verdict
from gcs_plugin.mission.plan_folder import NO_NEEDS, PlanNeeds
from orthoswarm.model.errors import InputError, OrthoSwarmError
from telemetry.live.live_poses import LinkPoses

if TYPE_CHECKING:
    from gcs_plugin.fleet.commands import Verb
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.fleet.fleet_events import FleetEvent
    from gcs_plugin.fleet.vehicle_state import Vehicle
    from gcs_plugin.mission.exchange import Exchange
    from gcs_plugin.mission.items import Mission
    from telemetry.live.live_poses import LivePoses

_WATCH_S: Final = 0.5
_SOON_S: Final = 5.0
_OUTCOME_S: Final = 60.0
_TRAIL: Final = 600  # positions of a vehicle on the page
_MOST_TEXTS: Final = 50  # of a vehicle on the page
_COMPLETE_EVERY: Final = 20  # looks after which all rows are sent, not only changed ones
_FAULT: Final = 4  # MAV_SEVERITY_WARNING
_REPLACED: Final = "dropped: the vehicle is complete, its refinement takes its place"
_log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class _VehicleRecord:
    """The daemon's own data about a vehicle, besides the fleet's."""

    id: str
    poses: "LivePoses"
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
        cancel_takeoff: cancels a takeoff that waits or is being checked; returns what it did in words, or "".
        takeoffs: vehicle -> its takeoff that waits or failed, see `Takeoffs.rows`.
    """

    def __init__(
        self, settings: Settings, journal: Journal, events: Events, jobs: Jobs, poses: "LinkPoses | None" = None
    ) -> None:
        """Open the links; the vehicles' poses are stored in `poses`, by their ids.

        Raises:
            InputError: a link cannot be opened.
        """
        from gcs_plugin.fleet.fleet import Fleet
        from gcs_plugin.links.signing import find_key

        self._settings, self._events, self._jobs = settings, events, jobs
        self._missions = MissionJournal(journal)
        self._titles = {v.id: v.name for v in settings.vehicles}
        self._names = {v.system: v.id for v in settings.vehicles if v.system is not None}
        self._records: dict[int, _VehicleRecord] = {}
        self._poses = LinkPoses() if poses is None else poses
        self._stop, self._silent = threading.Event(), threading.Event()
        self.latest: list[dict[str, Any]] = []
        self.cancel_takeoff: Callable[[str], str] = lambda _: ""
        self._starting = Counter[int]()
        self.takeoffs: Callable[[], Mapping[str, dict[str, Any]]] = dict
        self.fleet: Fleet = Fleet(settings.links, key=find_key(), tlog=settings.workspace / "telemetry.tlog")
        self.fleet.on_event(self._event)
        self.fleet.subscribe(self._message)
        self._fences = Fences(self.fleet)
        self._checks = StartChecks(self.fleet, self._fences, self.name_of, lambda: self.takeoffs())
        self._returns = Returns(self.fleet, self._give, lambda row: events.publish("command", **row), self.name_of)
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

    def name_of(self, system: int) -> str:
        """The id of a vehicle with a MAVLink system id; no two have the same."""
        name = number_name(system)
        if system not in self._names and name in self._names.values():  # the name of another system id
            return f"system-{system}"
        return self._names.get(system, name)

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

    def standing(self) -> dict[str, tuple[float, float] | str]:
        """Where vehicles stand on the ground, latitude and longitude in degrees, or why that is not known, by id."""
        known: dict[str, tuple[float, float] | str] = {}
        for system, v in list(self.fleet.vehicles.items()):
            place = "no position yet" if v.lat_deg is None or v.lon_deg is None else (v.lat_deg, v.lon_deg)
            known[self.name_of(system)] = "in the air" if v.flying else place
        return known

    def autopilots(self) -> dict[str, str]:
        """The autopilot of each vehicle that was heard, by id."""
        return {self.name_of(system): v.autopilot.value for system, v in list(self.fleet.vehicles.items())}

    def rows(self) -> list[dict[str, Any]]:
        """All vehicles on the links as JSON values.

        `takeoff` of each is None where none waits or failed; `returns_after` names those that it waits for until it
        returns, None where it does not wait.
        """

        def collect() -> list[dict[str, Any]]:
            now = time.monotonic()
            return [self._row(vehicle, now) for _, vehicle in sorted(self.fleet.vehicles.items())]

        takeoffs, returns = self.takeoffs(), self._returns.waits()
        return [
            row | {"takeoff": takeoffs.get(row["id"]), "returns_after": returns.get(row["id"])}
            for row in self.fleet.call(collect).result(5.0)
        ]

    @staticmethod
    def clock() -> float:
        """Monotonic seconds, by which commands expire."""
        return time.monotonic()

    def flight_state(self, vehicle: str) -> dict[str, Any]:
        """What a vehicle is doing: `state`, `text`, `item`, `items`.

        Raises:
            OrthoSwarmError: it was not heard on any link.
        """
        from gcs_plugin.fleet.flight_state import flight_state

        known = self.fleet.vehicles[self.system_of(vehicle)]
        return self.fleet.call(lambda: flight_state(known).document()).result(_SOON_S)

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
            A row per vehicle, see the top of this module.

        Raises:
            InputError: there is no such command.
        """
        from gcs_plugin.fleet.commands import VERBS, new_id

        if verb not in VERBS:
            raise InputError(f"there is no command '{verb}'; choose {', '.join(VERBS)}")
        given, number = self.clock() if given_s is None else min(given_s, self.clock()), command_id or new_id()
        names = [self.name_of(s) for s in sorted(self.fleet.vehicles)] if vehicles is None else list(vehicles)
        for system in list(self.fleet.vehicles):
            if self.name_of(system) in names:
                self._returns.cancel(system)
        return self._give(verb, names, given, number, override or {})

    def _give(
        self,
        verb: "Verb",
        names: Collection[str],
        given: float | None = None,
        number: str | None = None,
        override: Mapping[str, Collection[str]] = MappingProxyType({}),
    ) -> list[dict[str, Any]]:
        """Give a command, see `commands`; `given` and `number`: default now, and a new one."""
        from gcs_plugin.fleet.commands import Order, new_id

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
            self.fleet.call(lambda o=order: self.fleet.order(o))  # type: ignore[misc]
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

        Args:
            command_id: id of the command; a new one by default.

        Returns:
            A row per vehicle, see the top of this module; one that holds until its turn comes has done as it was told.
        """
        from gcs_plugin.fleet.commands import new_id

        return self._returns.begin({self.name_of(s): s for s in sorted(self.fleet.vehicles)}, command_id or new_id())

    def _without_command(
        self, verb: str, names: Collection[str], number: str, override: Mapping[str, Collection[str]]
    ) -> tuple[dict[str, dict[str, Any]], dict[str, int]]:
        """The rows of vehicles that need no command, and the system ids of the others."""
        from gcs_plugin.fleet.commands import URGENT
        from gcs_plugin.fleet.preflight import CONTINUED, ITEMS

        rows: dict[str, dict[str, Any]] = {}
        systems: dict[str, int] = {}

        def end(name: str, outcome: Verdict, reason: str) -> None:
            rows[name] = CommandResult(number, name, verb, outcome, reason).document()

        for name in names:
            try:
                systems[name] = self.system_of(name)
            except OrthoSwarmError as error:
                end(name, Verdict.NOT_SENT, str(error))
                continue
            if verb in URGENT:
                self.fleet.told_to_stop(systems[name])  # first of all: it makes void what is being checked now
                checked = "its start is cancelled" if self._starting[systems[name]] else ""
                if checked:
                    self.fleet.told_to_stop(systems[name])  # again, for a check that began after the first time
                cancelled = self.cancel_takeoff(name) or checked
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

    def _checked(self, systems: Mapping[str, int]) -> list[dict[str, Any]]:
        """The check of vehicles that are to start now; a command to stop that comes meanwhile finds them starting."""
        self._starting.update(systems.values())
        try:
            return self.preflight(list(systems))
        finally:
            self._starting.subtract(systems.values())

    def preflight(
        self,
        vehicles: Collection[str] | None = None,
        missions: "Mapping[str, Mission] | None" = None,
        *,
        starts: Mapping[str, float] | None = None,
        needs: PlanNeeds = NO_NEEDS,
        reread: bool = True,
    ) -> list[dict[str, Any]]:
        """Check vehicles before their start; their missions are read from them first.

        Args:
            vehicles: their ids; None for all on the links.
            missions: the plan's mission of each, by vehicle; without it the vehicle's stored mission is flown.
            starts: takeoff of each in seconds after the first; default all at once.
            needs: of the plan.
            reread: whether missions are read although they were read or written before and nothing changed them since.

        Returns:
            A row per vehicle, see the top of this module.

        Raises:
            OrthoSwarmError: a vehicle was not heard on any link.
        """
        names = [self.name_of(s) for s in sorted(self.fleet.vehicles)] if vehicles is None else list(vehicles)
        systems = {self.system_of(name): name for name in names}
        wanted = {s: missions[name] for s, name in systems.items() if missions and name in missions}
        times = {s: starts[name] for s, name in systems.items() if starts and name in starts}
        return self._checks.check(systems, wanted, times, needs=needs, reread=reread)

    def command(self, begin: Callable[["Fleet"], "Exchange"], timeout_s: float = 180.0) -> str:
        """Run a dialogue with a vehicle to its end; returns the final text.

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

    # -- what vehicles say (in the fleet's thread) ------------------------------------------------------------------

    def _record(self, system: int) -> _VehicleRecord:
        if system not in self._records:
            name = self.name_of(system)
            self._records[system] = _VehicleRecord(id=name, poses=self._poses.of(name))
        return self._records[system]

    def _message(self, vehicle: "Vehicle", message: Any, utc: float) -> None:
        record = self._record(vehicle.system)
        record.poses.feed(message, utc)

    def _event(self, event: "FleetEvent") -> None:
        name = self.name_of(event.system)
        vehicle = self.fleet.vehicles[event.system]
        record = self._record(event.system)
        try:
            if event.kind == "found":
                self._missions.found(vehicle, name)
            elif event.kind in ("started", "complete", "aborted", "suspended", "resumed"):
                flying = [
                    self.name_of(s) for s, v in sorted(self.fleet.vehicles.items()) if s != event.system and _flies(v)
                ]
                self._missions.note(event, vehicle, name, flying)
                if event.kind == "complete":
                    self._jobs.drop("coarse", name, _REPLACED)
                self._jobs.wake()
        except OrthoSwarmError as error:  # the disk is full: flying goes on
            _log.error("%s", error)
        record.lost_since = time.monotonic() if event.kind == "lost" else None
        text, pair = self._words(event), [self.name_of(system) for system in event.pair or ()]
        about: dict[str, Any] = {"vehicle": name, "kind": event.kind, "text": text, "time": event.time_s, "pair": pair}
        if event.kind == "text":
            said = {"text": vehicle.texts[-1], "severity": event.severity, "time": round(event.time_s, 1)}
            record.texts.append(said)
            about |= {"said": said["text"], "severity": said["severity"]}
        grave = event.kind == "danger" or event.severity <= _FAULT
        if grave or event.kind != "text":
            _log.log(logging.WARNING if grave else logging.INFO, "%s", text)
        self._events.publish("vehicle_event", **about)

    def _words(self, event: "FleetEvent") -> str:
        """An event in words; one about two vehicles names them as the operator does."""
        if event.pair is None:
            return event.text
        near = self.fleet.separation.alarms.get(event.pair)
        return (
            apart_text(event.pair, self.name_of)
            if near is None
            else near_text(near, self.fleet.separation, self.name_of)
        )

    # -- what time asks for -----------------------------------------------------------------------------------------

    def _watch(self) -> None:
        number = 0
        while not self._stop.wait(_WATCH_S):
            number += 1
            try:
                self.fleet.call(self._fences.look).result(_SOON_S)
                self._publish_rows(complete=number % _COMPLETE_EVERY == 0)
                if self.traffic.changed():
                    self._events.publish("traffic", rows=self.traffic.rows())
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
            always = {key: row[key] for key in ("id", "name", "silent_s")}
            self._events.publish("vehicle", **fresh | always)

    def _give_up_silent(self) -> None:
        """Refine the incomplete sortie of a vehicle that has been silent for long during its mission."""
        for system, record in list(self._records.items()):
            vehicle = self.fleet.vehicles[system]
            since = record.lost_since
            if since is None or time.monotonic() - since < self._settings.lost_after_s or not _under_way(vehicle):
                continue
            given_up = self._missions.give_up(record.id)
            record.lost_since = None  # after that: if the disk is full, it is tried again
            if given_up:
                _log.info("%s has been silent for long; what it sent is refined", record.id)
                self._jobs.wake()

    def _row(self, vehicle: "Vehicle", now: float) -> dict[str, Any]:
        from gcs_plugin.fleet.flight_state import summary

        record = self._record(vehicle.system)
        row = summary(vehicle, now) | {"id": record.id, "name": self._titles.get(record.id, "")}
        near = self.fleet.separation.text(vehicle.system, self.name_of)
        row["alarm"] = "; ".join(text for text in (near, vehicle.danger and f"{record.id} {vehicle.danger}") if text)
        row["behind"] = self.fleet.behind(vehicle.system)
        row["yaw_deg"] = row["heading_deg"]
        if vehicle.lat_deg is not None and vehicle.lon_deg is not None:
            point = (round(vehicle.lon_deg, 7), round(vehicle.lat_deg, 7))
            if not record.trail or record.trail[-1] != point:
                record.trail.append(point)
                del record.trail[:-_TRAIL]
        row["fence"] = self._fences.of(vehicle.system)
        row["trail"], row["texts"] = record.trail[-_TRAIL:], list(record.texts)
        return row


def _under_way(vehicle: "Vehicle") -> bool:
    from gcs_plugin.mission.completion import Phase

    return vehicle.detector.phase in (Phase.ACTIVE, Phase.SUSPENDED)


def _flies(vehicle: "Vehicle") -> bool:
    from gcs_plugin.mission.completion import Phase

    return (vehicle.detector.phase is Phase.ACTIVE or vehicle.flying) and not vehicle.lost
