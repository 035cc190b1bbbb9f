"""The records of one vehicle's frames as arrays in the local frame; gaps are filled and marked."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Flags
from orthoswarm.model.camera import rotation_from_angles
from orthoswarm.model.frame import DEFAULT_HEIGHT_M, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.trajectory.legs import course

_COURSE_REACH_PHOTOS: Final = 3  # flown steps are medians over so many photos before and after
_COURSE_TURN_DEG: Final = 12.0  # ... of those whose heading differs by less
_STEP_TIME_FACTOR: Final = 1.7  # ... and that took at most so many times longer or shorter
_VELOCITY_REACH_PHOTOS: Final = 2  # velocities are differences over so many photos before and after
_VELOCITY_LEAP: Final = 3.0  # so many times the median velocity, plus 1 m/s, is a leap and counts as 0


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightRecords:
    """Records of N frames in order of time.

    Attributes:
        position: float64 (N, 3), east, north minus the origin, height over the takeoff level (see has_height).
        yaw, pitch, roll: float64 (N,), GRID yaw; where unknown: the course, and nadir.
        time_s: float64 (N,); picture number where times are unknown or not increasing. timed: True for seconds.
        has_height, has_yaw, has_tilt: bool (N,), True where recorded.
        position_sigma: float64 (N,) horizontal, metres, as stated by the source (NaN where not).
    """

    position: Array
    yaw: Array
    pitch: Array
    roll: Array
    time_s: Array
    has_height: Flags
    has_yaw: Flags
    has_tilt: Flags
    position_sigma: Array
    timed: bool

    def rotation(self) -> Array:
        """Recorded attitudes, camera to ground, float64 (N, 3, 3)."""
        return rotation_from_angles(self.yaw, self.pitch, self.roll)

    def steps(self) -> Array:
        """Movement from the previous frame to each frame, float64 (N, 3), metres.

        The median over neighbours on the same course that took about as long; the recorded step where too few did, as
        where pictures between two frames are missing.
        """
        n, reach = len(self.position), _COURSE_REACH_PHOTOS
        raw = np.diff(self.position, axis=0, prepend=self.position[:1])
        took = np.maximum(np.diff(self.time_s, prepend=self.time_s[:1]), 1e-3)
        out = raw.copy()
        for i in range(1, n):
            near = np.arange(max(1, i - reach), min(n, i + reach + 1))
            same = np.abs(wrap_rad(self.yaw[near] - self.yaw[i])) < np.radians(_COURSE_TURN_DEG)
            same &= np.abs(np.log(took[near] / took[i])) < np.log(_STEP_TIME_FACTOR)
            chosen = near[same]
            if len(chosen) >= 3:
                out[i] = np.median(raw[chosen], axis=0)
        return out

    def velocity(self) -> Array:
        """Smoothed horizontal velocity (N, 2) in m/s (metres per picture where times are unknown)."""
        n, reach = len(self.position), _VELOCITY_REACH_PHOTOS
        a, b = np.maximum(np.arange(n) - reach, 0), np.minimum(np.arange(n) + reach, n - 1)
        dt = np.maximum(self.time_s[b] - self.time_s[a], 1e-3)[:, None]
        v = (self.position[b, :2] - self.position[a, :2]) / dt
        speed = np.hypot(*v.T)
        usual = float(np.median(speed)) if n else 0.0
        return np.asarray(np.where((speed > _VELOCITY_LEAP * usual + 1)[:, None], 0.0, v))


def read_records(frames: Sequence[Frame], grid: LocalGrid, origin: Array) -> FlightRecords:
    """Read the records of frames, in order; if no frame has a height, all get the configured default."""
    lat = np.array([f.fix.lat_deg for f in frames])
    lon = np.array([f.fix.lon_deg for f in frames])
    xy = grid.to_grid(lat, lon) - origin[:2]
    height = column([f.fix.height_m for f in frames])
    yaw = column([f.fix.yaw_rad for f in frames]) - grid.convergence_rad(lat, lon)
    pitch, roll = column([f.fix.pitch_rad for f in frames]), column([f.fix.roll_rad for f in frames])
    has_height, has_yaw, has_tilt = np.isfinite(height), np.isfinite(yaw), np.isfinite(pitch)
    filled = float(np.median(height[has_height])) if has_height.any() else DEFAULT_HEIGHT_M
    position = np.column_stack([xy, np.where(has_height, height, filled)])
    time = column([f.time_s for f in frames])
    rises = len(frames) > 1 and np.isfinite(time).all() and (np.diff(time) >= 0).all() and time[-1] > time[0]
    return FlightRecords(
        position=position,
        yaw=wrap_rad(np.where(has_yaw, yaw, course(xy))),
        pitch=np.where(has_tilt, pitch, -np.pi / 2),
        roll=np.where(np.isfinite(roll), roll, 0.0),
        time_s=time - time[0] if rises else np.arange(len(frames), dtype=float),
        has_height=has_height,
        has_yaw=has_yaw,
        has_tilt=has_tilt,
        position_sigma=column([f.fix.position_sigma_m for f in frames]),
        timed=bool(rises),
    )


def column(values: Sequence[float | None]) -> Array:
    """Values as an array, NaN for None."""
    return np.array([np.nan if v is None else v for v in values], float)
