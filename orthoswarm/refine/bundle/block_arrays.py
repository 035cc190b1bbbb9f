"""Orientation of many cameras and their observations as plain arrays for compiled kernels, and rotation vectors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Array, Floats, Ints
from orthoswarm.model.camera import LEAST_RADIAL_SLOPE, Camera, Lens

F, K1, K2, K3, CX, CY, WIDTH, HEIGHT = range(8)
"""Columns of CameraBlock.lens: focal length in px, radial terms, offset of the principal point in px, picture size."""
LEAST_DEPTH_M = 1e-3  # points less than this before a camera are not visible


@dataclass(frozen=True, slots=True)
class CameraBlock:
    """Cameras of one or several vehicles in a local frame (east, north, up about a common origin, metres).

    position: float64 (N, 3). rotation: float64 (N, 3, 3), camera to ground (columns are the camera's x, y, z axes).
    lens_id: int32 (N,), row of `lens`, float64 (L, 8), columns F, K1, K2, K3, CX, CY, WIDTH, HEIGHT.
    """

    position: Array
    rotation: Array
    lens_id: Ints
    lens: Array

    def __len__(self) -> int:
        return len(self.position)

    def copy(self) -> "CameraBlock":
        """A copy with its own arrays."""
        return replace(self, position=self.position.copy(), rotation=self.rotation.copy(), lens=self.lens.copy())

    def take(self, index: NDArray[np.integer] | slice) -> "CameraBlock":
        """A subset of the cameras; the lens table is shared."""
        return replace(self, position=self.position[index], rotation=self.rotation[index], lens_id=self.lens_id[index])

    def camera(self, i: int, origin: Array) -> Camera:
        """Camera i on the area's grid; origin (2,): of the local frame."""
        row = self.lens[self.lens_id[i]].tolist()
        lens = Lens(
            int(row[WIDTH]), int(row[HEIGHT]), row[F], k1=row[K1], k2=row[K2], k3=row[K3], cx=row[CX], cy=row[CY]
        )
        return Camera(self.position[i] + [*origin[:2], 0.0], self.rotation[i].copy(), lens)

    @classmethod
    def joined(cls, blocks: "Sequence[CameraBlock]") -> "CameraBlock":
        """The cameras of several blocks, one after the other, each with its own lenses."""
        before = np.cumsum([0, *(len(b.lens) for b in blocks)])
        lens_id = np.concatenate([b.lens_id + before[k] for k, b in enumerate(blocks)]).astype(np.int32)
        position, rotation, lens = (
            np.concatenate([getattr(b, name) for b in blocks]) for name in ("position", "rotation", "lens")
        )
        return cls(position, rotation, lens_id, lens)

    @property
    def arrays(self) -> tuple[Array, Array, Ints, Array]:
        """Position, rotation, lens_id and lens, as compiled code takes them."""
        return self.position, self.rotation, self.lens_id, self.lens

    def project(self, camera: NDArray[np.integer], points: Array) -> Array:
        """Pixels (M, 2), distorted, of points (M, 3) in cameras (M,); NaN behind one or beyond its distortion model."""
        uv = np.empty((len(camera), 2))
        _project_many(self.arrays, camera.astype(np.int32), np.asarray(points, float), uv)
        return uv

    def to_ground(self, camera: NDArray[np.integer], uv: Array, z: Array) -> Array:
        """Ground points (M, 2) of pixels (M, 2), distortion removed, at heights (M,); NaN above the horizon."""
        xy = np.empty((len(camera), 2))
        heights = np.ascontiguousarray(np.broadcast_to(np.asarray(z, float), (len(camera),)))
        _ground_many(self.arrays, camera.astype(np.int32), np.asarray(uv, float), heights, xy)
        return xy


@dataclass(frozen=True, slots=True)
class Tracks:
    """Observations of tie points in pictures, from tracked corners or matched features, in any order.

    camera: int32 (M,), index of the camera. point: int32 (M,), id of the track, 0..P-1. uv: float64 (M, 2), column and
    row, distorted as in the picture, pixel centres at integers. sigma_px: float32 (M,), one sigma.
    """

    camera: Ints
    point: Ints
    uv: Array
    sigma_px: Floats

    @property
    def count(self) -> int:
        """Number of tracks."""
        return int(self.point.max()) + 1 if len(self.point) else 0

    def take(self, index: NDArray[Any]) -> "Tracks":
        """Some of the observations."""
        return Tracks(self.camera[index], self.point[index], self.uv[index], self.sigma_px[index])

    def renumbered(self) -> "Tracks":
        """The observations with the numbers of the points that are left closed up."""
        return replace(self, point=np.unique(self.point, return_inverse=True)[1].reshape(-1).astype(np.int32))

    def with_more(self, camera: Ints, point: Ints, uv: Array, sigma_px: float) -> "Tracks":
        """The observations and more of them (K,), uv (K, 2), that have one sigma."""
        return Tracks(
            np.concatenate([self.camera, camera]),
            np.concatenate([self.point, point]),
            np.concatenate([self.uv, uv]),
            np.concatenate([self.sigma_px, np.full(len(camera), sigma_px, np.float32)]),
        )


@in_place_kernel
def project_point(position, rotation, lens, x, y, z):  # type: ignore[no-untyped-def]
    """Pixel (u, v) of a ground point; NaN behind the camera or where its distortion is no longer monotonic."""
    dx, dy, dz = x - position[0], y - position[1], z - position[2]
    cz = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    if cz < LEAST_DEPTH_M:
        return np.nan, np.nan
    cx = (rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz) / cz
    cy = (rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz) / cz
    r2 = cx * cx + cy * cy
    if 1.0 + r2 * (3.0 * lens[1] + r2 * (5.0 * lens[2] + r2 * 7.0 * lens[3])) < LEAST_RADIAL_SLOPE:
        return np.nan, np.nan
    s = lens[0] * (1.0 + r2 * (lens[1] + r2 * (lens[2] + r2 * lens[3])))
    return s * cx + 0.5 * (lens[6] - 1.0) + lens[4], s * cy + 0.5 * (lens[7] - 1.0) + lens[5]


@in_place_kernel
def pixel_ray(rotation, lens, u, v):  # type: ignore[no-untyped-def]
    """Ground direction (3 numbers, camera depth 1) of a pixel, distortion removed by Newton's method on the radius."""
    xd = (u - 0.5 * (lens[6] - 1.0) - lens[4]) / lens[0]
    yd = (v - 0.5 * (lens[7] - 1.0) - lens[5]) / lens[0]
    rd = np.sqrt(xd * xd + yd * yd)
    s = 1.0
    if rd > 1e-12 and (lens[1] != 0.0 or lens[2] != 0.0 or lens[3] != 0.0):
        r = rd
        for _ in range(10):
            r2 = r * r
            g = r * (1.0 + r2 * (lens[1] + r2 * (lens[2] + r2 * lens[3]))) - rd
            dg = 1.0 + r2 * (3.0 * lens[1] + r2 * (5.0 * lens[2] + r2 * 7.0 * lens[3]))
            r = min(max(r - g / max(dg, LEAST_RADIAL_SLOPE), 0.0), 4.0)
            if abs(g) < 1e-10:
                break
        s = r / rd
    x, y = xd * s, yd * s
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2],
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2],
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2],
    )


@in_place_kernel
def _project_many(cameras, camera, points, uv):  # type: ignore[no-untyped-def]
    position, rotation, lens_id, lens = cameras
    for m in range(len(camera)):
        i = camera[m]
        uv[m, 0], uv[m, 1] = project_point(
            position[i], rotation[i], lens[lens_id[i]], points[m, 0], points[m, 1], points[m, 2]
        )


@in_place_kernel
def _ground_many(cameras, camera, uv, z, xy):  # type: ignore[no-untyped-def]
    position, rotation, lens_id, lens = cameras
    for m in range(len(camera)):
        i = camera[m]
        dx, dy, dz = pixel_ray(rotation[i], lens[lens_id[i]], uv[m, 0], uv[m, 1])
        if dz < -1e-9:
            t = (z[m] - position[i, 2]) / dz
            xy[m, 0], xy[m, 1] = position[i, 0] + t * dx, position[i, 1] + t * dy
        else:
            xy[m, 0], xy[m, 1] = np.nan, np.nan


def exp_rotation(vector: Array) -> Array:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3), Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=1)
    a = np.where(angle < 1e-8, 1.0, np.sin(angle) / np.maximum(angle, 1e-12))[:, None, None]
    b = np.where(angle < 1e-4, 0.5, (1.0 - np.cos(angle)) / np.maximum(angle, 1e-12) ** 2)[:, None, None]
    k = np.zeros((len(vector), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -vector[:, 2], vector[:, 1], -vector[:, 0]
    k -= np.swapaxes(k, 1, 2)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def log_rotation(rotation: Array) -> Array:
    """Rotation vectors (N, 3) of rotation matrices (N, 3, 3)."""
    cosine = np.clip((np.trace(rotation, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    angle = np.arccos(cosine)
    vector = (rotation - np.swapaxes(rotation, 1, 2))[:, [2, 0, 1], [1, 2, 0]]
    scale = np.where(angle < 1e-6, 0.5, angle / np.maximum(2.0 * np.sin(angle), 1e-9))
    return np.asarray(vector * scale[:, None])
