"""DroneCAN, live: a bus over python-can, or a vehicle's own bus through MAVLink's CAN_FRAME, into a vehicle's poses.

Purpose: an RTK receiver on the bus is more accurate than the autopilot's fused position, and a
payload on the bench has no autopilot at all.

    poses = LivePoses("uav1")
    source = CanSource(poses)
    source.run("socketcan:can0", stop)
"""

import threading
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.errors import InputError
from telemetry.formats.log.dronecan_poses import MESSAGES, DronecanPoses
from telemetry.live.live_poses import LivePoses
from telemetry.samples.rotations import airframe_ned

_WAIT_S: Final = 0.2
_MOST_FAILURES: Final = 100
_EXTENDED: Final = 0x80000000
_FRAME_BYTES: Final = {"CAN_FRAME": 8, "CANFD_FRAME": 64}
# In an extended identifier: the message's type, and the bit that distinguishes messages from services.
_FILTERS: Final = [{"can_id": kind << 8, "can_mask": 0x00FFFF80, "extended": True} for kind in MESSAGES]


def open_bus(url: str) -> Any:
    """A python-can bus: "socketcan:can0", "slcan:/dev/ttyACM0", "udp_multicast:239.74.163.2", "virtual:name".

    A bit rate may follow an @ ("slcan:/dev/ttyACM0@500000"; default 1,000,000). Frames of messages other than those
    that are read are filtered out, by the kernel if the interface supports it. Raises InputError: it cannot be opened.
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
        return can.Bus(interface=kind, channel=channel, can_filters=_FILTERS, **options)
    except (can.CanError, OSError, ValueError, ImportError, NotImplementedError) as error:
        raise InputError(f"the CAN bus '{url}' cannot be opened ({error}); check its name and that it is up") from None


class CanSource:
    """Passes the frames of one bus into a vehicle's poses, each node as a source of its own."""

    def __init__(self, poses: LivePoses, *, clock: Callable[[], float] = time.time) -> None:
        self.poses = poses
        self._clock = clock
        self._bus = DronecanPoses(self._body_at)

    @property
    def received(self) -> int:
        """Number of messages that were read."""
        return sum(self._bus.received.values())

    def nodes(self) -> dict[str, dict[str, int]]:
        """Messages of each node, by its id: `received`, and `lost` on the way."""
        return {
            str(node): {"received": count, "lost": self._bus.lost[node]}
            for node, count in sorted(self._bus.received.copy().items())
        }

    def run(self, url: str, stop: threading.Event) -> None:
        """Read a bus until `stop` is set.

        Packets that are not CAN frames (other senders on a multicast group) are skipped.

        Raises InputError: it cannot be opened; OSError, can.CanError: the connection broke.
        """
        from can import CanOperationError

        failures = 0
        with open_bus(url) as bus:
            while not stop.is_set():
                try:
                    self.read(bus, _WAIT_S)
                    failures = 0
                except CanOperationError:
                    failures += 1
                    if failures > _MOST_FAILURES:
                        raise

    def read(self, bus: Any, wait_s: float = 0.0) -> bool:
        """Read one frame of a python-can bus within a timeout; returns whether one came."""
        message = bus.recv(wait_s)
        if message is None:
            return False
        if message.is_extended_id and not message.is_error_frame and not message.is_remote_frame:
            self._frame(message.arbitration_id, bytes(message.data), message.is_fd)
        return True

    def feed(self, message: Any) -> None:
        """Process a MAVLink CAN_FRAME or CANFD_FRAME message, whose `id` carries the flag of an extended frame."""
        name = message.get_type()
        if message.id & _EXTENDED:
            size = min(int(message.len), _FRAME_BYTES[name])
            self._frame(message.id & 0x1FFFFFFF, bytes(message.data[:size]), name == "CANFD_FRAME")

    def _frame(self, identifier: int, data: bytes, fd: bool) -> None:
        found = self._bus.feed(identifier, data, self._clock(), fd=fd)
        if found is not None:
            found.sample.vehicle = self.poses.vehicle
            self.poses.add(found.sample, source=f"DroneCAN node {found.node}", sigma=found.sigma)

    def _body_at(self, time_s: float) -> NDArray[np.float64] | None:
        """The airframe's attitude from the vehicle's other messages, for a gimbal alone on its bus."""
        return airframe_ned(self.poses.at(time_s))
