"""Vehicles that return in turn: none sets out while its way home is too near that of another, or one that waits there.

Each autopilot flies straight home at its own height, where those of one start meet: eight of a plan with one start,
sent home at once, came within 5 m of each other at 44 of 95 moments of their flights. Here those whose way is free
return at once, the others hold where they are. Which ways are free is found from where all of them are, once a second,
not from a timetable: behind one that is slow, in wind, the others wait longer.
"""

import math
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from gcs_plugin.config import LIMITS, RETURN
from gcs_plugin.fleet.autopilot_settings import Setting
from gcs_plugin.fleet.fence_limits import fence_limits
from gcs_plugin.fleet.flight_state import Word, flight_state
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.flight_modes import why_no_missions
from gcs_plugin.mission.track import STEP_S, Track, metres, near_samples
from orthoswarm.config import DEFAULT
from orthoswarm.model.arrays import Array
from orthoswarm.model.earth import distance_m
from orthoswarm.model.plan import APART, ON_GROUND_M

_GOES_HOME: Final = frozenset({Word.RETURNING, Word.LANDING})


@dataclass(frozen=True, slots=True)
class Hold:
    """How a vehicle holds.

    Attributes:
        mode: in words. place: latitude and longitude in degrees; None if it is not known, or if it circles.
        paused: whether a pause leaves a vehicle in this mode. still: it no longer brakes.
    """

    mode: str
    place: tuple[float, float] | None
    paused: bool
    still: bool

    def left(self, now: "Hold") -> str:
        """Why it holds no longer as now it is, in words; empty if it does."""
        if now.mode != self.mode:
            return f"its mode is {now.mode}"
        away_m = 0.0 if self.place is None or now.place is None else distance_m(*self.place, *now.place)
        return f"it has left the place where it held by {away_m:.0f} m" if away_m > RETURN.left_m else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Aloft:
    """A vehicle in the air, as the order sees it.

    Attributes:
        place: where it is, one sample. way: from now on if it returns; None where that is not known.
        height_known: whether the height of its way is known: it has said at what height it returns, or comes down.
        goes_home: its mode shows that it returns or lands. silent_s: since when it has not been heard, seconds.
        lost: its link is lost. must_land: its battery must not wait. hold: where and how it holds, if it does.
    """

    place: Track
    way: Track | None
    height_known: bool
    goes_home: bool
    silent_s: float
    lost: bool
    must_land: bool
    hold: Hold


class ReturnOrder:
    """Which of some vehicles, all in the air, may return now.

    Attributes:
        waits: vehicles that hold until their way is free, and whom each waits for (nobody before the first look).
        left: those that at the last look were found to follow another command, and what shows that, in words.
        heard_again: those that were lost, were heard again by the last look, and wait: nothing has told them to hold.
    """

    def __init__(self, systems: Collection[int], clock: Callable[[], float] = time.monotonic) -> None:
        self.waits: dict[int, tuple[int, ...]] = dict.fromkeys(systems, ())
        self.left: dict[int, str] = {}
        self.heard_again: set[int] = set()
        self._clock = clock
        self._sent: dict[int, float] = {}
        self._unheard: set[int] = set()
        self._held: dict[int, tuple[float, Hold | None]] = {}

    @property
    def pending(self) -> set[int]:
        """Those that wait, or were sent home without being heard."""
        return self.waits.keys() | self._unheard

    @property
    def over(self) -> bool:
        """Whether there is nobody of those."""
        return not self.pending

    def look(self, aloft: Mapping[int, Aloft]) -> list[int]:
        """The vehicles that may return now; they no longer wait, nor do those that have landed or go home already.

        One whose way is not known returns at once: nothing is known that would be better for it. So does one whose
        link is lost or whose battery must not wait; a lost one has its turn once more when it is heard and still holds.
        One that no longer holds as it did follows another command, of a remote control or another station.
        Vehicles that wait only for each other would wait for ever: while nothing moves, the one of them that waits for
        the fewest sets out.

        Args:
            aloft: all vehicles in the air, see `aloft_of`.
        """
        self.left = self._left(aloft)
        for system in self.left:
            self.drop(system)
        self._unheard = {s for s in self._unheard if s in aloft and not aloft[s].goes_home}
        heard = {s for s in self._unheard if not aloft[s].lost}
        self._unheard -= heard
        waits = [s for s in {**self.waits, **dict.fromkeys(heard)} if s in aloft and not aloft[s].goes_home]
        ready = [s for s in waits if aloft[s].way is None or aloft[s].lost or aloft[s].must_land]
        ways = {s: a.way for s, a in aloft.items() if a.way is not None}
        moving = {s for s in ways if self._goes_home(s, aloft[s])} | (ways.keys() & ready)
        stay = {s for s, a in aloft.items() if s not in moving and not a.lost}
        left = sorted((s for s in waits if s not in ready), key=lambda s: (len(ways[s].places), s))
        self.waits = {}
        for system in left:
            known = aloft[system].height_known
            others = [
                o
                for o in moving - {system}
                if not apart(ways[system], ways[o], heights=known and aloft[o].height_known)
            ]
            others += [o for o in stay if o != system and not apart(ways[system], aloft[o].place, heights=known)]
            if others:
                self.waits[system] = tuple(sorted(others))
            else:
                ready.append(system)
                moving.add(system)
                stay.discard(system)
        # Of these one sets out; not of those that wait for a vehicle outside this order, which need not give way.
        mutual = [s for s, others in self.waits.items() if self.waits.keys() >= set(others)]
        if mutual and not moving:
            ready.append(min(mutual, key=lambda s: (len(self.waits[s]), left.index(s))))
            del self.waits[ready[-1]]
        self.heard_again = heard & self.waits.keys()
        self._sent |= dict.fromkeys(ready, self._clock())
        self._unheard |= {s for s in ready if aloft[s].lost}
        for system in self._unheard:  # nobody knows what it does until it is heard
            self._held.pop(system, None)
        return ready

    def holds(self, system: int) -> None:
        """A vehicle that waits has acknowledged that it holds."""
        self._held[system] = self._clock(), None

    def drop(self, system: int) -> bool:
        """Let a vehicle wait no longer, since it was given another command; returns whether it did."""
        self._unheard.discard(system)
        return self.waits.pop(system, None) is not None

    def again(self, system: int) -> None:
        """Put a vehicle that did not acknowledge its return command back among those that wait."""
        self.waits[system] = ()
        self._sent.pop(system, None)

    def _left(self, aloft: Mapping[int, Aloft]) -> dict[int, str]:
        """Waiting vehicles that have left the mode or the place in which they held: system id -> which, in words."""
        found = {}
        for system in self.waits.keys() & self._held.keys() & aloft.keys():
            vehicle, (since, hold) = aloft[system], self._held[system]
            if vehicle.lost or vehicle.goes_home or self._clock() - since < RETURN.shows_s:
                continue
            if hold is None and vehicle.hold.paused:
                if vehicle.hold.still or self._clock() - since >= 3 * RETURN.shows_s:
                    self._held[system] = since, vehicle.hold
            elif why := hold.left(vehicle.hold) if hold is not None else f"its mode is {vehicle.hold.mode}":
                found[system] = why
        return found

    def _goes_home(self, system: int, vehicle: Aloft) -> bool:
        """Whether it flies home: by its mode, by what it was just told, or, unheard, as long as that takes."""
        if vehicle.lost:
            return vehicle.way is not None and vehicle.silent_s < STEP_S * len(vehicle.way.places)
        return vehicle.goes_home or self._clock() - self._sent.get(system, -math.inf) < RETURN.shows_s


def aloft_of(vehicles: Mapping[int, Vehicle], now: float) -> dict[int, Aloft]:
    """The vehicles in the air, by system id, at a time of the fleet's clock; in the fleet's thread."""
    known = {s: v for s, v in vehicles.items() if v.flying}
    origin = next((v.place for v in known.values() if v.place is not None), (0.0, 0.0))
    return {
        s: Aloft(
            place=Track(_point(v, origin), level_m=v.home_alt_m),
            way=way_home(v, origin),
            height_known=_height_known(v),
            goes_home=_goes_home(v),
            silent_s=now - v.heard,
            lost=v.lost,
            must_land=v.battery is not None and v.battery < 0.5 * LIMITS.reserve_share,
            hold=_hold(v),
        )
        for s, v in known.items()
    }


def _hold(vehicle: Vehicle) -> Hold:
    """A pause leaves ArduPilot in AUTO or GUIDED, or in the mode that holds; one that cannot hover circles in that."""
    modes, circles = vehicle.modes, bool(why_no_missions(vehicle.kind))
    paused = vehicle.custom_mode in (modes.mission, modes.ready, modes.hold)
    return Hold(vehicle.mode, None if circles else vehicle.place, paused, circles or vehicle.still_s > 0.0)


def _goes_home(vehicle: Vehicle) -> bool:
    """Whether its mode shows that it returns or lands. On a mission that is not known one that sinks may do neither."""
    unknown = vehicle.mission is None and vehicle.custom_mode == vehicle.modes.mission
    return not unknown and flight_state(vehicle).word in _GOES_HOME


def way_home(vehicle: Vehicle, origin: tuple[float, float]) -> Track | None:
    """Where a vehicle in the air is from now on if it returns; None where its home or place is not known."""
    from orthoswarm.planning.sorties.flight_time import Motion

    home, place = vehicle.home or vehicle.launch, vehicle.place
    if home is None or place is None:
        return None
    here, there = metres(*place, origin), metres(*home, origin)
    least_m = return_height_m(vehicle, math.hypot(there[0] - here[0], there[1] - here[1]))
    lands = flight_state(vehicle).word is Word.LANDING and _goes_home(vehicle)
    if lands:  # where it is, or above its home already
        there, least_m = here, vehicle.height_m
    top = max(vehicle.height_m, least_m, ON_GROUND_M)
    points = np.array([(*here, vehicle.height_m), (*here, top), (*there, top), (*there, 0.0)])
    kept = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1] - 1.0), axis=1) > 0.0
    motion = Motion(speed_m_s=_return_speed_m_s(vehicle), autopilot=DEFAULT.times(vehicle.autopilot.value), lands=lands)
    return Track(motion.places(points[kept], None, STEP_S), motion.autopilot, vehicle.home_alt_m)


def return_height_m(vehicle: Vehicle, away_m: float) -> float:
    """The height above home at which it returns from so far away, metres (ArduCopter's mode_rtl.cpp, PX4's rtl.cpp)."""
    said = vehicle.settings.get
    height, climb, cone = said(Setting.RETURN_HEIGHT), said(Setting.RETURN_CLIMB), said(Setting.RETURN_CONE)
    if vehicle.autopilot is not Autopilot.ARDUPILOT:
        least_m = RETURN.px4_m if height is None else height.value
        return max(vehicle.height_m, min(least_m, RETURN.cone * away_m) if away_m <= RETURN.px4_near_m else least_m)
    least_m = RETURN.ardupilot_m if height is None else height.value
    slope = RETURN.cone if cone is None else cone.value
    climbed_m = vehicle.height_m + (0.0 if climb is None else climb.value)
    limit_m = slope * away_m if slope >= RETURN.least_cone else math.inf
    return max(climbed_m, min(least_m, limit_m))


def _return_speed_m_s(vehicle: Vehicle) -> float:
    """The speed at which a vehicle flies home, metres per second."""
    back, mission = vehicle.settings.get(Setting.RETURN_SPEED), vehicle.settings.get(Setting.SPEED)
    if back is not None and back.value > 0.0:
        return back.value
    if vehicle.autopilot is Autopilot.PX4:
        return RETURN.px4_m_s
    return RETURN.ardupilot_m_s if mission is None else mission.value


def _height_known(vehicle: Vehicle) -> bool:
    """Whether the height of its way home is known: it has told its return height, or it is landing."""
    how = vehicle.settings.get(Setting.RETURN_TYPE)
    told = Setting.RETURN_HEIGHT in vehicle.settings and not (how is not None and how.returns)
    limits = fence_limits(vehicle) if vehicle.autopilot is Autopilot.ARDUPILOT else None
    if limits is not None and limits.top is not None:  # its way home stays below that, if it keeps its fence then
        told &= return_height_m(vehicle, math.inf) <= limits.top.value - limits.margin_m
    return told or flight_state(vehicle).word is Word.LANDING


def apart(one: Track, other: Track, *, heights: bool = True) -> bool:
    """Whether two vehicles keep a plan's distance or height, also where either is late by the slack of a landing.

    A track of one place is a vehicle that holds there; any other track ends on the ground. heights: whether both are
    known; if not, only the horizontal distance counts.
    """
    i, j = near_samples(one, other, APART.distance_m, APART.height_m if heights else None)
    if min(len(one.places), len(other.places)) == 1:
        return not len(i)
    slack_s = max(one.autopilot.landing_slack_s, other.autopilot.landing_slack_s)
    return not bool((np.abs(i - j) <= slack_s / STEP_S).any())


def _point(vehicle: Vehicle, origin: tuple[float, float]) -> Array:
    """East, north, height in metres, float64 (1, 3); no place at all if it is not known."""
    if vehicle.place is None:
        return np.zeros((0, 3))
    return np.array([(*metres(*vehicle.place, origin), vehicle.height_m)])
