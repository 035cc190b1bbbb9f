"""What is known about one vehicle: its state as its messages tell it."""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.fleet.message_rates import Streams
from gcs_plugin.links.mavlink import Autopilot, Message, dialect
from gcs_plugin.mission.completion import CompletionDetector
from gcs_plugin.mission.control import Pilot
from gcs_plugin.mission.exchange import Address
from gcs_plugin.mission.flight_modes import Modes, modes_of
from gcs_plugin.mission.items import Mission

if TYPE_CHECKING:
    from gcs_plugin.fleet.link_hub import Side
    from gcs_plugin.links.transports import Peer

_LANDED: Final = {0: "", 1: "on ground", 2: "in air", 3: "taking off", 4: "landing"}


@dataclass(slots=True)
class BootClock:
    """Watches a vehicle's own clock, which only a restart (or a second vehicle with the same id) sets back."""

    last_s: float = -1.0
    _low: int = 0
    _returns: float = 0.0
    _restarted: float = -1e9

    def feed(self, time_boot_s: float, now: float) -> str:
        """Take a time since boot; returns "", "rebooted", or "mixed" where two clocks take turns.

        Single packets from the past are late copies: a restart shows in three in a row.
        """
        if time_boot_s >= self.last_s - 1.5:
            self._returns = 0.98 * self._returns + (1.0 if self._low else 0.0)
            self._low, self.last_s = 0, max(self.last_s, time_boot_s)
            return "mixed" if self._returns > 5.0 else ""
        self._low += 1
        if self._low < 3:
            return ""
        again, self._restarted = now - self._restarted < 10.0, now
        self._low, self.last_s = 0, time_boot_s
        return "mixed" if again else "rebooted"


@dataclass(slots=True)
class Route:
    """A way on which a vehicle is heard.

    Attributes:
        side: the link; peer: the sender on it.
        heard: when something came last (the fleet's clock).
        boot: the vehicle's start on that clock, from its own counter; None before the first position.
        boot_at: when that was computed; asked_at: when its clock was asked for.
        clock: watches the counter.
    """

    side: "Side"
    peer: "Peer"
    heard: float
    boot: float | None = None
    boot_at: float = 0.0
    asked_at: float = 0.0
    clock: BootClock = field(default_factory=BootClock)


@dataclass(slots=True)
class Vehicle:
    """One vehicle.

    Attributes:
        address: its system and autopilot's component id.
        autopilot: its dialect; modes: its modes.
        detector: follows its mission.
        streams: keeps its messages coming.
        routes: the ways on which it is heard, by link and peer.
        lost: True while it is silent.
        twins: True while two vehicles use this system id; commands are refused then.
        heard: when it was heard last (the fleet's clock).
        lat_deg: latitude, None before the first position; lon_deg: longitude.
        alt_m: above sea level; height_m: above takeoff.
        velocity_m_s: north, east, down. heading_rad: clockwise from north, None if it does not know.
        roll_rad: attitude of the airframe, with pitch_rad and yaw_rad.
        boot_utc_s: UTC epoch seconds of its start, from its SYSTEM_TIME; None before it knows the time.
        time_boot_s: its own clock at the last position.
        mission: what it holds, where that was read or written in this session.
        photos: pictures that it has reported.
        received: packets; missed: packets that its counters say were lost on the way.
    """

    address: Address
    autopilot: Autopilot
    modes: Modes
    detector: CompletionDetector
    streams: Streams
    routes: dict[Any, Route] = field(default_factory=dict)
    route: Route | None = None
    lost: bool = False
    twins: bool = False
    heard: float = 0.0
    armed: bool = False
    custom_mode: int = 0
    kind: int = 0
    lat_deg: float | None = None
    lon_deg: float | None = None
    alt_m: float = 0.0
    height_m: float = 0.0
    velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    heading_rad: float | None = None
    roll_rad: float | None = None
    pitch_rad: float | None = None
    yaw_rad: float | None = None
    boot_utc_s: float | None = None
    time_boot_s: float = 0.0
    landed: str = ""
    battery: float | None = None
    gps_fix: int = 0
    satellites: int = 0
    mission: Mission | None = None
    mission_state: int = 0
    mission_seq: int = 0
    mission_total: int = 0
    photos: int = 0
    received: int = 0
    missed: int = 0
    texts: "deque[str]" = field(default_factory=lambda: deque(maxlen=50))
    _pictures: set[tuple[int, int]] = field(default_factory=set)

    @property
    def system(self) -> int:
        """Its system id."""
        return self.address.system

    @property
    def id(self) -> str:
        """Its name in plans, files and the web map: v1, v2, ..."""
        return f"v{self.system}"

    @property
    def mode(self) -> str:
        """Its mode in words."""
        return self.modes.name(self.custom_mode)

    @property
    def in_air(self) -> bool:
        """True if it says so."""
        return self.landed not in ("", "on ground")

    @property
    def pilot(self) -> Pilot:
        """Makes the commands for it."""
        return Pilot(self.address, self.streams.own, self.autopilot, self.modes)

    def update(self, message: Message) -> None:
        """Take a message of its autopilot or camera."""
        handler = _HANDLERS.get(message.get_msgId())
        if handler is not None:
            handler(self, message)

    def summary(self, now: float) -> dict[str, Any]:
        """Its state as JSON values, for `fleet list --json` and the web map."""
        return {
            "id": self.id,
            "system": self.system,
            "autopilot": self.autopilot.value,
            "link": self.route.side.link.name if self.route else "",
            "state": "lost" if self.lost else "conflict" if self.twins else "found",
            "silent_s": round(now - self.heard, 1),
            "armed": self.armed,
            "mode": self.mode,
            "landed": self.landed,
            "lat_deg": self.lat_deg,
            "lon_deg": self.lon_deg,
            "height_m": round(self.height_m, 2),
            "heading_deg": None if self.heading_rad is None else round(math.degrees(self.heading_rad), 1),
            "speed_m_s": round(math.hypot(*self.velocity_m_s[:2]), 2),
            "battery": self.battery,
            "gps_fix": self.gps_fix,
            "satellites": self.satellites,
            "mission": {
                "phase": self.detector.phase.value,
                "item": self.mission_seq,
                "items": self.mission_total,
            },
            "photos": self.photos,
            "received": self.received,
            "missed": self.missed,
        }

    # --- one method for each message ---

    def _heartbeat(self, m: Message) -> None:
        self.armed = bool(m.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        self.custom_mode = int(m.custom_mode)
        if m.type != self.kind:
            self.kind = int(m.type)
            self.modes = modes_of(self.autopilot, self.kind)

    def _position(self, m: Message) -> None:
        self.lat_deg, self.lon_deg = m.lat / 1e7, m.lon / 1e7
        self.alt_m, self.height_m = m.alt / 1e3, m.relative_alt / 1e3
        self.velocity_m_s = (m.vx / 100.0, m.vy / 100.0, m.vz / 100.0)
        self.heading_rad = None if m.hdg == 65535 else math.radians(m.hdg / 100.0)
        self.time_boot_s = m.time_boot_ms / 1e3

    def _attitude(self, m: Message) -> None:
        self.roll_rad, self.pitch_rad, self.yaw_rad = m.roll, m.pitch, m.yaw

    def _mission_current(self, m: Message) -> None:
        self.mission_seq, self.mission_state = int(m.seq), int(m.mission_state)
        if 0 < m.total < 0xFFFF:
            self.mission_total = int(m.total)

    def _extended(self, m: Message) -> None:
        self.landed = _LANDED.get(int(m.landed_state), "")

    def _system_time(self, m: Message) -> None:
        if m.time_unix_usec > 10**15:  # before it has a fix the clock stands in 1970
            self.boot_utc_s = m.time_unix_usec / 1e6 - m.time_boot_ms / 1e3

    def _gps(self, m: Message) -> None:
        self.gps_fix, self.satellites = int(m.fix_type), int(m.satellites_visible)

    def _power(self, m: Message) -> None:
        self.battery = m.battery_remaining / 100.0 if m.battery_remaining >= 0 else None

    def _text(self, m: Message) -> None:
        self.texts.append(str(m.text).strip("\x00 "))

    def _photo(self, m: Message) -> None:
        index = m.img_idx if m.get_type() == "CAMERA_FEEDBACK" else m.image_index
        known = len(self._pictures)
        self._pictures.add((int(index), int(getattr(m, "time_usec", 0) or getattr(m, "time_utc", 0))))
        self.photos += len(self._pictures) - known


_HANDLERS: Final = {
    int(dialect.MAVLINK_MSG_ID_HEARTBEAT): Vehicle._heartbeat,
    int(dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT): Vehicle._position,
    int(dialect.MAVLINK_MSG_ID_ATTITUDE): Vehicle._attitude,
    int(dialect.MAVLINK_MSG_ID_MISSION_CURRENT): Vehicle._mission_current,
    int(dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE): Vehicle._extended,
    int(dialect.MAVLINK_MSG_ID_SYSTEM_TIME): Vehicle._system_time,
    int(dialect.MAVLINK_MSG_ID_GPS_RAW_INT): Vehicle._gps,
    int(dialect.MAVLINK_MSG_ID_SYS_STATUS): Vehicle._power,
    int(dialect.MAVLINK_MSG_ID_STATUSTEXT): Vehicle._text,
    int(dialect.MAVLINK_MSG_ID_CAMERA_FEEDBACK): Vehicle._photo,
    int(dialect.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED): Vehicle._photo,
}
