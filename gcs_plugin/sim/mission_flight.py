"""A simulated vehicle's flight of its mission: items, camera, and the end as its autopilot does it."""

import enum
import math
from collections.abc import Collection
from dataclasses import dataclass, field
from random import Random
from typing import Final

from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission import items as mav
from gcs_plugin.mission.flight_modes import Modes
from gcs_plugin.mission.items import MissionItem
from gcs_plugin.sim.mission_store import MissionStore
from gcs_plugin.sim.multirotor import STEP_S, Airframe, Chart, VehicleMotion, VehiclePose
from orthoswarm.model.angles import wrap_rad

RTL_HEIGHT_M: Final = 15.0
_REACHED_M: Final = 1.5
_FINAL_SINK_M_S, _FINAL_BELOW_M = 0.7, 5.0
_OWN_TAKEOFF_S: Final = 0.7  # what the motion itself loses: by gathering speed in a takeoff,
_OWN_STOP_S: Final = 1.0  # and by slowing down above home
_LIFTED_M: Final = 0.3  # one that is lower when it leaves its mission, or stops landing, stands
_STICKS_S: Final = 5.0  # one that is steered flies to where it would be then
_IDLE_S: Final = {Autopilot.ARDUPILOT: 10.0, Autopilot.PX4: 2.0}
"""Landed by its sticks, it disarms after so long: factory settings of DISARM_DELAY and COM_DISARM_LAND."""


class Landed(enum.IntEnum):
    """MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class MissionState(enum.IntEnum):
    """MISSION_STATE."""

    NONE = 1
    NOT_STARTED = 2
    ACTIVE = 3
    PAUSED = 4
    COMPLETE = 5


class Task(enum.Enum):
    """The vehicle's present task."""

    STAND = "stand"
    HOLD = "hold"
    ITEM = "item"
    CLIMB_HOME = "climb home"
    GO_HOME = "go home"
    DESCEND = "descend"
    STEERED = "steered"


@dataclass(frozen=True, slots=True)
class TakenPicture:
    """A picture: its number from 0, seconds since boot, true pose, and place by the receiver (degrees)."""

    index: int
    time_s: float
    pose: VehiclePose
    lat_deg: float
    lon_deg: float


@dataclass(slots=True, kw_only=True)
class MissionFlight:
    """The flight of one vehicle.

    Attributes:
        mode: custom mode number. failsafe: it reports one; until it is disarmed. seq: current item.
        reached, texts: items reached, and texts, since the last look. exposures: all pictures.
        gimbal_pitch_deg: where its gimbal looks, -90 straight down; None without one.
        triggers: how often the camera was triggered; at those in misfires it took no picture.
    """

    autopilot: Autopilot
    modes: Modes
    store: MissionStore
    motion: VehicleMotion
    mode: int = 0
    armed: bool = False
    failsafe: bool = False
    seq: int = 0
    state: MissionState = MissionState.NONE
    landed: Landed = Landed.ON_GROUND
    reached: list[int] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)
    exposures: list[TakenPicture] = field(default_factory=list)
    triggers: int = 0
    misfires: Collection[int] = ()
    gimbal_pitch_deg: float | None = None
    time_s: float = 0.0
    paused: bool = False
    _task: Task = Task.STAND
    _waited: float = 0.0
    _trigger_m: float = 0.0
    _last_photo: tuple[float, float] | None = None
    _jumps: dict[int, int] = field(default_factory=dict)
    _ends_mission: bool = False
    _reached_any: bool = False
    _generation: int = 0
    _steered: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _cruise_m_s: float | None = None
    _in_control: bool = False

    @classmethod
    def make(
        cls, autopilot: Autopilot, modes: Modes, *, store: MissionStore, chart: Chart, frame: Airframe, seed: int
    ) -> "MissionFlight":
        """A vehicle standing at home."""
        motion = VehicleMotion(chart=chart, airframe=frame, random=Random(seed), speed=frame.speed_m_s)
        mode = modes.hold if autopilot is Autopilot.PX4 else 0
        return cls(autopilot=autopilot, modes=modes, store=store, motion=motion, mode=mode)

    # --- commands ---

    def arm(self) -> str:
        """Arm; returns why not."""
        if self.armed:
            return ""
        name = self._unarmable.get(self.mode) if self.autopilot is Autopilot.ARDUPILOT else None
        if name is not None:
            return f"Arm: {name} mode not armable"
        self.armed = True
        return ""

    def disarm(self) -> None:
        """Motors off, and what that does to the mission."""
        if not self.armed:
            return
        self.armed = self.failsafe = False
        self._stand()
        self._trigger_m = 0.0
        if self.state is MissionState.COMPLETE or self.autopilot is Autopilot.ARDUPILOT:
            self.seq = 0

    def set_mode(self, mode: int, *, anew: bool = False) -> None:
        """Change the mode; leaving the mission's mode suspends the mission. PX4's HOLD goes on with what it does."""
        if mode == self.mode == self.modes.hold and self.autopilot is Autopilot.PX4 and not anew:
            return
        was, self.mode = self.mode, mode
        modes = self.modes
        self._let_go()
        if mode == modes.mission:
            if self.armed and self.state is not MissionState.COMPLETE:
                self._enter_mission()
            return
        if was == modes.mission and self.state is MissionState.ACTIVE:
            self.state = MissionState.NOT_STARTED if self.autopilot is Autopilot.ARDUPILOT else MissionState.PAUSED
        self.paused = False
        if not self.armed or self.landed is Landed.ON_GROUND:
            return
        if self.motion.up < _LIFTED_M:
            self._settle()
        elif mode == modes.rtl:
            self._ends_mission = False
            self._go_home()
        elif mode == modes.land:
            self._ends_mission = False
            self._descend(*self.motion.seen)
        else:
            self._hold()

    def start_mission(self) -> str:
        """MISSION_START; returns why not."""
        first = self.autopilot.first_seq
        if len(self.store.items) <= first:
            return "No mission"
        begins = self._next_nav(first)
        if self.landed is Landed.ON_GROUND and (begins is None or self.store.items[begins].command != mav.TAKEOFF):
            return "Auto: Missing Takeoff Cmd" if self.autopilot is Autopilot.ARDUPILOT else "Takeoff waypoint required"
        if self.autopilot is Autopilot.ARDUPILOT and not self.armed:
            return "Mission start: not armed"
        self.armed, self.mode = True, self.modes.mission
        self._let_go()
        if self.state is not MissionState.ACTIVE or self._task is Task.STAND:
            # ArduCopter goes on where it left a mission, though another one has been stored since (MIS_RESTART 0).
            goes_on = self.autopilot is Autopilot.ARDUPILOT and self.state is not MissionState.COMPLETE
            if not (goes_on and first <= self.seq < len(self.store.items)):
                self.seq, self._jumps = first, {}
            self.state = MissionState.NOT_STARTED
            self._enter_mission()
        return ""

    def pause(self, go_on: bool) -> bool:
        """DO_PAUSE_CONTINUE: between waypoints only."""
        if self.state is not MissionState.ACTIVE or self._task is not Task.ITEM or self.mode != self.modes.mission:
            return False
        item = self.store.items[self.seq]
        if item.command in (mav.TAKEOFF, mav.LAND, mav.RTL):
            return False
        if go_on == self.paused:
            self.paused = not go_on
            self._aim(item)
        return True

    def set_current(self, seq: int) -> bool:
        """Jump to an item; ArduPilot's item 0 stands for the beginning."""
        if not 0 <= seq < len(self.store.items):
            return False
        if seq < self.autopilot.first_seq:
            seq, self._jumps = self.autopilot.first_seq, {}
        if self.state is MissionState.COMPLETE:
            self.state = MissionState.NOT_STARTED
        self.seq, self.paused = seq, False
        if self.state is MissionState.ACTIVE:
            self._run_from(seq)
        return True

    def steer(self, north_m_s: float, east_m_s: float, up_m_s: float) -> None:
        """Be moved by sticks, or by another station, until the mode changes; down to the ground, too."""
        if not self.armed or self.landed is Landed.ON_GROUND:
            return
        self._let_go()
        self._task, self.landed = Task.STEERED, Landed.IN_AIR
        self._steered, self._cruise_m_s = (north_m_s, east_m_s, up_m_s), self.motion.speed
        self.motion.speed = math.hypot(north_m_s, east_m_s)

    def fail_safe(self, text: str) -> None:
        """Its battery is low: it says so and flies home, or takes its motors off where it stands."""
        self.texts.append(text)
        self.failsafe = self.armed
        if self.landed is Landed.ON_GROUND:
            self.disarm()
        else:
            self.set_mode(self.modes.rtl)

    # --- time ---

    def step(self, time_s: float) -> None:
        """Advance by STEP_S."""
        self.time_s = time_s
        if self.store.generation != self._generation:
            self._generation = self.store.generation
            self._mission_changed()
        if not self.armed:
            return
        self._pace()
        self.motion.step(time_s)
        match self._task:
            case Task.ITEM:
                self._fly_item(self.store.items[self.seq])
            case Task.CLIMB_HOME if self.motion.distance()[1] < 1.0:
                self.motion.go((0.0, 0.0, self.motion.up))
                self._task = Task.GO_HOME
            case Task.GO_HOME if self.motion.distance()[0] < _REACHED_M:
                times = self.motion.airframe.times
                self._waited += STEP_S
                if times is None or self._waited > times.home_wait_s - _OWN_STOP_S:
                    self._descend(0.0, 0.0)
            case Task.DESCEND:
                self._touch_down()
            case Task.STEERED:
                self._follow_sticks()
            case Task.STAND if self._waited > 0.0:
                self._idle()
        if self._trigger_m > 0.0 and self.landed is Landed.IN_AIR:
            self._photograph()

    # --- the mission ---

    @property
    def _unarmable(self) -> dict[int, str]:
        """ArduCopter's modes here in which it does not arm."""
        return {self.modes.mission: "Auto", self.modes.hold: "Brake", self.modes.rtl: "RTL", self.modes.land: "Land"}

    def _next_nav(self, seq: int) -> int | None:
        return next((i for i in range(seq, len(self.store.items)) if self.store.items[i].is_nav), None)

    def _mission_changed(self) -> None:
        """A new mission lies in the store. The mission's state goes stale: it still says complete."""
        if self._task is Task.ITEM:
            if self.seq < len(self.store.items) and self.store.items[self.seq].is_nav:
                self._begin(self.store.items[self.seq])
            else:
                self._finish()
                self._hold()
            return
        if self.state is not MissionState.COMPLETE:
            self.state = (
                MissionState.NOT_STARTED if len(self.store.items) > self.autopilot.first_seq else MissionState.NONE
            )
        if not self.armed:
            self.seq = 0

    def _enter_mission(self) -> None:
        self.state, self.paused, self._reached_any = MissionState.ACTIVE, False, False
        self._run_from(max(self.seq, self.autopilot.first_seq))

    def _run_from(self, seq: int) -> None:
        """Execute items up to the next one that is flown."""
        while seq < len(self.store.items):
            item = self.store.items[seq]
            if item.is_nav:
                self.seq, self._task, self._waited = seq, Task.ITEM, 0.0
                self._begin(item)
                return
            jump = self._do(seq, item)
            seq = jump if jump is not None else seq + 1
        self.seq = len(self.store.items) - 1
        self._finish()
        self._hold(at_target=True)

    def _do(self, seq: int, item: MissionItem) -> int | None:
        if item.command == mav.TRIGGER_DISTANCE:
            self._trigger_m, self._last_photo = item.params[0], None
            if item.params[0] > 0.0 and not item.params[2]:  # the first picture only after the distance
                self._last_photo = self.motion.seen
        elif item.command == mav.CHANGE_SPEED and item.params[1] > 0.0:
            self.motion.speed = self.motion.airframe.held_m_s(item.params[1])
        elif self.gimbal_pitch_deg is not None and self._may_turn(item):
            self.gimbal_pitch_deg = item.params[0]
        elif item.command == mav.GIMBAL_CLAIM:
            self._in_control = True
        elif item.command == mav.JUMP and self._jumps.get(seq, 0) < item.params[1]:
            self._jumps[seq] = self._jumps.get(seq, 0) + 1
            return int(item.params[0])
        return None

    def _may_turn(self, item: MissionItem) -> bool:
        """Whether an item turns its gimbal; PX4 ignores a manager's command before it was given control."""
        px4 = self.autopilot is Autopilot.PX4
        return item.command == mav.MOUNT_CONTROL or (item.command == mav.GIMBAL_PITCH and (self._in_control or not px4))

    def _begin(self, item: MissionItem) -> None:
        lifts = item.command == mav.TAKEOFF or (
            self.autopilot is Autopilot.PX4 and item.command not in (mav.RTL, mav.LAND)
        )
        if self.landed is Landed.ON_GROUND and not lifts:  # ArduCopter wants a takeoff
            self._task = Task.STAND
            return
        self.texts.append(f"Mission: {self.seq} {item.name}")
        if item.command == mav.RTL:
            if self.autopilot is Autopilot.PX4:
                self._finish()
                self.mode = self.modes.rtl
            self._ends_mission = self.autopilot is Autopilot.ARDUPILOT
            self._go_home()
        elif item.command in mav.LANDINGS:
            self._aim(item)
            self._ends_mission = True
        else:
            if self.landed is Landed.ON_GROUND:
                self.landed = Landed.TAKEOFF
            self._aim(item)

    def _aim(self, item: MissionItem) -> None:
        motion = self.motion
        north, east = motion.seen
        if self.paused:
            motion.stop()
            return
        if item.command != mav.TAKEOFF and (item.x or item.y):
            north, east = motion.chart.to_metres(item.lat_deg, item.lon_deg)
        height = item.z - (motion.chart.alt_m if item.plain_frame == mav.FRAME_GLOBAL else 0.0)
        if item.command == mav.TAKEOFF and motion.up > _LIFTED_M:  # it flies: where it stops, and no lower
            motion.stop()
            motion.climb_to(height)
            return
        stays_high = item.command in mav.LANDINGS or not item.has_place
        # On a leg it keeps to the line, which is what makes the leg straight.
        motion.go((north, east, motion.up if stays_high else height), along_line=bool(self._reached_any))

    def _fly_item(self, item: MissionItem) -> None:
        if self.paused:
            return
        horizontal, vertical = self.motion.distance()
        if self.landed is Landed.TAKEOFF and self.motion.up > 2.0 and item.command != mav.TAKEOFF:
            self.landed = Landed.IN_AIR
        if horizontal > _REACHED_M or vertical > 1.0:
            return
        if item.command in mav.LANDINGS:
            times = self.motion.airframe.times
            self._waited += STEP_S
            if self.motion.target and (times is None or self._waited > times.land_wait_s - _OWN_STOP_S):
                self._descend(self.motion.target[0], self.motion.target[1])
            return
        if item.command == mav.LOITER_UNLIM:
            return
        self._waited += STEP_S
        hold = item.params[0] if item.command in (mav.WAYPOINT, mav.LOITER_TIME, mav.DELAY) else 0.0
        if self._waited <= hold + self._lost_s(item):
            return
        if item.command == mav.TAKEOFF:
            self.landed = Landed.IN_AIR
            times = self.motion.airframe.times
            if times is not None:
                self.motion.gathers_m_s2 = times.acceleration_m_s2
        self._reach(self.seq)
        self._run_from(self.seq + 1)

    def _pace(self) -> None:
        """How fast its autopilot lets it climb and gather speed now."""
        motion, times = self.motion, self.motion.airframe.times
        if times is None:
            return
        low = self.landed is Landed.TAKEOFF and motion.up < times.takeoff_below_m
        usual_s = times.takeoff_below_m / motion.airframe.climb_m_s
        lost_s = max(0.0, times.takeoff_below_s - _OWN_TAKEOFF_S)
        motion.climb_m_s = times.takeoff_below_m / (usual_s + lost_s) if low else motion.airframe.climb_m_s
        if math.hypot(motion.vn, motion.ve) > 0.9 * motion.speed:
            motion.gathers_m_s2 = motion.airframe.accel_m_s2

    def _lost_s(self, item: MissionItem) -> float:
        """Seconds that the autopilot takes at a point beyond its motion."""
        motion, times = self.motion, self.motion.airframe.times
        if times is None or motion.target is None:
            return 0.0
        if item.command == mav.TAKEOFF:
            return times.takeoff_s - max(times.takeoff_below_s, _OWN_TAKEOFF_S) + times.set_off_s
        came, goes = _step(motion.came_from, motion.target), _step(motion.target, self._next_place())
        if not came or not goes:
            return times.height_change_s
        angle = abs(wrap_rad(math.atan2(goes[1], goes[0]) - math.atan2(came[1], came[0])))
        return motion.airframe.turn_s(motion.speed, angle)

    def _next_place(self) -> tuple[float, ...]:
        """North and east of the point after the present one; home at the end."""
        seq = self._next_nav(self.seq + 1)
        item = None if seq is None else self.store.items[seq]
        if item is None or not (item.x or item.y):
            return 0.0, 0.0
        return self.motion.chart.to_metres(item.lat_deg, item.lon_deg)

    def _reach(self, seq: int) -> None:
        self._reached_any = True
        self.reached.append(seq)
        self.texts.append(f"Reached command #{seq}")

    def _finish(self) -> None:
        self.state = MissionState.COMPLETE
        self._trigger_m = 0.0

    # --- going home and landing ---

    def _hold(self, *, at_target: bool = False) -> None:
        """Hold position: at the last waypoint, or here."""
        if not at_target:
            self.motion.stop()
        self._task = Task.HOLD

    def _go_home(self) -> None:
        self._trigger_m = 0.0
        north, east = self.motion.seen
        self.motion.go((north, east, max(self.motion.up, RTL_HEIGHT_M)))
        self._task, self._waited = Task.CLIMB_HOME, 0.0

    def _descend(self, north: float, east: float) -> None:
        self.landed, self._task = Landed.LANDING, Task.DESCEND
        self.motion.go((north, east, -1.0))

    def _touch_down(self) -> None:
        motion, times = self.motion, self.motion.airframe.times
        sink, below = (_FINAL_SINK_M_S, _FINAL_BELOW_M) if times is None else (times.landing_m_s, times.landing_below_m)
        if motion.up < below and motion.vu < -sink:
            motion.vu = -sink
        if motion.up > 0.05:
            return
        in_mission = self.mode == self.modes.mission and self._ends_mission
        landing = in_mission and self.store.items[self.seq].command in mav.LANDINGS
        if in_mission and self.autopilot is Autopilot.ARDUPILOT and not landing:
            self._reach(self.seq)  # RTL is reached, LAND is not
            self._finish()
        if landing and self.autopilot is Autopilot.PX4:
            self._finish()
        self.texts.append("Disarming motors")
        state = self.state
        self.disarm()
        if landing and self.autopilot is Autopilot.ARDUPILOT:
            self.seq, self.state = 1, MissionState.ACTIVE  # measured: back at the first item, still "active"
        elif state is not MissionState.COMPLETE:
            self.state = MissionState.NOT_STARTED

    # --- by hand ---

    def _let_go(self) -> None:
        """The sticks, or another station, move it no longer, and it lands no longer."""
        if self._cruise_m_s is not None:
            self.motion.speed, self._cruise_m_s = self._cruise_m_s, None
        if self.landed is Landed.LANDING:
            self.landed = Landed.IN_AIR

    def _follow_sticks(self) -> None:
        motion, (vn, ve, vu) = self.motion, self._steered
        north, east = motion.seen
        motion.go((north + _STICKS_S * vn, east + _STICKS_S * ve, motion.up + vu))
        if vu < 0.0 and motion.up <= 0.05:
            self._let_go()
            self._settle()

    def _settle(self) -> None:
        """Stand on the ground with its motors on, for a while."""
        self._stand()
        self._waited = STEP_S

    def _stand(self) -> None:
        self._task, self.landed, self._waited = Task.STAND, Landed.ON_GROUND, 0.0
        self.motion.still()

    def _idle(self) -> None:
        self._waited += STEP_S
        if self._waited > _IDLE_S[self.autopilot]:
            self.texts.append("Disarming motors")
            self.disarm()

    # --- the camera ---

    def _photograph(self) -> None:
        north, east = self.motion.seen
        last = self._last_photo
        if last is not None and (north - last[0]) ** 2 + (east - last[1]) ** 2 < self._trigger_m**2:
            return
        self._last_photo = (north, east)
        self.triggers += 1
        if self.triggers in self.misfires:
            return
        lat, lon = self.motion.chart.to_degrees(north, east)
        self.exposures.append(TakenPicture(len(self.exposures), self.time_s, self.motion.pose(self.time_s), lat, lon))


def _step(before: tuple[float, ...], place: tuple[float, ...]) -> tuple[float, float] | None:
    """North and east of a step, None on one spot."""
    step = place[0] - before[0], place[1] - before[1]
    return step if math.hypot(*step) > 2.0 * _REACHED_M else None
