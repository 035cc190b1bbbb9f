"""The state of one vehicle, from its messages."""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

from gcs_plugin.fleet.autopilot_settings import CHECKED, NEWER, PARAMETERS, Questions, Setting, SetTo, answer
from gcs_plugin.fleet.heard_messages import MESSAGE_IDS
from gcs_plugin.fleet.message_rates import Streams
from gcs_plugin.fleet.routes import Route, Routes
from gcs_plugin.links.mavlink import Autopilot, Message, dialect, has_place
from gcs_plugin.mission.command_dialogues import Pilot
from gcs_plugin.mission.completion import CompletionDetector
from gcs_plugin.mission.exchange import Address, command_long
from gcs_plugin.mission.flight_modes import HOLDS, Modes, modes_of
from gcs_plugin.mission.items import Mission
from gcs_plugin.mission.start_dialogue import MOVED_M, Standing, mission_id, others_command
from orthoswarm.model.earth import distance_m

_LANDED: Final = {0: "", 1: "on ground", 2: "in air", 3: "taking off", 4: "landing"}
_FIRST: Final = 0
_SURE_TIMES: Final = 3  # that a battery was told before, where packets are lost: then the others were, too (chosen)
_PREARM: Final = int(dialect.MAV_SYS_STATUS_PREARM_CHECK)
_GEOFENCE: Final = int(dialect.MAV_SYS_STATUS_GEOFENCE)
_PREARM_S: Final = 45.0  # autopilots repeat what is wrong every 30 s
# EKF_STATUS_FLAGS and ESTIMATOR_STATUS_FLAGS agree in these. PX4 sets CONST_POS_MODE whenever it stands still.
_EKF_NEEDED: Final = int(dialect.EKF_ATTITUDE | dialect.EKF_POS_HORIZ_ABS | dialect.EKF_POS_VERT_ABS)
_EKF_WRONG: Final = int(dialect.EKF_CONST_POS_MODE | dialect.EKF_UNINITIALIZED)
_MISSION_PAUSED: Final = int(dialect.MISSION_STATE_PAUSED)
_CRITICAL: Final = frozenset({int(dialect.MAV_STATE_CRITICAL), int(dialect.MAV_STATE_EMERGENCY)})
_INFO, _FAULT = int(dialect.MAV_SEVERITY_INFO), int(dialect.MAV_SEVERITY_WARNING)
_SEVERE_S: Final = 30.0  # so often autopilots repeat what is still wrong
_READ_AGAIN_S: Final = 60.0  # ArduPilot does not say that another station has stored a mission of as many items
_SINKS_M_S: Final = 0.5  # faster than one that holds its height moves, slower than any descent
_STILL_M_S: Final = (0.6, 0.25)  # horizontally, vertically; slower than the last metres of a landing


@dataclass(slots=True, kw_only=True)
class Vehicle:
    """One vehicle.

    Attributes:
        streams: keeps its messages coming.
        routes: the ways on which it is heard, and whether several vehicles use its system id.
        signs: True once it was heard to sign its messages.
        heard: when it was heard last (the fleet's clock). lost: True while it is silent.
        kind: MAV_TYPE.
        lat_deg, lon_deg: None before the first position.
        reported: True once it has sent a position message, if only to say that it has no position.
        height_m: above takeoff. alt_m: above the sea, None before the first position.
        velocity_m_s: north, east, down. heading_rad: clockwise from north, None if it does not know.
        roll_rad: attitude of the airframe, with pitch_rad and yaw_rad.
        boot_utc_s: UTC epoch seconds of its start, from its SYSTEM_TIME; None before it knows the time.
        time_boot_s: its own clock at the last position.
        battery: what is left in its emptiest battery, 0 to 1; None if not reported.
        mission: what it holds, where that was read or written in this session.
        held_id: the vehicle's own checksum of it; 0 for an ArduPilot, which tells none. mission_id: the one told last.
        read_s: when its mission was read last; read_at: when it is to be read again (the fleet's clock).
        touched: how often its mode or arming has changed, or it has obeyed another station.
        way: the mode in which it was last under way in this flight, not held; None on the ground, or not known.
        danger: what endangers it by itself, in words; empty if nothing does.
        failsafe: whether it reports one (MAV_STATE_CRITICAL, MAV_STATE_EMERGENCY). had_failsafe: in this flight, ever.
        unbegun: it was given that mission here and has not begun it.
        told_to_stay: a pause was given to it here, and nothing since.
        photos: pictures that it has reported.
        gimbal_pitch_deg: where its gimbal looks, -90 straight down, 0 the horizon; None if it reports none.
        received: packets; missed: packets lost according to its counters.
        impossible: number of messages with values out of range, which were dropped.
        ekf_ok: whether its filter has an absolute position; None if not reported.
        prearm_ok: whether its pre-arm checks have passed; None if not reported.
        home: latitude and longitude of its home in degrees; home_alt_m: altitude above the sea; None before it is set.
        ask_why_at: when it may be asked again why it would not arm (the fleet's clock).
        pace: seconds of its clock in one of ours; 1 but for a simulation that runs fast or slow.
        launch: where it armed last, latitude and longitude in degrees.
        settings: what it is set to, as far as it has answered. questions: asks it for that.
        fence_on: whether ArduPilot reports that it keeps a geofence now, by its parameters or a switch.
        paused_in_mission: MISSION_CURRENT says "paused", and a HEARTBEAT after it still shows the mission's mode. A
            change to RTL or hold suspends the mission as well, and its HEARTBEAT may come a second later.
    """

    address: Address
    autopilot: Autopilot
    modes: Modes
    detector: CompletionDetector
    streams: Streams
    routes: Routes = field(default_factory=Routes)
    lost: bool = False
    signs: bool = False
    heard: float = 0.0
    armed: bool = False
    custom_mode: int = 0
    kind: int = 0
    lat_deg: float | None = None
    lon_deg: float | None = None
    reported: bool = False
    height_m: float = 0.0
    alt_m: float | None = None
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
    held_id: int = 0
    mission_id: int = 0
    read_s: float = -math.inf
    read_at: float = 0.0
    touched: int = 0
    way: int | None = None
    danger: str = ""
    failsafe: bool = False
    had_failsafe: bool = False
    unbegun: bool = False
    mission_state: int = 0
    mission_seq: int = 0
    mission_total: int = 0
    paused_in_mission: bool = False
    told_to_stay: bool = False
    photos: int = 0
    gimbal_pitch_deg: float | None = None
    received: int = 0
    missed: int = 0
    impossible: int = 0
    ekf_ok: bool | None = None
    prearm_ok: bool | None = None
    home: tuple[float, float] | None = None
    home_alt_m: float | None = None
    launch: tuple[float, float] | None = None
    settings: dict[Setting, SetTo] = field(default_factory=dict)
    questions: Questions = field(init=False)
    fence_on: bool = False
    ask_why_at: float = 0.0
    pace: float = 1.0
    texts: "deque[str]" = field(default_factory=lambda: deque(maxlen=50))
    _prearm: dict[str, float] = field(default_factory=dict)
    _still_since: float | None = None
    _sinks_since: float | None = None
    _mode_since: float = 0.0
    _severe: tuple[str, float] = ("", -math.inf)
    _batteries: dict[int, float | None] = field(default_factory=dict)
    _told: dict[int, tuple[int, int]] = field(default_factory=dict)
    _all_batteries: bool = False
    _pictures: set[tuple[int, int]] = field(default_factory=set)

    def __post_init__(self) -> None:
        """Nothing is asked yet."""
        self.questions = Questions(self.address, self.autopilot)

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
        """True if it reports so."""
        return self.landed not in ("", "on ground")

    @property
    def flying(self) -> bool:
        """True if it is armed and, as far as is known, off the ground."""
        return self.armed and (self.in_air or (not self.landed and self.height_m > 1.5))

    @property
    def place(self) -> tuple[float, float] | None:
        """Where it is, latitude and longitude in degrees; None if that is not known."""
        return None if self.lat_deg is None or self.lon_deg is None else (self.lat_deg, self.lon_deg)

    def place_age_s(self, now: float) -> float:
        """Seconds since it reported where it is, or since it was heard, if that is longer ago."""
        return max(now - self.heard, self.streams.age_s(MESSAGE_IDS["GLOBAL_POSITION_INT"], now) or 0.0)

    @property
    def route(self) -> Route | None:
        """The way that carries commands, None before it was heard."""
        return self.routes.best

    @property
    def claimants(self) -> tuple[str, ...]:
        """Addresses of those who use its system id, where they are several; empty otherwise."""
        return self.routes.claimants

    @property
    def still_s(self) -> float:
        """For how many seconds of its own clock it has stood still."""
        return 0.0 if self._still_since is None else max(0.0, self.time_boot_s - self._still_since)

    @property
    def in_mode_s(self) -> float:
        """For how many seconds of its own clock it has been in its mode."""
        return max(0.0, self.time_boot_s - self._mode_since)

    @property
    def sinks_s(self) -> float:
        """For how many seconds of its own clock it has been sinking."""
        return 0.0 if self._sinks_since is None else max(0.0, self.time_boot_s - self._sinks_since)

    @property
    def standing(self) -> Standing:
        """What a start that is given now relies on."""
        place = None if self.flying else self.place
        return Standing(mode=self.custom_mode, armed=self.armed, place=place, touched=self.touched)

    def changed_since(self, then: Standing) -> str:
        """What has changed since a start was given, in words; empty if nothing has."""
        if self.custom_mode != then.mode:
            return f"was put into {self.mode}"
        if self.armed != then.armed:
            return "was armed" if self.armed else "was disarmed"
        if self.touched != then.touched:
            return "was commanded by someone else"
        here = self.standing.place
        away = 0.0 if here is None or then.place is None else distance_m(*here, *then.place)
        return f"was moved by {away:.0f} m" if away > MOVED_M else ""

    def mission_was_read(self, now: float) -> None:
        """Its mission was just read from it, or written and read back."""
        self.held_id, self.read_s, self.read_at = self.mission_id, now, now + _READ_AGAIN_S

    @property
    def battery_name(self) -> str:
        """The emptiest of several batteries, as ArduPilot counts them: "battery 2"; empty with one battery."""
        known = {number: left for number, left in self._batteries.items() if left is not None}
        return f"battery {min(known, key=known.__getitem__) + 1}" if len(known) > 1 else ""

    def battery_age_s(self, now: float) -> float | None:
        """Seconds since its batteries were reported, of several the longest time; None before that."""
        told = ("SYS_STATUS", "BATTERY_STATUS") if len(self._batteries) > 1 else ("SYS_STATUS",)
        ages = [self.streams.age_s(MESSAGE_IDS[name], now) for name in told]
        return max((age_s for age_s in ages if age_s is not None), default=None)

    def restarted(self) -> None:
        """Forget what it was set up with: it may have been set up anew, and with other batteries."""
        self.mission, self.unbegun, self.read_at, self.way = None, False, 0.0, None
        self.touched += 1
        self.settings.clear()
        self.questions.asked = False
        self._batteries.clear()
        self._told.clear()
        self._all_batteries = False

    @property
    def ready_to_check(self) -> bool:
        """True once what a check before a start looks at was told, or was asked for in vain."""
        batteries = self._all_batteries or not self._told  # one that tells of none has none but SYS_STATUS's
        return self.streams.ready_to_check and batteries and not self.answers_settings

    @property
    def answers_settings(self) -> bool:
        """True while a setting that a check before a start looks at has been asked for and may still be told."""
        fence = self.settings.get(Setting.FENCE)
        off = fence is not None and not fence.value and not self.fence_on  # unless it switches it on as it arms
        return self.questions.waits_for(CHECKED | {Setting.FENCE_AUTO} if off else CHECKED)

    @property
    def untold(self) -> bool:
        """True if a check before a start asks it once more for settings that it waits for.

        Not for what older versions do not have, and not if it has been asked and has answered nothing: each start would
        wait for these in vain, until the command is too old.
        """
        if not self.settings:
            return not self.questions.asked
        have = {p.setting for p in PARAMETERS[self.autopilot]} & CHECKED - NEWER
        return not have <= self.settings.keys()

    def prearm_texts(self, now: float) -> list[str]:
        """What it said lately about why it would not arm."""
        return [text for text, said in self._prearm.items() if now - said < _PREARM_S]

    def home_question(self) -> Message:
        """A request for where its home is, which it says every few seconds only."""
        return command_long(self.address, dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_HOME_POSITION)

    @property
    def pilot(self) -> Pilot:
        """Makes the commands for it."""
        return Pilot(self.address, self.streams.own, self.autopilot, self.modes)

    @property
    def severe_text(self) -> str:
        """The last text by which its autopilot reported a fault in the air, for some seconds of its own clock."""
        text, said_s = self._severe
        return text if self.flying and 0.0 <= self.time_boot_s - said_s < _SEVERE_S else ""

    def says(self, text: str, now: float, severity: int = _INFO) -> None:
        """Process a text of its autopilot, of a MAV_SEVERITY."""
        self.texts.append(text)
        if severity <= _FAULT and self.flying:
            self._severe = text, self.time_boot_s
        if text.startswith(("PreArm", "Arm:", "Preflight")):
            self._prearm.pop(text, None)
            self._prearm[text] = now

    def update(self, message: Message) -> None:
        """Process a message of its autopilot or camera."""
        handler = _HANDLERS.get(message.get_msgId())
        if handler is not None:
            handler(self, message)

    # --- one method for each message ---

    def _heartbeat(self, m: Message) -> None:
        was, self.armed = self.armed, bool(m.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        if self.armed and not was and self.place is not None and not self.in_air:
            self.launch = self.place
        changed = self.armed != was or self.custom_mode != int(m.custom_mode)
        self.touched += changed
        self.custom_mode, self.failsafe = int(m.custom_mode), int(m.system_status) in _CRITICAL
        if changed:
            self.read_at, self._mode_since = 0.0, self.time_boot_s
        self.had_failsafe = self.armed and (self.had_failsafe or self.failsafe)
        if not self.armed:
            self.way = None
        elif self.mode not in HOLDS:
            self.way = self.custom_mode
        if m.type != self.kind:
            self.kind = int(m.type)
            self.modes = modes_of(self.autopilot, self.kind)
        self.paused_in_mission = self.mission_state == _MISSION_PAUSED and self.custom_mode == self.modes.mission

    def _position(self, m: Message) -> None:
        self.reported = True
        self.lat_deg, self.lon_deg = (m.lat / 1e7, m.lon / 1e7) if has_place(m) else (None, None)
        self.height_m = m.relative_alt / 1e3
        self.alt_m = None if self.lat_deg is None else m.alt / 1e3
        self.velocity_m_s = (m.vx / 100.0, m.vy / 100.0, m.vz / 100.0)
        self.heading_rad = None if m.hdg == 65535 else math.radians(m.hdg / 100.0)
        self.time_boot_s = m.time_boot_ms / 1e3
        moves = math.hypot(*self.velocity_m_s[:2]) > _STILL_M_S[0] or abs(self.velocity_m_s[2]) > _STILL_M_S[1]
        self._sinks_since = self._since(self._sinks_since, self.velocity_m_s[2] >= _SINKS_M_S)
        self._still_since = self._since(self._still_since, not moves)

    def _since(self, before: float | None, holds: bool) -> float | None:
        """Since when something holds on its clock, which may have gone back; None if it does not."""
        now = self.time_boot_s
        return None if not holds else now if before is None or before > now else before

    def _attitude(self, m: Message) -> None:
        self.roll_rad, self.pitch_rad, self.yaw_rad = m.roll, m.pitch, m.yaw

    def _mission_current(self, m: Message) -> None:
        self.mission_seq, self.mission_state = int(m.seq), int(m.mission_state)
        self.paused_in_mission &= self.mission_state == _MISSION_PAUSED
        last, self.mission_id = self.mission_id, mission_id(m)
        if self.mission_id != last:
            self.read_at = 0.0
        if 0 < m.total < 0xFFFF:
            self.mission_total = int(m.total)

    def _acknowledged(self, m: Message) -> None:
        self.touched += others_command(m, self.streams.own)

    def _extended(self, m: Message) -> None:
        self.landed = _LANDED.get(int(m.landed_state), "")

    def _system_time(self, m: Message) -> None:
        if m.time_unix_usec > 10**15:  # before it has a fix the clock stands in 1970
            self.boot_utc_s = m.time_unix_usec / 1e6 - m.time_boot_ms / 1e3

    def _gps(self, m: Message) -> None:
        self.gps_fix, self.satellites = int(m.fix_type), int(m.satellites_visible)

    def _power(self, m: Message) -> None:
        self._left_in(_FIRST, m)
        known = self.autopilot is Autopilot.PX4 or m.onboard_control_sensors_enabled & _PREARM
        self.prearm_ok = bool(m.onboard_control_sensors_health & _PREARM) if known else None
        self.fence_on = bool(m.onboard_control_sensors_enabled & _GEOFENCE) and self.autopilot is Autopilot.ARDUPILOT

    def _battery(self, m: Message) -> None:
        """Of one of several; the first one's is in SYS_STATUS, too, and PX4's SYS_STATUS is of the emptiest one."""
        if self.autopilot is not Autopilot.PX4:
            times, missed = self._told.get(int(m.id), (0, 0))
            # They are told one after the other: between two of one come all others, unless a packet was lost.
            self._all_batteries |= times > 0 and (missed == self.missed or times >= _SURE_TIMES)
            self._told[int(m.id)] = times + 1, self.missed
            if m.id != _FIRST:
                self._left_in(int(m.id), m)

    def _left_in(self, battery: int, m: Message) -> None:
        self._batteries[battery] = m.battery_remaining / 100.0 if 0 <= m.battery_remaining <= 100 else None
        self.battery = min((left for left in self._batteries.values() if left is not None), default=None)

    def _filter(self, m: Message) -> None:
        wrong = _EKF_WRONG if m.get_type() == "EKF_STATUS_REPORT" else 0
        self.ekf_ok = m.flags & _EKF_NEEDED == _EKF_NEEDED and not m.flags & wrong

    def _home(self, m: Message) -> None:
        self.home, self.home_alt_m = (m.latitude / 1e7, m.longitude / 1e7), m.altitude / 1e3

    def _parameter(self, m: Message) -> None:
        found = answer(m, self.autopilot)
        if found is not None:
            self.settings[found[0]] = found[1]
            self.questions.answered(found[0])

    def _gimbal(self, m: Message) -> None:
        w, x, y, z = m.q
        self.gimbal_pitch_deg = math.degrees(
            math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x) / math.hypot(*m.q) ** 2)))
        )

    def _photo(self, m: Message) -> None:
        index = m.img_idx if m.get_type() == "CAMERA_FEEDBACK" else m.image_index
        known = len(self._pictures)
        self._pictures.add((int(index), int(getattr(m, "time_usec", 0) or getattr(m, "time_utc", 0))))
        self.photos += len(self._pictures) - known


_HANDLERS: Final = {
    MESSAGE_IDS["HEARTBEAT"]: Vehicle._heartbeat,
    MESSAGE_IDS["GLOBAL_POSITION_INT"]: Vehicle._position,
    MESSAGE_IDS["ATTITUDE"]: Vehicle._attitude,
    MESSAGE_IDS["MISSION_CURRENT"]: Vehicle._mission_current,
    MESSAGE_IDS["COMMAND_ACK"]: Vehicle._acknowledged,
    MESSAGE_IDS["EXTENDED_SYS_STATE"]: Vehicle._extended,
    MESSAGE_IDS["SYSTEM_TIME"]: Vehicle._system_time,
    MESSAGE_IDS["GPS_RAW_INT"]: Vehicle._gps,
    MESSAGE_IDS["SYS_STATUS"]: Vehicle._power,
    MESSAGE_IDS["BATTERY_STATUS"]: Vehicle._battery,
    MESSAGE_IDS["EKF_STATUS_REPORT"]: Vehicle._filter,
    MESSAGE_IDS["ESTIMATOR_STATUS"]: Vehicle._filter,
    MESSAGE_IDS["HOME_POSITION"]: Vehicle._home,
    MESSAGE_IDS["PARAM_VALUE"]: Vehicle._parameter,
    MESSAGE_IDS["GIMBAL_DEVICE_ATTITUDE_STATUS"]: Vehicle._gimbal,
    MESSAGE_IDS["CAMERA_FEEDBACK"]: Vehicle._photo,
    MESSAGE_IDS["CAMERA_IMAGE_CAPTURED"]: Vehicle._photo,
}
