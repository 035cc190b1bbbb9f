"""DroneCAN frames to poses: the frames of one bus in, positions and attitudes of its nodes out.

Used both for live buses (`telemetry.live.dronecan_bus`) and for logs of buses (`can_log`). It reads gnss.Fix2 and
Fix, ahrs.Solution and camera_gimbal.Status; frames of all other types are skipped by their identifier, before
decoding. Frames of reference: body x forward, y right, z down; camera z along the optical axis, x right, y down
(DroneCAN specification, "Coordinate frames"). Transfers: DroneCAN specification, "CAN bus transport layer".
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from orthoswarm.model.arrays import Array
from telemetry.formats.log.mavlink_poses import euler_deg
from telemetry.samples.rotations import camera_frame_angles_deg, quaternion_ned
from telemetry.samples.sample import Sample, checked
from telemetry.samples.times import GPS_MINUS_UTC_S, TAI_MINUS_UTC_S

_SOLUTION, _GIMBAL, _FIX, _FIX2 = 1000, 1044, 1060, 1063
MESSAGES: Final = (_SOLUTION, _GIMBAL, _FIX, _FIX2)
"""Data type identifiers of the messages that are read: bits 8 to 23 of the CAN identifier."""

_SERVICE: Final = 0x80
_MOST_FRAMES: Final = 64
_LEAST_STEP_S: Final = 0.02
_ATTITUDE_AGE_S: Final = 0.5
_FIXES_FOR_CLOCK: Final = 50
_RTK_FIXED_M, _RTK_FLOAT_M = 0.02, 0.3


@dataclass(frozen=True, slots=True)
class NodePose:
    """The content of one message."""

    sample: Sample  # a position, the airframe's attitude or the camera's; its time is UTC
    node: int  # DroneCAN node id of the sender, 1 to 127
    sigma: float | None  # stated one sigma, metres of a position, degrees of an attitude; None where it is not stated


class DronecanPoses:
    """Turns the frames of one bus into poses.

    Attributes:
        received: node -> number of messages read.
        lost: node -> number of messages lost or incomplete, by gaps in their transfer numbers.
    """

    def __init__(self, body_at: Callable[[float], Array | None] = lambda time_s: None) -> None:
        """Start without frames.

        A gimbal on a bus without ahrs.Solution needs `body_at`: the airframe's rotation to north-east-down at a time
        (UTC), None where unknown.
        """
        self.received: Counter[int] = Counter()
        self.lost: Counter[int] = Counter()
        self._body_at = body_at
        self._body: tuple[float, Array] | None = None
        self._transfers: dict[int, list[Any]] = {}
        self._last: dict[tuple[int, int], tuple[float, int]] = {}  # type and node -> arrival and number
        self._with_fix2: set[int] = set()
        self._clocks: deque[float] = deque(maxlen=_FIXES_FOR_CLOCK)

    def feed(self, identifier: int, data: bytes, arrival_s: float, *, fd: bool = False) -> NodePose | None:
        """Process a frame; returns the pose of the message that it completes, None if it completes none.

        Args:
            identifier: 29 bits, of an extended frame. data: 0 to 8 bytes, to 64 of CAN FD (`fd`).
            arrival_s: time of arrival, seconds of any steady clock; UTC follows from the fixes.
        """
        kind, node = (identifier >> 8) & 0xFFFF, identifier & 0x7F
        if kind not in MESSAGES or identifier & _SERVICE or node == 0 or not data:
            return None
        tail = data[-1]
        last = self._last.get((kind, node))
        if tail & 0x80:
            self._transfers.pop(identifier, None)
            if last is not None and 0.0 <= arrival_s - last[0] < _LEAST_STEP_S:  # sent more often than poses change
                self._last[kind, node] = last[0], tail & 31
                return None
            self._transfers[identifier] = []
        frames = self._transfers.get(identifier)
        if frames is None or len(frames) >= _MOST_FRAMES:
            return None
        from dronecan.transport import Frame

        frames.append(Frame(identifier, data, arrival_s, arrival_s, fd))
        if not tail & 0x40:
            return None
        del self._transfers[identifier]
        message = _decoded(frames)
        if message is None:
            return None
        self.received[node] += 1
        if last is not None:
            self.lost[node] += ((tail & 31) - last[1] - 1) % 32
        self._last[kind, node] = arrival_s, tail & 31
        handler = {_FIX2: self._fix2, _FIX: self._fix, _SOLUTION: self._solution, _GIMBAL: self._gimbal}[kind]
        return handler(message, node, arrival_s)

    @property
    def knows_utc(self) -> bool:
        """Whether a fix has given UTC yet."""
        return bool(self._clocks)

    def utc(self, arrival_s: float) -> float:
        """UTC of an arrival, by the least delayed fixes; the arrival itself until a fix gives UTC."""
        return arrival_s + max(self._clocks, default=0.0)

    def _fix2(self, m: Any, node: int, arrival_s: float) -> NodePose | None:
        if m.status < m.STATUS_2D_FIX:
            return None
        self._with_fix2.add(node)
        sigma = _sigma(m.covariance)
        if sigma is None and m.mode == m.MODE_RTK:
            sigma = _RTK_FIXED_M if m.sub_mode == m.SUB_MODE_RTK_FIXED else _RTK_FLOAT_M
        return self._position(m, node, arrival_s, sigma)

    def _fix(self, m: Any, node: int, arrival_s: float) -> NodePose | None:
        if m.status < m.STATUS_2D_FIX or node in self._with_fix2:  # the older message repeats the newer one
            return None
        return self._position(m, node, arrival_s, _sigma(m.position_covariance))

    def _position(self, m: Any, node: int, arrival_s: float, sigma: float | None) -> NodePose | None:
        sample = checked(
            Sample(
                lat_deg=m.latitude_deg_1e8 * 1e-8,
                lon_deg=m.longitude_deg_1e8 * 1e-8,
                altitude_m=m.height_msl_mm * 1e-3,
                sigma_m=sigma,
            )
        )
        if sample is None or not sample.has_position:
            return None
        utc_s = _gnss_utc_s(m)
        if utc_s is not None:
            self._clocks.append(utc_s - arrival_s)
        sample.time_s = self.utc(arrival_s) if utc_s is None else utc_s
        return NodePose(sample, node, sample.sigma_m)

    def _solution(self, m: Any, node: int, arrival_s: float) -> NodePose | None:
        rotation = _rotation(m.orientation_xyzw)
        if rotation is None:
            return None
        time_s = self.utc(arrival_s)
        self._body = arrival_s, rotation
        yaw, pitch, roll = euler_deg(rotation)
        sample = Sample(time_s=time_s, flight_yaw_deg=yaw, flight_pitch_deg=pitch, flight_roll_deg=roll)
        return NodePose(sample, node, _angle_sigma_deg(m.orientation_covariance))

    def _gimbal(self, m: Any, node: int, arrival_s: float) -> NodePose | None:
        camera = _rotation(m.camera_orientation_in_body_frame_xyzw)
        time_s = self.utc(arrival_s)
        fresh = self._body is not None and abs(arrival_s - self._body[0]) < _ATTITUDE_AGE_S
        body = self._body[1] if self._body is not None and fresh else self._body_at(time_s)
        if camera is None or body is None:
            return None
        yaw, pitch, roll = camera_frame_angles_deg(body @ camera)
        sample = Sample(time_s=time_s, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)
        return NodePose(sample, node, _angle_sigma_deg(m.camera_orientation_in_body_frame_covariance))


def _decoded(frames: Sequence[Any]) -> Any | None:
    """The message of a transfer; None where it is damaged: frames missing, checksum wrong, too short."""
    import dronecan
    from dronecan.transport import Transfer

    transfer = Transfer()
    try:
        transfer.from_frames(frames)
    except (dronecan.UAVCANException, ValueError, IndexError, KeyError):
        return None
    return transfer.payload


def _rotation(xyzw: Sequence[float]) -> Array | None:
    x, y, z, w = (float(v) for v in xyzw)
    return quaternion_ned(w, x, y, z) if math.isfinite(x + y + z + w) and any((x, y, z, w)) else None


def _sigma(covariance: Sequence[float]) -> float | None:
    """One sigma by the larger of the first two variances of a covariance: full, its diagonal, or one number."""
    index = {36: (0, 7), 21: (0, 6), 9: (0, 4), 6: (0, 1), 3: (0, 1), 1: (0, 0)}.get(len(covariance))
    if index is None:
        return None
    largest = max(float(covariance[index[0]]), float(covariance[index[1]]))
    return math.sqrt(largest) if math.isfinite(largest) and 0.0 < largest < 1e8 else None


def _angle_sigma_deg(covariance: Sequence[float]) -> float | None:
    sigma_rad = _sigma(covariance)
    return None if sigma_rad is None else math.degrees(sigma_rad)


def _gnss_utc_s(m: Any) -> float | None:
    """UTC of a fix, None where the receiver does not know it."""
    seconds = m.gnss_timestamp.usec * 1e-6
    if seconds < 1e9:
        return None
    leap = float(m.num_leap_seconds)
    if m.gnss_time_standard == m.GNSS_TIME_STANDARD_UTC:
        return float(seconds)
    if m.gnss_time_standard == m.GNSS_TIME_STANDARD_GPS:
        return float(seconds - (leap - 9.0 if leap else GPS_MINUS_UTC_S))
    if m.gnss_time_standard == m.GNSS_TIME_STANDARD_TAI:
        return float(seconds - (leap + 10.0 if leap else TAI_MINUS_UTC_S))
    return None
