"""Positions of vehicles over time on their missions, and the separation of missions, by the planner's own model.

A mission is a path: takeoff at home, waypoints, the way back. The planner's `Motion` says when each point of it is
passed (orthoswarm.planning.sorties.flight_time), and vehicles keep apart if at any moment, and some seconds earlier or
later, they are far enough from each other or at another height (orthoswarm.planning.sorties.deconfliction).

Plans keep vehicles apart for some seconds off schedule (`schedule_slack_s`). One that is later than that, because of
wind, or a speed that it does not reach, is where others do not expect it.
"""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Final

import numpy as np

from gcs_plugin.config import LIMITS
from gcs_plugin.mission import items as mav
from gcs_plugin.mission.items import Mission, MissionItem
from gcs_plugin.mission.plan_folder import NO_NEEDS, PlanNeeds
from orthoswarm.config import DEFAULT, Config
from orthoswarm.config.autopilot import ARDUPILOT, AutopilotTimes
from orthoswarm.config.planning import PLANNING
from orthoswarm.model.arrays import Array, Flags, Indices
from orthoswarm.model.earth import DEGREE_M
from orthoswarm.model.plan import APART, ON_GROUND_M, PAD_DISTANCES

Ints = Indices
STEP_S: Final = 0.5
"""Time between the samples of a track, seconds."""
_SPEED_M_S: Final = 5.0
_HAIR_M: Final = 0.01
_FOREVER: Final = 200
"""How often a jump without an end is followed: longer than any battery lasts."""
_MOST_FLOWN: Final = 100_000
"""So many items are followed at most: jumps within jumps multiply."""
_LIFTED_M: Final = (0.5, 5.0)
"""A flight begins as it is first seen between these heights over its takeoff; one seen higher is under way already."""
_AHEAD_S: Final = 30.0
"""How far ahead of the place where it was last its next place is looked for, seconds of its plan."""
_OFF_M: Final = 15.0
"""A vehicle that is farther from its way is not on it: it was paused, sent elsewhere, or blown off."""
_STANDS_S: Final = 3.0
"""A plan that stays within `_AS_NEAR_M` of one place for longer waits there; the slowest turn takes less."""
_STILL_BEHIND: Final = 0.5
"""One that is behind is so until it is late by less than this share of what is allowed: words must not come and go."""
_AS_NEAR_M: Final = 1.0
"""Moments of the plan whose places are so little farther from the vehicle than the nearest one fit it as well."""


@dataclass(frozen=True, slots=True)
class Track:
    """A flight, sampled every half second from its start on.

    Attributes:
        places: float64 (n, 3), east and north of a common origin and height over takeoff, metres.
        autopilot: whose times these are.
        level_m: altitude of its takeoff above the sea, metres; None if that is not known.
    """

    places: Array
    autopilot: AutopilotTimes = ARDUPILOT
    level_m: float | None = None

    def higher_m(self, other: "Track") -> float:
        """How much higher its takeoff lies than another one's, metres; 0 within the error of receivers."""
        if self.level_m is None or other.level_m is None:
            return 0.0
        higher = self.level_m - other.level_m
        return higher if abs(higher) > LIMITS.level_m else 0.0

    def elapsed_s(self, place: tuple[float, float, float]) -> float:
        """The time at which it comes nearest to a place (east, north, height over takeoff; metres), seconds."""
        if not len(self.places):
            return 0.0
        return STEP_S * float(np.argmin(np.linalg.norm(self.places - np.array(place), axis=1)))

    def pad(self, radius_m: float) -> Flags:
        """Samples near its start."""
        return np.asarray(np.hypot(*(self.places[:, :2] - self.places[0, :2]).T) < radius_m)

    def pad_slack_s(self, radius_m: float) -> Array:
        """Seconds off schedule that a plan allows each sample near its start: fewer before it has left it first."""
        from orthoswarm.planning.sorties.flight_time import start_slack_s

        return start_slack_s(self.pad(radius_m), self.autopilot)


def flight_path(mission: Mission, origin: tuple[float, float]) -> tuple[Array, Array, float]:
    """The points of a mission, float64 (n, 3): east, north, height in metres; the wait before each, s; speed in m/s.

    The origin of east and north is a latitude and longitude in degrees.
    """
    points: list[tuple[float, float, float]] = []
    waits: dict[int, float] = {}
    home, speed = home_of(mission), _SPEED_M_S
    base = _ground_m(mission)
    if home is not None:
        points.append((*metres(*home, origin), 0.0))
    for _, item in _flown(mission):
        if item.command == mav.CHANGE_SPEED and item.params[1] > 0.0:
            speed = item.params[1]
        elif item.command == mav.RTL and home is not None and points:
            top = points[-1][2]
            points += [(*metres(*home, origin), top), (*metres(*home, origin), 0.0)]
        elif item.command == mav.DELAY and item.params[0] > 0.0 and points:
            points.append(points[-1])
            waits[len(points) - 1] = item.params[0]
        elif item.is_nav and item.has_place:
            height, place = _height_m(item, base), item.place or home
            if place is None:
                continue
            if item.command in mav.LANDINGS and points:
                points.append((*metres(*place, origin), points[-1][2]))
                height = 0.0
            points.append((*metres(*place, origin), height))
            if item.command == mav.LOITER_TIME or (item.command == mav.WAYPOINT and item.params[0] > 0.0):
                points.append(points[-1])
                waits[len(points) - 1] = item.params[0]
    before = np.array([waits.get(k, 0.0) for k in range(len(points))])
    return np.array(points, float).reshape(-1, 3), before, speed


def _flown(mission: Mission) -> Iterator[tuple[int, MissionItem]]:
    """The items with their sequence numbers in the order in which they are flown, with jumps carried out."""
    items, seq, jumped = mission.items, mission.first_seq, dict[int, int]()
    for _ in range(_MOST_FLOWN):
        if seq >= len(items):
            return
        item = items[seq]
        target, times = item.params[:2]
        if item.command != mav.JUMP:
            yield seq, item
        elif 0 <= target < len(items) and jumped.get(seq, 0) < (_FOREVER if times < 0 else times):
            jumped[seq] = jumped.get(seq, 0) + 1
            seq = int(target)
            continue
        seq += 1


def track_of(mission: Mission, origin: tuple[float, float], config: Config = DEFAULT) -> Track:
    """A mission as positions over time, by the autopilots' times of a configuration."""
    from orthoswarm.planning.sorties.flight_time import Motion

    times = config.times(mission.autopilot.value)
    points, waits, speed = flight_path(mission, origin)
    if len(points) < 2:
        return Track(points, times)
    end = next((item.command for item in mission.items if item.command in (mav.RTL, *mav.LANDINGS)), mav.RTL)
    motion = Motion(speed_m_s=speed, autopilot=times, lands=end != mav.RTL)
    return Track(motion.places(points, waits, STEP_S), motion.autopilot)


def flight_seconds(mission: Mission) -> float:
    """Duration of a mission by the planner's model, seconds."""
    home = home_of(mission)
    return 0.0 if home is None else STEP_S * max(0, len(track_of(mission, home).places) - 1)


def fastest_m_s(mission: Mission) -> float | None:
    """The greatest speed that a mission asks for, None if it leaves that to the vehicle."""
    speeds = [item.params[1] for item in mission.items if item.command == mav.CHANGE_SPEED and item.params[1] > 0.0]
    return max(speeds, default=None)


def heights_m(mission: Mission) -> list[tuple[MissionItem, float]]:
    """The items of a mission that have a place, each with its height above takeoff, metres."""
    base = _ground_m(mission)
    return [(i, _height_m(i, base)) for i in mission.items[mission.first_seq :] if i.is_nav and i.has_place]


def route_points(mission: Mission) -> list[tuple[int, float, float]]:
    """Where a mission leads, in the order of flight: sequence number of the item, longitude and latitude in degrees."""
    home, route = home_of(mission), list[tuple[int, float, float]]()
    for seq, item in _flown(mission):
        place = home if item.command == mav.RTL else item.place if item.is_nav and item.has_place else None
        if place is not None:
            route.append((seq, place[1], place[0]))
    return route


def highest_m(mission: Mission) -> float | None:
    """The greatest height above takeoff in a mission, None if it contains none."""
    return max((height for _, height in heights_m(mission)), default=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Approaches:
    """Pairs of samples of two flights that are too near each other, arrays (n,).

    Attributes:
        delay: by how many samples the second flight must start later for the pair to be at one time.
        at: sample of the first flight. distance_m: horizontal distance.
        at_start: both are around a start that they share.
        start_slack_s: seconds off schedule that a plan allows there.
    """

    delay: Ints
    at: Ints
    distance_m: Array
    at_start: Flags
    start_slack_s: Array


@dataclass(slots=True)
class Airspace:
    """Missions that are flown together, and their safe start times.

    Attributes:
        tracks: by system id.
        distance_m, height_m, slack_s: how far apart, or at what other height, and how many seconds off schedule.
        in_turn: around a start that they share, vehicles keep apart in height, too; if not, by `launch_s` alone.
    """

    tracks: dict[int, Track]
    _: KW_ONLY
    distance_m: float
    height_m: float
    slack_s: float
    in_turn: bool = False
    launch_s: float = PLANNING.launch_s
    _found: dict[tuple[int, int], "_Approaches"] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls, missions: Mapping[int, Mission], levels_m: Mapping[int, float] | None = None, needs: PlanNeeds = NO_NEEDS
    ) -> "Airspace":
        """Of missions by system id.

        Args:
            levels_m: altitudes of the takeoffs above the sea, metres, where they are known.
            needs: of their plan: how far apart they are to be, and with which times of flight.
        """
        origin = next((home for mission in missions.values() if (home := home_of(mission))), (0.0, 0.0))
        levels = levels_m or {}
        tracks = {
            s: replace(track_of(mission, origin, needs.config), level_m=levels.get(s))
            for s, mission in missions.items()
        }
        slack_s = max((track.autopilot.schedule_slack_s for track in tracks.values()), default=0.0)
        keeps, launch_s = needs.apart or APART, needs.config.planning.launch_s
        return cls(tracks, distance_m=keeps.distance_m, height_m=keeps.height_m, slack_s=slack_s, launch_s=launch_s)

    def meeting(self, one: int, other: int, later_s: float) -> tuple[float, float] | None:
        """When (seconds after the first one's start) and how close two vehicles come if the other starts later.

        None if they stay separated by the plan's measure: at any time, and `slack_s` earlier or later, around a start
        that they share a part of it.
        """
        near = self._approaches(one, other)
        slack, pad_slack = math.ceil(self.slack_s / STEP_S), np.full(len(near.at), -1.0)
        if self.in_turn:  # a sample less than the plan's, which lie at other moments
            pad_slack = np.ceil(np.minimum(near.start_slack_s, self.slack_s) / STEP_S) - 1.0
        shift = round(later_s / STEP_S)
        within = np.flatnonzero(np.abs(near.delay - shift) <= np.where(near.at_start, pad_slack, slack))
        if not len(within):
            return None
        at = within[np.argmin(near.distance_m[within])]
        return float(near.at[at]) * STEP_S, float(near.distance_m[at])

    def _approaches(self, one: int, other: int) -> "_Approaches":
        """All moments of two flights too near each other, found once; they meet for some delays of the other."""
        known = self._found.get((one, other))
        if known is None:
            first, second, radius_m = self.tracks[one], self.tracks[other], self._pad_m()
            i, j = near_samples(first, second, self.distance_m, self.height_m - _HAIR_M)
            at_start, start_slack_s = np.zeros(len(i), bool), np.zeros(len(i))
            if self._share_a_start(one, other):
                at_start = first.pad(radius_m)[i] & second.pad(radius_m)[j]
                start_slack_s = np.maximum(first.pad_slack_s(radius_m)[i], second.pad_slack_s(radius_m)[j])
            distance_m = np.hypot(*(first.places[i, :2] - second.places[j, :2]).T)
            known = self._found[one, other] = _Approaches(
                delay=i - j, at=i, distance_m=distance_m, at_start=at_start, start_slack_s=start_slack_s
            )
        return known

    def as_planned(self, starts: Mapping[int, float]) -> "Airspace":
        """The same with `in_turn` as these planned starts have it: they may not be moved so that this is lost."""
        planned = replace(self, in_turn=True)
        return planned if not planned.conflicts(starts) else replace(self, in_turn=False)

    def conflicts(
        self, starts: Mapping[int, float], *, but_among: Collection[int] = ()
    ) -> list[tuple[int, int, float, float]]:
        """Pairs that come too close with these starts: both vehicles, time on the starts' clock, distance in metres.

        Pairs of `but_among` are left out.
        """
        systems = sorted(set(starts) & set(self.tracks))
        found = []
        for index, one in enumerate(systems):
            for other in systems[index + 1 :]:
                if one in but_among and other in but_among:
                    continue
                meeting = self.meeting(one, other, starts[other] - starts[one])
                if meeting is not None:
                    found.append((one, other, starts[one] + meeting[0], meeting[1]))
        return found

    def next_start(self, system: int, earliest_s: float, others: Mapping[int, float]) -> float:
        """The first time, not before `earliest_s`, at which a vehicle stays separated from others with fixed times.

        `others` are the starts of those in the air, or of those that wait, on one clock.
        """
        start = earliest_s
        known = {other: at for other, at in others.items() if other != system and other in self.tracks}
        while any(self._too_near(other, system, start - at) for other, at in known.items()):
            start += STEP_S
        return start

    def _too_near(self, one: int, other: int, later_s: float) -> bool:
        launches = self._share_a_start(one, other) and abs(later_s) < self.launch_s
        return launches or self.meeting(one, other, later_s) is not None

    def _pad_m(self) -> float:
        """Radius about a start that vehicles share."""
        return PAD_DISTANCES * self.distance_m

    def _share_a_start(self, one: int, other: int) -> bool:
        a, b = self.tracks[one].places, self.tracks[other].places
        return bool(len(a) and len(b) and np.hypot(*(a[0, :2] - b[0, :2])) < self._pad_m())


def near_samples(one: Track, other: Track, distance_m: float, height_m: float | None) -> tuple[Ints, Ints]:
    """Numbers of the samples of two flights in the air that are nearer horizontally and, unless None, in height."""
    from scipy.spatial import cKDTree

    a, b = one.places, other.places
    flying_a, flying_b = (np.flatnonzero(places[:, 2] > ON_GROUND_M) for places in (a, b))
    if not len(flying_a) or not len(flying_b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    found = cKDTree(a[flying_a, :2]).query_ball_tree(cKDTree(b[flying_b, :2]), distance_m)
    i = np.repeat(flying_a, [len(row) for row in found])
    j = flying_b[np.fromiter((k for row in found for k in row), np.int64)]
    near = np.hypot(*(a[i, :2] - b[j, :2]).T) < distance_m
    if height_m is not None:
        near &= np.abs(a[i, 2] - b[j, 2] + one.higher_m(other)) < height_m
    return i[near], j[near]


def takeoff_place(mission: Mission) -> tuple[float, float] | None:
    """The place that the takeoff of a mission states, degrees; None if it states none."""
    flown = mission.items[mission.first_seq :]
    return next((item.place for item in flown if item.command in mav.TAKEOFFS and item.place), None)


def home_of(mission: Mission) -> tuple[float, float] | None:
    """Where a mission takes off, degrees: its takeoff's place, ArduPilot's item 0, or the first waypoint."""
    home = mission.items[: mission.first_seq]
    places = [takeoff_place(mission), *(i.place for i in home), *(i.place for i in mission.items if i.has_place)]
    return next(filter(None, places), None)


def _height_m(item: MissionItem, base_m: float) -> float:
    """Height of an item above takeoff, which lies at `base_m` above the sea; metres."""
    return item.z - (base_m if item.plain_frame == mav.FRAME_GLOBAL else 0.0)


def _ground_m(mission: Mission) -> float:
    """The level of the takeoff above the sea, for items that say their altitude that way."""
    return mission.items[0].z if mission.first_seq and mission.items else 0.0


def metres(lat: float, lon: float, origin: tuple[float, float]) -> tuple[float, float]:
    """East and north of an origin, in metres; all in degrees."""
    east = (lon - origin[1]) * DEGREE_M * math.cos(math.radians(origin[0]))
    return east, (lat - origin[0]) * DEGREE_M


@dataclass(slots=True)
class Lateness:
    """One flight of a mission, compared with its times.

    Attributes:
        late_s: how far it is behind, seconds of its own clock; negative: ahead. While its plan waits in one place,
            every moment of that fits where the vehicle is: this is kept then unless it must be more.
        behind: True while it is later than plans allow for. paused_s: for how long it was told to stay.
    """

    mission: Mission
    late_s: float = field(default=0.0, init=False)
    behind: bool = field(default=False, init=False)
    paused_s: float = field(default=0.0, init=False)
    _rests_since: float | None = field(default=None, init=False)
    _track: Track | None = field(default=None, init=False)
    _home: tuple[float, float] = field(default=(0.0, 0.0), init=False)
    _begun_s: float | None = field(default=None, init=False)
    _at: int = field(default=0, init=False)
    _seen_m: float = field(default=float("inf"), init=False)

    def __post_init__(self) -> None:
        home = home_of(self.mission)
        if home is not None:
            self._home, self._track = home, track_of(self.mission, home)

    @property
    def allowed_s(self) -> float:
        """How late it may be, seconds."""
        return self._track.autopilot.schedule_slack_s if self._track is not None else float("inf")

    @property
    def ordered(self) -> bool:
        """True if it is behind because it was told to stay, and for no other reason."""
        return self.late_s - self.paused_s <= self.allowed_s

    def rest(self, time_s: float) -> None:
        """Count a pause; time of the vehicle's clock, seconds."""
        since, self._rests_since = self._rests_since, time_s
        self.paused_s += max(0.0, time_s - since) if since is not None else 0.0

    def look(self, time_s: float, lat_deg: float, lon_deg: float, height_m: float) -> None:
        """Compare a position at a time of the vehicle's clock, seconds; degrees, and metres over its takeoff."""
        if self._rests_since is not None:
            self.rest(time_s)
            self._rests_since = None
        track = self._track
        if track is None or len(track.places) < 2:
            return
        if self._begun_s is None:
            seen, self._seen_m = self._seen_m, height_m
            if seen < _LIFTED_M[0] <= height_m < _LIFTED_M[1]:
                self._begun_s = time_s - STEP_S * int(np.argmax(track.places[:, 2] >= height_m))
            return
        flown_s = time_s - self._begun_s
        window = track.places[self._at : self._at + round(_AHEAD_S / STEP_S) + 1]
        here = np.array([*metres(lat_deg, lon_deg, self._home), height_m])
        away = np.linalg.norm(window - here, axis=1)
        nearest = int(np.argmin(away))
        if away[nearest] < _OFF_M:
            far = np.flatnonzero(away > away[nearest] + _AS_NEAR_M)  # another leg beside this one does not count
            first = max(far[far < nearest], default=-1) + 1
            last = min(far[far > nearest], default=len(away)) - 1
            self._at += int(np.clip(round(flown_s / STEP_S) - self._at, first, last))
            late_s = flown_s - STEP_S * self._at
            self.late_s = max(self.late_s, late_s) if (last - first) * STEP_S > _STANDS_S else late_s
        else:
            self.late_s = flown_s - STEP_S * self._at
        self.behind = self.late_s > self.allowed_s * (_STILL_BEHIND if self.behind else 1.0)
