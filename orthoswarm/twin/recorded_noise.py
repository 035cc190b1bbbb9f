"""Recorded poses: the true ones with the errors of GNSS receivers, compasses and clocks."""

from dataclasses import dataclass

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.twin.true_flight import TrueFlight


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Errors of recorded poses; each value is one sigma or a half range, as stated.

    Attributes:
        position_m: half range of the uniform error of each picture's horizontal position (paper IV.A: 1 m).
        drift_per_photo_m: half range of the drift per picture; the drift is index times one draw per vehicle
            and axis (paper IV.A: 0.1 m).
        heading_bias_deg: one sigma of a vehicle's fixed compass error. tilt_bias_deg: of its pitch and roll error.
        angle_deg: one sigma of the angles from picture to picture.
        outlier_share: share of positions that are 5 to 20 m off.
        lag_s: (smallest, largest) delay of positions in seconds, one draw per vehicle.
        height_m: one sigma of the height from picture to picture. height_offset_m: fixed offset of all heights.
        follows_plan: the autopilot steers by the drifting receiver, so the recorded positions follow the plan.
    """

    position_m: float = 1.0
    drift_per_photo_m: float = 0.1
    heading_bias_deg: float = 0.0
    tilt_bias_deg: float = 0.0
    angle_deg: float = 0.0
    outlier_share: float = 0.0
    lag_s: tuple[float, float] = (0.0, 0.0)
    height_m: float = 0.0
    height_offset_m: float = 0.0
    follows_plan: bool = False


@dataclass(frozen=True, slots=True)
class Record:
    """Recorded poses of one vehicle.

    Attributes:
        position: float64 (N, 3), easting, northing, height over takeoff.
        angles: float64 (N, 3), the camera's GRID yaw, pitch, roll in radians.
        body: float64 (N, 3), the airframe's.
    """

    position: Array
    angles: Array
    body: Array


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
