"""Simulated DroneCAN nodes: messages as their frames, put on a python-can bus."""

import math
import os
from dataclasses import dataclass, field

import dronecan
from dronecan.transport import Transfer

# One for each process: tests that run at the same time do not hear each other.
GROUP = f"239.74.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"


def quaternion_xyzw(yaw, pitch, roll):
    y, p, r = (math.radians(angle) / 2 for angle in (yaw, pitch, roll))
    cy, sy, cp, sp, cr, sr = math.cos(y), math.sin(y), math.cos(p), math.sin(p), math.cos(r), math.sin(r)
    return [
        sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy,
    ]  # fmt: skip


def fix2(lat_deg, lon_deg, altitude_m, utc_s, sigma_m=0.02):
    message = dronecan.uavcan.equipment.gnss.Fix2()
    message.gnss_timestamp.usec = round(utc_s * 1e6)
    message.gnss_time_standard = message.GNSS_TIME_STANDARD_UTC
    message.latitude_deg_1e8, message.longitude_deg_1e8 = round(lat_deg * 1e8), round(lon_deg * 1e8)
    message.height_msl_mm = round(altitude_m * 1e3)
    message.status, message.mode, message.sub_mode = 3, message.MODE_RTK, message.SUB_MODE_RTK_FIXED
    message.covariance = [sigma_m**2, sigma_m**2, 0.001, 0.01, 0.01, 0.01]
    return message


def fix(lat_deg, lon_deg, altitude_m):
    message = dronecan.uavcan.equipment.gnss.Fix()
    message.latitude_deg_1e8, message.longitude_deg_1e8 = round(lat_deg * 1e8), round(lon_deg * 1e8)
    message.height_msl_mm, message.status = round(altitude_m * 1e3), 3
    return message


def attitude(yaw, pitch=0.0, roll=0.0):
    message = dronecan.uavcan.equipment.ahrs.Solution()
    message.orientation_xyzw = quaternion_xyzw(yaw, pitch, roll)
    return message


def camera_down(yaw_in_body=0.0, sigma_deg=None):
    """Camera z = body z (down), picture's up = body x, turned clockwise about the view by yaw_in_body."""
    message = dronecan.uavcan.equipment.camera_gimbal.Status()
    half = math.radians(90.0 + yaw_in_body) / 2
    message.camera_orientation_in_body_frame_xyzw = [0.0, 0.0, math.sin(half), math.cos(half)]
    if sigma_deg is not None:
        message.camera_orientation_in_body_frame_covariance = [math.radians(sigma_deg) ** 2] * 3
    return message


@dataclass
class CanNode:
    """A node with its counters of transfers."""

    number: int = 42
    fd: bool = False
    counters: dict[int, int] = field(default_factory=dict)

    def frames(self, message) -> list[tuple[int, bytes]]:
        """Identifiers and data of a message's frames."""
        transfer = Transfer(payload=message, source_node_id=self.number, transfer_priority=16, canfd=self.fd)
        transfer.transfer_id = self.counters.get(transfer.data_type_id, 0)
        self.counters[transfer.data_type_id] = (transfer.transfer_id + 1) % 32
        return [(frame.message_id, bytes(frame.bytes)) for frame in transfer.to_frames()]

    def send(self, bus, message) -> None:
        """Put a message on a bus."""
        for frame in self.messages(message):
            bus.send(frame)

    def messages(self, message, time_s=0.0) -> list:
        """A message's frames as python-can messages."""
        import can

        return [
            can.Message(timestamp=time_s, arbitration_id=identifier, data=data, is_extended_id=True, is_fd=self.fd)
            for identifier, data in self.frames(message)
        ]
