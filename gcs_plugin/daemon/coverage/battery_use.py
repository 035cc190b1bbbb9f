"""How long vehicles can still fly: by their battery, and by what their flight so far has cost."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

_LEAST_DROP: Final = 0.03
_LEAST_S: Final = 60.0
_SWAPPED: Final = 0.05


@dataclass(slots=True)
class _Flight:
    """A vehicle's flight: when it was first seen in the air and with how much, and what is left now (shares)."""

    begun_s: float
    begun_with: float
    left: float
    rate: float | None = None


class BatteryUse:
    """Follows batteries; only a drop of 3 % over a minute in the air tells what flying costs."""

    def __init__(self) -> None:
        self._flights: dict[str, _Flight] = {}

    def look(self, row: Mapping[str, Any], flies: bool, now_s: float) -> None:
        """Take what a vehicle's link says, at a moment of any clock in seconds."""
        vehicle, battery = str(row["id"]), row.get("battery")
        if battery is None:
            return
        flight = self._flights.get(vehicle)
        if flight is None:
            self._flights[vehicle] = _Flight(now_s, battery, battery)
            return
        if battery > flight.left + _SWAPPED or not flies:
            flight.begun_s, flight.begun_with = now_s, battery  # what flying cost before still holds
        flight.left = battery
        spent, took = flight.begun_with - battery, now_s - flight.begun_s
        if spent >= _LEAST_DROP and took >= _LEAST_S:
            flight.rate = spent / took

    def left(self, vehicle: str) -> float | None:
        """What is left of a vehicle's battery, 0 to 1; None where it does not say."""
        flight = self._flights.get(vehicle)
        return None if flight is None else flight.left

    def seconds(self, vehicle: str, reserve: float) -> float | None:
        """How long it can fly until a share is left, by what its flight so far cost; None where that is not known."""
        flight = self._flights.get(vehicle)
        if flight is None or flight.rate is None:
            return None
        return max(0.0, flight.left - reserve) / flight.rate
