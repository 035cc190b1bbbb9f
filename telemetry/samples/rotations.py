"""Attitudes of other conventions converted to ours (orthoswarm.model.camera: pitch -90 deg looks straight down)."""

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import NED_TO_ENU, angles_from_rotation
from telemetry.samples.sample import Sample

# Camera (x right, y down, z along the optical axis) in a frame whose x is the optical axis, y right, z down.
_CAMERA_TO_FORWARD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def euler_ned(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll): body (x forward, y right, z down) to north-east-down, float64 (3, 3)."""
    y, p, r = np.radians([yaw_deg, pitch_deg, roll_deg])
    cy, sy, cp, sp, cr, sr = np.cos(y), np.sin(y), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def airframe_ned(sample: Sample) -> Array | None:
    """The airframe's rotation body to north-east-down, pitch and roll 0 where unknown; None without a yaw."""
    if sample.flight_yaw_deg is None:
        return None
    return euler_ned(sample.flight_yaw_deg, sample.flight_pitch_deg or 0.0, sample.flight_roll_deg or 0.0)


def quaternion_ned(w: float, x: float, y: float, z: float) -> Array:
    """Rotation body to north-east-down of a Hamilton quaternion (MAVLink order), float64 (3, 3)."""
    n = w * w + x * x + y * y + z * z
    s = 2.0 / n if n > 0 else 0.0
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
        ]
    )


def camera_angles_deg(forward_ned: Array) -> tuple[float, float, float]:
    """Our yaw, pitch, roll in degrees of a camera whose optical axis is the x axis of a body-to-NED rotation.

    This is the form of MISB sensor angles and of MAVLink gimbals: x along the optical axis, y to the picture's right,
    z towards its lower edge.
    """
    return camera_frame_angles_deg(forward_ned @ _CAMERA_TO_FORWARD)


def camera_frame_angles_deg(camera_ned: Array) -> tuple[float, float, float]:
    """Our yaw, pitch, roll in degrees of a camera-to-NED rotation whose z is the optical axis, x right, y down."""
    return _degrees(NED_TO_ENU @ camera_ned)


def _degrees(camera_enu: Array) -> tuple[float, float, float]:
    yaw, pitch, roll = angles_from_rotation(camera_enu)
    return float(np.degrees(yaw)), float(np.degrees(pitch)), float(np.degrees(roll))


def mounted_down_deg(body_ned: Array) -> tuple[float, float, float]:
    """Our yaw, pitch, roll in degrees of a camera fixed under an airframe, with the picture's up towards the nose."""
    down = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # optical axis = body z, picture up = body x
    return camera_angles_deg(body_ned @ down)


def camera_angles_from_opk_deg(omega: float, phi: float, kappa: float) -> tuple[float, float, float]:
    """Our yaw, pitch, roll in degrees of photogrammetry's omega, phi, kappa in degrees.

    R = Rx(omega) Ry(phi) Rz(kappa) turns image axes (x right, y up, z away from the ground) to east-north-up (Förstner
    and Wrobel, "Photogrammetric Computer Vision", section 8.1). East and north are those of the table's grid.
    """
    o, p, k = np.radians([omega, phi, kappa])
    co, so, cp, sp, ck, sk = np.cos(o), np.sin(o), np.cos(p), np.sin(p), np.cos(k), np.sin(k)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, co, -so], [0.0, so, co]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[ck, -sk, 0.0], [sk, ck, 0.0], [0.0, 0.0, 1.0]])
    return _degrees(about_x @ about_y @ about_z @ np.diag([1.0, -1.0, -1.0]))
