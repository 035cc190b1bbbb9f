"""A simulated vehicle: a small autopilot that receives and sends MAVLink messages in simulated time.

ArduPilot's dialect sends heartbeats only until it is asked for more; PX4's sends 50 Hz of position and attitude as soon
as a ground station is there. Both answer commands and missions as measured (docs/vehicles.md).
"""

import heapq
import math
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from gcs_plugin.links.mavlink import Autopilot, Message, dialect
from gcs_plugin.mission.exchange import Address
from gcs_plugin.mission.flight_modes import modes_of
from gcs_plugin.mission.items import FRAME_GLOBAL, WAYPOINT, MissionItem
from gcs_plugin.sim.mission_flight import RTL_HEIGHT_M, Landed, MissionFlight, MissionState, TakenPicture
from gcs_plugin.sim.mission_store import MissionStore
from gcs_plugin.sim.multirotor import STEP_S, Airframe, Chart, VehiclePose

_OK, _REJECTED, _DENIED, _UNSUPPORTED, _FAILED = (
    int(dialect.MAV_RESULT_ACCEPTED), int(dialect.MAV_RESULT_TEMPORARILY_REJECTED), int(dialect.MAV_RESULT_DENIED),
    int(dialect.MAV_RESULT_UNSUPPORTED), int(dialect.MAV_RESULT_FAILED),
)  # fmt: skip
_HEARTBEAT: Final = int(dialect.MAVLINK_MSG_ID_HEARTBEAT)
_POSITION: Final = int(dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT)
_ATTITUDE: Final = int(dialect.MAVLINK_MSG_ID_ATTITUDE)
_CURRENT: Final = int(dialect.MAVLINK_MSG_ID_MISSION_CURRENT)
_PX4_DEFAULTS: Final = {_POSITION: 50.0, _ATTITUDE: 50.0, _CURRENT: 1.0, 245: 5.0, 1: 1.0, 24: 1.0, 2: 1.0}
_FIX_SHARE: Final = 0.25  # of the time until it can arm, after which it has a position
_TX_BUFFER: Final = 300.0  # bytes
_CHECKS_MISSION_S: Final = 1.0  # PX4 looks at a new mission for so long, and does not start it meanwhile
_WHY_S: Final = 30.0
_BATTERY_S: Final = 1800.0  # with its motors on; what stands on the ground uses hardly any of it
_EKF: Final = int(dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
_ESTIMATOR: Final = int(dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS)
_BATTERY: Final = int(dialect.MAVLINK_MSG_ID_BATTERY_STATUS)
_GIMBAL: Final = int(dialect.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS)
_LEFT_GROUND_M: Final = 0.2
_PX4_TOP_M_S: Final = 12.0  # factory setting
_HOME: Final = (47.397742, 8.545594, 488.0)
_WPNAV_SPEED_M_S: Final = 10.0
"""ArduCopter flies faster if it is asked to and can."""


class _MissionCurrent(dialect.MAVLink_mission_current_message):  # type: ignore[misc]
    """The message with the checksum of the mission, which PX4 sends and this version of the dialect does not know."""

    mission_id = 0

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """Its bytes."""
        known = self.unpacker.pack(self.seq, self.total, self.mission_state, self.mission_mode)
        more = struct.pack("<I", self.mission_id) if self.mission_id else b""
        return bytes(self._pack(mav, self.crc_extra, known + more, force_mavlink1=force_mavlink1))


@dataclass(slots=True, kw_only=True)
class SimVehicle:
    """One simulated vehicle; drive it with `handle` and `advance`, in seconds since its boot.

    Attributes:
        kind: MAV_TYPE that it reports; it flies as a multirotor in any case.
        home: latitude, longitude (degrees), altitude (metres).
        boot_utc_s: UTC epoch seconds of its boot; its clock runs with the time that it is given.
        ready_s: when its filter has a position, so that it can be armed; its receiver has a fix before that.
        seed: of its receiver's errors.
        arms: False for one that refuses to arm although all its checks pass.
        wipes: True for ArduPilot's simulation with -w, which loses the mission at each restart.
        tx_bytes_s: capacity of its radio. Streams beyond that are skipped, as ArduPilot does; heartbeats and answers
            are sent first.
        withheld: ids of messages that it does not stream, whatever rate it is asked for.
        used_s: for how long its motors have used its battery, seconds.
        second_battery: what is left in a second one, 0 to 1; None for one without.
        parameters: by name; integers are those that the autopilot keeps as such.
    """

    system: int
    autopilot: Autopilot = Autopilot.ARDUPILOT
    home: tuple[float, float, float] = _HOME
    airframe: Airframe = field(default_factory=Airframe)
    kind: int = int(dialect.MAV_TYPE_QUADROTOR)
    boot_utc_s: float = 1_700_000_000.0
    ready_s: float = 0.0
    seed: int = 0
    arms: bool = True
    wipes: bool = False
    tx_bytes_s: float = math.inf
    on_exposure: "Callable[[SimVehicle, TakenPicture], None] | None" = None
    flight: MissionFlight = field(init=False)
    store: MissionStore = field(init=False)
    second_battery: float | None = field(default=None, init=False)
    withheld: set[int] = field(default_factory=set, init=False)
    parameters: dict[str, float] = field(init=False)
    reboots: int = field(default=0, init=False)
    used_s: float = field(default=0.0, init=False)
    _now: float = field(default=0.0, init=False)
    _booted: float = field(default=0.0, init=False)
    _off_until: float = field(default=-1.0, init=False)
    _stepped: float = field(default=0.0, init=False)
    _rates: dict[int, float] = field(default_factory=dict, init=False)
    _due: list[tuple[float, int]] = field(default_factory=list, init=False)
    _greeted: bool = field(default=False, init=False)
    _photos_sent: int = field(default=0, init=False)
    _reported_state: tuple[bool, int] = field(default=(False, 0), init=False)
    _why_at: float = field(default=0.0, init=False)
    _long_texts: int = field(default=0, init=False)
    _battery_id: int = field(default=0, init=False)
    _tx_room: float = field(default=_TX_BUFFER, init=False)
    _tx_at: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        """Stand at home with an empty store."""
        if self.autopilot is Autopilot.PX4:
            self.airframe = replace(self.airframe, top_m_s=min(self.airframe.top_m_s, _PX4_TOP_M_S))
        self.parameters = _factory_parameters(self.autopilot, self.airframe.top_m_s)
        home = MissionItem.at(WAYPOINT, *self.home, frame=FRAME_GLOBAL)
        items = [home] if self.autopilot is Autopilot.ARDUPILOT else []
        self.store = MissionStore(autopilot=self.autopilot, home=home, items=items)
        chart = Chart(*self.home)
        modes = modes_of(self.autopilot, self.kind)
        self.flight = MissionFlight.make(
            self.autopilot, modes, store=self.store, chart=chart, frame=self.airframe, seed=self.seed + self.system
        )
        self._boot(0.0)

    # --- for tests and cameras ---

    @property
    def exposures(self) -> list[TakenPicture]:
        """All pictures so far."""
        return self.flight.exposures

    @property
    def off(self) -> bool:
        """True while it restarts."""
        return self._now < self._off_until

    def pose_at(self, time_s: float) -> VehiclePose:
        """Its true pose at a time since boot, in the last ten minutes of flight."""
        return self.flight.motion.pose_at(time_s)

    def utc_s(self, time_s: float) -> float:
        """A time since boot as UTC epoch seconds on its clock."""
        return self.boot_utc_s + time_s

    def reboot(self, now: float, silence_s: float = 3.0) -> None:
        """Restart: silent for a while, with all state lost except the stored mission."""
        self._off_until = now + silence_s
        self.reboots += 1
        self.store.rebooted()
        if self.wipes:
            self.store.clear()
        flight = self.flight
        flight.disarm()
        flight.mode = flight.modes.hold if self.autopilot is Autopilot.PX4 else 0
        flight.seq, flight.paused = 0, False
        flight.state = MissionState.NOT_STARTED if len(self.store.items) > 1 else MissionState.NONE
        self._boot(now + silence_s)

    def _boot(self, at: float) -> None:
        self._booted, self._greeted = at, False
        self._rates = {_HEARTBEAT: 1.0}
        self._due = [(at, _HEARTBEAT)]

    # --- messages in ---

    def handle(self, message: Message, sender: Address, now: float) -> list[Message]:
        """Process a message for this vehicle or for all; returns the answers."""
        self._now = max(self._now, now)
        if self.off or getattr(message, "target_system", self.system) not in (0, self.system):
            return []
        kind = message.get_type()
        if kind == "HEARTBEAT":
            if not self._greeted and self.autopilot is Autopilot.PX4:
                for number, hz in _PX4_DEFAULTS.items():
                    self._stream(number, hz)
            self._greeted = True
            return []
        if kind.startswith("MISSION_") and kind != "MISSION_SET_CURRENT":
            return self.store.feed(message, sender, now)
        if kind == "PARAM_REQUEST_READ":
            return _parameter_answer(self.parameters, str(message.param_id).strip("\x00"), self.autopilot)
        if kind == "MISSION_SET_CURRENT":
            self.flight.set_current(int(message.seq))
        if kind in ("COMMAND_LONG", "COMMAND_INT"):
            result = self._command(message)
            texts = self._texts()
            ack = dialect.MAVLink_command_ack_message(message.command, result, 0, 0, sender.system, sender.component)
            return [*texts, ack, *self._requested(message), *self._change()]
        return []

    def _requested(self, message: Message) -> list[Message]:
        """The message that a command asks for, if it has it."""
        maker = _MAKERS.get(int(message.param1)) if message.command == dialect.MAV_CMD_REQUEST_MESSAGE else None
        made = None if maker is None else maker(self)
        return [] if made is None else [made]

    def _command(self, message: Message) -> int:
        flight, p1, p2, p3 = self.flight, message.param1, message.param2, message.param3
        match message.command:
            case dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
                foreign = [_EKF, _BATTERY] if self.autopilot is Autopilot.PX4 else [_ESTIMATOR]
                foreign += [_GIMBAL] if flight.gimbal_pitch_deg is None else []
                if int(p1) not in _MAKERS or int(p1) in foreign:
                    return _FAILED if self.autopilot is Autopilot.ARDUPILOT else _DENIED
                self._stream(int(p1), 1e6 / p2 if p2 > 0 else 0.0)
                return _OK
            case dialect.MAV_CMD_REQUEST_MESSAGE:
                return _OK if int(p1) in _MAKERS else _UNSUPPORTED
            case dialect.MAV_CMD_DO_SET_MODE:
                px4 = self.autopilot is Autopilot.PX4
                flight.set_mode((int(p2) << 16) | (int(p3) << 24) if px4 else int(p2))
                return _OK
            case dialect.MAV_CMD_COMPONENT_ARM_DISARM:
                return self._arm(bool(p1))
            case dialect.MAV_CMD_MISSION_START:
                why = self._mission_unchecked or flight.start_mission()
                flight.texts += [why] if why else []
                return (_FAILED if self.autopilot is Autopilot.ARDUPILOT else _DENIED) if why else _OK
            case dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                flight.set_mode(flight.modes.rtl)
                return _OK
            case dialect.MAV_CMD_NAV_LAND:
                flight.set_mode(flight.modes.land)
                return _OK
            case dialect.MAV_CMD_RUN_PREARM_CHECKS:
                flight.texts += [] if self._ready else [self._why_not]
                return _OK
            case dialect.MAV_CMD_DO_PAUSE_CONTINUE:
                if self.autopilot is Autopilot.PX4:
                    return _UNSUPPORTED
                return _OK if flight.pause(go_on=bool(p1)) else _FAILED
            case dialect.MAV_CMD_DO_REPOSITION if self.autopilot is Autopilot.PX4 and math.isnan(message.param5):
                flight.set_mode(flight.modes.hold, anew=True)
                return _OK
            case dialect.MAV_CMD_DO_SET_MISSION_CURRENT:
                return _OK if flight.set_current(int(p1)) else _DENIED
        return _UNSUPPORTED

    @property
    def _mission_unchecked(self) -> str:
        """PX4's refusal of a start right after an upload; empty once it has checked the mission."""
        checks = self.autopilot is Autopilot.PX4 and self._now - self.store.stored_at < _CHECKS_MISSION_S
        return "Mission start denied! No valid mission" if checks else ""

    def _arm(self, wanted: bool) -> int:
        if not wanted:
            if self.flight.motion.up > _LEFT_GROUND_M:  # not in the air, unless it is forced
                return _FAILED if self.autopilot is Autopilot.ARDUPILOT else _REJECTED
            self.flight.disarm()
            return _OK
        if not self._ready:
            self.flight.texts.append(self._why_not.replace("PreArm", "Arm"))
            return _FAILED if self.autopilot is Autopilot.ARDUPILOT else _REJECTED
        why = self.flight.arm() if self.arms else "Arm: Motors: Check frame class and type"
        self.flight.texts += [why] if why else []
        return _FAILED if why else _OK

    @property
    def _ready(self) -> bool:
        return self._now - self._booted >= self.ready_s

    @property
    def _has_fix(self) -> bool:
        """Whether its receiver has a fix; ArduCopter's EKF accepts the position half a minute later."""
        return self._now - self._booted >= _FIX_SHARE * self.ready_s

    @property
    def _why_not(self) -> str:
        if self.autopilot is Autopilot.PX4:
            return "Preflight Fail: Waiting for estimator to initialize"
        return "PreArm: Need Position Estimate" if self._has_fix else "PreArm: GPS 1: Bad fix"

    # --- messages out ---

    def advance(self, now: float) -> list[Message]:
        """Advance to the present time; returns the messages sent meanwhile."""
        self._now = now
        if self.off:
            self._stepped = now
            return []
        messages: list[Message] = []
        while self._stepped + STEP_S <= now + 1e-9:
            self._stepped += STEP_S
            self.flight.step(self._stepped - self._booted)
            self.used_s += STEP_S if self.flight.armed else 0.0
            messages += self._happened()
        messages += self.store.tick(now)
        self._spend(messages, now)
        if not self._ready and now >= self._why_at:
            self._why_at = now + _WHY_S
            self.flight.texts.append(self._why_not)
            messages += self._texts()
        while self._due and self._due[0][0] <= now:
            at, kind = heapq.heappop(self._due)
            hz = self._rates.get(kind, 0.0)
            if hz > 0.0:
                heapq.heappush(self._due, (max(at + 1.0 / hz, now - 1.0), kind))
                message = None if kind in self.withheld else _MAKERS[kind](self)
                if message is not None and (kind == _HEARTBEAT or self._tx_room >= _bytes_of(message)):
                    self._spend([message], now)
                    messages.append(message)
        return messages

    def _spend(self, messages: Sequence[Message], now: float) -> None:
        """Charge messages to the radio's capacity."""
        if self.tx_bytes_s < math.inf:
            self._tx_room = min(_TX_BUFFER, self._tx_room + self.tx_bytes_s * (now - self._tx_at))
            self._tx_room -= sum(_bytes_of(message) for message in messages)
            self._tx_at = now

    def _stream(self, kind: int, hz: float) -> None:
        self._rates[kind] = hz
        self._due = [entry for entry in self._due if entry[1] != kind]
        heapq.heapify(self._due)
        if hz > 0.0:
            heapq.heappush(self._due, (self._now + 1.0 / hz, kind))

    def _happened(self) -> list[Message]:
        """Messages to be sent at once: reached items, texts, pictures, arming."""
        flight = self.flight
        messages: list[Message] = []
        if flight.reached:
            messages += [dialect.MAVLink_mission_item_reached_message(seq) for seq in flight.reached]
            flight.reached.clear()
        messages += self._texts()
        for exposure in flight.exposures[self._photos_sent :]:
            messages += self._photo(exposure)
            if self.on_exposure is not None:
                self.on_exposure(self, exposure)
        self._photos_sent = len(flight.exposures)
        return messages + self._change()

    def _texts(self) -> list[Message]:
        texts, self.flight.texts = self.flight.texts, []
        return [part for text in texts for part in self._text_parts(text)]

    def _text_parts(self, text: str) -> list[Message]:
        """A text in messages of 50 characters; several have a number in common."""
        data, severity = text.encode(), _severity_of(text)
        if len(data) <= 50:
            return [dialect.MAVLink_statustext_message(severity, data)]
        self._long_texts = self._long_texts % 0xFFFF + 1
        starts = enumerate(range(0, len(data) + 1, 50))
        return [
            dialect.MAVLink_statustext_message(severity, data[at : at + 50], self._long_texts, n) for n, at in starts
        ]

    def _change(self) -> list[Message]:
        """ArduPilot sends a heartbeat at once when it arms, disarms or changes its mode."""
        state = (self.flight.armed, self.flight.mode)
        changed, self._reported_state = self._reported_state != state, state
        return [self._heartbeat()] if changed and self.autopilot is Autopilot.ARDUPILOT else []

    def _photo(self, exposure: TakenPicture) -> list[Message]:
        pose, utc_us = exposure.pose, int(self.utc_s(self._booted + exposure.time_s) * 1e6)
        lat, lon = round(exposure.lat_deg * 1e7), round(exposure.lon_deg * 1e7)
        if self.autopilot is Autopilot.ARDUPILOT:
            roll, pitch, yaw = (math.degrees(a) for a in (pose.roll_rad, pose.pitch_rad, pose.yaw_rad))
            heights, angles = (pose.alt_m, pose.height_m), (roll, pitch, yaw % 360.0)
            about = (utc_us, 1, 0, exposure.index, lat, lon)
            return [dialect.MAVLink_camera_feedback_message(*about, *heights, *angles, 0.0, 0, 0)]
        boot_ms, index = int(exposure.time_s * 1e3), exposure.index
        turn = list(pose.quaternion)
        alt, rel = round(pose.alt_m * 1e3), round(pose.height_m * 1e3)
        return [
            dialect.MAVLink_camera_trigger_message(utc_us, index),
            dialect.MAVLink_camera_image_captured_message(boot_ms, utc_us, 1, lat, lon, alt, rel, turn, index, 1, b""),
        ]

    # --- one method for each stream ---

    @property
    def _boot_ms(self) -> int:
        return max(0, int((self._now - self._booted) * 1e3))

    def _heartbeat(self) -> Message:
        flight = self.flight
        kind = (
            dialect.MAV_AUTOPILOT_ARDUPILOTMEGA if self.autopilot is Autopilot.ARDUPILOT else dialect.MAV_AUTOPILOT_PX4
        )
        base = 81 | (dialect.MAV_MODE_FLAG_SAFETY_ARMED if flight.armed else 0)
        status = dialect.MAV_STATE_STANDBY if flight.landed is Landed.ON_GROUND else dialect.MAV_STATE_ACTIVE
        status = dialect.MAV_STATE_CRITICAL if flight.failsafe else status
        return dialect.MAVLink_heartbeat_message(self.kind, kind, base, flight.mode, status, 3)

    def _position(self) -> Message | None:
        motion = self.flight.motion
        lat, lon = motion.chart.to_degrees(*motion.seen)
        if not self._has_fix and self.autopilot is Autopilot.PX4:  # PX4 says nothing, ArduCopter 0, 0
            return None
        if not self._has_fix:
            return dialect.MAVLink_global_position_int_message(self._boot_ms, 0, 0, 0, 0, 0, 0, 0, 65535)
        heading = round(math.degrees(motion.yaw) % 360.0 * 100.0) % 36000
        return dialect.MAVLink_global_position_int_message(
            self._boot_ms, round(lat * 1e7), round(lon * 1e7), round((motion.chart.alt_m + motion.up) * 1e3),
            round(motion.up * 1e3), round(motion.vn * 100), round(motion.ve * 100), round(-motion.vu * 100), heading,
        )  # fmt: skip

    def _attitude(self) -> Message:
        motion = self.flight.motion
        return dialect.MAVLink_attitude_message(self._boot_ms, motion.roll, motion.pitch, motion.yaw, 0.0, 0.0, 0.0)

    def _current(self) -> Message:
        flight, count = self.flight, len(self.store.items)
        total = count - 1 if self.autopilot is Autopilot.ARDUPILOT else count
        mode = 1 if flight.mode == flight.modes.mission else 2
        message = _MissionCurrent(flight.seq, max(0, total), int(flight.state), mode)
        if self.autopilot is Autopilot.PX4 and count:
            message.mission_id = zlib.crc32(repr(self.store.items).encode())
        return message

    def _extended(self) -> Message:
        return dialect.MAVLink_extended_sys_state_message(0, int(self.flight.landed))

    def _system_time(self) -> Message:
        return dialect.MAVLink_system_time_message(int(self.utc_s(self._now) * 1e6), self._boot_ms)

    def _gps(self) -> Message:
        motion = self.flight.motion
        if not self._has_fix:
            return dialect.MAVLink_gps_raw_int_message(0, 1, 0, 0, 0, 65535, 65535, 65535, 65535, 0)
        lat, lon = motion.chart.to_degrees(*motion.seen)
        return dialect.MAVLink_gps_raw_int_message(
            int((self._now - self._booted) * 1e6), 3, round(lat * 1e7), round(lon * 1e7),
            round((motion.chart.alt_m + motion.up) * 1e3), 80, 120, round(math.hypot(motion.vn, motion.ve) * 100),
            65535, 14,
        )  # fmt: skip

    @property
    def _left(self) -> int:
        """Percent left in its first battery."""
        return max(0, 100 - int(100.0 * self.used_s / _BATTERY_S))

    def _battery(self) -> Message:
        """One battery after the other, as ArduPilot does."""
        left = self._left
        self._battery_id = 1 - self._battery_id if self.second_battery is not None else 0
        if self._battery_id and self.second_battery is not None:
            left = round(100.0 * self.second_battery)
        cells = [0xFFFF] * 10
        return dialect.MAVLink_battery_status_message(self._battery_id, 0, 0, 0x7FFF, cells, -1, -1, -1, left)

    def _power(self) -> Message:
        left = self._left
        has = int(dialect.MAV_SYS_STATUS_PREARM_CHECK)
        said = 0 if self.autopilot is Autopilot.PX4 else has  # PX4 sets the bit of health only
        health = has if self._ready else 0
        return dialect.MAVLink_sys_status_message(said, said, health, 250, 15800, 1200, left, 0, 0, 0, 0, 0, 0)

    def _filter(self) -> Message:
        """The EKF or estimator status, with the flags that ArduCopter 4.7 and PX4 were observed to send."""
        if self.autopilot is Autopilot.PX4:
            flags = 0x3FF if self._ready else 0xA5
            return dialect.MAVLink_estimator_status_message(self._boot_ms * 1000, flags, *(0.0,) * 8)
        flags = 0x33F if self._ready else 0xA7
        return dialect.MAVLink_ekf_status_report_message(flags, 0.0, 0.0, 0.0, 0.0, 0.0)

    def _gimbal(self) -> Message | None:
        pitch_deg = self.flight.gimbal_pitch_deg
        if pitch_deg is None:
            return None
        half = math.radians(pitch_deg) / 2.0
        q = [math.cos(half), 0.0, math.sin(half), 0.0]
        flags = dialect.GIMBAL_DEVICE_FLAGS_ROLL_LOCK | dialect.GIMBAL_DEVICE_FLAGS_PITCH_LOCK
        return dialect.MAVLink_gimbal_device_attitude_status_message(0, 0, self._boot_ms, flags, q, 0.0, 0.0, 0.0, 0)

    def _home(self) -> Message | None:
        if not self._has_fix:
            return None
        lat, lon, alt = self.home
        return dialect.MAVLink_home_position_message(
            round(lat * 1e7), round(lon * 1e7), round(alt * 1e3), 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0
        )


_MAKERS: Final[dict[int, Callable[[SimVehicle], Message | None]]] = {
    _EKF: SimVehicle._filter,
    _ESTIMATOR: SimVehicle._filter,
    _BATTERY: SimVehicle._battery,
    _GIMBAL: SimVehicle._gimbal,
    _HEARTBEAT: SimVehicle._heartbeat,
    _POSITION: SimVehicle._position,
    _ATTITUDE: SimVehicle._attitude,
    _CURRENT: SimVehicle._current,
    int(dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE): SimVehicle._extended,
    int(dialect.MAVLINK_MSG_ID_SYSTEM_TIME): SimVehicle._system_time,
    int(dialect.MAVLINK_MSG_ID_GPS_RAW_INT): SimVehicle._gps,
    int(dialect.MAVLINK_MSG_ID_SYS_STATUS): SimVehicle._power,
    int(dialect.MAVLINK_MSG_ID_HOME_POSITION): SimVehicle._home,
}


def _bytes_of(message: Message) -> int:
    """Its size on the radio: MAVLink 2's frame, unsigned."""
    return int(message.unpacker.size) + 12


def _severity_of(text: str) -> int:
    """MAV_SEVERITY of a text, as autopilots say it."""
    bad = text.startswith(("Arm:", "PreArm:", "Preflight", "Auto:", "No mission", "Mission start", "Takeoff waypoint"))
    usual = dialect.MAV_SEVERITY_WARNING if "failsafe" in text.lower() else dialect.MAV_SEVERITY_INFO
    return int(dialect.MAV_SEVERITY_CRITICAL if bad else usual)


def _factory_parameters(autopilot: Autopilot, top_m_s: float) -> dict[str, float]:
    """What a ground station asks for, as it leaves the factory, but it returns when its battery is low.

    Integers are those that the autopilot keeps as such.
    """
    if autopilot is Autopilot.PX4:
        return {
            "MPC_XY_VEL_MAX": top_m_s, "RTL_RETURN_ALT": RTL_HEIGHT_M, "RTL_TYPE": 0, "NAV_DLL_ACT": 0,
            "COM_LOW_BAT_ACT": 3,
            "GF_MAX_HOR_DIST": 0.0, "GF_MAX_VER_DIST": 0.0,
        }  # fmt: skip
    return {
        "WPNAV_SPEED": 100.0 * _WPNAV_SPEED_M_S, "RTL_ALT": 100.0 * RTL_HEIGHT_M, "RTL_ALT_TYPE": 0, "FS_GCS_ENABLE": 0,
        "BATT_FS_LOW_ACT": 2,
        "FENCE_ENABLE": 0, "FENCE_AUTOENABLE": 0, "FENCE_TYPE": 7, "FENCE_ACTION": 1, "FENCE_RADIUS": 300.0,
        "FENCE_ALT_MAX": 100.0, "FENCE_ALT_MIN": -10.0, "FENCE_MARGIN": 2.0,
    }  # fmt: skip


def _parameter_answer(known: Mapping[str, float], name: str, autopilot: Autopilot) -> list[Message]:
    """The value of a parameter; an autopilot does not answer about one that it has not."""
    if name not in known:
        return []
    value, kind = known[name], int(dialect.MAV_PARAM_TYPE_REAL32)
    if isinstance(value, int):
        kind = int(dialect.MAV_PARAM_TYPE_INT32)
        value = struct.unpack("<f", struct.pack("<i", value))[0] if autopilot is Autopilot.PX4 else value
    return [dialect.MAVLink_param_value_message(name.encode(), value, kind, len(known), 0)]
