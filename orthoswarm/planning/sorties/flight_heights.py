"""How high a path is flown: at one height, or at a constant height above the ground within a tolerance.

Heights here are metres over one level for all vehicles: takeoff without a height model, the zero of the model with one.
"""

import math
from dataclasses import KW_ONLY, dataclass, field
from typing import Final

import numpy as np

from orthoswarm.config.planning import PLANNING
from orthoswarm.model.arrays import Array
from orthoswarm.model.placement import Terrain

_SAME_M = 0.01

BESIDE_M: Final = 10.0
"""Ground up to so far beside a flight counts as ground below it: 8 m by which receivers err (GPS SPS Performance
Standard 2020, 95 %) and 2 m by which a vehicle may pass a waypoint (ArduCopter's WPNAV_RADIUS)."""
_PROFILE_FINEST_M: Final = 1.0  # least distance of the places at which the ground below a flight is read (for its time)
_PROFILE_COARSEST_M: Final = 10.0  # greatest distance of them (slopes of up to 45 degrees)


def profile_step_m(*grounds: Terrain) -> float:
    """Distance of the places along a flight at which heights of the ground are read, metres."""
    return float(np.clip(0.5 * min(g.step_m for g in grounds), _PROFILE_FINEST_M, _PROFILE_COARSEST_M))


@dataclass(frozen=True)
class LevelHeights:
    """All legs at one height."""

    z_m: float  # height of the legs
    _: KW_ONLY
    ground: Terrain | None = None  # heights of the ground, None where only the height above takeoff counts
    highest: Terrain | None = None  # the highest ground up to `BESIDE_M` from each place
    nominal_m: float | None = None  # height above the ground that was asked for, None for z_m
    follows: bool = False  # False, as heights do not follow the ground
    by_vehicle: bool = False  # False, likewise
    least_above_m: float = PLANNING.least_above_ground_m  # what flights keep over the highest ground

    @property
    def above_m(self) -> float:
        """Nominal height of legs above the ground, or above takeoff without ground."""
        return self.z_m if self.nominal_m is None else self.nominal_m

    def ground_at(self, place: Array) -> float:
        """Height of the ground at a place (2,), 0 without a height model."""
        return 0.0 if self.ground is None else float(self.ground.height(place))

    def at(self, place: Array, more_m: float) -> float:
        """Height of a flight over a place (2,), so many metres higher than legs."""
        return self.z_m + more_m

    def between(self, start: Array, end: Array, more_m: float) -> Array:
        """The way from `start` (3,) straight to `end` (2,): float64 (1, 3), its end."""
        return np.array([[*end, self.at(end, more_m)]])


@dataclass(frozen=True, kw_only=True)
class GroundHeights:
    """A constant height above the ground within a tolerance, on straight pieces as long as that allows.

    Beside ground that is much higher a flight is higher than that: `least_above_m` above it.
    """

    ground: Terrain  # heights of the ground
    highest: Terrain  # the highest ground up to `BESIDE_M` from each place
    above_m: float  # height above the ground
    tolerance_m: float  # largest difference from it
    follows: bool = True  # True, as heights follow the ground
    # the vehicle itself keeps its height above the ground, so that points put in for their height are no mission items,
    # and no ground beside it lifts it
    by_vehicle: bool = False
    least_above_m: float = PLANNING.least_above_ground_m
    _known: dict[tuple[float, ...], Array] = field(default_factory=dict, repr=False, compare=False)

    def ground_at(self, place: Array) -> float:
        """Height of the ground at a place (2,)."""
        return float(self.ground.height(place))

    def at(self, place: Array, more_m: float) -> float:
        """Height of a flight over a place (2,), so many metres higher than legs."""
        return float(self._heights_at(place)[0]) + more_m

    def _heights_at(self, places: Array) -> tuple[Array, Array, Array]:
        """The height that is wanted of legs over places (..., 2), the lowest and the highest allowed, each (...,)."""
        nominal = np.asarray(self.ground.height(places), np.float64) + self.above_m
        low, high = nominal - self.tolerance_m, nominal + self.tolerance_m
        if not self.by_vehicle:
            # Also that of the next places to be read, so that the straight way to them keeps clear of a steep wall.
            reach = math.sqrt(2.0) * self.step_m
            around = places[..., None, :] + reach * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
            floor = np.asarray(self.highest.height(around), np.float64).max(axis=-1)
            low = np.maximum(low, floor + self.least_above_m)
        return np.maximum(nominal, low), low, np.maximum(high, low)

    @property
    def step_m(self) -> float:
        """Distance of the places at which the ground is read."""
        return profile_step_m(self.ground, self.highest)

    def between(self, start: Array, end: Array, more_m: float) -> Array:
        """The way from `start` (3,) straight to `end` (2,), float64 (n, 3): points put in for the height, and the end.

        Each piece is as long as it stays within the tolerance (a greedy walk along the corridor).
        """
        key = (*start.tolist(), *end.tolist(), more_m)
        if key not in self._known:
            self._known[key] = self._walk(start, end, more_m)
        return self._known[key]

    def _walk(self, start: Array, end: Array, more_m: float) -> Array:
        length = float(np.hypot(*(end - start[:2])))
        if length < _SAME_M:
            return np.array([[*end, self.at(end, more_m)]])
        share = np.linspace(0.0, 1.0, int(np.ceil(length / self.step_m)) + 1)
        places = start[:2] + share[:, None] * (end - start[:2])
        wanted, low, high = (heights + more_m for heights in self._heights_at(places))
        found, here, z = [], 0, float(start[2])
        while here < len(share) - 1:
            run = share[here + 1 :] - share[here]
            least = np.maximum.accumulate((low[here + 1 :] - z) / run)
            most = np.minimum.accumulate((high[here + 1 :] - z) / run)
            reached = int(np.argmax(least > most)) - 1 if (least > most).any() else len(run) - 1
            slope = float(np.clip((wanted[here + 1 + reached] - z) / run[reached], least[reached], most[reached]))
            z += slope * float(run[reached])
            here += reached + 1
            found.append([*places[here], z])
        return np.array(found)


FlightHeights = LevelHeights | GroundHeights
