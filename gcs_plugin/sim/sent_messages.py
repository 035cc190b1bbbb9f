"""Messages that a simulated vehicle sends: their size and severity, and one with a field that pymavlink lacks."""

import struct
from typing import Any

from gcs_plugin.links.mavlink import Message, dialect


class MissionCurrent(dialect.MAVLink_mission_current_message):  # type: ignore[misc]
    """The message with the checksum of the mission, which PX4 sends and this version of the dialect does not know."""

    mission_id = 0

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """Its bytes."""
        known = self.unpacker.pack(self.seq, self.total, self.mission_state, self.mission_mode)
        more = struct.pack("<I", self.mission_id) if self.mission_id else b""
        return bytes(self._pack(mav, self.crc_extra, known + more, force_mavlink1=force_mavlink1))


def bytes_of(message: Message) -> int:
    """Its size on the radio: MAVLink 2's frame, unsigned."""
    return int(message.unpacker.size) + 12


def severity_of(text: str) -> int:
    """MAV_SEVERITY of a text, as autopilots say it."""
    bad = text.startswith(("Arm:", "PreArm:", "Preflight", "Auto:", "No mission", "Mission start", "Takeoff waypoint"))
    usual = dialect.MAV_SEVERITY_WARNING if "failsafe" in text.lower() else dialect.MAV_SEVERITY_INFO
    return int(dialect.MAV_SEVERITY_CRITICAL if bad else usual)
