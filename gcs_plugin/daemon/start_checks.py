"""The check before a start with what the daemon knows, and the takeoffs that wait. Missions are read for the check.

A mission that was read a moment ago is not read again as long as the vehicle's messages show no change of it. So a
start can follow its check at once on a slow link too, where reading alone takes longer than a command stays valid.
"""

import threading
import time
from collections.abc import Collection, Mapping
from functools import partial
from typing import Final, TypedDict, cast

from gcs_plugin.config import COMMAND
from gcs_plugin.daemon.airspace import Fences
from gcs_plugin.daemon.vehicle_names import TakeoffRow
from gcs_plugin.fleet.fleet import Fleet
from gcs_plugin.fleet.preflight import preflight_all
from gcs_plugin.fleet.separation.separation_check import SeparationFindings, flights_of, others_of, separation_of
from gcs_plugin.fleet.separation.separation_watch import VehicleNames
from gcs_plugin.fleet.separation.takeoff_schedule import TakeoffSchedule
from gcs_plugin.mission.items import Mission
from gcs_plugin.mission.plan_folder import NO_NEEDS, PlanNeeds


class WaitingTakeoffs:
    """What `Takeoffs` starts one after the other, and commands to stop cancel.

    Attributes:
        condition: to be held while the others are changed; notified of every change.
        schedule: the times of those that wait. vehicles: ids of its vehicles by their system ids.
        failed: vehicle -> why it did not take off. checking: those whose check before the start is under way.
        about_to: those whose time has come, until their start is sent.
    """

    def __init__(self, names: VehicleNames) -> None:
        self._names = names
        self.condition = threading.Condition()
        self.schedule = TakeoffSchedule.of({}, time.monotonic())
        self.vehicles: dict[int, str] = {}
        self.failed: dict[str, str] = {}
        self.checking: frozenset[int] = frozenset()
        self.about_to: set[int] = set()

    @property
    def are_under_way(self) -> bool:
        """Whether any waits, is being checked or about to begin; the lock is held."""
        return bool(self.schedule.waiting or self.checking or self.about_to)

    def __contains__(self, system: object) -> bool:
        """Whether a vehicle's takeoff waits or is being checked. Without the lock: the fleet's thread never waits."""
        return system in self.checking or system in self.schedule.waiting or system in self.about_to

    def rows(self) -> dict[str, TakeoffRow]:
        """Vehicle -> its takeoff that waits or has failed."""
        now = time.monotonic()
        with self.condition:
            times = self.schedule.waiting.items()
            rows: dict[str, TakeoffRow] = {v: {"failed": text} for v, text in self.failed.items()}
            return rows | {self.vehicles[s]: {"in_s": round(max(0.0, due - now), 1)} for s, due in times}

    def cancel(self, vehicle: str, fleet: Fleet) -> str:
        """Cancel a takeoff that waits or is being checked; returns that in words, empty if there was none.

        `Fleet.told_to_stop` makes a start void that is being checked or about to be sent; it is told here again, since
        a start whose check began after the first time would not see that.
        """
        with self.condition:
            system = next((s for s in self.checking if self._names.name_of(s) == vehicle), None)
            if system is not None:
                fleet.told_to_stop(system)
                return "the start that was being checked is cancelled"
            system = next((s for s, name in self.vehicles.items() if name == vehicle), None)
            if system is not None and system in self.about_to:
                fleet.told_to_stop(system)
                return "its start, which was due now, is cancelled"
            due = None if system is None else self.schedule.waiting.pop(system, None)
            self.condition.notify_all()
        return "" if due is None else f"its takeoff in {max(0.0, due - time.monotonic()):.0f} s is cancelled"


_SOON_S: Final = 5.0
_READ_S: Final = 20.0
_CHECK_S: Final = 20.0
_SETTINGS_S: Final = 5.0  # they are asked for thrice in less


class CheckRow(TypedDict):
    """The check of a vehicle; a red item stops its start unless it is overridden by its name.

    `items`: each with `name` (of `fleet.preflight.ITEMS`), `state` (ok, warning, red) and `reason`.
    """

    vehicle: str
    state: str
    items: list[dict[str, str]]


def red_items(row: CheckRow, allowed: Collection[str]) -> list[str]:
    """The red items of a vehicle's row that are not allowed by name, in words."""
    red = [item for item in row["items"] if item["state"] == "red" and item["name"] not in allowed]
    return [f"{item['name']}: {item['reason']}" for item in red]


class StartChecks:
    """Checks vehicles before their start."""

    def __init__(self, fleet: Fleet, fences: Fences, names: VehicleNames, waiting: WaitingTakeoffs) -> None:
        self._fleet, self._fences, self._names, self._waiting = fleet, fences, names, waiting

    def check(
        self,
        systems: Mapping[int, str],
        missions: Mapping[int, Mission],
        starts: Mapping[int, float],
        *,
        needs: PlanNeeds = NO_NEEDS,
        reread: bool = True,
    ) -> list[CheckRow]:
        """Check vehicles that are to start together; waits for their missions.

        Args:
            systems: their names by system id. missions: the plan's. starts: takeoffs in seconds after the first.
            needs: of the plan.
            reread: whether missions that are known and did not change are read all the same.
        """
        stored = self._missions(systems, reread=reread)
        if reread:
            self._hear_settings(systems)
        separation = SeparationFindings()
        if reread:  # it is a schedule's, otherwise
            first = min(starts.values(), default=0.0)
            after_s = {s: at - first for s, at in starts.items()}
            separation = self._separation(systems, missions, stored, after_s, needs=needs)
        checks = self._fleet.call(
            lambda: preflight_all(
                {s: self._fleet.vehicles[s] for s in systems},
                missions,
                stored,
                starts,
                time.monotonic(),
                needs=needs,
                names=self._names,
                separation=separation,
                zones=self._fences.zones(),
                reading=[s for s in systems if self._fleet.reads(s)],
            )
        ).result(_CHECK_S)
        return [cast(CheckRow, check.document(systems[check.system])) for check in checks]

    def _hear_settings(self, systems: Collection[int]) -> None:
        """Wait for the settings, asked for again where not told: a lost packet must not let a vehicle start."""
        vehicles = {s: self._fleet.vehicles[s] for s in systems}
        again = [s for s, v in vehicles.items() if not v.lost and not v.answers_settings and v.untold]
        for asked in [self._fleet.call(partial(self._fleet.ask_settings, system)) for system in again]:
            asked.result(_SOON_S)
        end = time.monotonic() + _SETTINGS_S
        while any(v.answers_settings for v in vehicles.values() if not v.lost) and time.monotonic() < end:
            time.sleep(0.02)

    def _separation(
        self,
        systems: Collection[int],
        missions: Mapping[int, Mission],
        stored: Mapping[int, Mission],
        starts: Mapping[int, float],
        *,
        needs: PlanNeeds,
    ) -> SeparationFindings:
        """How they keep apart from each other and from others, found in this thread: the links' must not wait."""
        rows = self._waiting.rows()
        waits = {
            s: rows[n]["in_s"]
            for s in list(self._fleet.vehicles)
            if "in_s" in rows.get(n := self._names.name_of(s), ())
        }
        flights = self._fleet.call(
            lambda: (
                others_of({s: v for s, v in self._fleet.vehicles.items() if s not in systems}, waits)
                | flights_of({s: self._fleet.vehicles[s] for s in systems}, missions, stored, starts)
            )
        ).result(_CHECK_S)
        return separation_of(flights, self._names, needs)

    def _missions(self, systems: Collection[int], *, reread: bool) -> dict[int, Mission]:
        """The missions that vehicles hold, read again where that was long ago; of those that answer in time.

        One that is being read anyway, as after an upload, is waited for too.
        """
        vehicles, now = {s: self._fleet.vehicles[s] for s in systems}, time.monotonic()
        old = [s for s, v in vehicles.items() if v.mission is None or now - v.read_s > COMMAND.read_kept_s]
        for begun in [self._fleet.call(partial(self._fleet.read_mission, s)) for s in old if reread]:
            begun.result(_SOON_S)
        while any(self._fleet.reads(s) for s in systems) and time.monotonic() < now + _READ_S:
            time.sleep(0.02)
        return {s: v.mission for s, v in vehicles.items() if v.mission is not None and not self._fleet.reads(s)}
