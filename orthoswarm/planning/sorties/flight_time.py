"""How long a multirotor takes along a path, and where it is when."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.angles import wrap_rad

Array = NDArray[np.float64]

_TURN_RAD = np.radians(10.0)


@dataclass(frozen=True, slots=True)
class Motion:
    """A simple multirotor: constant speed on straights, time lost where the direction changes.

    Attributes:
        speed_m_s: ground speed without wind.
        acceleration_m_s2: horizontal acceleration (ArduCopter's default is 2.5).
        climb_m_s: rate of climb.
        descent_m_s: rate of descent.
        wind_m_s: where the wind blows to, east and north. The speed is then that through the air.
    """

    speed_m_s: float = 10.0
    acceleration_m_s2: float = 2.5
    climb_m_s: float = 2.5
    descent_m_s: float = 1.5
    wind_m_s: tuple[float, float] = (0.0, 0.0)

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
        against constant speed. A full stop and start costs v / a.
        """
        return np.asarray(self.speed_m_s * np.sin(0.5 * angle_rad) / self.acceleration_m_s2)

    @property
    def turn_m(self) -> float:
        """Metres that could be flown in the time two right-angle turns cost: the price of one more line."""
        return float(2.0 * self.turn_s(np.array(0.5 * np.pi)) * self.speed_m_s)

    def times(self, points: Array) -> Array:
        """When each point (n, 3) of a path is passed, seconds from 0, starting and ending at rest."""
        step = np.diff(points, axis=0)
        flat = np.hypot(step[:, 0], step[:, 1])
        rise = step[:, 2]
        vertical = np.maximum(rise, 0.0) / self.climb_m_s + np.maximum(-rise, 0.0) / self.descent_m_s
        seconds = np.maximum(flat / self.ground_speed(step[:, :2]), vertical)
        moving = np.flatnonzero(flat > 0.01)
        if len(moving):
            seconds[moving[1:]] += self.turn_s(angles(points))
            seconds[moving[0]] += 0.5 * self.speed_m_s / self.acceleration_m_s2
            seconds[moving[-1]] += 0.5 * self.speed_m_s / self.acceleration_m_s2
        return np.concatenate([[0.0], np.cumsum(seconds)])


def angles(points: Array) -> Array:
    """Changes of direction in radians, [0, pi], along a path (n, 2 or 3), points on one spot skipped."""
    step = np.diff(points[:, :2], axis=0)
    step = step[np.hypot(*step.T) > 0.01]
    heading = np.arctan2(step[:, 1], step[:, 0])
    return np.asarray(np.abs(wrap_rad(np.diff(heading))))


def turns(points: Array) -> int:
    """Changes of direction by more than ten degrees along a path (n, 2 or 3)."""
    return int((angles(points) > _TURN_RAD).sum())


def length(points: Array) -> float:
    """Horizontal length of a path (n, 2 or 3), metres."""
    return float(np.hypot(*np.diff(points[:, :2], axis=0).T).sum())
