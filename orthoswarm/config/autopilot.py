"""How much longer autopilots with their factory settings take than constant speed on straight lines; their memory.

Measured in flights of both firmwares in simulation: 44 of ArduCopter 4.7 and 8 of PX4 1.17 (docs/vehicles.md).
"""

from dataclasses import dataclass, replace
from typing import Final

from orthoswarm.config.ranges import above_zero, from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotTimes:
    """One autopilot; the usual values are those of ArduCopter."""

    speed_share: float = above_zero(1.0)
    """Speed amid a long line, as a share of the one asked for (measured: 0.997 to 1.001 at 5 to 10 m/s)."""
    acceleration_m_s2: float = 1.2
    """Acceleration as it stops and sets off, metres per second squared (measured; its WPNAV_ACCEL is 2.5)."""
    corner_m_s: float = from_zero(2.8)
    """Speed at which it passes corners (measured: a right angle takes 0.1 s at 3, 0.5 s at 5, 2.1 s at 8, 3.0 s at
    10 m/s; angles of 30 to 180 degrees follow from it within 1.3 s in ten turns)."""
    takeoff_s: float = from_zero(2.6)
    """Seconds lost in the takeoff, against a rate of climb of 2.5 m/s (measured: 2.3 to 2.9)."""
    takeoff_below_s: float = from_zero(0.4)
    """Those of them that it loses in the first metres (measured: 0.4 to 0.5); the others at the top."""
    takeoff_below_m: float = from_zero(2.0)
    """Height above home up to which it loses them, metres (measured)."""
    set_off_s: float = from_zero(0.7)
    """Seconds above its home until it accelerates towards the first point (measured: 0.6 to 1.1)."""
    height_change_s: float = from_zero(1.4)
    """Seconds lost in a climb or descent on one spot amid the flight (measured: 0.9 to 2.2)."""
    home_wait_s: float = from_zero(12.0)
    """Seconds of slowing down and waiting above home before it descends (measured: 10 to 14; 5 are RTL_LOIT_TIME)."""
    land_wait_s: float = from_zero(4.5)
    """Seconds of slowing down and waiting before it descends where a mission ends with LAND (measured: 3.8 to 5.1)."""
    landing_m_s: float = 0.5
    """Rate of the last part of the descent, metres per second (its LAND_SPEED)."""
    landing_below_m: float = from_zero(10.0)
    """Height above home at which that part begins, metres (its LAND_ALT_LOW)."""
    schedule_slack_s: float = from_zero(10.0)
    """How much later than planned one vehicle may be than another while they stay separated, seconds: three times the
    greatest difference from these times in flight (measured: 2.4 on the way, 3.4 on the ground), for wind, loads and
    other settings."""
    takeoff_slack_s: float = from_zero(3.5)
    """How much later than planned one vehicle may be than another as they take off from a start that they share,
    seconds (two differed by up to 3.0, as one took so long to arm). Three times as much, as above, at each takeoff and
    landing would hold a swarm of one start on the ground."""
    landing_slack_s: float = from_zero(5.0)
    """How much later than planned one may be than another as they come home and land, seconds (two of one flight
    differed by up to 4.9)."""
    most_items: int = 650
    """Mission items that it stores, home among them (measured)."""


ARDUPILOT: Final = AutopilotTimes()
"""ArduCopter."""
PX4: Final = AutopilotTimes(
    speed_share=0.975,  # measured: 0.985 at 5, 0.966 at 8, 0.973 at 10 m/s; it takes half a minute to settle
    # Measured: it nearly stops at each waypoint, a right angle takes 4.0 s at 5, 5.0 s at 8, 6.0 s at 10 m/s beyond it.
    acceleration_m_s2=1.05,
    corner_m_s=0.0,
    takeoff_s=5.5,  # measured: 3.7 to 8.3
    takeoff_below_s=5.5,  # all (measured: 4.4 to 6.0)
    takeoff_below_m=10.0,  # measured: it climbs at 1.5 m/s up to there
    set_off_s=2.0,  # measured: 0.5 to 2.7
    height_change_s=2.2,  # measured: 1.1 to 3.7
    home_wait_s=10.0,  # measured: 7 to 12, once 16
    land_wait_s=1.0,  # measured: -0.5 to 3.8
    landing_m_s=0.7,  # its MPC_LAND_SPEED
    landing_below_m=7.5,  # between its MPC_LAND_ALT1 and MPC_LAND_ALT2
    schedule_slack_s=20.0,  # measured: up to 7 late at 10 m/s, up to 12 at 5 m/s, up to 6 early
    takeoff_slack_s=7.5,  # two differed by up to 7.2
    landing_slack_s=18.0,  # two differed by up to 18
    most_items=1900,  # the table of its dataman
)
"""PX4 multicopters."""
DJI: Final = replace(
    PX4,  # not measured: missions have it stop at each corner, as a PX4 nearly does
    speed_share=1.0,
    schedule_slack_s=30.0,  # chosen, as these: a person starts it
    takeoff_slack_s=15.0,
    landing_slack_s=30.0,
    most_items=65_535,  # the indices of WPML
)
"""DJI drones on missions of Pilot 2 or Litchi; nobody sets these."""
