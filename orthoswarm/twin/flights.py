"""Flights over the area: boustrophedon legs, the true deviations from them, and what receivers and compasses record."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import Lens, focal_px
from orthoswarm.model.placement import Terrain

_START_S: Final = 1_750_000_000.0  # UTC epoch seconds of the first vehicle's first picture
FOVS_DEG = (85.0, 90.0, 95.0, 100.0, 105.0)  # the paper's cameras (IV.A)


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """The swarm's flight plan: blocks of parallel legs, one block per vehicle, in rows and columns."""

    columns: int = 3  # blocks side by side across the legs
    rows: int = 1  # blocks one behind the other along the legs
    photos: int = 339  # pictures of each vehicle
    legs: int = 4  # legs of each vehicle
    spacing_m: float = 8.75  # distance of pictures along the path
    leg_spacing_m: float = 100.0  # distance of neighbouring legs, also across a border between vehicles
    height_m: float = 150.0  # flying height over takeoff
    speed_m_s: float = 8.75  # cruising speed
    heading_rad: float = 0.0  # grid azimuth of the first leg
    width: int = 640  # columns of a picture
    height: int = 480  # rows

    @property
    def leg_length_m(self) -> float:
        """Length of a leg for which legs and turns together give the stated number of pictures."""
        return ((self.photos - 1) * self.spacing_m - (self.legs - 1) * self.leg_spacing_m) / self.legs

    @property
    def vehicles(self) -> int:
        """Number of vehicles."""
        return self.columns * self.rows

    @property
    def extent_m(self) -> tuple[float, float]:
        """Size of the area: across the legs, along them (half a leg spacing around the outer legs)."""
        across = self.columns * self.legs * self.leg_spacing_m
        along = self.rows * (self.leg_length_m + self.leg_spacing_m) - self.leg_spacing_m
        return across, along

    def vehicle_id(self, vehicle: int) -> str:
        """Id of a vehicle by its number, "uav01" for 0."""
        return f"uav{vehicle + 1:0{max(2, len(str(self.vehicles)))}d}"

    def outline(self) -> Array:
        """The closed ring (5, 2) around the area, across and along, about its centre."""
        across, along = (0.5 * side for side in self.extent_m)
        return np.array([[-across, -along], [across, -along], [across, along], [-across, along], [-across, -along]])

    def to_grid(self, across_along: Array, center: tuple[float, float]) -> Array:
        """Grid coordinates (..., 2) of positions across and along the legs, about the area's centre."""
        s, c = np.sin(self.heading_rad), np.cos(self.heading_rad)
        x, y = across_along[..., 0], across_along[..., 1]
        return np.stack([center[0] + x * c + y * s, center[1] - x * s + y * c], -1)

    def corners(self, vehicle: int) -> Array:
        """Waypoints (2 legs, 2) of a vehicle, across and along, about the area's centre."""
        across, along = self.extent_m
        column, row = vehicle % self.columns, vehicle // self.columns
        x0 = -0.5 * across + (column * self.legs + 0.5) * self.leg_spacing_m
        y0 = -0.5 * along + row * (self.leg_length_m + self.leg_spacing_m)
        points = []
        for k in range(self.legs):
            x = x0 + k * self.leg_spacing_m
            ends = [(x, y0), (x, y0 + self.leg_length_m)]
            points += ends if k % 2 == 0 else ends[::-1]
        return np.array(points)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueFlight:
    """The true flight of one vehicle."""

    vehicle: str
    lens: Lens  # its camera's true lens
    mount_rad: tuple[float, float]  # fixed offsets of the camera from the airframe (yaw, pitch)
    time_s: Array  # float64 (N,), UTC epoch seconds of the pictures
    planned: Array  # float64 (N, 3), planned position of each picture
    position: Array  # float64 (N, 3), true position of the camera
    velocity: Array  # float64 (N, 2), true ground speed
    angles: Array  # float64 (N, 3), the camera's true GRID yaw, pitch, roll in radians
    body: Array  # float64 (N, 3), the airframe's GRID yaw, pitch, roll in radians


def smooth_noise(rng: np.random.Generator, n: int, length: float, sigma: float) -> Array:
    """A smooth random curve of n values: standard deviation sigma, correlated over about `length` values."""
    pad = int(4 * length) + 1
    t = np.arange(-pad, pad + 1)
    kernel = np.exp(-0.5 * (t / max(length, 1e-3)) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    white = rng.normal(0.0, sigma, n + 2 * pad)
    return np.asarray(np.convolve(white, kernel, mode="valid")[:n])


def _path(corners: Array, count: int, spacing: float) -> tuple[Array, Array]:
    """Positions (N, 2) at equal steps along a polyline, and the direction (N,) there (clockwise from `along`)."""
    step = np.diff(corners, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    start = np.concatenate([[0.0], np.cumsum(length)])
    s = np.minimum(np.arange(count) * spacing, start[-1])
    k = np.clip(np.searchsorted(start, s, side="right") - 1, 0, len(length) - 1)
    t = (s - start[k]) / length[k]
    heading = np.arctan2(step[k, 0], step[k, 1])
    return corners[k] + step[k] * t[:, None], heading


def _curved(corners: Array, radius: float) -> Array:
    """The legs of a path as arcs to the left and right in turn, of 60 degrees each; turns between legs stay straight.

    An arc's chord is as long as its radius, so that it leaves the leg by 0.13 radii.
    """
    points = []
    for start, end in zip(corners[::2], corners[1::2], strict=True):
        length = float(np.hypot(*(end - start)))
        ahead = (end - start) / length
        side = np.array([ahead[1], -ahead[0]])
        along = np.linspace(0.0, length, max(2, int(length)))
        arc, x = np.divmod(along, radius)
        off = np.sqrt(radius**2 - (x - 0.5 * radius) ** 2) - np.cos(np.pi / 6) * radius
        points.append(start + along[:, None] * ahead + (np.where(arc % 2 == 0, off, -off))[:, None] * side)
    return np.concatenate(points)


def _ground_speed(
    heading: Array, motion: "FlightDeviations", wind_from_rad: float, calm_m_s: float
) -> tuple[Array, Array]:
    """Ground speed (N,) and crab angle (N,) along courses; without wind the plan's speed and 0.

    The vehicle flies `air_speed_m_s` through the air and points its nose into the wind so far that it keeps its course.
    """
    if not motion.wind_m_s:
        return np.full(len(heading), calm_m_s), np.zeros(len(heading))
    against = wind_from_rad - heading
    crab = np.arcsin(motion.wind_m_s / motion.air_speed_m_s * np.sin(against))
    return motion.air_speed_m_s * np.cos(crab) - motion.wind_m_s * np.cos(against), crab


def _slew(heading: Array, seconds: Array, rate_rad_s: float) -> Array:
    """Headings that follow the path's with a limited turning rate; `seconds` (N,): since the picture before."""
    out = heading.copy()
    for i in range(1, len(out)):
        turn = wrap_rad(float(heading[i] - out[i - 1]))
        out[i] = out[i - 1] + np.clip(turn, -rate_rad_s * seconds[i], rate_rad_s * seconds[i])
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightDeviations:
    """Deviations of the true flight from the plan."""

    track_m: float = 0.4  # one sigma of the horizontal deviation from the plan, slowly varying
    attitude_deg: float = 1.2  # one sigma of roll and pitch of the airframe, slowly varying
    jitter_deg: float = 0.25  # from picture to picture
    height_m: float = 0.35  # one sigma of the height
    drift_m: float = 0.0  # drift of the receiver, which the autopilot follows, so that the true path leaves the plan
    mount_yaw_deg: float = 30.0  # range of the camera's fixed yaw offset
    mount_pitch_deg: float = 5.0  # of its pitch offset
    wind_m_s: float = 0.0  # wind, from a direction drawn for the set; the nose turns into it by the crab angle
    air_speed_m_s: float = 15.0  # speed through the air, used in wind only
    curve_radius_m: float = 0.0  # legs are arcs of this radius, to the left and right in turn; 0: straight


def fly(
    plan: FlightPlan,
    motion: FlightDeviations,
    center: tuple[float, float],
    *,
    vehicle: int,
    seed: int,
    lens_k: tuple[float, float] = (0.0, 0.0),
) -> TrueFlight:
    """One vehicle's true flight.

    Args:
        plan: the swarm's flight plan. motion: deviations from it, the wind and the curvature of legs.
        center: grid coordinates of the area's centre. vehicle: its number.
        seed: of the set; each vehicle draws its own numbers from it. lens_k: radial distortion k1, k2 of all lenses.
    """
    rng = np.random.default_rng([seed, 41, vehicle])
    n = plan.photos
    corners = plan.corners(vehicle)
    way = _curved(corners, motion.curve_radius_m) if motion.curve_radius_m else corners
    local, heading = _path(way, n, plan.spacing_m)
    wind_from = float(np.random.default_rng([seed, 47]).uniform(0.0, 2.0 * np.pi))
    speed, crab = _ground_speed(heading + plan.heading_rad, motion, wind_from, plan.speed_m_s)
    seconds = plan.spacing_m / speed
    since_start: Array = np.concatenate([[0.0], np.cumsum(seconds[:-1])])
    if not motion.wind_m_s:  # equal steps, to the last bit
        since_start = seconds[0] * np.arange(n, dtype=np.float64)
    planned = np.c_[plan.to_grid(local, center), np.full(n, plan.height_m)]
    fov = float(rng.choice(FOVS_DEG))
    mount = np.radians([rng.uniform(-1, 1) * motion.mount_yaw_deg, rng.uniform(-1, 1) * motion.mount_pitch_deg])

    position = planned.copy()
    for axis in range(2):
        position[:, axis] += smooth_noise(rng, n, 8.0, motion.track_m) + rng.normal(0, 0.05, n)
        if motion.drift_m:
            position[:, axis] += _receiver_drift(rng, n, motion.drift_m)
    position[:, 2] += smooth_noise(rng, n, 12.0, motion.height_m)
    velocity = np.gradient(position[:, :2], since_start if motion.wind_m_s else seconds[0], axis=0)

    calm, jitter = np.radians(motion.attitude_deg), np.radians(motion.jitter_deg)
    nose = _slew(heading + plan.heading_rad + crab, seconds, np.radians(35.0))
    body = np.stack([nose, np.zeros(n), np.zeros(n)], -1)
    for axis in range(3):
        body[:, axis] += smooth_noise(rng, n, 3.0, calm) + rng.normal(0, jitter, n)
    body[:, 1] -= np.radians(1.0)  # nose down at cruise
    # the gimbal lets 80 % of the airframe's tilt through
    angles = np.stack([body[:, 0] + mount[0], -np.pi / 2 + mount[1] + 0.8 * body[:, 1], 0.8 * body[:, 2]], -1)
    lens = Lens(plan.width, plan.height, focal_px(np.radians(fov), plan.width), k1=lens_k[0], k2=lens_k[1])
    time: Array = _START_S + 7.0 * vehicle + since_start
    return TrueFlight(
        vehicle=plan.vehicle_id(vehicle), lens=lens, mount_rad=(float(mount[0]), float(mount[1])), time_s=time,
        planned=planned, position=position, velocity=velocity, angles=angles, body=body,
    )  # fmt: skip


def raised(flight: TrueFlight, ground: Terrain) -> TrueFlight:
    """The flight with its heights above the ground instead of above takeoff (terrain following)."""
    up = np.zeros_like(flight.planned)
    up[:, 2] = ground.height(flight.planned[:, :2])
    return replace(flight, planned=flight.planned + up, position=flight.position + up)


def _receiver_drift(rng: np.random.Generator, n: int, size: float) -> Array:
    """A smooth drift of a receiver along a flight of n pictures, 0 at the start, up to about `size` metres."""
    i = np.arange(n) / max(1, n - 1)
    line = rng.uniform(-1.0, 1.0) * size * i
    slow = smooth_noise(rng, n, 0.12 * n + 1, 0.22 * size)
    fast = smooth_noise(rng, n, 0.04 * n + 1, 0.05 * size)
    curve = line + slow + fast
    return np.asarray(curve - curve[0])


# -- records -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Errors of recorded poses; each value is one sigma or a half range, as stated."""

    position_m: float = 1.0  # half range of the uniform error of each picture's horizontal position (paper IV.A: 1 m)
    # half range of the drift per picture; the drift is index times one draw per vehicle and axis (paper IV.A: 0.1 m)
    drift_per_photo_m: float = 0.1
    heading_bias_deg: float = 0.0  # one sigma of a vehicle's fixed compass error
    tilt_bias_deg: float = 0.0  # of its pitch and roll error
    angle_deg: float = 0.0  # one sigma of the angles from picture to picture
    outlier_share: float = 0.0  # share of positions that are 5 to 20 m off
    lag_s: tuple[float, float] = (0.0, 0.0)  # (smallest, largest) delay of positions in seconds, one draw per vehicle
    height_m: float = 0.0  # one sigma of the height from picture to picture
    height_offset_m: float = 0.0  # fixed offset of all heights
    # the autopilot steers by the drifting receiver, so the recorded positions follow the plan
    follows_plan: bool = False


@dataclass(frozen=True, slots=True)
class Record:
    """Recorded poses of one vehicle."""

    position: Array  # float64 (N, 3), easting, northing, height over takeoff
    angles: Array  # float64 (N, 3), the camera's GRID yaw, pitch, roll in radians
    body: Array  # float64 (N, 3), the airframe's


def record(flight: TrueFlight, noise: Noise, vehicle: int, seed: int) -> Record:
    """The recorded poses of a flight; the same seed gives the same errors."""
    rng = np.random.default_rng([seed, 43, vehicle])
    n = len(flight.time_s)
    position = flight.position.copy()
    drift = rng.uniform(-noise.drift_per_photo_m, noise.drift_per_photo_m, 2)
    jitter = rng.uniform(-noise.position_m, noise.position_m, (n, 2))
    lag = float(rng.uniform(*noise.lag_s))
    if noise.follows_plan:
        position = flight.planned.copy()
        position[:, 2] = flight.position[:, 2]
    else:
        position[:, :2] += np.arange(n)[:, None] * drift
    position[:, :2] += jitter - lag * flight.velocity
    far = rng.random(n) < noise.outlier_share
    bearing, size = rng.uniform(0, 2 * np.pi, n), rng.uniform(5.0, 20.0, n)
    position[far, :2] += (size[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1))[far]
    position[:, 2] += noise.height_offset_m + rng.normal(0.0, noise.height_m, n)
    bias = np.radians(rng.normal(0, [noise.heading_bias_deg, noise.tilt_bias_deg, noise.tilt_bias_deg]))
    wander = np.radians(rng.normal(0, noise.angle_deg, (n, 3)))
    return Record(position, flight.angles + bias + wander, flight.body + bias + wander)
