"""The takeoffs of a plan: one command starts all its vehicles, each at its planned time, which separates them.

A plan's vehicles share airspace: they are separated by heights and takeoff times (`start_s`). No vehicle is
started unless all have passed their preflight check; if one then refuses, the waiting ones stay on the ground.
Waiting takeoffs are dropped when the daemon ends: a start is a command and is never repeated automatically.
"""

import contextlib
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from typing import Any, Final

from gcs_plugin.config import COMMAND
from gcs_plugin.daemon.start_checks import CheckRow, red_items
from gcs_plugin.daemon.vehicles import VehicleLinks
from gcs_plugin.daemon.web_plans import Plans
from gcs_plugin.fleet.commands import Order
from gcs_plugin.fleet.separation.takeoff_schedule import TakeoffSchedule
from gcs_plugin.mission.exchange import Outcome, Verdict
from gcs_plugin.mission.items import Mission
from gcs_plugin.mission.plan_folder import NO_NEEDS
from gcs_plugin.mission.start_dialogue import Standing
from gcs_plugin.mission.track import Airspace
from orthoswarm.model.errors import InputError, OrthoSwarmError

_LOOK_S: Final = 0.05
_REMEMBERED: Final = 1000  # cancelled starts
_log = logging.getLogger(__name__)


class Takeoffs:
    """Starts the vehicles of one plan at a time."""

    def __init__(self, links: VehicleLinks, plans: Plans, say: Callable[[str], None]) -> None:
        self._links, self._plans, self._say, self.waiting = links, plans, say, links.waiting
        self._stops: dict[int, int] = {}
        self._given_s: dict[int, float] = {}
        self._standing: dict[int, Standing] = {}
        self._missions: dict[int, Mission] = {}
        self._needs = NO_NEEDS
        self._allowed: dict[str, Collection[str]] = {}
        self._cancelled: OrderedDict[str | None, None] = OrderedDict()
        self._closed = False

    def preflight(self, plan: str, sortie: int = 1, names: Mapping[str, str] | None = None) -> list[CheckRow]:
        """Check a plan's vehicles before their start.

        Args:
            plan, sortie, names: as for `begin`.

        Returns:
            A row per vehicle, as from `VehicleLinks.preflight`.

        Raises:
            InputError: there is no such plan or flight.
            OrthoSwarmError: vehicles are not heard.
        """
        return self._check(plan, sortie, names)[0]

    def _check(
        self, plan: str, sortie: int, names: Mapping[str, str] | None
    ) -> tuple[list[CheckRow], dict[str, Mission]]:
        """The rows of `preflight`, and the plan's missions by vehicle."""
        starts = self._plans.starts(plan, sortie)
        whose = {vehicle: (names or {}).get(vehicle, vehicle) for vehicle in starts}
        missions = {}
        for vehicle, name in whose.items():
            known = self._links.fleet.vehicles[self._links.fleet.system_of(name)]
            mission = vehicle if sortie == 1 else f"{vehicle}-sortie{sortie}"
            missions[name] = self._plans.mission({"plan": plan, "mission": mission}, vehicle, known.autopilot)
        times = {whose[vehicle]: start_s for vehicle, start_s in starts.items()}
        rows = self._links.preflight(list(whose.values()), missions, starts=times, needs=self._plans.needs(plan))
        return rows, missions

    def begin(
        self,
        plan: str,
        sortie: int = 1,
        names: Mapping[str, str] | None = None,
        override: Mapping[str, Collection[str]] | None = None,
        *,
        number: str | None = None,
        given_s: float | None = None,
    ) -> dict[str, float]:
        """Start a plan's vehicles; returns vehicle -> seconds from now.

        All are checked before the first takes off. If one cannot start at its time, the waiting ones stay on
        the ground, and this is reported.

        Args:
            plan: its id. sortie: which flight of each vehicle, from 1.
            names: the plan's vehicle -> the daemon's, where they differ.
            override: names of red preflight items that do not stop the start, by the daemon's vehicle.
            number: the start's id, by which it can be cancelled until the first is told to start.
            given_s: when it was given, on the clock; default now.

        Raises:
            InputError: there is no such plan or flight.
            OrthoSwarmError: vehicles are not heard, a preflight item is red, takeoffs are under way, one of the
                vehicles was told to stop meanwhile, the check took so long that the start is too old, or it is no
                longer wanted; none was started.
        """
        given = time.monotonic() if given_s is None else min(given_s, time.monotonic())
        starts = self._plans.starts(plan, sortie)
        whose = {vehicle: (names or {}).get(vehicle, vehicle) for vehicle in starts}
        with self.waiting.condition:
            if self.waiting.are_under_way:
                raise OrthoSwarmError("other takeoffs are under way; pause or rtl a waiting vehicle to cancel its own")
            with _none_started():
                systems = {vehicle: self._links.fleet.system_of(name) for vehicle, name in whose.items()}
            self.waiting.checking, stops = frozenset(systems.values()), dict(self._links.fleet.stops)
            standing = {s: self._links.fleet.vehicles[s].standing for s in systems.values()}
        try:
            with _none_started():
                missions = self._ready(plan, sortie, names, override or {})
            first = min(starts.values())
            delays = {systems[vehicle]: start_s - first for vehicle, start_s in starts.items()}
            held = {s: self._links.fleet.vehicles[s].mission for s in delays}
            schedule = TakeoffSchedule.of(delays, time.monotonic())
            needs = self._plans.needs(plan)
            with self.waiting.condition:
                if number in self._cancelled:
                    raise OrthoSwarmError("the start was cancelled; no vehicle was started")
                self._still_wanted(given, stops)
                self.waiting.failed.clear()
                self._standing = standing
                self._stops, self._given_s = stops, {s: given for s, delay in delays.items() if delay <= 0.0}
                self.waiting.vehicles = {systems[vehicle]: whose[vehicle] for vehicle in starts}
                self._needs = needs
                self._missions = {system: missions[self.waiting.vehicles[system]] for system in systems.values()}
                self._allowed = dict(override or {})
                self.waiting.schedule, self.waiting.checking = schedule, frozenset()
        finally:
            self.waiting.checking = frozenset()
        threading.Thread(target=self._run, name="takeoffs", daemon=True).start()
        known = {s: mission for s, mission in held.items() if mission is not None}
        threading.Thread(target=self._follow, args=(schedule, known, delays), daemon=True).start()
        return {whose[vehicle]: round(start_s - first, 1) for vehicle, start_s in starts.items()}

    def cancel(self, number: str) -> None:
        """Have no vehicle started by a start with this id that is still being checked, or that has not come yet."""
        self._cancelled[number] = None
        while len(self._cancelled) > _REMEMBERED:
            self._cancelled.popitem(last=False)

    def close(self) -> None:
        """Cancel all waiting takeoffs."""
        with self.waiting.condition:
            self._closed = True
            self.waiting.schedule.waiting.clear()
            self.waiting.condition.notify_all()

    def _still_wanted(self, given_s: float, stops: Mapping[int, int]) -> None:
        """Make sure that nobody told a vehicle to stop during the check, and that this did not take too long."""
        told = [s for s in sorted(self.waiting.checking) if self._links.fleet.stops.get(s, 0) != stops.get(s, 0)]
        if told:
            who = ", ".join(self._links.names.name_of(system) for system in told)
            raise OrthoSwarmError(f"{who} was told to stop during the check; no vehicle was started")
        age_s = time.monotonic() - given_s
        if age_s > COMMAND.fresh_s:
            raise OrthoSwarmError(
                f"the check took until {age_s:.0f} s after the start was given, so no vehicle was started; give it"
                f" again (missions read within {COMMAND.read_kept_s:.0f} s are not read again)"
            )

    def _ready(
        self, plan: str, sortie: int, names: Mapping[str, str] | None, override: Mapping[str, Collection[str]]
    ) -> dict[str, Mission]:
        """Check the plan's vehicles; returns its missions by vehicle; raises OrthoSwarmError: not all have passed."""
        rows, missions = self._check(plan, sortie, names)
        wrong = [
            f"{row['vehicle']}: {text}" for row in rows for text in red_items(row, override.get(row["vehicle"], ()))
        ]
        if wrong:
            raise OrthoSwarmError("; ".join(wrong))
        return missions

    def _follow(self, schedule: TakeoffSchedule, missions: Mapping[int, Mission], delays: Mapping[int, float]) -> None:
        """Give a schedule the airspace by which it moves takeoffs; beside it, as many vehicles take seconds."""
        airspace = Airspace.of(missions, needs=self._needs).as_planned(delays)
        with self.waiting.condition:
            schedule.airspace = airspace

    def _run(self) -> None:
        """Start each at its time; ends with the last."""
        while True:
            with self.waiting.condition:
                due = self.waiting.schedule.next_s()
                if due is None:
                    return
                if due > time.monotonic():
                    self.waiting.condition.wait(due - time.monotonic())
                    continue
                ready = self.waiting.schedule.due(time.monotonic())
                self.waiting.about_to.update(ready)
                if not ready:  # an earlier start is still undecided
                    self.waiting.condition.wait(_LOOK_S)
            for system in ready:
                threading.Thread(target=self._start, args=(self.waiting.vehicles[system], system), daemon=True).start()

    def _start(self, vehicle: str, system: int) -> None:
        """Start one vehicle; if that fails, the waiting ones stay on the ground."""
        stops, given_s = self._stops.get(system, 0), self._given_s.get(system)
        try:
            red = self._red_now(vehicle, system)
            # A later one is given by its planned time: it has just been checked again.
            order = Order(verb="start", system=system, given_s=time.monotonic() if given_s is None else given_s)
            order.stops, order.standing, order.mission = stops, self._standing[system], self._missions[system]
            if red:
                order.end(f"{vehicle} was not started: {red}", Verdict.NOT_SENT)
            else:
                self._links.fleet.call(partial(self._order, order))
            while order.outcome is None and not self._closed:
                time.sleep(_LOOK_S)
        except Exception as error:  # the links are being closed, or do not answer: nobody else takes off then
            if not self._closed:
                _log.error("starting %s", vehicle, exc_info=error)
                self._note(vehicle, system, Outcome(ok=False, text=f"{vehicle} could not be checked and started"))
            return
        finally:
            self.waiting.about_to.discard(system)
        if order.outcome is not None and not self._closed:
            self._note(vehicle, system, order.outcome, order.begun_s)

    def _order(self, order: Order) -> None:
        """Send a start; in the fleet's thread, so that nobody finds it neither about to start nor under way."""
        self.waiting.about_to.discard(order.system)
        self._links.fleet.order(order)

    def _red_now(self, vehicle: str, system: int) -> str:
        """What is red of a vehicle whose time to take off has come, in words; its check may be minutes old.

        Its distances to others are the schedule's.
        """
        mission = self._missions[system]
        (row,) = self._links.preflight([vehicle], {vehicle: mission}, reread=False, needs=self._needs)
        return "; ".join(red_items(row, {*self._allowed.get(vehicle, ()), "separation"}))

    def _note(self, vehicle: str, system: int, outcome: Outcome, begun_s: float | None = None) -> None:
        """Apply the outcome of one start to the waiting ones."""
        with self.waiting.condition:
            if outcome.ok:
                said = self.waiting.schedule.started(
                    system, time.monotonic(), self.waiting.vehicles.__getitem__, begun_s
                )
            else:
                self.waiting.failed[vehicle] = outcome.text
                held = [self.waiting.vehicles[waiter] for waiter in self.waiting.schedule.failed(system)]
                for name in held:
                    self.waiting.failed[name] = f"held on the ground, because {vehicle} did not take off"
                also = f"; {', '.join(held)} stay on the ground" if held else ""
                said = [f"{vehicle} did not take off: {outcome.text}{also}"]
            self.waiting.condition.notify_all()
        for text in said:
            self._say(text)


@contextlib.contextmanager
def _none_started() -> Iterator[None]:
    """Say of what keeps a start back that no vehicle was started; a wrong request is told as it is."""
    try:
        yield
    except InputError:
        raise
    except OrthoSwarmError as error:
        raise OrthoSwarmError(f"{error}; no vehicle was started") from None


def names_of(body: Mapping[str, Any]) -> tuple[int, dict[str, str]]:
    """The flight's number and the vehicles' names in a request; raises InputError: they are invalid."""
    sortie, names = body.get("sortie", 1), body.get("vehicles", {})
    if isinstance(sortie, bool) or not isinstance(sortie, int) or sortie < 1:
        raise InputError("sortie is not a number from 1; send one, or nothing for the first")
    if not isinstance(names, dict) or not all(isinstance(name, str) for name in names.values()):
        raise InputError('vehicles does not name vehicles; send for example {"v1": "alpha"}, or nothing')
    return sortie, names
