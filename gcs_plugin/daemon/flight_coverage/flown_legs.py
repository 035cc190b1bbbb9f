"""Which legs of a plan are finished, from the vehicles' positions on their links or in their pictures."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gcs_plugin.daemon.flight_coverage.planned_area import PlannedLegs
from gcs_plugin.daemon.vehicle_names import VehicleRow

Array = NDArray[np.float64]
_LEAST_REACH_M: Final = 12.0
_ARRIVED_M: Final = 3.0
"""A vehicle so near the end of a leg has flown it, though it waits there."""
_IDLE_S: Final = 60.0
_MISSION_OVER: Final = ("complete", "aborted")


@dataclass(kw_only=True)
class FlownLegs:
    """Tracks vehicles along the legs of a plan.

    A leg is over once a vehicle has flown along it from end to end (it may wait there), or the vehicle that is to fly
    it has ended that flight. When nobody flies and no picture has come for a minute, all that was not seen is missed.

    Attributes:
        legs: of the plan. reach_m: largest cross-track distance of a vehicle on a leg.
        ahead_m: how far from a leg's ends the first and last position may be; at least a picture spacing where only
            pictures give positions.
        flown: bool (n,), legs flown from end to end.
        flights: vehicle -> number of flights begun. down: vehicles that have left their mission or are
            lost. grounded: those of them that have landed since.
    """

    legs: PlannedLegs
    reach_m: float
    ahead_m: float
    flown: NDArray[np.bool_] = field(init=False)
    flights: dict[str, int] = field(default_factory=dict)
    down: set[str] = field(default_factory=set)
    grounded: set[str] = field(default_factory=set)
    _along: dict[str, Array] = field(default_factory=dict)
    _last_picture_s: float | None = None

    def __post_init__(self) -> None:
        self.flown = np.zeros(len(self.legs.vehicles), bool)
        self._reach, self._ahead = max(_LEAST_REACH_M, self.reach_m), max(_LEAST_REACH_M, self.ahead_m)
        step = self.legs.ends[:, 1] - self.legs.ends[:, 0]
        self._length = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
        self._way = step / self._length[:, None]

    def state(self) -> dict[str, Any]:
        """The state to be stored for a restart, as JSON values."""
        return {
            "flown": np.nonzero(self.flown)[0].tolist(), "flights": dict(self.flights), "down": sorted(self.down),
            "grounded": sorted(self.grounded),
        }  # fmt: skip

    def resume(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state` of the same plan."""
        self.flown[state["flown"]] = True
        self.flights, self.down = dict(state["flights"]), set(state["down"])
        self.grounded = set(state["grounded"])

    @property
    def over(self) -> NDArray[np.bool_]:
        """Finished legs, bool (n,): flown, or part of a flight that has ended."""
        ended = [
            self.flights.get(v, 0) >= s + (v not in self.down)
            for v, s in zip(self.legs.vehicles, self.legs.sorties.tolist(), strict=True)
        ]
        return np.asarray(self.flown | np.array(ended, bool))

    def pass_by(self, vehicle: str, east: float, north: float) -> None:
        """Process a vehicle's position, grid metres; call in the order of time."""
        if not len(self.flown):
            return
        away = np.array([east, north]) - self.legs.ends[:, 0]
        along = (away * self._way).sum(1)
        across = np.abs(away[:, 0] * self._way[:, 1] - away[:, 1] * self._way[:, 0])
        on = (across < self._reach) & (along > -self._ahead) & (along < self._length + self._ahead)
        seen = self._along.setdefault(vehicle, np.stack([np.full(len(on), np.inf), np.full(len(on), -np.inf)]))
        through = (seen[0] < self._ahead) & (seen[1] > self._length - self._ahead)
        self.flown |= through & (~on | (along > self._length - _ARRIVED_M))
        seen[0] = np.where(on, np.minimum(seen[0], along), np.inf)
        seen[1] = np.where(on, np.maximum(seen[1], along), -np.inf)

    def picture_came(self, time_s: float) -> None:
        """Record the arrival of a picture, UTC epoch seconds."""
        self._last_picture_s = time_s

    def look(self, rows: list[VehicleRow]) -> None:
        """Process the vehicles' states (`VehicleLinks.rows`)."""
        for row in rows:
            vehicle = str(row["id"])
            if flies(row):
                if vehicle not in self.flights or vehicle in self.grounded:
                    self.flights[vehicle] = self.flights.get(vehicle, 0) + 1
                self.down.discard(vehicle)
                self.grounded.discard(vehicle)
            elif vehicle in self.flights:
                self.down.add(vehicle)
                if row["state"] != "lost" and not row["armed"]:
                    self.grounded.add(vehicle)

    def all_over(self, rows: list[VehicleRow], now_s: float) -> bool:
        """Whether the operation is over: nobody flies, and all legs are finished or no picture came for a minute."""
        if self._last_picture_s is None or any(flies(row) for row in rows):
            return False
        return now_s - self._last_picture_s > _IDLE_S or (len(self.flown) > 0 and bool(self.over.all()))

    def remaining(self) -> dict[str, list[int]]:
        """Vehicle that has left its mission or is lost -> its legs of begun flights that are not flown."""
        return {
            vehicle: [
                k
                for k, v in enumerate(self.legs.vehicles)
                if v == vehicle and self.legs.sorties[k] <= count and not self.flown[k]
            ]
            for vehicle, count in self.flights.items()
            if vehicle in self.down
        }


def flies(row: VehicleRow) -> bool:
    """Whether a vehicle is on a mission that continues."""
    if row["state"] == "lost" or row["mission"]["phase"] in _MISSION_OVER:
        return False
    return bool(row["armed"]) and row["flight"]["state"] not in (
        "on ground",
        "returning",
        "landing",
        "lost",
        "complete",
    )
