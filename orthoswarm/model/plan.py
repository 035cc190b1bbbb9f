"""The plan as value types: vehicles fly sorties, a sortie is a row of waypoints, legs are the stretches with pictures.

Positions are latitude and longitude in degrees (a plan is what autopilots and files get), heights are metres above
the point of takeoff, times are seconds, lengths are horizontal metres. A plan knows no autopilot: how its waypoints
become mission items of a dialect is the ground station's business.
"""

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

End = Literal["rtl", "land", "hover"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """A point that is flown to in a straight line from the one before.

    Attributes:
        lat_deg, lon_deg: latitude and longitude, degrees. height_m: height above the takeoff point, metres.
        camera: True at a leg's first point (pictures by distance begin as soon as it is reached), False at a leg's last
            point (they stop), None where nothing changes.
        above_ground_m: nominal height above the ground where heights follow it, else None.
        between: the point lies on a straight way and was put in for its height alone.
        wait_s: how long the vehicle stays there before it flies on.
    """

    lat_deg: float
    lon_deg: float
    height_m: float
    camera: bool | None = None
    above_ground_m: float | None = None
    between: bool = False
    wait_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Sortie:
    """One flight: from takeoff to the end on one battery.

    The way out and the way home are among the waypoints, around no-fly zones. With `end` "rtl" or "land" the last
    waypoint lies above the home position; with "hover" it is the end of the last leg.

    Attributes:
        home_lat_deg, home_lon_deg: latitude and longitude of the takeoff point.
        takeoff_height_m: height to climb to before the first waypoint, metres.
        waypoints: the points in order; `camera` marks the legs.
        start_s: when the sortie takes off, seconds after the swarm's start (keeps vehicles apart; changing batteries is
            in it for a second sortie).
        time_s: time from takeoff to the end, seconds.
        length_m: horizontal length of the whole path from takeoff to the end, metres.
        turns: changes of direction by more than ten degrees on the path.
        photos: pictures that the trigger distance gives on the legs.
    """

    home_lat_deg: float
    home_lon_deg: float
    takeoff_height_m: float
    waypoints: tuple[Waypoint, ...]
    start_s: float
    time_s: float
    length_m: float
    turns: int
    photos: int

    @property
    def legs(self) -> tuple[tuple[Waypoint, Waypoint], ...]:
        """First and last waypoint of each leg; between them lie at most points for the height, on a straight line."""
        starts = [w for w in self.waypoints if w.camera is True]
        ends = [w for w in self.waypoints if w.camera is False]
        return tuple(zip(starts, ends, strict=True))


@dataclass(frozen=True, slots=True)
class VehiclePlan:
    """Everything one vehicle flies.

    Attributes:
        number: 1, 2, ... in the plan; by default also the MAVLink system id it is meant for.
        sorties: its flights in order; a later one resumes where the one before stopped.
    """

    number: int
    sorties: tuple[Sortie, ...]

    @property
    def id(self) -> str:
        """The vehicle's name in files and reports: v1, v2, ..."""
        return f"v{self.number}"

    @property
    def length_m(self) -> float:
        """Horizontal length of all sorties, metres."""
        return sum(s.length_m for s in self.sorties)

    @property
    def turns(self) -> int:
        """Turns of all sorties."""
        return sum(s.turns for s in self.sorties)

    @property
    def photos(self) -> int:
        """Pictures of all sorties."""
        return sum(s.photos for s in self.sorties)

    @property
    def flight_s(self) -> float:
        """Time in the air, seconds."""
        return sum(s.time_s for s in self.sorties)

    @property
    def time_s(self) -> float:
        """Time from the swarm's start until this vehicle's last sortie has ended, seconds."""
        return max(s.start_s + s.time_s for s in self.sorties)


@dataclass(frozen=True, slots=True)
class Gap:
    """A piece of the area that no picture of the narrowest camera is sure to see.

    Attributes:
        lat_deg, lon_deg: latitude and longitude of a point in it. area_m2: its size, square metres.
    """

    lat_deg: float
    lon_deg: float
    area_m2: float


@dataclass(frozen=True, slots=True, kw_only=True)
class OverGround:
    """How a plan lies over a height model, metres above the ground straight below unless said otherwise.

    Attributes:
        follows: legs keep a constant height above the ground; else all legs lie at one height.
        by_vehicle: mission items are to state heights above the ground, which the vehicle keeps by a model of its own.
        nominal_m: height above the ground that was asked for. least_m, most_m: lowest and highest point of the legs.
        way_least_m: lowest point of the flights but for takeoff and landing, above the highest ground up to `beside_m`
            from it.
        top_m: highest point of the flights, above their takeoff.
        side_overlap: of neighbouring lines: the 5th percentile along the legs, and the median.
        forward_overlap: of consecutive pictures at the lowest point of the legs.
        return_height_m: above takeoff, at which a straight way home passes over all ground and what stands on it.
    """

    follows: bool
    by_vehicle: bool
    nominal_m: float
    least_m: float
    most_m: float
    way_least_m: float
    top_m: float
    side_overlap: tuple[float, float]
    forward_overlap: float
    return_height_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Fence:
    """A geofence that goes with a plan.

    Attributes:
        inclusion: flights must stay inside it, else outside.
        points: latitude and longitude in degrees of a polygon's corners, or of a circle's centre.
        radius_m: of a circle, None for a polygon.
    """

    inclusion: bool
    points: tuple[tuple[float, float], ...]
    radius_m: float | None = None


class Apart(NamedTuple):
    """How far apart vehicles are to be: so far horizontally, or so far in height, metres."""

    distance_m: float
    height_m: float


APART: Final = Apart(10.0, 5.0)
"""What vehicles keep where a plan says nothing else: receivers err by 3 m; the layers of ways out and home."""
ON_GROUND_M: Final = 2.0  # up to this height over its takeoff a vehicle stands on the ground
PAD_DISTANCES: Final = 1.5
"""Radius about a start that vehicles share, in separation distances; in it they take off and land in turn."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Missions for a swarm over one area, or along given lines.

    Attributes:
        method: "columns", "bcd", "tmstc", or "lines" where a given polyline is followed.
        vehicles: what each vehicle flies, by number.
        altitude_m: height of the legs above takeoff, metres; above the ground where they follow it.
        speed_m_s: planned ground speed, metres per second. trigger_m: distance between pictures on a leg, metres.
        spacing_m: largest distance between neighbouring lines, metres.
        footprint_m: width (across the leg) and height (along it) of the narrowest camera's picture on the ground.
        end: what a sortie does at last. epsg: UTM grid in which the plan was made.
        area_m2: size of the area, square metres; None along given lines.
        covered_share: share of the area that is seen for certain, 0 to 1; None along given lines.
        gaps: what is missed, largest first. separation: how vehicles are kept apart, in words.
        warnings: what the user should know. over_ground: how it lies over the height model, None without one.
        fences: geofences that vehicles are to hold while they fly it.
        apart: how far apart vehicles are at any time, horizontally or in height; None where that is not known.
        gimbal_pitch_deg: to which missions turn the gimbal, -90 straight down; None where they leave it alone.
    """

    method: str
    vehicles: tuple[VehiclePlan, ...]
    altitude_m: float
    speed_m_s: float
    trigger_m: float
    spacing_m: float
    footprint_m: tuple[float, float]
    end: End
    epsg: int
    area_m2: float | None
    covered_share: float | None
    gaps: tuple[Gap, ...]
    separation: str
    warnings: tuple[str, ...]
    over_ground: OverGround | None = None
    fences: tuple[Fence, ...] = ()
    apart: Apart | None = None
    gimbal_pitch_deg: float | None = None

    @property
    def makespan_s(self) -> float:
        """Time from the swarm's start until the last vehicle has ended, seconds."""
        return max(v.time_s for v in self.vehicles)

    @property
    def balance(self) -> float:
        """Longest over mean path length of the vehicles; 1 is perfectly even."""
        lengths = [v.length_m for v in self.vehicles]
        mean = sum(lengths) / len(lengths)
        return max(lengths) / mean if mean > 0 else 1.0
