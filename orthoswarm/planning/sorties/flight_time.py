"""How long a multirotor takes along a path, and where it is when."""

import itertools
import math
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from orthoswarm.config.autopilot import ARDUPILOT, AutopilotTimes
from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Flags

_TURN_RAD = np.radians(10.0)
_SPOT_M = 0.01
_RAMP = 5  # places at which a change of speed is followed


@dataclass(frozen=True, slots=True)
class Motion:
    """A multirotor: constant speed on straights, and what its autopilot loses in turns, takeoff and landing."""

    speed_m_s: float = 10.0  # ground speed without wind
    _: KW_ONLY
    climb_m_s: float = 2.5  # rate of climb
    descent_m_s: float = 1.5  # rate of descent
    # where the wind blows to, east and north. The speed is then that through the air
    wind_m_s: tuple[float, float] = (0.0, 0.0)
    autopilot: AutopilotTimes = ARDUPILOT  # acceleration in turns, and the times of takeoff and landing
    lands: bool = False  # its flights end with LAND; if not, with a return to launch, which waits above home first

    @property
    def crab_rad(self) -> float:
        """Largest angle between heading and course, on a course across the wind, radians."""
        return float(np.arcsin(min(1.0, np.hypot(*self.wind_m_s) / self.speed_m_s)))

    @property
    def even_speed_m_s(self) -> float:
        """Ground speed, averaged over a way out and back along the wind: no other direction averages less."""
        return self.speed_m_s - (self.wind_m_s[0] ** 2 + self.wind_m_s[1] ** 2) / self.speed_m_s

    def ground_speed(self, steps: Array) -> Array:
        """Ground speed (n,) on courses along steps (n, 2), metres per second: v cos(crab) plus the wind along it."""
        if self.wind_m_s == (0.0, 0.0):
            return np.full(len(steps), self.speed_m_s)
        course = steps / np.maximum(np.hypot(steps[:, 0], steps[:, 1]), 1e-9)[:, None]
        along = course[:, 0] * self.wind_m_s[0] + course[:, 1] * self.wind_m_s[1]
        across = course[:, 0] * self.wind_m_s[1] - course[:, 1] * self.wind_m_s[0]
        return np.asarray(np.sqrt(self.speed_m_s**2 - across**2) + along)

    def turn_s(self, angle_rad: Array) -> Array:
        """Seconds lost by changing direction by an angle.

        The velocity changes by 2 v sin(angle / 2), which takes that over the acceleration; half of it is lost
        against constant speed. A full stop and start costs v / a. An autopilot that passes corners at a speed c
        slows down by v - c alone, on a way that is shorter by that again.
        """
        slowed = max(0.0, 1.0 - self.autopilot.corner_m_s / self.speed_m_s)
        return np.asarray(self.stop_s * np.sin(0.5 * angle_rad) * slowed**2)

    def without_turns(self) -> "Motion":
        """The motion of this vehicle if turns took no time."""
        return replace(self, autopilot=replace(self.autopilot, acceleration_m_s2=math.inf))

    @property
    def turn_m(self) -> float:
        """Metres that could be flown in the time two right-angle turns cost: the price of one more line."""
        return float(2.0 * self.turn_s(np.array(0.5 * np.pi)) * self.speed_m_s)

    def times(self, points: Array) -> Array:
        """When each point (n, 3) of a path is passed, seconds from 0, starting at rest.

        A first step straight up is a takeoff, a last one straight down a landing, which begins with slowing down.
        """
        step = np.diff(points, axis=0)
        flat = np.hypot(step[:, 0], step[:, 1])
        rise = step[:, 2]
        vertical = np.maximum(rise, 0.0) / self.climb_m_s + np.maximum(-rise, 0.0) / self.descent_m_s
        seconds = np.maximum(flat / (self.autopilot.speed_share * self.ground_speed(step[:, :2])), vertical)
        moving = np.flatnonzero(flat > _SPOT_M)
        if len(moving):
            seconds[moving[1:]] += self.turn_s(angles(points))
            seconds[moving[0]] += self.autopilot.set_off_s + 0.5 * self.stop_s
        upright = (flat <= _SPOT_M) & (np.abs(rise) > _SPOT_M)
        ends = np.zeros(len(step), bool)
        if len(step) and upright[0] and rise[0] > 0.0:
            ends[0] = True
            seconds[0] += self.autopilot.takeoff_s
        if len(step) and upright[-1] and rise[-1] < 0.0:
            ends[-1] = True
            seconds[-1] += self.landing_s(-float(rise[-1]))
        seconds[upright & ~ends] += self.autopilot.height_change_s
        return np.concatenate([[0.0], np.cumsum(seconds)])

    def course(self, points: Array, waits_s: Array | None = None) -> tuple[Array, Array]:
        """Where it is when: times (m,) in seconds, and places (m, 3) between which it moves evenly.

        Where time is lost is known as well as how much: slow first metres of the climb, a wait above home, gathering
        speed; slowing down, a wait above home, slow last metres.

        points: float64 (n, 3), the path. waits_s: float64 (n,), seconds that it stays before each point.
        """
        times = self.times(points) + (0.0 if waits_s is None else np.cumsum(waits_s))
        step = np.diff(points, axis=0)
        flat, rise = np.hypot(step[:, 0], step[:, 1]), step[:, 2]
        upright, moving = (flat <= _SPOT_M) & (np.abs(rise) > _SPOT_M), np.flatnonzero(flat > _SPOT_M)
        slows = np.zeros(len(step))  # by how much each way is left later than at its full speed
        lands = bool(len(step)) and bool(upright[-1]) and rise[-1] < 0.0
        if lands and len(moving) and not upright[moving[-1] + 1 : -1].any():
            slows[moving[-1]] = min(0.5 * self.stop_s, self._wait_s)
        knots = [(np.zeros(1), points[:1])]
        for k, (begin, end) in enumerate(itertools.pairwise(times)):
            if k == 0 and upright[0] and rise[0] > 0.0:
                after, up = self._climbing(float(rise[0]))
            elif lands and k == len(step) - 1:
                after, up = self._landing(-float(rise[-1]))
            elif slows[k] > 0.0 or (len(moving) and k == moving[0]):
                after, up = self._between_stops(end - begin, k == moving[0], float(slows[k]))
            else:
                after, up = np.array([end - begin]), np.ones(1)
            knots.append((begin + after, points[k] + up[:, None] * step[k]))
        at, places = (np.concatenate(rows) for rows in zip(*knots, strict=True))
        return np.maximum.accumulate(at), places

    def places(self, points: Array, waits_s: Array | None, step_s: float) -> Array:
        """Where it is at every time step from the start to the end of a path, (n, 3); see `course`."""
        times, places = self.course(points, waits_s)
        moments = np.arange(0.0, times[-1] + step_s, step_s)
        return np.stack([np.interp(moments, times, places[:, axis]) for axis in range(3)], axis=1)

    def _climbing(self, rise_m: float) -> tuple[Array, Array]:
        """A takeoff: times, and shares of its height."""
        low_m, low_s = min(rise_m, self.autopilot.takeoff_below_m), self.autopilot.takeoff_below_s
        at = [low_m / self.climb_m_s + low_s, rise_m / self.climb_m_s + low_s]
        return np.array([*at, rise_m / self.climb_m_s + self.autopilot.takeoff_s]), np.array([low_m / rise_m, 1.0, 1.0])

    def _landing(self, fall_m: float) -> tuple[Array, Array]:
        """A landing: times, and shares of its height."""
        slow_m, all_s = min(fall_m, self.autopilot.landing_below_m), fall_m / self.descent_m_s + self.landing_s(fall_m)
        at = [self._wait_s, all_s - slow_m / self.autopilot.landing_m_s, all_s]
        return np.array(at), np.array([0.0, 1.0 - slow_m / fall_m, 1.0])

    def _between_stops(self, lasts_s: float, sets_off: bool, slows_s: float) -> tuple[Array, Array]:
        """A way that begins or ends at rest: times, and shares of the way.

        Args:
            lasts_s: seconds of it, without those that slowing down takes beyond. sets_off: it begins at rest.
            slows_s: by how much it ends later at rest.
        """
        hold_s = min(self.autopilot.set_off_s, lasts_s) if sets_off else 0.0
        moves_s = lasts_s - hold_s + slows_s
        first, last = (self.stop_s if sets_off else 0.0), 2.0 * slows_s
        shorter = min(1.0, moves_s / max(first + last, 1e-9))  # a way too short for the full speed
        first, last = shorter * first, shorter * last
        full = 1.0 / max(moves_s - 0.5 * (first + last), 1e-9)
        part = np.linspace(0.0, 1.0, _RAMP)
        begins, ends = 0.5 * full * first * part**2, 1.0 - 0.5 * full * last * (1.0 - part) ** 2
        after = hold_s + np.concatenate([part * first, moves_s - (1.0 - part) * last])
        return after, np.concatenate([begins, ends])

    @property
    def stop_s(self) -> float:
        """Seconds lost by a full stop and start."""
        return self.speed_m_s / self.autopilot.acceleration_m_s2

    def landing_s(self, height_m: float) -> float:
        """Seconds that coming down from above home takes longer than a descent at the usual rate."""
        slow_m = min(height_m, self.autopilot.landing_below_m)
        return self._wait_s + slow_m / self.autopilot.landing_m_s - slow_m / self.descent_m_s

    @property
    def _wait_s(self) -> float:
        """Seconds of slowing down and waiting above home before it comes down."""
        return self.autopilot.land_wait_s if self.lands else self.autopilot.home_wait_s


def start_slack_s(near_start: Flags, autopilot: AutopilotTimes) -> Array:
    """Seconds off schedule that a plan allows a flight around a start that vehicles share, float64 (n,).

    near_start: bool (n,), which of its samples are there. Before it has left it first it takes off, then it lands.
    """
    takes_off = np.arange(len(near_start)) < np.argmin(near_start)
    return np.where(takes_off, autopilot.takeoff_slack_s, autopilot.landing_slack_s)


def angles(points: Array) -> Array:
    """Changes of direction in radians, [0, pi], along a path (n, 2 or 3), points on one spot skipped."""
    step = np.diff(points[:, :2], axis=0)
    step = step[np.hypot(*step.T) > _SPOT_M]
    heading = np.arctan2(step[:, 1], step[:, 0])
    return np.asarray(np.abs(wrap_rad(np.diff(heading))))


def turns(points: Array) -> int:
    """Changes of direction by more than ten degrees along a path (n, 2 or 3)."""
    return int((angles(points) > _TURN_RAD).sum())


def length(points: Array) -> float:
    """Horizontal length of a path (n, 2 or 3), metres."""
    return float(np.hypot(*np.diff(points[:, :2], axis=0).T).sum())
