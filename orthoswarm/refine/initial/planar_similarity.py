"""Level photos as planar similarities of the ground: records, pairs and pictures as complex numbers.

Ground: east + i north. Picture: z = (u - u0) - i (v - v0), pixels about the picture's centre, y up. A level photo shows
the ground point P + m exp(-i yaw) z: P straight below, m metres per pixel, yaw clockwise from grid north.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Complex, Flags, Indices, Ints
from orthoswarm.model.camera import NADIR_PITCH_RAD, rotation_from_angles
from orthoswarm.model.frame import UNSTATED_SIGMA_M
from orthoswarm.refine.features.sift_features import SiftFeatures
from orthoswarm.trajectory.legs import PAUSE_S

_TURN_SIGMA_DEG: Final = 1.0  # sigma of the turn between two photos by relief and tilt
_TURN_MISFIT_SIGMAS: Final = 3.0  # ... and so many times the misfit over the spread, by the root of matches
_TAG_TILT_LIMIT_DEG: Final = 45.0  # recorded tilt beyond this is not a start: such a photo could not be matched anyway
_STATED_SIGMA_FLOOR_M: Final = 0.1  # least sigma of a position whose source states one: an antenna is not a camera
_VELOCITY_LEAST_S: Final = 0.05  # photos nearer in time give no velocity
_VELOCITY_LIMIT_M_S: Final = 40.0  # faster is a leap of the record (faster than small drones fly)
_VELOCITY_TURN_SHARE: Final = 0.5  # a larger difference of velocities before and after is a turn


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoRecords:
    """Records of N photos of L lenses in S segments, of a vehicle in order of time; NaN where unknown.

    Attributes:
        position: complex (N,), east + i north in metres about some origin. position_sigma: float64 (N,), as stated.
        time_s: float64 (N,). height_m: float64 (N,) above takeoff or ground. altitude_m: float64 (N,) absolute.
        yaw: float64 (N,) grid azimuth of the picture's up direction; flight_yaw: of the airframe, radians.
        pitch: float64 (N,), -pi/2 is nadir; roll: float64 (N,).
        lens: int32 (N,). segment: int32 (N,). vehicle: int32 (N,), a vehicle with one of its lenses.
        width, rows: float64 (N,), of the picture. fov_hint: float64 (L,), from tags, radians.
    """

    position: Complex
    position_sigma: Array
    time_s: Array
    height_m: Array
    altitude_m: Array
    yaw: Array
    flight_yaw: Array
    pitch: Array
    roll: Array
    lens: Ints
    segment: Ints
    vehicle: Ints
    width: Array
    rows: Array
    fov_hint: Array

    def __len__(self) -> int:
        return len(self.position)

    def gps_sigma(self) -> Array:
        """One sigma of the recorded positions in metres, (N,): as stated (with a floor), else as usual."""
        stated = np.hypot(self.position_sigma, _STATED_SIGMA_FLOOR_M)
        return np.asarray(np.where(np.isfinite(stated), stated, UNSTATED_SIGMA_M))

    def velocity(self) -> Complex:
        """Ground velocity, complex (N,) m/s, from the neighbours in the segment; 0 at turns and where unknown."""
        v = np.zeros(len(self), np.complex128)
        for s in np.unique(self.segment):
            rows = np.flatnonzero(self.segment == s)
            dt, dp = np.diff(self.time_s[rows]), np.diff(self.position[rows])
            good = (dt > _VELOCITY_LEAST_S) & (dt < PAUSE_S) & (np.abs(dp) < _VELOCITY_LIMIT_M_S * dt)
            leap = np.where(good, dp / np.where(good, dt, 1.0), np.nan)
            sides = np.stack([np.r_[np.nan, leap], np.r_[leap, np.nan]])
            known = np.isfinite(sides)
            mean = np.where(known, sides, 0.0).sum(0) / np.maximum(known.sum(0), 1)
            larger = np.abs(np.where(known, sides, 0.0)).max(0)
            turn = known.all(0) & (np.abs(sides[0] - sides[1]) > _VELOCITY_TURN_SHARE * larger)
            v[rows] = np.where(turn, 0.0, mean)
        return v

    def tag_level(self) -> Array:
        """Rotations camera to level camera by the tilt tags, float64 (N, 3, 3); the identity where none are usable."""
        pitch = np.where(np.isfinite(self.pitch), self.pitch, NADIR_PITCH_RAD)
        roll = np.where(np.isfinite(self.roll), self.roll, 0.0)
        level = _from_level(0.0).T @ rotation_from_angles(0.0, pitch, roll)
        level[level[:, 2, 2] < np.cos(float(np.radians(_TAG_TILT_LIMIT_DEG)))] = np.eye(3)
        return np.asarray(level)


@dataclass(frozen=True, slots=True, kw_only=True)
class PairGraph:
    """Similarities between pairs of level pictures: z of the second = factor (z of the first) + constant.

    Attributes:
        first: int32 (E,), index of one photo; second: int32 (E,).
        factor: complex (E,); its argument is yaw(second) - yaw(first), its size m(first) / m(second).
        centre_first: complex (E,), mean of the matches in the first; centre_second: in the second.
        count: int64 (E,) matches. spread: float64 (E,) their one sigma about the mean, pixels of the first.
        residual: float64 (E,) median misfit in pixels of the second.
    """

    first: Ints
    second: Ints
    factor: Complex
    centre_first: Complex
    centre_second: Complex
    count: Indices
    spread: Array
    residual: Array

    def __len__(self) -> int:
        return len(self.first)

    def take(self, keep: Flags) -> "PairGraph":
        """Some of the pairs."""
        return PairGraph(**{name: getattr(self, name)[keep] for name in self.__slots__})

    @property
    def turn_sigma(self) -> Array:
        """One sigma of the turn, radians (E,): larger for few, close or ill-fitting matches."""
        arm = np.maximum(self.spread * np.abs(self.factor), 1.0)
        misfit = _TURN_MISFIT_SIGMAS * self.residual / (arm * np.sqrt(self.count))
        return np.asarray(np.hypot(np.radians(_TURN_SIGMA_DEG), misfit))

    @property
    def turn(self) -> Complex:
        """exp(i (yaw(second) - yaw(first))), complex (E,)."""
        return np.asarray(self.factor / np.maximum(np.abs(self.factor), 1e-12))


def _from_level(yaw: Array | float) -> Array:
    """Rotation level camera to ground, float64 (..., 3, 3)."""
    return rotation_from_angles(yaw, NADIR_PITCH_RAD, 0.0)


def rotation_of(yaw: Array, level: Array) -> Array:
    """Camera-to-ground rotations (N, 3, 3) of grid yaw (N,) and camera-to-level rotations (N, 3, 3)."""
    return np.asarray(_from_level(yaw) @ level)


def centred(features: SiftFeatures) -> Complex:
    """Pixels of features about the picture's centre, y up, complex (n,)."""
    uv = features.uv.astype(np.float64)
    return np.asarray((uv[:, 0] - 0.5 * (features.width - 1)) - 1j * (uv[:, 1] - 0.5 * (features.height - 1)))


def level_from_nadir(offset: complex, focal: float) -> Array:
    """The smallest rotation (3, 3) that puts the nadir, at pixel `offset` (y up), onto the optical axis."""
    n = np.array([offset.real, -offset.imag, focal])
    n /= np.linalg.norm(n)
    axis = np.array([n[1], -n[0], 0.0])  # n x z
    sine, cosine = float(np.hypot(n[0], n[1])), float(n[2])
    if sine < 1e-12:
        return np.eye(3)
    k = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]]) / sine
    return np.asarray(np.eye(3) + sine * k + (1.0 - cosine) * (k @ k))
