"""DroneCAN: positions and attitudes straight from the bus, over python-can or through MAVLink's CAN_FRAME tunnel.

Why a ground station wants it: a receiver with RTK on the bus is better than the autopilot's fused position, and a
payload on the bench has no autopilot at all. Read are gnss.Fix2 (and Fix), ahrs.Solution and camera_gimbal.Status.
Frames: body x forward, y right, z down; camera z along the optical axis, x right, y down (UAVCAN conventions).

    poses = LivePoses("uav1")
    with CanSource.open("socketcan:can0", poses) as source:
        source.run(stop)
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from types import TracebackType
from typing import Any

import numpy as np
from dronecan.driver.common import AbstractDriver, CANFrame

from orthoswarm.model.errors import InputError
from telemetry.formats.log.mavlink_poses import euler_deg
from telemetry.live.live_poses import LivePoses
from telemetry.samples.rotations import camera_frame_angles_deg, quaternion_ned
from telemetry.samples.sample import Sample, checked

CAN_FORWARD_COMMAND = 32000
"""MAV_CMD_CAN_FORWARD; param1 = bus + 1, 0 stops. Send it again every second or two: the vehicle forgets."""

_TAI_MINUS_UTC_S = 37.0
_GPS_MINUS_UTC_S = 18.0
_MAX_QUEUE = 4096


class BusDriver(AbstractDriver):  # type: ignore[misc]
    """dronecan's view of a python-can bus; its own driver is broken on the virtual bus."""

    def __init__(self, bus: Any) -> None:
        super().__init__()
        self._bus = bus

    def receive(self, timeout: float | None = None) -> CANFrame | None:
        """The next frame, None if none came in time."""
        message = self._bus.recv(timeout)
        if message is None or message.is_error_frame or message.is_remote_frame:
            return None
        return CANFrame(message.arbitration_id, bytearray(message.data), message.is_extended_id)

    def send_frame(self, frame: CANFrame) -> None:
        """Put a frame on the bus."""
        import can

        self._bus.send(
            can.Message(arbitration_id=frame.id, data=bytes(frame.data), is_extended_id=bool(frame.extended))
        )

    def close(self) -> None:
        """Shut the bus."""
        self._bus.shutdown()


class TunnelDriver(AbstractDriver):  # type: ignore[misc]
    """dronecan's view of a vehicle's bus that comes as MAVLink CAN_FRAME messages."""

    def __init__(self) -> None:
        super().__init__()
        self._frames: deque[CANFrame] = deque(maxlen=_MAX_QUEUE)

    def put(self, message: Any) -> None:
        """Take a CAN_FRAME message."""
        extended = bool(message.id & 0x80000000)
        length = min(int(message.len), 8)
        self._frames.append(CANFrame(message.id & 0x1FFFFFFF, bytearray(bytes(message.data)[:length]), extended))

    def receive(self, timeout: float | None = None) -> CANFrame | None:
        """The next frame, None at once if there is none."""
        return self._frames.popleft() if self._frames else None

    def send_frame(self, frame: CANFrame) -> None:
        """Nothing is sent: this end only listens."""

    def close(self) -> None:
        """Forget what waits."""
        self._frames.clear()


def open_bus(url: str) -> Any:
    """A python-can bus: "socketcan:can0", "slcan:/dev/ttyACM0", "udp_multicast:239.74.163.2", "virtual:name".

    A bit rate may follow an @ ("slcan:/dev/ttyACM0@500000"; default 1,000,000).

    Raises:
        InputError: it cannot be opened.
    """
    import can

    kind, _, rest = url.partition(":")
    if kind == "udp_multicast" and find_spec("msgpack") is None:
        raise InputError(f"the CAN bus '{url}' needs msgpack; install it with: pip install msgpack")
    channel, _, rate = rest.partition("@")
    if not channel or (rate and not rate.isdigit()):
        raise InputError(f"'{url}' names no CAN bus; write for instance socketcan:can0 or slcan:/dev/ttyACM0@1000000")
    options: dict[str, Any] = {"bitrate": int(rate or 1_000_000)} if kind in ("slcan", "socketcan") else {}
    try:
        return can.Bus(interface=kind, channel=channel, **options)
    except (can.CanError, OSError, ValueError, ImportError, NotImplementedError) as error:
        raise InputError(f"the CAN bus '{url}' cannot be opened ({error}); check its name and that it is up") from None


class CanSource:
    """Reads one bus into a vehicle's poses.

    Attributes:
        received: number of messages of the types that are read.
    """

    def __init__(self, driver: AbstractDriver, poses: LivePoses, *, clock: Callable[[], float] = time.time) -> None:
        import dronecan

        self.received = 0
        self._poses = poses
        self._clock = clock
        self._driver = driver
        self._body: Any = None
        self._node = dronecan.node.Node(driver, node_id=None, catch_handler_exceptions=True)
        equipment = dronecan.uavcan.equipment
        for kind, handler in (
            (equipment.gnss.Fix2, self._fix2),
            (equipment.gnss.Fix, self._fix),
            (equipment.ahrs.Solution, self._solution),
            (equipment.camera_gimbal.Status, self._gimbal),
        ):
            self._node.add_handler(kind, handler)
        self._has_fix2 = False

    @classmethod
    def open(cls, url: str, poses: LivePoses) -> "CanSource":
        """Open a bus by its URL; see `open_bus`."""
        return cls(BusDriver(open_bus(url)), poses)

    def __enter__(self) -> "CanSource":
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self._node.close()

    def run(self, stop: threading.Event) -> None:
        """Read until told to stop."""
        while not stop.is_set():
            self.spin(0.2)

    def spin(self, timeout_s: float = 0.0) -> None:
        """Handle what came, waiting for it at most so long; damaged transfers are dropped."""
        import dronecan

        try:
            self._node.spin(timeout_s)
        except (dronecan.UAVCANException, ValueError, IndexError, KeyError):
            return

    def feed(self, message: Any) -> None:
        """Take a MAVLink CAN_FRAME message, for a source on a `TunnelDriver`."""
        self._driver.put(message)
        self.spin()

    def _fix2(self, event: Any) -> None:
        m = event.message
        if m.status < m.STATUS_2D_FIX:
            return
        self._has_fix2 = True
        sigma = _sigma([float(c) for c in m.covariance])
        if sigma is None and m.mode == m.MODE_RTK:
            sigma = 0.02 if m.sub_mode == m.SUB_MODE_RTK_FIXED else 0.3
        self._position(m, sigma)

    def _fix(self, event: Any) -> None:
        m = event.message
        if m.status >= m.STATUS_2D_FIX and not self._has_fix2:  # the older message repeats the newer one
            self._position(m, _sigma([float(c) for c in m.position_covariance]))

    def _position(self, m: Any, sigma: float | None) -> None:
        sample = checked(
            Sample(
                lat_deg=m.latitude_deg_1e8 * 1e-8,
                lon_deg=m.longitude_deg_1e8 * 1e-8,
                altitude_m=m.height_msl_mm * 1e-3,
                sigma_m=sigma,
            )
        )
        self._add(sample, _gnss_utc(m))

    def _solution(self, event: Any) -> None:
        x, y, z, w = (float(v) for v in event.message.orientation_xyzw)
        if not all(map(math.isfinite, (x, y, z, w))) or x == y == z == w == 0.0:
            return
        self._body = quaternion_ned(w, x, y, z)
        yaw, pitch, roll = euler_deg(self._body)
        self._add(Sample(flight_yaw_deg=yaw, flight_pitch_deg=pitch, flight_roll_deg=roll), None)

    def _gimbal(self, event: Any) -> None:
        x, y, z, w = (float(v) for v in event.message.camera_orientation_in_body_frame_xyzw)
        if self._body is None or not all(map(math.isfinite, (x, y, z, w))) or x == y == z == w == 0.0:
            return
        yaw, pitch, roll = camera_frame_angles_deg(self._body @ quaternion_ned(w, x, y, z))
        self._add(Sample(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll), None)

    def _add(self, sample: Sample | None, time_s: float | None) -> None:
        if sample is None:
            return
        self.received += 1
        sample.time_s = self._clock() if time_s is None else time_s
        sample.vehicle = self._poses.vehicle
        self._poses.add(sample)


def _sigma(covariance: Sequence[float]) -> float | None:
    """One sigma of the horizontal position of a covariance: full 6x6 or 3x3, its diagonal, or one number."""
    count = len(covariance)
    index = {36: (0, 7), 9: (0, 4), 6: (0, 1), 3: (0, 1), 1: (0, 0)}.get(count)
    if index is None:
        return None
    largest = max(covariance[index[0]], covariance[index[1]])
    return float(np.sqrt(largest)) if math.isfinite(largest) and 0.0 < largest < 1e8 else None


def _gnss_utc(m: Any) -> float | None:
    """UTC of a fix, None where the receiver does not know it."""
    seconds = m.gnss_timestamp.usec * 1e-6
    if seconds < 1e9:
        return None
    leap = float(m.num_leap_seconds)
    if m.gnss_time_standard == m.GNSS_TIME_STANDARD_UTC:
        return float(seconds)
    if m.gnss_time_standard == m.GNSS_TIME_STANDARD_GPS:
        return float(seconds - (leap - 9.0 if leap else _GPS_MINUS_UTC_S))
    if m.gnss_time_standard == m.GNSS_TIME_STANDARD_TAI:
        return float(seconds - (leap + 10.0 if leap else _TAI_MINUS_UTC_S))
    return None
