"""How long a multirotor takes along a path, and where it is when."""

import math
from dataclasses import KW_ONLY, dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.config.autopilot import AutopilotConfig
from orthoswarm.model.angles import wrap_rad

Array = NDArray[np.float64]

_TURN_RAD = np.radians(10.0)
_SPOT_M = 0.01


@dataclass(frozen=True, slots=True)
class Motion:
    """A multirotor: constant speed on straights, and what its autopilot loses in turns, takeoff and landing.

    Attributes:
        speed_m_s: ground speed without wind.
        climb_m_s: rate of climb.
        descent_m_s: rate of descent.
        wind_m_s: where the wind blows to, east and north. The speed is then that through the air.
        autopilot: acceleration in turns, and the times of takeoff and landing.
        lands: its flights end with LAND; if not, with a return to launch, which waits above home first.
    """

    speed_m_s: float = 10.0
    _: KW_ONLY
    climb_m_s: float = 2.5
    descent_m_s: float = 1.5
    wind_m_s: tuple[float, float] = (0.0, 0.0)
    autopilot: AutopilotConfig = field(default_factory=lambda: active().ardupilot)
    lands: bool = False

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
        """The same vehicle, if turns took no time."""
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

    @property
    def stop_s(self) -> float:
        """Seconds lost by a full stop and start."""
        return self.speed_m_s / self.autopilot.acceleration_m_s2

    def landing_s(self, height_m: float) -> float:
        """Seconds that coming down from above home takes longer than a descent at the usual rate."""
        slow_m = min(height_m, self.autopilot.landing_below_m)
        wait_s = self.autopilot.land_wait_s if self.lands else self.autopilot.home_wait_s
        return wait_s + slow_m / self.autopilot.landing_m_s - slow_m / self.descent_m_s


def autopilot_config(name: str) -> AutopilotConfig:
    """What is known of an autopilot's times: of PX4 if its name is `px4`, otherwise of ArduCopter."""
    return active().px4 if name == "px4" else active().ardupilot


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
