"""One flight from its legs: way out, legs with the ways between, way home, in grid metres."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array, Flags
from orthoswarm.planning.lines.detours import Router
from orthoswarm.planning.sorties.flight_heights import FlightHeights
from orthoswarm.planning.sorties.flight_time import Motion, length, turns

_SAME_M = 0.05

_STRAIGHT_COS: Final = 0.985  # a vehicle comes straight into a leg up to this angle, without run-in: 10 degrees


@dataclass(frozen=True, kw_only=True)
class Flight:
    """The path of one sortie."""

    home: Array  # float64 (2,), where it takes off
    climb_m: float  # height to climb to at home
    points: Array  # float64 (n, 3), waypoints: easting, northing, height (see `flight_heights`)
    camera: NDArray[np.int8]  # int8 (n,): 1 at a leg's first point, -1 at its last, else 0
    returns: bool  # the last point is above home, and the vehicle comes down there
    home_z_m: float  # height of the ground at home
    # float64 (n,), nominal height above the ground of each point; NaN where heights do not follow the ground
    above_m: Array
    between: Flags  # bool (n,), points on a straight way, put in for their height alone
    ground_by_vehicle: bool = False  # the vehicle keeps its height above the ground by itself, without those points
    wait_s: float = 0.0  # how long it stays where its last leg ends before it comes home

    def track(self) -> Array:
        """The whole path from the ground on, (n, 3)."""
        up = [[*self.home, self.home_z_m], [*self.home, self.climb_m]]
        down = [[*self.home, self.home_z_m]] if self.returns else np.empty((0, 3))
        return np.concatenate([up, self.points, down])

    def times(self, motion: Motion) -> Array:
        """When each point of `track` is left, seconds after takeoff; where it waits, that is after the wait."""
        times = motion.times(self.track())
        times[2 + self.last_leg_end :] += self.wait_s  # behind the ground and the point above home
        return times

    @property
    def last_leg_end(self) -> int:
        """Index of the point at which the last leg ends."""
        return int(np.flatnonzero(self.camera == -1)[-1])

    def time_s(self, motion: Motion) -> float:
        """Seconds from takeoff to the end."""
        return float(self.times(motion)[-1])

    @property
    def length_m(self) -> float:
        """Horizontal metres flown."""
        return length(self.track())

    @property
    def turns(self) -> int:
        """Changes of direction by more than ten degrees."""
        return turns(self.track())

    @property
    def items(self) -> int:
        """Mission items that it needs: waypoints, camera commands, home, takeoff, speed and the end."""
        points = np.count_nonzero(~self.between) if self.ground_by_vehicle else len(self.points)
        return int(points) + int(np.count_nonzero(self.camera)) + 4 + (self.wait_s > 0.0)


def make_flight(
    legs: Array,
    home: Array,
    heights: FlightHeights,
    *,
    router: Router,
    returns: bool,
    out_m: float = 0.0,
    home_m: float = 0.0,
    run_in_m: float = 0.0,
) -> Flight:
    """The flight over a row of legs.

    Args:
        legs: float64 (n, 2, 2) in flying order. home: float64 (2,). heights: of the legs and of the ways between them.
        router: finds ways around obstacles. returns: fly back above home at the end.
        out_m: how much higher the way out is. home_m: how much higher the way home is.
        run_in_m: length of a straight, in line with the leg, before its first picture; left out where an obstacle or
            the start lies in the way, and where the vehicle comes straight on.
    """
    flat: list[tuple[Array, float, int]] = []  # place, height above that of legs, camera mark

    def add(path: Array, more_m: float, mark: int = 0) -> None:
        flat.extend((point, more_m, mark) for point in path)

    far = float(np.hypot(*(legs[0, 0] - home))) > _SAME_M
    if far:
        entry = _entry(legs[0], home, router, run_in_m)
        add(router.path(home, entry[0])[1:-1], out_m)
        if out_m > 0.0:
            add(entry[:1], out_m)
        add(entry[:-1], 0.0)
    for k, (start, end) in enumerate(legs):
        if k:
            entry = _entry(legs[k], legs[k - 1, 1], router, run_in_m)
            add(router.path(legs[k - 1, 1], entry[0])[1:-1], 0.0)
            add(entry[:-1], 0.0)
        add(start[None], 0.0, 1)
        add(end[None], 0.0, -1)
    if returns:
        if home_m > 0.0:
            add(legs[-1:, 1], home_m)
        add(router.path(legs[-1, 1], home)[1:], home_m)
    climb = heights.at(home, out_m if far else 0.0)
    return _raised(flat, np.array([*home, climb]), heights, returns)


def _raised(flat: list[tuple[Array, float, int]], start: Array, heights: FlightHeights, returns: bool) -> Flight:
    """A flight from places on the map: heights, and the points that they need between the places.

    Args:
        flat: place, height above that of legs, and camera mark of each waypoint. start: float64 (3,), above home.
        heights: as flown. returns: see `Flight`.
    """
    points: list[Array] = []
    mores: list[float] = []
    camera: list[int] = []
    between: list[bool] = []
    here = start
    for place, more, mark in flat:
        way = heights.between(here, place, more)
        points.extend(way)
        mores += [more] * len(way)
        camera += [0] * (len(way) - 1) + [mark]
        between += [True] * (len(way) - 1) + [False]
        here = way[-1]
    above = np.array(mores) + heights.above_m if heights.follows else np.full(len(points), np.nan)
    home = start[:2]
    return Flight(
        home=home, climb_m=float(start[2]), points=np.array(points), camera=np.array(camera, np.int8), returns=returns,
        home_z_m=heights.ground_at(home), above_m=above, between=np.array(between, bool),
        ground_by_vehicle=heights.by_vehicle,
    )  # fmt: skip


def _entry(leg: Array, before: Array, router: Router, run_in_m: float) -> Array:
    """Where a leg is entered, coming from a point: its first point, behind that of a run-in if there is one."""
    start = leg[:1]
    if run_in_m <= 0.0:
        return start
    along = (leg[1] - leg[0]) / np.hypot(*(leg[1] - leg[0]))
    way = leg[0] - before
    comes_straight = float(way @ along) >= _STRAIGHT_COS * float(np.hypot(*way))
    ahead = start - run_in_m * along
    if comes_straight or router.inside(ahead)[0] or router.blocked(ahead, start)[0]:
        return start
    return np.concatenate([ahead, start])
