"""The takeoffs that wait for their time or are being checked, and why others have failed; what cancels one."""

import threading
import time
from typing import TYPE_CHECKING

from gcs_plugin.daemon.vehicle_names import TakeoffRow, VehicleNames
from gcs_plugin.fleet.separation.takeoff_schedule import TakeoffSchedule

if TYPE_CHECKING:
    from gcs_plugin.fleet.fleet import Fleet


class WaitingTakeoffs:
    """What `Takeoffs` starts one after the other, and commands to stop cancel.

    Attributes:
        condition: to be held while the others are changed; notified of every change.
        schedule: the times of those that wait. vehicles: ids of its vehicles by their system ids.
        failed: vehicle -> why it did not take off. checking: those whose check before the start is under way.
        about_to: those whose time has come, until their start is sent.
    """

    def __init__(self, fleet: "Fleet", names: VehicleNames) -> None:
        self._fleet, self._names = fleet, names
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

    def is_due(self, system: int) -> bool:
        """Whether a vehicle's takeoff waits or is being checked. Without the lock: the fleet's thread never waits."""
        return system in self.checking or system in self.schedule.waiting or system in self.about_to

    def rows(self) -> dict[str, TakeoffRow]:
        """Vehicle -> its takeoff that waits or has failed."""
        now = time.monotonic()
        with self.condition:
            times = self.schedule.waiting.items()
            rows: dict[str, TakeoffRow] = {v: {"failed": text} for v, text in self.failed.items()}
            return rows | {self.vehicles[s]: {"in_s": round(max(0.0, due - now), 1)} for s, due in times}

    def cancel(self, vehicle: str) -> str:
        """Cancel a takeoff that waits or is being checked; returns that in words, empty if there was none.

        `Fleet.told_to_stop` makes a start void that is being checked or about to be sent; it is told here again, since
        a start whose check began after the first time would not see that.
        """
        with self.condition:
            system = next((s for s in self.checking if self._names.name_of(s) == vehicle), None)
            if system is not None:
                self._fleet.told_to_stop(system)
                return "the start that was being checked is cancelled"
            system = next((s for s, name in self.vehicles.items() if name == vehicle), None)
            if system is not None and system in self.about_to:
                self._fleet.told_to_stop(system)
                return "its start, which was due now, is cancelled"
            due = None if system is None else self.schedule.waiting.pop(system, None)
            self.condition.notify_all()
        return "" if due is None else f"its takeoff in {max(0.0, due - time.monotonic()):.0f} s is cancelled"
