"""The frustum camera of the paper (III.B): lens, orientation, flat-ground homography, footprint, nadir point.

Axes: ground east, north, up (grid metres); camera x right, y down, z forward; pixel centres at integers.
The orientation is R_ned = Rz(yaw) Ry(pitch + 90 deg) Rx(roll) with camera (x, y, z) -> body (-y, x, z), so
pitch -90 deg looks straight down and yaw is the azimuth of the picture's up direction at nadir.
Sign and axis conventions are defined only in this module.
"""

from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

NADIR_PITCH_RAD = -np.pi / 2
_CAMERA_TO_BODY = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
NED_TO_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

LEAST_RADIAL_SLOPE = 0.2
"""The lens model holds while d r_distorted / d r = 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6 stays above this: a polynomial
that was fitted within the picture folds back somewhere outside it."""


def focal_px(fov_rad: float, width: int) -> float:
    """Focal length in pixels of a horizontal field of view: (W/2) / tan(FoV/2)."""
    return 0.5 * width / float(np.tan(0.5 * fov_rad))


def fov_rad(focal_px: float, width: int) -> float:
    """Horizontal field of view in radians of a focal length in pixels."""
    return 2.0 * float(np.arctan(0.5 * width / focal_px))


def rotation_from_angles(yaw_rad: ArrayLike, pitch_rad: ArrayLike, roll_rad: ArrayLike) -> Array:
    """Camera-to-ground rotations, float64 (..., 3, 3), of GRID yaw, pitch and roll in radians.

    Columns are the camera's x, y, z axes in east, north, up. Grid yaw = true yaw - meridian convergence.
    """
    y, p, r = np.broadcast_arrays(
        np.asarray(yaw_rad, float), np.asarray(pitch_rad, float) + np.pi / 2, np.asarray(roll_rad, float)
    )
    cy, sy, cp, sp, cr, sr = np.cos(y), np.sin(y), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    ned = np.empty((*y.shape, 3, 3))
    ned[..., 0, 0], ned[..., 0, 1], ned[..., 0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    ned[..., 1, 0], ned[..., 1, 1], ned[..., 1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    ned[..., 2, 0], ned[..., 2, 1], ned[..., 2, 2] = -sp, cp * sr, cp * cr
    return np.asarray(NED_TO_ENU @ ned @ _CAMERA_TO_BODY, dtype=np.float64)


def angles_from_rotation(rotation: ArrayLike) -> tuple[Array, Array, Array]:
    """GRID yaw, pitch, roll in radians of camera-to-ground rotations (..., 3, 3); inverse of the above."""
    ned = NED_TO_ENU.T @ np.asarray(rotation, float) @ _CAMERA_TO_BODY.T
    yaw = np.arctan2(ned[..., 1, 0], ned[..., 0, 0])
    pitch = np.arcsin(np.clip(-ned[..., 2, 0], -1.0, 1.0)) - np.pi / 2
    roll = np.arctan2(ned[..., 2, 1], ned[..., 2, 2])
    return yaw, pitch, roll


@dataclass(frozen=True, slots=True)
class Lens:
    """A pinhole with OpenCV's radial distortion about the picture's centre.

    x_d = x_u (1 + k1 r2 + k2 r2^2 + k3 r2^3) with x in units of f about ((W-1)/2 + cx, (H-1)/2 + cy).

    Attributes:
        width, height: columns and rows of the picture. focal_px: focal length in pixels of the undistorted pinhole.
        k1, k2, k3: radial terms. cx, cy: offset of the principal point from the centre in pixels, columns and rows.
    """

    width: int
    height: int
    focal_px: float
    _: KW_ONLY
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    cx: float = 0.0
    cy: float = 0.0

    @property
    def fov_rad(self) -> float:
        """Horizontal field of view, radians."""
        return fov_rad(self.focal_px, self.width)

    @property
    def principal_point(self) -> tuple[float, float]:
        """Column and row of the principal point."""
        return (0.5 * (self.width - 1) + self.cx, 0.5 * (self.height - 1) + self.cy)

    @property
    def is_pinhole(self) -> bool:
        """True without radial distortion."""
        return self.k1 == 0.0 and self.k2 == 0.0 and self.k3 == 0.0

    def reduced(self, factor: int) -> "Lens":
        """The lens of the picture averaged over blocks of factor x factor, which divides its sides."""
        width, height, focal_px = self.width // factor, self.height // factor, self.focal_px / factor
        return replace(self, width=width, height=height, focal_px=focal_px, cx=self.cx / factor, cy=self.cy / factor)

    def matrix(self) -> Array:
        """The 3x3 calibration matrix (undistorted pinhole)."""
        u, v = self.principal_point
        return np.array([[self.focal_px, 0.0, u], [0.0, self.focal_px, v], [0.0, 0.0, 1.0]])

    def distort(self, xy: ArrayLike) -> Array:
        """Distorted from undistorted normalised coordinates (..., 2)."""
        x = np.asarray(xy, float)
        r2 = (x * x).sum(-1, keepdims=True)
        return np.asarray(x * (1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))))

    def undistort(self, xy: ArrayLike) -> Array:
        """Undistorted from distorted normalised coordinates (..., 2), by Newton's method on the radius."""
        d = np.asarray(xy, float)
        rd = np.sqrt((d * d).sum(-1, keepdims=True))
        r = rd.copy()
        for _ in range(12):
            r2 = r * r
            g = r * (1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))) - rd
            dg = 1.0 + r2 * (3 * self.k1 + r2 * (5 * self.k2 + r2 * 7 * self.k3))
            # where the distortion is not monotonic there is no inverse: stay finite
            r = np.clip(r - g / np.maximum(dg, 0.2), 0.0, 4.0)
        return np.asarray(d * np.where(rd > 1e-12, r / np.maximum(rd, 1e-12), 1.0))


def ground_jacobian(rotation: Array, height_m: float, least_down: float) -> Array | None:
    """How the point where a picture's optical axis meets level ground moves with the picture's exterior orientation.

    Args:
        rotation: (3, 3), camera to ground. height_m: of the camera above the ground.
        least_down: least downward component of the axis (unit vector).

    Returns:
        float64 (2, 6): east and north by position (3) and by rotation about the camera's own axes (3, radians). None
        where the axis does not point down by that much.
    """
    ray = rotation[:, 2]
    if ray[2] > -least_down:
        return None
    reach = -height_m / ray[2]
    moved = np.zeros((3, 6))
    moved[:, :3] = np.eye(3)
    for axis in range(3):  # a rotation about the camera's axis a turns the ray by R (e_a x e_z)
        moved[:, 3 + axis] = reach * (rotation @ np.cross(np.eye(3)[axis], [0.0, 0.0, 1.0]))
    onto = np.array([[1.0, 0.0, -ray[0] / ray[2]], [0.0, 1.0, -ray[1] / ray[2]]])
    return np.asarray(onto @ moved)


@dataclass(frozen=True, slots=True)
class Camera:
    """Exterior and interior orientation of a picture.

    Attributes:
        position: float64 (3,), easting, northing, height in metres (heights share the datum of the ground plane).
        rotation: float64 (3, 3), camera to ground; columns are the camera's axes in east, north, up.
        lens: interior orientation.
    """

    position: Array
    rotation: Array
    lens: Lens

    def project(self, points: ArrayLike) -> Array:
        """Pixels (..., 2), distortion included, of ground points (..., 3); NaN behind the camera."""
        d = (np.asarray(points, float) - self.position) @ self.rotation
        z = np.where(d[..., 2:] > 1e-9, d[..., 2:], np.nan)
        u, v = self.lens.principal_point
        return np.asarray(self.lens.distort(d[..., :2] / z) * self.lens.focal_px + np.array([u, v]))

    def to_ground(self, pixels: ArrayLike, ground_z_m: ArrayLike = 0.0) -> Array:
        """Ground points (..., 2) of pixels (..., 2), distortion removed, at a height; NaN above the horizon."""
        u, v = self.lens.principal_point
        xy = (np.asarray(pixels, float) - np.array([u, v])) / self.lens.focal_px
        if not self.lens.is_pinhole:
            xy = self.lens.undistort(xy)
        ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1) @ self.rotation.T
        down = np.where(ray[..., 2] < -1e-9, ray[..., 2], np.nan)
        scale = (np.asarray(ground_z_m, float) - self.position[2]) / down
        return np.asarray(self.position[:2] + ray[..., :2] * scale[..., None])

    def homography(self, ground_z_m: float = 0.0) -> Array:
        """The 3x3 matrix, last element 1, from undistorted pixel (column, row, 1) to (east, north) on a plane.

        Paper III.B in closed form: ground = C + K^-1 ray scaled to the plane's height.
        """
        inverse = self.rotation @ np.linalg.inv(self.lens.matrix())
        drop = ground_z_m - self.position[2]
        h = np.empty((3, 3))
        h[0] = drop * inverse[0] + self.position[0] * inverse[2]
        h[1] = drop * inverse[1] + self.position[1] * inverse[2]
        h[2] = inverse[2]
        return np.asarray(h / h[2, 2])

    def corners(self, ground_z_m: float = 0.0) -> Array:
        """Ground points (4, 2) of the corner pixels' centres: upper left, upper right, lower right, lower left."""
        w, h = self.lens.width - 1.0, self.lens.height - 1.0
        return self.to_ground(np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]), ground_z_m)

    @property
    def nadir(self) -> Array:
        """The orthogonal centre P_oc: the ground point straight below, float64 (2,)."""
        return np.asarray(self.position[:2])
