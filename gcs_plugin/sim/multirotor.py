"""Motion of a simulated multirotor: straight to its target with limited acceleration, tilted accordingly, nose ahead.

Positions are metres north and east of home and up from it, in a chart of the ellipsoid around home (degrees have the
length everywhere that they have at home's latitude). Angles are radians: yaw clockwise from true north, pitch nose up,
roll right side down. Control sees the position with the receiver's error, as a real autopilot
does, so that the true path drifts while the recorded one looks straight.
"""

import bisect
import math
from collections import deque
from dataclasses import dataclass, field, replace
from random import Random
from typing import Final

import numpy as np

from orthoswarm.config.autopilot import AutopilotTimes
from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.earth import EQUATOR_RADIUS_M
from orthoswarm.planning.sorties import flight_time as planner

_GRAVITY: Final = 9.80665  # m/s2
_ECCENTRICITY2: Final = 6.69437999014e-3  # of WGS 84
STEP_S: Final = 0.05
_FILTER_S: Final = 3.0
_LOOK_AHEAD_S: Final = 0.8
_LOWEST_M: Final = 0.5  # it stops no lower, unless it lands
_LIFT_M_S2: Final = 1.5  # greatest change of its rate of climb


@dataclass(frozen=True, slots=True)
class Chart:
    """Metres around a point of the ellipsoid WGS 84 (degrees); `alt_m` is the altitude of height 0."""

    lat_deg: float
    lon_deg: float
    alt_m: float = 0.0

    @property
    def metres_per_deg(self) -> tuple[float, float]:
        """Length of a degree of latitude and of longitude."""
        sin2 = math.sin(math.radians(self.lat_deg)) ** 2
        w = 1.0 - _ECCENTRICITY2 * sin2
        meridian = EQUATOR_RADIUS_M * (1.0 - _ECCENTRICITY2) / w**1.5
        parallel = EQUATOR_RADIUS_M / math.sqrt(w) * math.cos(math.radians(self.lat_deg))
        return math.radians(meridian), math.radians(parallel)

    def to_metres(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """North and east."""
        per_lat, per_lon = self.metres_per_deg
        return (lat_deg - self.lat_deg) * per_lat, (lon_deg - self.lon_deg) * per_lon

    def to_degrees(self, north: float, east: float) -> tuple[float, float]:
        """Latitude and longitude."""
        per_lat, per_lon = self.metres_per_deg
        return self.lat_deg + north / per_lat, self.lon_deg + east / per_lon


@dataclass(frozen=True, slots=True, kw_only=True)
class VehiclePose:
    """The true pose of the airframe, so many seconds after its boot; height above home, altitude above the sea."""

    time_s: float
    lat_deg: float
    lon_deg: float
    height_m: float
    alt_m: float
    yaw_rad: float
    pitch_rad: float
    roll_rad: float

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Rotation from north-east-down to the airframe, w first."""
        cr, sr = math.cos(self.roll_rad / 2), math.sin(self.roll_rad / 2)
        cp, sp = math.cos(self.pitch_rad / 2), math.sin(self.pitch_rad / 2)
        cy, sy = math.cos(self.yaw_rad / 2), math.sin(self.yaw_rad / 2)
        return (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Airframe:
    """Performance of a vehicle.

    Attributes:
        speed_m_s: cruise, until a mission says otherwise; climb_m_s, sink_m_s: vertical speeds.
        accel_m_s2: greatest horizontal acceleration.
        drag: forward lean at speed, m/s2 per m/s.
        yaw_rate: turning speed, rad/s.
        gps_sigma_m: one sigma of the receiver's horizontal error, which wanders with gps_tau_s.
        top_m_s: its top speed, whatever is asked for.
        times: what an autopilot takes beyond its motion; None flies as fast as the motion allows.
    """

    speed_m_s: float = 8.0
    climb_m_s: float = 3.0
    sink_m_s: float = 2.0
    accel_m_s2: float = 2.5
    drag: float = 0.12
    yaw_rate: float = math.radians(60.0)
    gps_sigma_m: float = 0.0
    gps_tau_s: float = 60.0
    top_m_s: float = math.inf
    times: AutopilotTimes | None = None

    def as_flown(self, times: AutopilotTimes) -> "Airframe":
        """The same vehicle with the times of a real autopilot, and its rates of climb and descent."""
        usual = planner.Motion()
        return replace(self, climb_m_s=usual.climb_m_s, sink_m_s=usual.descent_m_s, times=times)

    def turn_s(self, speed_m_s: float, angle_rad: float) -> float:
        """Seconds that its autopilot takes longer than its motion for a turn."""
        if self.times is None:
            return 0.0
        own_s = speed_m_s * math.sin(0.5 * angle_rad) / self.accel_m_s2
        return max(0.0, float(planner.Motion(speed_m_s, autopilot=self.times).turn_s(np.array(angle_rad))) - own_s)

    def held_m_s(self, speed_m_s: float) -> float:
        """The speed that its autopilot holds where so much is asked for."""
        share = 1.0 if self.times is None else self.times.speed_share
        return min(share * speed_m_s, self.top_m_s)


@dataclass(slots=True, kw_only=True)
class VehicleMotion:
    """The state of motion of one vehicle, advanced in steps of STEP_S.

    Attributes:
        north: true position with east and up; velocities vn, ve, vu.
        speed: present cruise speed, m/s.
        climb_m_s: present rate of climb; gathers_m_s2: greatest gain of speed, less as it sets off.
        target: its target (north, east, up), None to stay on the ground; see `go`.
    """

    chart: Chart
    airframe: Airframe
    random: Random
    north: float = 0.0
    east: float = 0.0
    up: float = 0.0
    vn: float = 0.0
    ve: float = 0.0
    vu: float = 0.0
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    speed: float = 8.0
    climb_m_s: float = math.inf
    gathers_m_s2: float = math.inf
    target: tuple[float, float, float] | None = None
    _an: float = 0.0
    _ae: float = 0.0
    _start: tuple[float, float] = (0.0, 0.0)
    _drift: tuple[float, float] = (0.0, 0.0)
    _error: tuple[float, float] = (0.0, 0.0)
    _track: "deque[tuple[float, ...]]" = field(default_factory=lambda: deque(maxlen=20 * 600))

    def step(self, time_s: float) -> None:
        """Advance by STEP_S to a time since boot."""
        self._wander()
        if self.target is not None:
            self._fly(self.target)
        self._track.append((time_s, self.north, self.east, self.up, self.yaw, self.pitch, self.roll))

    def go(self, target: tuple[float, float, float], *, along_line: bool = False) -> None:
        """Fly to a point: along the line from the previous target, or straight from the present position."""
        before = self.target
        self._start = (before[0], before[1]) if along_line and before is not None else self.seen
        self.target = target

    def stop(self) -> None:
        """Brake to a stop with the largest acceleration."""
        north, east = self.seen
        after_s = math.hypot(self.vn, self.ve) / (2.0 * self.airframe.accel_m_s2) + 0.7
        up = max(min(self.up, _LOWEST_M), self.up + self.vu * abs(self.vu) / (2.0 * _LIFT_M_S2))
        self.go((north + self.vn * after_s, east + self.ve * after_s, up))

    def climb_to(self, up: float) -> None:
        """Raise the target."""
        if self.target is not None:
            self.target = (self.target[0], self.target[1], max(up, self.target[2]))

    def still(self) -> None:
        """Stand on the ground."""
        self.vn = self.ve = self.vu = self._an = self._ae = self.pitch = self.roll = self.up = 0.0
        self.target = None

    @property
    def came_from(self) -> tuple[float, float]:
        """North and east of where the way to the target began."""
        return self._start

    @property
    def seen(self) -> tuple[float, float]:
        """North and east from its receiver."""
        return self.north + self._error[0], self.east + self._error[1]

    def distance(self) -> tuple[float, float]:
        """Horizontal and vertical distance to the target as the autopilot sees it."""
        if self.target is None:
            return 0.0, 0.0
        north, east = self.seen
        return math.hypot(self.target[0] - north, self.target[1] - east), abs(self.target[2] - self.up)

    def pose(self, time_s: float) -> VehiclePose:
        """The true pose now."""
        return self._pose(time_s, (self.north, self.east, self.up, self.yaw, self.pitch, self.roll))

    def pose_at(self, time_s: float) -> VehiclePose:
        """The true pose at a time since boot, in the last ten minutes of flight; beyond its ends, the nearest."""
        track = self._track
        if not track:
            return self.pose(time_s)
        index = bisect.bisect_left(track, time_s, key=lambda sample: sample[0])
        if index == 0:
            return self._pose(time_s, track[0][1:])
        if index == len(track):
            return self._pose(time_s, track[-1][1:])
        before, after = track[index - 1], track[index]
        share = (time_s - before[0]) / (after[0] - before[0])
        values = [a + share * (b - a) for a, b in zip(before[1:], after[1:])]
        values[3] = before[4] + share * wrap_rad(after[4] - before[4])
        return self._pose(time_s, tuple(values))

    def _pose(self, time_s: float, values: tuple[float, ...]) -> VehiclePose:
        north, east, up, yaw, pitch, roll = values
        lat, lon = self.chart.to_degrees(north, east)
        return VehiclePose(
            time_s=time_s,
            lat_deg=lat,
            lon_deg=lon,
            height_m=up,
            alt_m=self.chart.alt_m + up,
            yaw_rad=yaw,
            pitch_rad=pitch,
            roll_rad=roll,
        )

    def _wander(self) -> None:
        sigma, tau = self.airframe.gps_sigma_m, self.airframe.gps_tau_s
        if sigma > 0.0:  # Ornstein-Uhlenbeck, smoothed as a filter does it that trusts inertia for some seconds
            keep = math.exp(-STEP_S / tau)
            kick = sigma * math.sqrt(1.0 - keep * keep)
            gauss = self.random.gauss
            dn, de = (keep * value + kick * gauss(0.0, 1.0) for value in self._drift)
            share = STEP_S / _FILTER_S
            en, ee = self._error
            self._drift, self._error = (dn, de), (en + share * (dn - en), ee + share * (de - ee))

    def _fly(self, target: tuple[float, float, float]) -> None:
        frame, dt = self.airframe, STEP_S
        seen_north, seen_east = self.seen
        distance = math.hypot(target[0] - seen_north, target[1] - seen_east)
        dn, de = self._carrot(target, seen_north, seen_east)
        ahead = math.hypot(dn, de)
        # The highest speed from which it can stop in time, with a margin for the lag of its tilt.
        wanted = min(self.speed, math.sqrt(1.4 * frame.accel_m_s2 * distance), 0.8 * distance)
        scale = wanted / ahead if ahead > 1e-6 else 0.0
        an, ae = (dn * scale - self.vn) / 0.5, (de * scale - self.ve) / 0.5
        size = math.hypot(an, ae)
        most = min(frame.accel_m_s2, self.gathers_m_s2) if an * self.vn + ae * self.ve >= 0.0 else frame.accel_m_s2
        limit = min(1.0, most / size) if size > 0.0 else 1.0
        lag = dt / 0.2
        self._an += lag * (an * limit - self._an)
        self._ae += lag * (ae * limit - self._ae)
        self.vn += dt * self._an
        self.ve += dt * self._ae
        rise = target[2] - self.up
        wanted_up = max(-frame.sink_m_s, min(frame.climb_m_s, self.climb_m_s, 1.0 * rise))
        self.vu += max(-_LIFT_M_S2 * dt, min(_LIFT_M_S2 * dt, wanted_up - self.vu))
        self.north += dt * self.vn
        self.east += dt * self.ve
        self.up += dt * self.vu
        if distance > 3.0:
            turn = wrap_rad(math.atan2(de, dn) - self.yaw)
            self.yaw = wrap_rad(self.yaw + max(-frame.yaw_rate * dt, min(frame.yaw_rate * dt, turn)))
        self._lean()

    def _carrot(self, target: tuple[float, float, float], north: float, east: float) -> tuple[float, float]:
        """Vector to a point on the line to the target, a little ahead of the nearest point (carrot chasing)."""
        ln, le = target[0] - self._start[0], target[1] - self._start[1]
        length = math.hypot(ln, le)
        if length < 1e-6:
            return target[0] - north, target[1] - east
        along = ((north - self._start[0]) * ln + (east - self._start[1]) * le) / length
        share = min(1.0, max(0.0, along + _LOOK_AHEAD_S * self.speed) / length)
        return self._start[0] + share * ln - north, self._start[1] + share * le - east

    def _lean(self) -> None:
        """Thrust points where the acceleration and the drag ask for."""
        north, east = self._an + self.airframe.drag * self.vn, self._ae + self.airframe.drag * self.ve
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        self.pitch = -math.atan2(north * cos + east * sin, _GRAVITY)
        self.roll = math.atan2(east * cos - north * sin, _GRAVITY)
