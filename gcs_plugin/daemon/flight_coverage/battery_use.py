"""Remaining flight time of vehicles, from their battery level and its use so far."""

from dataclasses import dataclass
from typing import Final

from gcs_plugin.daemon.vehicle_names import VehicleRow

_LEAST_DROP: Final = 0.03  # share of the battery after which its use is known
_LEAST_S: Final = 60.0  # of flight for that
_SWAPPED: Final = 0.05  # a charge that rises by this share is another battery


@dataclass(slots=True)
class _Flight:
    """A vehicle's flight: time and battery level when first seen in the air, and the present level (shares)."""

    begun_s: float
    begun_with: float
    left: float
    rate: float | None = None


class BatteryUse:
    """Tracks batteries; the rate is known once the level dropped by 3 % over at least a minute in the air."""

    def __init__(self) -> None:
        self._flights: dict[str, _Flight] = {}

    def look(self, row: VehicleRow, flies: bool, now_s: float) -> None:
        """Process a vehicle's state from its link, at a time of any clock in seconds."""
        vehicle, battery = row["id"], row.get("battery")
        if battery is None:
            return
        flight = self._flights.get(vehicle)
        if flight is None:
            self._flights[vehicle] = _Flight(now_s, battery, battery)
            return
        if battery > flight.left + _SWAPPED or not flies:
            flight.begun_s, flight.begun_with = now_s, battery  # the rate found before remains valid
        flight.left = battery
        spent, took = flight.begun_with - battery, now_s - flight.begun_s
        if spent >= _LEAST_DROP and took >= _LEAST_S:
            flight.rate = spent / took

    def left(self, vehicle: str) -> float | None:
        """Battery level of a vehicle, 0 to 1; None if it is not reported."""
        flight = self._flights.get(vehicle)
        return None if flight is None else flight.left

    def seconds(self, vehicle: str, reserve: float) -> float | None:
        """Flight time in seconds until a level is reached, at the rate so far; None if unknown."""
        flight = self._flights.get(vehicle)
        if flight is None or flight.rate is None:
            return None
        return max(0.0, flight.left - reserve) / flight.rate
