"""The takeoffs of a plan: one command starts all its vehicles, each at the plan's time, which keeps them apart.

A plan's vehicles share airspace: they stay apart by heights and by the times of their takeoffs (`start_s`). Nobody is
started unless all are heard and hold their missions of this plan; one that then refuses leaves the others where the
plan has them. What waits is forgotten when the daemon ends: a start is a command, and is not repeated by itself.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

from gcs_plugin.daemon.vehicles import Flock
from gcs_plugin.daemon.web_plans import Plans
from orthoswarm.model.errors import InputError, OrthoSwarmError

_AT_ONCE: Final = 16
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Takeoff:
    system: int
    due: float


class Takeoffs:
    """Starts the vehicles of one plan at a time.

    Args:
        flock: the vehicles. plans: of the workspace. say: told what went wrong. clock: monotonic seconds.
    """

    def __init__(
        self, flock: Flock, plans: Plans, say: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._flock, self._plans, self._say, self._clock = flock, plans, say, clock
        self._condition = threading.Condition()
        self._waiting: dict[str, _Takeoff] = {}
        self._failed: dict[str, str] = {}
        self._checking = self._closed = False

    def begin(self, plan: str, sortie: int = 1, names: Mapping[str, str] | None = None) -> dict[str, float]:
        """Start a plan's vehicles; gives vehicle -> seconds from now.

        Args:
            plan: its id. sortie: which flight of each vehicle, from 1.
            names: the plan's vehicle -> the daemon's, where they differ.

        Raises:
            InputError: there is no such plan or flight.
            OrthoSwarmError: vehicles are not heard, or do not hold their mission, or takeoffs are under way; nobody
                was started.
        """
        starts = self._plans.starts(plan, sortie)
        with self._condition:
            if self._waiting or self._checking:
                raise OrthoSwarmError("other takeoffs are under way; pause or rtl a waiting vehicle to cancel its own")
            self._checking = True
        try:
            whose = {vehicle: (names or {}).get(vehicle, vehicle) for vehicle in starts}
            systems = self._ready(plan, sortie, whose)
            first, now = min(starts.values()), self._clock()
            with self._condition:
                self._failed.clear()
                for vehicle, start_s in starts.items():
                    self._waiting[whose[vehicle]] = _Takeoff(systems[vehicle], now + start_s - first)
        finally:
            self._checking = False
        threading.Thread(target=self._run, name="takeoffs", daemon=True).start()
        return {whose[vehicle]: round(start_s - first, 1) for vehicle, start_s in starts.items()}

    def cancel(self, vehicle: str) -> float | None:
        """Forget a takeoff that waits; gives in how many seconds it would have been, None if there was none."""
        with self._condition:
            takeoff = self._waiting.pop(vehicle, None)
            self._condition.notify_all()
        return None if takeoff is None else max(0.0, takeoff.due - self._clock())

    def rows(self) -> dict[str, dict[str, Any]]:
        """Vehicle -> `in_s` of a takeoff that waits, or `failed` with the reason."""
        now = self._clock()
        with self._condition:
            waiting = {v: {"in_s": round(max(0.0, t.due - now), 1)} for v, t in self._waiting.items()}
            return {v: {"failed": text} for v, text in self._failed.items()} | waiting

    def close(self) -> None:
        """Forget all that wait."""
        with self._condition:
            self._closed = True
            self._waiting.clear()
            self._condition.notify_all()

    def _ready(self, plan: str, sortie: int, whose: Mapping[str, str]) -> dict[str, int]:
        """The plan's vehicles' system ids, once all hold their missions."""
        try:
            systems = {vehicle: self._flock.system_of(name) for vehicle, name in whose.items()}
        except OrthoSwarmError as error:
            raise OrthoSwarmError(f"{error}; nobody was started") from None

        def check(vehicle: str) -> str | None:
            system = systems[vehicle]
            known = self._flock.fleet.vehicles[system]
            if known.lost:
                return f"{whose[vehicle]} is silent"
            name = vehicle if sortie == 1 else f"{vehicle}-sortie{sortie}"
            try:
                mission = self._plans.mission({"plan": plan, "mission": name}, vehicle, known.autopilot)
                found = self._flock.unlike(system, mission)
            except OrthoSwarmError as error:
                return str(error)
            return None if found is None else f"{whose[vehicle]} does not hold its mission of this plan ({found})"

        with ThreadPoolExecutor(_AT_ONCE) as pool:
            wrong = [text for text in pool.map(check, whose) if text is not None]
        if wrong:
            raise OrthoSwarmError(f"{'; '.join(wrong)}; nobody was started, upload the plan first")
        return systems

    def _run(self) -> None:
        """Start each at its time; ends with the last."""
        while True:
            with self._condition:
                if not self._waiting:
                    return
                vehicle = min(self._waiting, key=lambda name: self._waiting[name].due)
                takeoff = self._waiting[vehicle]
                if takeoff.due > self._clock():
                    self._condition.wait(takeoff.due - self._clock())
                    continue
                del self._waiting[vehicle]
            threading.Thread(target=self._start, args=(vehicle, takeoff.system), daemon=True).start()

    def _start(self, vehicle: str, system: int) -> None:
        try:
            self._flock.command(lambda fleet: fleet.start(system))
        except OrthoSwarmError as error:
            if self._closed:
                return
            with self._condition:
                self._failed[vehicle] = str(error)
            self._say(f"{vehicle} did not take off: {error}")
        except Exception as error:  # the links are being closed
            if not self._closed:
                _log.error("starting %s", vehicle, exc_info=error)


def names_of(body: Mapping[str, Any]) -> tuple[int, dict[str, str]]:
    """The flight's number and the vehicles' names in a request.

    Raises:
        InputError: they are not what they should be.
    """
    sortie, names = body.get("sortie", 1), body.get("vehicles", {})
    if isinstance(sortie, bool) or not isinstance(sortie, int) or sortie < 1:
        raise InputError("sortie is no number from 1; send one, or nothing for the first")
    if not isinstance(names, dict) or not all(isinstance(name, str) for name in names.values()):
        raise InputError('vehicles does not name vehicles; send for example {"v1": "alpha"}, or nothing')
    return sortie, names
