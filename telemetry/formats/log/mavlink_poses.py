"""MAVLink messages to poses and camera events: one vehicle's messages in, samples and exposures out.

Used both for live links (`telemetry.live`) and for tlogs (`flight_logs`). Angles of a gimbal are interpreted in the
frame that its flags name; without any gimbal message the camera is assumed fixed under the airframe, its picture's up
towards the nose. Message fields: MAVLink common and ardupilotmega.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telemetry.samples.rotations import camera_angles_deg, euler_ned, mounted_down_deg, quaternion_ned
from telemetry.samples.sample import Sample, checked, is_position
from telemetry.samples.times import YEAR_2000_S

Array = NDArray[np.float64]

_YAW_LOCK, _YAW_IN_VEHICLE, _YAW_IN_EARTH = 16, 32, 64
_LEAST_HEIGHT_M = 0.5
_DOWNWARD = 25
_REBOOT_S = 10.0
_MOST_H_ACC_MM = 1_000_000
_LOOKS_DOWN = 0.7
"""Sine of 45 degrees: no airframe flies that far nose down."""

TYPES = frozenset(
    {
        "SYSTEM_TIME", "GLOBAL_POSITION_INT", "ATTITUDE", "ATTITUDE_QUATERNION", "GIMBAL_DEVICE_ATTITUDE_STATUS",
        "MOUNT_ORIENTATION", "CAMERA_FEEDBACK", "CAMERA_IMAGE_CAPTURED", "CAMERA_TRIGGER",
        "TERRAIN_REPORT", "RANGEFINDER", "DISTANCE_SENSOR", "HOME_POSITION", "GPS_RAW_INT",
    }
)  # fmt: skip
"""Message types that say anything here."""


@dataclass(slots=True)
class CameraEvent:
    """One exposure that an autopilot reported.

    Attributes:
        time_s: UTC epoch seconds, None where only the time since boot is known.
        boot_s: seconds since boot, None where unknown.
        number: image index as the autopilot counts. sample: the pose it reported. kind: name of the message.
    """

    time_s: float | None
    boot_s: float | None
    number: int | None
    sample: Sample
    kind: str


@dataclass(slots=True, kw_only=True)
class MavlinkPoses:
    """Turns one vehicle's messages into samples and camera events.

    Attributes:
        utc_minus_boot_s: offset from time since boot to UTC, None until the vehicle knows UTC.
        heading_deg: of the airframe, latest. has_gimbal: whether a gimbal reported.
        reboots: number of times that the time since boot went back. home_altitude_m: altitude of home above sea level.
        position_sigma_m: horizontal sigma stated by the receiver, None if it states none.
    """

    utc_minus_boot_s: float | None = None
    heading_deg: float | None = None
    has_gimbal: bool = False
    reboots: int = 0
    home_altitude_m: float | None = None
    position_sigma_m: float | None = None
    _boot_s: float = field(default=0.0, repr=False)

    def feed(self, message: Any) -> Sample | CameraEvent | None:
        """Process a message; returns its sample (time in seconds since boot) or event, None if it has neither."""
        handler = _HANDLERS.get(message.get_type())
        if handler is None:
            return None
        result: Sample | CameraEvent | None = handler(self, message)
        if isinstance(result, Sample):
            if result.time_s is None:
                result.time_s = self._boot_s
            return _checked(result)
        return result

    def utc(self, boot_s: float | None) -> float | None:
        """UTC of a time since boot, None while unknown."""
        if boot_s is None or self.utc_minus_boot_s is None:
            return None
        return boot_s + self.utc_minus_boot_s

    def _boot(self, milliseconds: int) -> float:
        boot_s = milliseconds * 1e-3
        if boot_s < self._boot_s - _REBOOT_S:
            self.reboots += 1
            self.utc_minus_boot_s = None
        self._boot_s = boot_s
        return boot_s

    def _system_time(self, m: Any) -> None:
        boot_s = self._boot(m.time_boot_ms)
        utc_s = m.time_unix_usec * 1e-6
        if utc_s > YEAR_2000_S:
            self.utc_minus_boot_s = utc_s - boot_s

    def _position(self, m: Any) -> Sample | None:
        boot_s = self._boot(m.time_boot_ms)
        if not is_position(m.lat * 1e-7, m.lon * 1e-7):
            return None  # no fix yet: the height is invalid, too
        return Sample(
            time_s=boot_s,
            lat_deg=m.lat * 1e-7,
            lon_deg=m.lon * 1e-7,
            altitude_m=m.alt * 1e-3,
            height_m=m.relative_alt * 1e-3,
        )

    def _attitude(self, m: Any) -> Sample:
        yaw, pitch, roll = math.degrees(m.yaw), math.degrees(m.pitch), math.degrees(m.roll)
        return self._airframe(self._boot(m.time_boot_ms), yaw, pitch, roll)

    def _attitude_quaternion(self, m: Any) -> Sample:
        yaw, pitch, roll = euler_deg(quaternion_ned(m.q1, m.q2, m.q3, m.q4))
        return self._airframe(self._boot(m.time_boot_ms), yaw, pitch, roll)

    def _airframe(self, boot_s: float, yaw: float, pitch: float, roll: float) -> Sample:
        self.heading_deg = yaw
        return Sample(time_s=boot_s, flight_yaw_deg=yaw, flight_pitch_deg=pitch, flight_roll_deg=roll)

    def _gimbal(self, m: Any) -> Sample | None:
        rotation = gimbal_rotation(m.q, m.flags, self.heading_deg)
        if rotation is None:
            return None
        self.has_gimbal = True
        return _camera(self._boot(m.time_boot_ms), rotation)

    def _mount(self, m: Any) -> Sample | None:
        yaw = m.yaw_absolute
        if not math.isfinite(yaw):
            if self.heading_deg is None:
                return None
            yaw = self.heading_deg + m.yaw
        if not all(map(math.isfinite, (yaw, m.pitch, m.roll))):
            return None
        self.has_gimbal = True
        return _camera(self._boot(m.time_boot_ms), euler_ned(yaw, m.pitch, m.roll))

    def _home(self, m: Any) -> None:
        self.home_altitude_m = m.altitude * 1e-3

    def _receiver(self, m: Any) -> None:
        stated = getattr(m, "h_acc", 0)  # an extension that MAVLink 1 does not have
        self.position_sigma_m = stated * 1e-3 if 0 < stated < _MOST_H_ACC_MM else None

    def _terrain(self, m: Any) -> Sample | None:
        return _above_ground(m.current_height) if m.loaded else None

    def _rangefinder(self, m: Any) -> Sample | None:
        return _above_ground(m.distance)

    def _distance(self, m: Any) -> Sample | None:
        if m.orientation != _DOWNWARD or not m.min_distance < m.current_distance < m.max_distance:
            return None
        return _above_ground(m.current_distance * 1e-2)

    def _feedback(self, m: Any) -> CameraEvent:
        sample = Sample(
            lat_deg=m.lat * 1e-7,
            lon_deg=m.lng * 1e-7,
            altitude_m=m.alt_msl,
            height_m=m.alt_rel,
            flight_yaw_deg=m.yaw,
            flight_pitch_deg=m.pitch,
            flight_roll_deg=m.roll,
        )
        return self._event(m.time_usec * 1e-6, m.img_idx, sample, "CAMERA_FEEDBACK")

    def _captured(self, m: Any) -> CameraEvent | None:
        if m.capture_result == 0:
            return None
        sample = Sample(lat_deg=m.lat * 1e-7, lon_deg=m.lon * 1e-7, altitude_m=m.alt * 1e-3)
        if m.relative_alt * 1e-3 > _LEAST_HEIGHT_M:  # PX4 sends -1 m where it does not know the ground
            sample.height_m = m.relative_alt * 1e-3
        elif self.home_altitude_m is not None and sample.altitude_m is not None:
            sample.height_m = sample.altitude_m - self.home_altitude_m
        put_capture_attitude(sample, m.q)
        utc_s = m.time_utc * 1e-6
        boot_s = self._boot(m.time_boot_ms)
        event = self._event(utc_s, m.image_index, sample, "CAMERA_IMAGE_CAPTURED")
        event.boot_s = boot_s
        if event.time_s is None:
            event.time_s = self.utc(boot_s)
        return event

    def _trigger(self, m: Any) -> CameraEvent:
        return self._event(m.time_usec * 1e-6, m.seq, Sample(), "CAMERA_TRIGGER")

    def _event(self, seconds: float, number: int, sample: Sample, kind: str) -> CameraEvent:
        """An event whose time is UTC, or time since boot where the value is too small for UTC."""
        if seconds > YEAR_2000_S:
            boot_s = None if self.utc_minus_boot_s is None else seconds - self.utc_minus_boot_s
            time_s: float | None = seconds
        else:
            boot_s, time_s = (seconds if seconds > 0 else self._boot_s), None
            time_s = self.utc(boot_s)
        return CameraEvent(time_s, boot_s, int(number), checked(sample) or Sample(), kind)


def _checked(sample: Sample) -> Sample | None:
    """A checked sample; None if nothing but its time is valid."""
    boot_s = sample.time_s
    sample.time_s = None
    result = checked(sample)
    if result is not None:
        result.time_s = boot_s
    return result


def euler_deg(rotation: Any) -> tuple[float, float, float]:
    """Yaw, pitch, roll in degrees of a body-to-NED rotation."""
    return (
        float(np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0]))),
        float(np.degrees(-np.arcsin(np.clip(rotation[2, 0], -1.0, 1.0)))),
        float(np.degrees(np.arctan2(rotation[2, 1], rotation[2, 2]))),
    )


def gimbal_rotation(q: Sequence[float], flags: int, heading_deg: float | None) -> Array | None:
    """Rotation of a gimbal to north-east-down, from a GIMBAL_DEVICE_ATTITUDE_STATUS in the frame that its flags name.

    Args:
        q: quaternion w, x, y, z.
        flags: GIMBAL_DEVICE_FLAGS.
        heading_deg: of the airframe, for a yaw that is relative to it.

    Returns:
        float64 (3, 3); None if the quaternion is invalid, or the heading is needed and unknown.
    """
    if not all(map(math.isfinite, q)) or not any(q):
        return None
    rotation = quaternion_ned(*q)
    if flags & _YAW_IN_EARTH or (flags & _YAW_LOCK and not flags & _YAW_IN_VEHICLE):
        return rotation
    return None if heading_deg is None else euler_ned(heading_deg, 0.0, 0.0) @ rotation


def put_capture_attitude(sample: Sample, q: Sequence[float]) -> None:
    """Store the attitude of a capture: PX4 reports the airframe's or the camera's, and only the camera points down."""
    if not all(map(math.isfinite, q)) or not any(q):
        return
    rotation = quaternion_ned(*q)
    if rotation[2, 0] > _LOOKS_DOWN:
        sample.yaw_deg, sample.pitch_deg, sample.roll_deg = camera_angles_deg(rotation)
    else:
        sample.flight_yaw_deg, sample.flight_pitch_deg, sample.flight_roll_deg = euler_deg(rotation)


def _camera(boot_s: float, forward_ned: Any) -> Sample:
    yaw, pitch, roll = camera_angles_deg(forward_ned)
    return Sample(time_s=boot_s, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)


def _above_ground(metres: float) -> Sample | None:
    if not math.isfinite(metres) or not _LEAST_HEIGHT_M < metres < 5000.0:
        return None
    return Sample(height_m=float(metres), height_is_ground=True)


def fixed_camera(sample: Sample) -> Sample:
    """The sample; where camera angles are unknown, those of a camera fixed under the airframe."""
    if sample.yaw_deg is None and sample.flight_yaw_deg is not None:
        body = euler_ned(sample.flight_yaw_deg, sample.flight_pitch_deg or 0.0, sample.flight_roll_deg or 0.0)
        sample.yaw_deg, sample.pitch_deg, sample.roll_deg = mounted_down_deg(body)
    return sample


_HANDLERS: dict[str, Any] = {
    "SYSTEM_TIME": MavlinkPoses._system_time,
    "GLOBAL_POSITION_INT": MavlinkPoses._position,
    "ATTITUDE": MavlinkPoses._attitude,
    "ATTITUDE_QUATERNION": MavlinkPoses._attitude_quaternion,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": MavlinkPoses._gimbal,
    "MOUNT_ORIENTATION": MavlinkPoses._mount,
    "TERRAIN_REPORT": MavlinkPoses._terrain,
    "RANGEFINDER": MavlinkPoses._rangefinder,
    "DISTANCE_SENSOR": MavlinkPoses._distance,
    "HOME_POSITION": MavlinkPoses._home,
    "GPS_RAW_INT": MavlinkPoses._receiver,
    "CAMERA_FEEDBACK": MavlinkPoses._feedback,
    "CAMERA_IMAGE_CAPTURED": MavlinkPoses._captured,
    "CAMERA_TRIGGER": MavlinkPoses._trigger,
}
