"""From the homography of a leg to cameras: the best-fitting pose of each frame, and corrections for unmatched legs.

The paper warps a leg's frames by its homography. All products here need cameras, so each frame gets the pose whose
footprint is closest to the warped one, with interior orientation fixed. What a perspective camera cannot represent,
mainly shear, remains as `rms_m`: a few centimetres on real legs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import Camera

_POSE_ROUNDS: Final = 6  # most Gauss-Newton steps of the pose that reproduces a homography best


@dataclass(frozen=True, slots=True)
class CorrectedCamera:
    """A corrected camera and the rms of the residuals of its ground points, metres."""

    camera: Camera
    rms_m: float


def fit_camera(camera: Camera, corrected: Array, pixels: Array) -> CorrectedCamera:
    """Space resection by Gauss-Newton: the pose that images ground points (N, 2) at height 0 at pixels (N, 2)."""
    points = np.c_[corrected, np.zeros(len(corrected))]
    position = camera.position + np.array([*(corrected - camera.to_ground(pixels)).mean(axis=0), 0.0])
    current = Camera(position, camera.rotation, camera.lens)
    for _ in range(_POSE_ROUNDS):
        projected = current.project(points)
        jacobian = np.empty((2 * len(points), 6))
        for k in range(6):
            jacobian[:, k] = ((_moved(current, k, 1e-5).project(points) - projected) / 1e-5).ravel()
        step, *_ = np.linalg.lstsq(jacobian, (pixels - projected).ravel(), rcond=None)
        if not np.isfinite(step).all():
            break
        current = _apply_step(current, np.asarray(step, np.float64))
        if np.abs(step).max() < 1e-7:
            break
    error = current.to_ground(pixels) - corrected
    return CorrectedCamera(current, float(np.sqrt((error**2).sum(1).mean())))


def pixel_grid(camera: Camera, columns: int = 6, rows: int = 5) -> Array:
    """Pixels (N, 2) evenly over a picture."""
    u = np.linspace(0.05, 0.95, columns) * (camera.lens.width - 1)
    v = np.linspace(0.05, 0.95, rows) * (camera.lens.height - 1)
    return np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)


def carried_shift(index: Array, matched: Sequence[tuple[float, Array]]) -> Array:
    """Corrections (N, 2) of frames between matched legs of the same vehicle, interpolated by frame number.

    Args:
        index: float64 (N,), frame numbers.
        matched: middle frame number and shift (2,) of each leg that was found.
    """
    order = sorted(matched, key=lambda m: m[0])
    at = np.array([m[0] for m in order])
    shift = np.array([m[1] for m in order])
    return np.column_stack([np.interp(index, at, shift[:, k]) for k in range(2)])


def _moved(camera: Camera, k: int, step: float) -> Camera:
    change = np.zeros(6)
    change[k] = step
    return _apply_step(camera, change)


def _apply_step(camera: Camera, step: Array) -> Camera:
    return Camera(camera.position + step[:3], rotation_of(step[3:]) @ camera.rotation, camera.lens)


def rotation_of(vector: Array) -> Array:
    """The rotation (3, 3) about a vector by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-15:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k))
