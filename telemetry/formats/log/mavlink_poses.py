"""MAVLink messages to poses and camera events: one vehicle's messages in, samples and exposures out.

Used both for live links (`telemetry.live`) and for tlogs (`flight_logs`). Angles of a gimbal are interpreted in the
frame that its flags name; without any gimbal message the camera is assumed fixed under the airframe, its picture's up
towards the nose. All components of a vehicle may be fed: position, attitude and UTC are taken from the autopilot's
(positions from another while it sends none), times of others are converted to its clock. Message fields: MAVLink common
and ardupilotmega.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from orthoswarm.model.arrays import Array
from telemetry.formats.log.sender_clocks import AUTOPILOT, SenderClocks
from telemetry.samples.rotations import airframe_ned, camera_angles_deg, euler_ned, mounted_down_deg, quaternion_ned
from telemetry.samples.sample import Sample, checked, is_position
from telemetry.samples.times import YEAR_2000_S

_YAW_LOCK, _YAW_IN_VEHICLE, _YAW_IN_EARTH = 16, 32, 64
_LEAST_HEIGHT_M = 0.5
_DOWNWARD = 25
_MOST_H_ACC_MM = 1_000_000
_LOOKS_DOWN = 0.7  # sine of 45 degrees: no airframe flies that far nose down

TYPES = frozenset(
    {
        "SYSTEM_TIME", "GLOBAL_POSITION_INT", "ATTITUDE", "ATTITUDE_QUATERNION", "GIMBAL_DEVICE_ATTITUDE_STATUS",
        "MOUNT_ORIENTATION", "CAMERA_FEEDBACK", "CAMERA_IMAGE_CAPTURED", "CAMERA_TRIGGER",
        "TERRAIN_REPORT", "RANGEFINDER", "DISTANCE_SENSOR", "HOME_POSITION", "GPS_RAW_INT", "HEARTBEAT",
    }
)  # fmt: skip
"""Message types that say anything here."""

_TIMED = frozenset({"SYSTEM_TIME", "GLOBAL_POSITION_INT", "ATTITUDE", "ATTITUDE_QUATERNION"})
"""Types by which autopilots tell their time since boot."""
_OF_AUTOPILOT = _TIMED | {"HOME_POSITION", "GPS_RAW_INT"}
"""Types that count only from the autopilot: a gimbal's ATTITUDE is not the airframe's, and MAVROS sends SYSTEM_TIME."""
_NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID, which HEARTBEATs of everything but autopilots contain
_NO_VEHICLES = frozenset({6, 26, 30})
"""MAV_TYPE of ground stations, gimbals and cameras, some of which fill in an autopilot nevertheless."""


@dataclass(slots=True)
class ExposureEvent:
    """One exposure that an autopilot reported."""

    time_s: float | None  # UTC epoch seconds, None where only the time since boot is known
    boot_s: float | None  # seconds since boot, None where unknown
    number: int | None  # image index as the autopilot counts
    sample: Sample  # the pose it reported
    kind: str  # name of the message


@dataclass(slots=True, kw_only=True)
class MavlinkPoses:
    """Turns one vehicle's messages into samples and camera events."""

    heading_deg: float | None = None  # of the airframe, latest
    has_gimbal: bool = False  # whether a gimbal reported
    home_altitude_m: float | None = None  # altitude of home above sea level
    position_sigma_m: float | None = None  # horizontal sigma stated by the receiver, None if it states none
    clocks: SenderClocks = field(default_factory=SenderClocks, repr=False)  # of all components
    _arrival_s: float | None = field(default=None, repr=False)

    def feed(self, message: Any, arrival_s: float | None = None) -> Sample | ExposureEvent | None:
        """Process a message of any component of the vehicle.

        Args:
            message: decoded by pymavlink.
            arrival_s: when it came, seconds of any clock; None if unknown, then other components' clocks are compared
                with the autopilot's latest message.

        Returns:
            Its sample (time in seconds since the autopilot's boot) or event, None if it has neither.
        """
        name = message.get_type()
        handler = _HANDLERS.get(name)
        if handler is None or not self._counts(message, name):
            return None
        self._arrival_s = arrival_s
        result: Sample | ExposureEvent | None = handler(self, message)
        if isinstance(result, Sample):
            if result.time_s is None:
                result.time_s = self.clocks.boot_s
            return _checked(result)
        return result

    def _counts(self, message: Any, name: str) -> bool:
        """Whether a message's sender is one that its type is taken from."""
        sender = _sender(message)
        if name == "HEARTBEAT":
            return True
        positions = name == "GLOBAL_POSITION_INT" and is_position(message.lat * 1e-7, message.lon * 1e-7)
        chosen = self.clocks.is_autopilot(sender, timed=name in _TIMED, positions=positions)
        if name == "GLOBAL_POSITION_INT":
            return chosen or self.clocks.places(sender)
        return chosen or name not in _OF_AUTOPILOT or (name not in _TIMED and sender in self.clocks.fliers)

    def utc(self, boot_s: float | None) -> float | None:
        """UTC of a time since boot, None while unknown."""
        offset_s = self.clocks.utc_minus_boot_s
        return None if boot_s is None or offset_s is None else boot_s + offset_s

    def _boot(self, m: Any) -> float | None:
        """Seconds since the autopilot's boot of a message's time_boot_ms; None while that clock is unknown."""
        return self.clocks.heard(_sender(m), m.time_boot_ms * 1e-3, self._arrival_s)

    def _heartbeat(self, m: Any) -> None:
        if m.autopilot != _NO_AUTOPILOT and m.type not in _NO_VEHICLES:
            self.clocks.fliers.add(_sender(m))

    def _system_time(self, m: Any) -> None:
        utc_s, boot_s = m.time_unix_usec * 1e-6, self._boot(m)
        if utc_s > YEAR_2000_S and m.time_boot_ms > 0 and boot_s is not None:  # 0: the sender has no clock of its own
            self.clocks.utc_minus_boot_s = utc_s - boot_s

    def _position(self, m: Any) -> Sample | None:
        boot_s = self._boot(m)
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
        return self._airframe(self._boot(m), yaw, pitch, roll)

    def _attitude_quaternion(self, m: Any) -> Sample:
        yaw, pitch, roll = euler_deg(quaternion_ned(m.q1, m.q2, m.q3, m.q4))
        return self._airframe(self._boot(m), yaw, pitch, roll)

    def _airframe(self, boot_s: float | None, yaw: float, pitch: float, roll: float) -> Sample:
        self.heading_deg = yaw
        return Sample(time_s=boot_s, flight_yaw_deg=yaw, flight_pitch_deg=pitch, flight_roll_deg=roll)

    def _gimbal(self, m: Any) -> Sample | None:
        rotation = gimbal_rotation(m.q, m.flags, self.heading_deg)
        return None if rotation is None else self._camera(m, rotation)

    def _mount(self, m: Any) -> Sample | None:
        yaw = m.yaw_absolute
        if not math.isfinite(yaw) or yaw == 0.0:  # an extension, which reads as 0 where the sender does not fill it
            if self.heading_deg is None:
                return None
            yaw = self.heading_deg + m.yaw
        if not all(map(math.isfinite, (yaw, m.pitch, m.roll))):
            return None
        return self._camera(m, euler_ned(yaw, m.pitch, m.roll))

    def _camera(self, m: Any, forward_ned: Any) -> Sample | None:
        self.has_gimbal = True
        boot_s = self._boot(m)
        if boot_s is None:
            return None
        yaw, pitch, roll = camera_angles_deg(forward_ned)
        return Sample(time_s=boot_s, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)

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

    def _feedback(self, m: Any) -> ExposureEvent:
        sample = Sample(
            lat_deg=m.lat * 1e-7, lon_deg=m.lng * 1e-7, altitude_m=m.alt_msl, height_m=m.alt_rel, flight_yaw_deg=m.yaw,
            flight_pitch_deg=m.pitch, flight_roll_deg=m.roll,
        )  # fmt: skip
        return self._event(m, m.time_usec * 1e-6, m.img_idx, sample)

    def _captured(self, m: Any) -> ExposureEvent | None:
        if m.capture_result == 0:
            return None
        sample = Sample(lat_deg=m.lat * 1e-7, lon_deg=m.lon * 1e-7, altitude_m=m.alt * 1e-3)
        if m.relative_alt * 1e-3 > _LEAST_HEIGHT_M:  # PX4 sends -1 m where it does not know the ground
            sample.height_m = m.relative_alt * 1e-3
        elif self.home_altitude_m is not None and sample.altitude_m is not None:
            sample.height_m = sample.altitude_m - self.home_altitude_m
        put_capture_attitude(sample, m.q)
        utc_s = m.time_utc * 1e-6  # 0, or time since boot, from a camera that does not know UTC
        return self._event(m, utc_s if utc_s > YEAR_2000_S else m.time_boot_ms * 1e-3, m.image_index, sample)

    def _trigger(self, m: Any) -> ExposureEvent:
        return self._event(m, m.time_usec * 1e-6, m.seq, Sample())

    def _event(self, m: Any, seconds: float, number: int, sample: Sample) -> ExposureEvent:
        """An event whose time is UTC, or time since boot where the value is too small for UTC."""
        if seconds > YEAR_2000_S:
            boot_s = None if self.clocks.utc_minus_boot_s is None else seconds - self.clocks.utc_minus_boot_s
            time_s: float | None = seconds
        else:
            boot_s = self.clocks.of(_sender(m), seconds, self._arrival_s, number=int(number), kind=m.get_type())
            time_s = self.utc(boot_s)
        return ExposureEvent(time_s, boot_s, int(number), checked(sample) or Sample(), m.get_type())


def _sender(message: Any) -> int:
    return message.get_srcComponent() or AUTOPILOT


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
        q: quaternion w, x, y, z. flags: GIMBAL_DEVICE_FLAGS.
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


def _above_ground(metres: float) -> Sample | None:
    if not math.isfinite(metres) or not _LEAST_HEIGHT_M < metres < 5000.0:
        return None
    return Sample(height_m=float(metres), height_is_ground=True)


def fixed_camera(sample: Sample) -> Sample:
    """The sample; where camera angles are unknown, those of a camera fixed under the airframe."""
    if sample.yaw_deg is None and (body := airframe_ned(sample)) is not None:
        sample.yaw_deg, sample.pitch_deg, sample.roll_deg = mounted_down_deg(body)
    return sample


_HANDLERS: dict[str, Any] = {
    "HEARTBEAT": MavlinkPoses._heartbeat,
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
