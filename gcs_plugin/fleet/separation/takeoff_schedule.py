"""Takeoff times of a plan, and their changes if a vehicle cannot keep its own.

Vehicles of one plan share airspace and keep apart by their times. One that does not take off holds those that still
wait on the ground; one that took off late moves them to the next times that keep every pair apart by the plan's own
measure (`Airspace`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from gcs_plugin.config import COMMAND
from gcs_plugin.mission.track import Airspace

_MOVED_S: Final = 0.5


@dataclass(slots=True)
class TakeoffSchedule:
    """Takeoffs under way: start times of the waiting and of the flying vehicles, on the caller's clock.

    Attributes:
        airspace: their missions; None where they are not known, then times are only kept, not moved.
    """

    waiting: dict[int, float]
    airspace: Airspace | None = None
    flown: dict[int, float] = field(default_factory=dict)
    _planned: dict[int, float] = field(default_factory=dict)
    _undecided: dict[int, float] = field(default_factory=dict)

    @classmethod
    def of(cls, delays: Mapping[int, float], now: float, airspace: Airspace | None = None) -> "TakeoffSchedule":
        """Starts so many seconds from now, by system id."""
        waiting = {system: now + delay for system, delay in delays.items()}
        return cls(waiting, airspace and airspace.as_planned(delays), {}, dict(waiting), {})

    def due(self, now: float) -> list[int]:
        """Vehicles that are due, with no earlier start undecided; they are no longer waiting."""
        ready = sorted((s for s, at in self.waiting.items() if at <= now), key=lambda s: self.waiting[s])
        begun: list[int] = []
        for system in ready:
            if any(at < self.waiting[system] for at in self._undecided.values()):
                break
            self._undecided[system] = self.waiting.pop(system)
            begun.append(system)
        return begun

    def next_s(self) -> float | None:
        """When the next one starts, None if none waits."""
        return min(self.waiting.values(), default=None)

    def started(self, system: int, now: float, name: Callable[[int], str], begun: float | None = None) -> list[str]:
        """A vehicle has taken off; returns the changes for others, in words.

        `begun`: when it began its mission, which is earlier, by its climb; default now.
        """
        begun = now if begun is None else begun
        self._undecided.pop(system, None)
        planned = self._planned.get(system, begun)
        late = begun - planned
        self.flown[system] = begun if late > COMMAND.takeoff_late_s else planned
        if late <= COMMAND.takeoff_late_s:
            return []
        said = [f"{name(system)} took off {late:.0f} s late"]
        if self.airspace is None:
            return said
        for one, two, at, metres in self.airspace.conflicts(self.flown):
            if system in (one, two):  # others that meet were told when the later one of them started
                both = f"{name(system)} may come within {metres:.0f} m of {name(two if system == one else one)}"
                said.append(f"{both} in {max(0.0, at - now):.0f} s: pause one of them")
        for waiter in sorted(self.waiting, key=lambda s: self.waiting[s]):
            others = {**self.flown, **{s: at for s, at in self.waiting.items() if at < self.waiting[waiter]}}
            start = self.airspace.next_start(waiter, max(now, self.waiting[waiter]), others)
            if start > self.waiting[waiter] + _MOVED_S:
                later = start - self.waiting[waiter]
                said.append(f"{name(waiter)} takes off {later:.0f} s later, to keep apart from others")
                self.waiting[waiter] = start
        return said

    def failed(self, system: int) -> list[int]:
        """A vehicle did not take off; returns the waiting ones, which now stay on the ground."""
        self._undecided.pop(system, None)
        held = sorted(self.waiting)
        self.waiting.clear()
        return held
