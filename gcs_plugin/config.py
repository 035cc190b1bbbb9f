"""Numbers that steer several places of the ground station, or that an operator wants to know: one dataclass a subject.

They belong to the safety of a flight and are not overridden; the distances that vehicles keep are a plan's
(`orthoswarm.model.plan.APART`). What only one module uses (a polling period, a buffer) stands at its top.
"""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True, kw_only=True)
class HearingConfig:
    """When a vehicle counts as heard."""

    lost_s: float = 5.0
    """A vehicle that was silent for so long is lost, seconds: five heartbeats of 1 Hz (chosen)."""
    fresh_s: float = 2.0
    """A state up to this old is that of now, seconds: two heartbeats (chosen)."""
    all_found_s: float = 2.2
    """After so long without a further vehicle no more are expected, seconds: two heartbeats (chosen)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightLimits:
    """What a flight may use, where plan and user do not say it."""

    legal_height_m: float = 120.0
    """Height up to which drones fly without a permit in the EU (2019/947, UAS.OPEN.010), metres; 400 ft in the US."""
    endurance_s: float = 1200.0
    """Flight time of a full battery, seconds (chosen: a small multicopter's)."""
    reserve_share: float = 0.2
    """Share of the battery that is to be left after landing (chosen: what pilots keep)."""
    level_m: float = 12.0
    """Takeoffs whose altitudes differ by less count as level, metres: receivers err by about 5 m in height (u-blox M8:
    2.5 m horizontally, twice that in height), two of them by 7 m and now and then by 12 m. A plan's layers are 5 m
    apart, so that such an error would be taken for a vehicle in another one's layer."""
    fence_margin_m: float = 2.0
    """A mission that comes so near a limit of a geofence may be carried beyond it, metres: ArduCopter's factory setting
    of FENCE_MARGIN, which counts where it is known."""
    fence_px4_rise_m: float = 13.0
    """The same for the height of a PX4, metres: it rises by so much as it brakes (measured, docs/vehicles.md)."""
    lossy_share: float = 0.05
    """A link that loses more of its packets may lose three questions or their answers: (2 * 0.05) ** 3, one in a
    thousand times."""
    old_s: float = 15.0
    """The state of battery or receiver that was reported longer ago is not that of now, seconds: both come once a
    second, and are asked for again three seconds after they stop (chosen)."""
    start_off_m: float = 15.0
    """How far from its mission's takeoff a vehicle may stand, metres: as far as vehicles may be from a start that they
    share in a plan (`PAD_DISTANCES` separation distances)."""
    start_off_height_m: float = 15.0
    """The same in height above the sea, where both are known, metres: receivers err by 5 m in height, global height
    models by up to 10 m (SRTM, Copernicus: 90 % within 4 to 9 m)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmConfig:
    """When two vehicles in the air come too near each other."""

    over_share: float = 1.2
    """An alarm ends where they are so many times farther apart than it begins at (chosen: it must not come and go)."""
    height_kept_m: float = 0.5
    """How well vehicles keep their height, metres: those that a plan puts a layer apart are a little less apart."""
    ahead_s: float = 4.0
    """How far ahead vehicles are followed on straight lines, seconds."""
    less_a_second: float = 0.15
    """By this share a second the distances that count ahead are less, since vehicles turn. Of 35 real autopilots in
    simulation three pairs came within 10 m: said 3.0 to 4.0 s before they were nearest, as of one pair that turned away
    (at 12 m). Without this share two pairs turned away, and five if they are followed for 5 s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandConfig:
    """When a command is too late."""

    fresh_s: float = 5.0
    """How long after it was given a command may still be sent, seconds; a later one could surprise whoever gave it."""
    read_kept_s: float = 60.0
    """A mission read so lately need not be read again for a start while nothing indicates a change, seconds: reading
    eight missions over a radio of 57,600 baud takes up to a minute (chosen)."""
    takeoff_late_s: float = 5.0
    """A takeoff later than planned by more is late, seconds: arming and the start take up to three of themselves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReturnConfig:
    """How an autopilot flies home where it has not said it: its factory settings."""

    ardupilot_m_s: float = 10.0
    """Speed, metres per second (WPNAV_SPEED, which RTL_SPEED 0 stands for)."""
    px4_m_s: float = 5.0
    """The same (MPC_XY_CRUISE)."""
    ardupilot_m: float = 15.0
    """Least height above home, metres (RTL_ALT)."""
    px4_m: float = 60.0
    """The same (RTL_RETURN_ALT)."""
    cone: float = 3.0
    """ArduCopter climbs to so many times its distance at most (RTL_CONE_SLOPE)."""
    least_cone: float = 0.5
    """A smaller RTL_CONE_SLOPE limits nothing (RTL_MIN_CONE_SLOPE, ArduCopter/config.h)."""
    px4_near_m: float = 10.0
    """PX4 climbs to its full height unless it is so near home, metres (RTL_MIN_DIST)."""
    known_s: float = 3.0
    """A command to return in turn waits so long at most for homes that are not known yet, seconds (chosen)."""
    look_s: float = 1.0
    """Time between looks at vehicles that return in turn, seconds (chosen: they fly 10 m in it)."""
    shows_s: float = 5.0
    """So long after a command a vehicle's heartbeats may show another mode, seconds (chosen: as a pause)."""
    left_m: float = 10.0
    """One that held and is so far from there, metres, follows another command (chosen: the separation of plans)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SortieConfig:
    """How many pictures a flight's steps take."""

    coarse_map_pictures: int = 10
    """Least number of new pictures of finished legs for a coarse map during the flight (chosen)."""
    again_pictures: int = 10
    """With so many late pictures a sortie is refined again; fewer are resected from its refined ones (chosen)."""


HEARING: Final = HearingConfig()
LIMITS: Final = FlightLimits()
ALARM: Final = AlarmConfig()
COMMAND: Final = CommandConfig()
RETURN: Final = ReturnConfig()
SORTIE: Final = SortieConfig()
