"""Who flies what: legs shared among the vehicles of a plan, and cut into sorties."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, Literal

import numpy as np

from orthoswarm.config.autopilot import ARDUPILOT, AutopilotTimes
from orthoswarm.config.planning import PLANNING
from orthoswarm.model.arrays import Array
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.plan import End
from orthoswarm.planning.lines.detours import Router
from orthoswarm.planning.lines.line_spacing import Footprint
from orthoswarm.planning.lines.visiting_order import shorten
from orthoswarm.planning.sorties.deconfliction import Maker, Schedule, Separation, separate
from orthoswarm.planning.sorties.flight_heights import FlightHeights
from orthoswarm.planning.sorties.flight_path import Flight, make_flight
from orthoswarm.planning.sorties.flight_time import Motion
from orthoswarm.planning.sorties.workload_split import Limits, Row, cut, share, sorties

Heading = float | Literal["wind", "longest"]

MOST_VEHICLES = 250  # MAVLink system ids
_FARTHEST_M = 100_000.0
_SLOWEST_M_S, _FASTEST_M_S = 0.5, 60.0
_LONGEST_RUN_IN_M = 200.0
_LONGEST_WAIT_S = 3600.0
_MOST_WIND = 0.8  # of the speed through the air

_FAIR_BALANCE: Final = 1.15  # the longest sortie over the mean up to which a division is fair
_UNFAIR_BALANCE: Final = 1.22  # ... and from which on it is priced steeply
_BALANCE_PRICES: Final = (2.0, 6.0)  # prices of what the balance is above either, in shares of the longest sortie
_ENDURANCE_SPARE: Final = 1.05  # where an endurance is too short, so many times what is needed is asked for
_ITEMS_A_LEG: Final = 4  # mission items of a leg: two ends, camera on and off
_SPARE_ITEMS: Final = 40  # mission items kept for ways, takeoff and landing
_LEAST_LEG_TRIGGERS: Final = 4.0  # legs are no shorter than so many picture distances, if endurance allows
_SORTIE_PARTS: Final = 40.0  # a leg's parts are at most this fraction of a sortie long
_ROW_PARTS: Final = 2000.0  # most parts of a vehicle's legs (for its time)
_SORTIE_TRIES: Final = 12  # most times that legs are cut again because a sortie is longer than was estimated ...
_SORTIE_SHORTER: Final = 0.005  # ... each time shorter by this share ...
_SORTIE_SHORTER_GROWTH: Final = 1.6  # ... times this with each further one


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """Everything about the flights that has a good default."""

    # speeds of the vehicles, and the times of the slowest autopilot, by which the work is shared
    motion: Motion = field(default_factory=Motion)
    # the times of each vehicle's autopilot, given in turn; none: those of `motion` for all
    autopilots: Sequence[AutopilotTimes] = ()
    end: End = "rtl"  # what a sortie does at last: return to launch, land at home, or hover at the end of its last leg
    # takeoff points as (latitude, longitude) in degrees: none (each vehicle starts where its first leg begins), one for
    # all, or several that vehicles are given in turn
    starts: Sequence[tuple[float, float]] = ()
    endurance_s: float = float("inf")  # longest flight on one battery; infinite without a limit
    # longest flight of each vehicle, where they differ; then `endurance_s` is not used
    endurances_s: Sequence[float] = ()
    # distance that paths keep from no-fly zones; None keeps a metre, less where pictures are so small that a metre
    # would leave gaps
    clearance_m: float | None = None
    separation: Separation = field(default_factory=Separation)  # how far apart vehicles stay
    most_items: int = ARDUPILOT.most_items  # mission items that the autopilot can hold
    # straight flight in line with a leg before its first picture, so that the vehicle is out of its turn
    run_in_m: float = 0.0
    # how long a vehicle stays at the end of its last flight's last leg before it comes home, as far as its endurance
    # allows
    wait_s: float = 0.0
    # of an area's lines, degrees clockwise from true north, along the wind, or along its longest side; None for the
    # directions that are done soonest
    heading: Heading | None = None
    cross: bool = False  # cover an area a second time by lines across the first
    quickest_s: float = PLANNING.quickest_s  # shortest time between pictures without a warning

    def __post_init__(self) -> None:
        object.__setattr__(self, "motion", replace(self.motion, lands=self.end == "land"))

    def motion_of(self, vehicle: int) -> Motion:
        """How a vehicle, counted from 0, moves."""
        if not self.autopilots:
            return self.motion
        return replace(self.motion, autopilot=self.autopilots[vehicle % len(self.autopilots)])

    def check(self) -> None:
        """Refuse values that mean nothing.

        Raises InputError: a value that is not larger than 0 or out of reach, or a start that is not a position.
        """
        speed = self.motion.speed_m_s
        if not _SLOWEST_M_S <= speed <= _FASTEST_M_S:
            raise InputError(f"the speed is {speed:g} m/s; give a number from {_SLOWEST_M_S:g} to {_FASTEST_M_S:g}")
        wind = math.hypot(*self.motion.wind_m_s)
        if not wind <= _MOST_WIND * speed:
            raise InputError(
                f"a wind of {wind:g} m/s is too much for {speed:g} m/s: at most {_MOST_WIND * speed:g} m/s leave some "
                "speed against it; fly faster, or another day"
            )
        positive = {
            "endurance": (min((self.endurance_s, *self.endurances_s)) / 60.0, "min"),
            "clearance": (1.0 if self.clearance_m is None else self.clearance_m, "m"),
            "separation": (self.separation.distance_m, "m"),
            "height step": (self.separation.height_m, "m"),
        }
        for name, (value, unit) in positive.items():
            if not value > 0.0:
                raise InputError(f"the {name} is {value:g} {unit}; give a number larger than 0")
        if not 0.0 <= self.run_in_m <= _LONGEST_RUN_IN_M:
            raise InputError(f"the run-in is {self.run_in_m:g} m; give 0 to {_LONGEST_RUN_IN_M:g}")
        if not 0.0 <= self.wait_s <= _LONGEST_WAIT_S:
            raise InputError(f"the wait is {self.wait_s / 60:g} min; give 0 to {_LONGEST_WAIT_S / 60:g}")
        if self.wait_s and self.end == "hover":
            raise InputError("a vehicle that hovers at the end needs no wait; let it end with rtl or land")
        if self.heading == "wind" and not wind:
            raise InputError("lines along the wind need one; give it with --wind-m-s and --wind-from")
        if not isinstance(self.heading, str | None) and not abs(self.heading) <= 360.0:
            raise InputError(f"the heading of the lines is {self.heading:g}; give degrees from 0 to 360")
        for name in ("clearance", "separation", "height step"):
            if not math.isfinite(positive[name][0]):
                raise InputError(f"the {name} is not finite; give a number of metres")
        for lat, lon in self.starts:
            if not (abs(lat) <= 90.0 and abs(lon) <= 180.0):
                raise InputError(f"the start {lat:g},{lon:g} is not a position; give latitude,longitude in degrees")


@dataclass(frozen=True)
class Work:
    """What each vehicle of a plan flies."""

    sorties: list[list[Array]]  # per vehicle, its sorties' legs, float64 (n, 2, 2) each, in flying order
    homes: list[Array]  # per vehicle, where it takes off, float64 (2,)
    longest_s: float  # time in the air of the busiest vehicle
    balance: float  # longest over mean path length of the vehicles

    @property
    def score(self) -> float:
        """Less is better: the makespan, dearer where the work is shared unevenly."""
        limits = _FAIR_BALANCE, _UNFAIR_BALANCE
        price = sum(p * max(0.0, self.balance - limit) for p, limit in zip(_BALANCE_PRICES, limits, strict=True))
        return self.longest_s * (1.0 + price)


class Swarm:
    """Vehicles that take off somewhere and share legs.

    Attributes:
        vehicles: how many.
        starts: float64 (vehicles, 2), grid metres; None where each starts at its own first leg.
    """

    def __init__(
        self,
        vehicles: int,
        heights: FlightHeights,
        *,
        foot: Footprint,
        grid: LocalGrid,
        router: Router,
        options: PlanOptions,
    ) -> None:
        if not 1 <= vehicles <= MOST_VEHICLES:
            raise InputError(f"{vehicles} vehicles were asked for; give a number from 1 to {MOST_VEHICLES}")
        options.check()
        self.vehicles = vehicles
        self._heights, self._foot, self._router, self._options = heights, foot, router, options
        self._returns = options.end != "hover"
        self.starts: Array | None = None
        if options.starts:
            lat_lon = np.asarray(options.starts, np.float64)
            places = grid.to_grid(lat_lon[:, 0], lat_lon[:, 1])
            if router.inside(places).any():
                raise InputError("a start lies in a no-fly zone; move it out")
            self.starts = places[np.arange(vehicles) % len(places)]
        endurances_s = options.endurances_s or [options.endurance_s]
        self._endurances_s = np.array([endurances_s[k % len(endurances_s)] for k in range(vehicles)], np.float64)
        self._limits = self._flight_limits()

    def _flight_limits(self) -> Limits:
        motion, apart = self._options.motion, self._options.separation
        above = apart.layers * apart.height_m  # whatever layer the schedule gives
        climb = self._heights.above_m
        if self.starts is not None:
            climb = max(self._heights.at(home, 0.0) - self._heights.ground_at(home) for home in self.starts)
        fixed = (climb + above) / motion.climb_m_s + motion.stop_s
        fixed += motion.autopilot.takeoff_s + motion.autopilot.set_off_s + motion.autopilot.height_change_s
        if self._returns:
            fixed += (climb + above) / motion.descent_m_s + motion.landing_s(climb + above)
            fixed += above / motion.climb_m_s + motion.autopilot.height_change_s
        most_legs = max(
            1,
            (self._options.most_items - _SPARE_ITEMS) // (_ITEMS_A_LEG + (self._options.run_in_m > 0.0)),
        )
        return Limits(self._endurances_s, fixed, apart.swap_s, most_legs)

    def share(self, legs: Array, reorder: bool) -> Work:
        """Share a row of legs.

        Args:
            legs: float64 (n, 2, 2) in flying order.
            reorder: a vehicle may fly its legs in another order if that shortens its ways.

        Raises:
            InputError: the endurance is too short.
        """
        if self.starts is not None:
            far = float(np.hypot(*(self.starts - legs[0, 0]).T).max())
            if not far < _FARTHEST_M:
                raise InputError(f"a start is {far / 1000:.0f} km from the area; check that it is given as LAT,LON")
        by_time = self._shared(legs, reorder, self._options.motion)
        if by_time.balance <= _FAIR_BALANCE:
            return by_time
        # Where turns take most of the time, even times are uneven paths: try even paths, too.
        by_length = self._shared(legs, reorder, self._options.motion.without_turns())
        return by_length if by_length.score < by_time.score else by_time

    def _shared(self, legs: Array, reorder: bool, motion: Motion) -> Work:
        options, router = self._options, self._router
        row = cut(legs, router, motion, shares=self.vehicles, least_m=self._least_leg_m)
        pieces = share(
            row, self.vehicles, self.starts, returns=self._returns, router=router, motion=motion, limits=self._limits
        )
        if pieces is None:
            raise self._too_short(row, self.starts, float(self._endurances_s.min()))
        homes, work, lengths, times = [], [], [], []
        for vehicle, (begin, end) in enumerate(pieces):
            mine = row.legs(begin, end)
            home = mine[0, 0] if self.starts is None else self.starts[vehicle]
            if reorder and self.starts is not None and self._returns:
                mine = shorten(mine, router, home)
            flown = self._sorties(mine, home, float(self._endurances_s[vehicle]))
            flights = [self._flight(f, home, 0.0, 0.0) for f in flown]
            homes.append(home)
            work.append(flown)
            lengths.append(sum(f.length_m for f in flights))
            moves = options.motion_of(vehicle)
            times.append(sum(f.time_s(moves) for f in flights) + (len(flights) - 1) * self._limits.swap_s)
        return Work(work, homes, max(times), max(lengths) / (sum(lengths) / len(lengths)))

    def schedule(self, work: Work) -> Schedule:
        """Layers and takeoff times of all sorties, so that vehicles stay apart."""
        makers: list[list[Maker]] = []
        for vehicle, (flown, home) in enumerate(zip(work.sorties, work.homes, strict=True)):
            waits = [0.0] * (len(flown) - 1) + [self._wait_s(flown[-1], home, float(self._endurances_s[vehicle]))]
            makers.append([partial(self._flight, f, home, wait_s=w) for f, w in zip(flown, waits, strict=True)])
        motions = [self._options.motion_of(vehicle) for vehicle in range(len(makers))]
        return separate(makers, motions, self._options.separation)

    def _wait_s(self, legs: Array, home: Array, endurance_s: float) -> float:
        """How long a vehicle can stay at the end of a flight: as long as is asked for and its endurance allows."""
        if not self._options.wait_s:
            return 0.0
        top = self._options.separation.layers * self._options.separation.height_m
        left = endurance_s - self._flight(legs, home, top, top).time_s(self._options.motion)
        return float(np.floor(np.clip(left, 0.0, self._options.wait_s)))

    def _flight(self, legs: Array, home: Array, out_m: float, home_m: float, wait_s: float = 0.0) -> Flight:
        run_in = self._options.run_in_m
        flight = make_flight(
            legs, home, self._heights, router=self._router, returns=self._returns, out_m=out_m, home_m=home_m,
            run_in_m=run_in,
        )  # fmt: skip
        return replace(flight, wait_s=wait_s) if wait_s else flight

    @property
    def _least_leg_m(self) -> float:
        return _LEAST_LEG_TRIGGERS * self._foot.trigger_m

    def _sorties(self, legs: Array, home: Array, endurance_s: float) -> list[Array]:
        """A vehicle's legs, cut into as many flights as endurance and mission size ask for."""
        options, least, within_s = self._options, self._least_leg_m, endurance_s
        limits = replace(self._limits, endurance_s=within_s)
        top = options.separation.layers * options.separation.height_m
        for attempt in range(_SORTIE_TRIES):
            step = least
            if np.isfinite(within_s):
                step = min(max(within_s * options.motion.speed_m_s / _SORTIE_PARTS, self._foot.trigger_m), least)
            total = float(np.hypot(*(legs[:, 1] - legs[:, 0]).T).sum())
            coarse = max(step, total / _ROW_PARTS)
            row = cut(legs, self._router, options.motion, shares=1, least_m=step, step_m=coarse)
            found = sorties(row, home, self._returns, router=self._router, motion=options.motion, limits=limits)
            if found is None:
                raise self._too_short(row, home[None], endurance_s)
            result = [row.legs(a, b) for a, b in found]
            flights = [self._flight(f, home, top, top) for f in result]
            longest, most = max(f.time_s(options.motion) for f in flights), max(f.items for f in flights)
            if longest <= endurance_s and most <= options.most_items:
                return result
            # The cut knows turns and detours only roughly: cut again a little shorter, and by more where that does not
            # move the cut.
            fewer = limits.most_legs if most <= options.most_items else limits.most_legs * options.most_items // most
            shorter = 1.0 - _SORTIE_SHORTER * _SORTIE_SHORTER_GROWTH**attempt
            within_s = shorter * within_s * min(1.0, endurance_s / longest)
            limits = replace(limits, endurance_s=within_s, most_legs=max(1, fewer))
        raise self._too_short(row, home[None], endurance_s)

    def _too_short(self, row: Row, starts: Array | None, endurance_s: float) -> InputError:
        """What to say when a part of the row is out of reach: how long the flight to the farthest would be."""
        top = self._options.separation.layers * self._options.separation.height_m
        places = row.parts[:1, 0] if starts is None else starts
        far = self._router.distances(places, row.parts[:, 0]) + self._router.distances(places, row.parts[:, 1])
        start, part = np.unravel_index(np.argmax(far), far.shape)
        home = row.parts[part, 0] if starts is None else places[start]
        needed = self._flight(row.parts[part][None], home, top, top).time_s(self._options.motion)
        asked_for = _ENDURANCE_SPARE * needed
        return InputError(
            f"the endurance of {endurance_s / 60:.1f} min is too short: the farthest line needs about "
            f"{math.ceil(asked_for / 6) / 10:.1f} min; start nearer, fly faster or lower, or use larger batteries"
        )
