"""A frame: one picture with the recorded pose of its camera. Readers of telemetry yield frames."""

from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Final

SURVEYED = "surveyed points"  # source (`Frame.origin`) of positions that control points gave
ON_MAP = "the basemap"  # source of positions of photos that were found on the basemap
BY_OTHERS = "photos beside it"  # source of positions that other photos of the same ground gave
THETA_HAT_DEG: Final = 70.0
"""Horizontal field of view where nothing is known: below that of most drones' cameras (paper III.B)."""
DEFAULT_HEIGHT_M: Final = 80.0
"""Height above ground where no photo records one, until pictures give the scale. Measured on two flights at 90 m with
positions only, with 60, 80 and 100 m: error of the map 0.147, 0.142, 0.145 m (95 %: 0.51, 0.51, 0.48), heights off by
3.3, 2.8, 2.8 m."""
UNSTATED_SIGMA_M: Final = 1.5
"""Sigma of a horizontal position, an axis, whose source states none; receivers' drift has its own prior. Measured: 0.57
m on a real flight with a map (18 photos), whose real-time ground points lie within one stated sigma in 97 % of the axes
(2 of 2 sigmas: all); 0.5, 1.5 and 3 m give 43 real photos without tags the same place on their control points (0.593,
0.593, 0.594 m rms). Drifting receivers exceed it (9 m, simulated)."""
TAGGED_TILT_SIGMA: Final = 0.03
"""Error of the ground point at a photo's centre through its recorded attitude, as a share of the height: 1.7
degrees."""


@dataclass(frozen=True, slots=True)
class Fix:
    """The recorded pose of a camera at a picture, an observation with errors; None where unknown.

    Attributes:
        lat_deg, lon_deg: latitude and longitude, WGS 84.
        height_m: height above the takeoff level (or above ground where a source knows it).
        altitude_m: absolute altitude (sea level or ellipsoid); never used as a height.
        yaw_rad: azimuth of the picture's up direction at nadir, clockwise from true north.
        pitch_rad: -pi/2 looks straight down. roll_rad: > 0 right side down.
        flight_yaw_rad: heading of the airframe, where it is recorded besides the camera's yaw.
        position_sigma_m: one sigma of the horizontal position, if the source states it (RTK).
        height_is_ground: True where the height is above the ground below (rangefinder), not above takeoff.
    """

    lat_deg: float
    lon_deg: float
    height_m: float | None = None
    _: KW_ONLY
    altitude_m: float | None = None
    yaw_rad: float | None = None
    pitch_rad: float | None = None
    roll_rad: float | None = None
    flight_yaw_rad: float | None = None
    position_sigma_m: float | None = None
    height_is_ground: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One picture and its fix.

    Attributes:
        image: its name in all products (path relative to the input with forward slashes; `video.mp4#000123`).
        path: the readable picture file on this machine (for a video, the extracted picture).
        vehicle: id of the vehicle that took it. time_s: UTC epoch seconds, None if unknown. fix: the recorded pose.
        width, height: columns and rows as stored in the file (EXIF rotation not applied).
        camera: distinguishes lenses of one vehicle (model, size, zoom); frames of equal `vehicle` and `camera` share
            one lens.
        fov_hint_rad: horizontal field of view from the picture's own tags, None if there is none.
        origin: field -> source, for `inspect` and the report.
        damaged: True if parts of the picture were predicted from lost data: it is used for its position only, and is
            drawn only where there is no other picture.
        ambiguous: True where the position is that of one of several camera events of a log, and nothing tells of which;
            the fix's sigma covers the others.
    """

    image: str
    path: Path
    vehicle: str
    time_s: float | None
    fix: Fix
    width: int
    height: int
    camera: str = ""
    fov_hint_rad: float | None = None
    origin: dict[str, str] = field(default_factory=dict, compare=False)
    damaged: bool = False
    ambiguous: bool = False

    @property
    def has_own_position(self) -> bool:
        """Whether a receiver says its position, and not control points or other photos."""
        return self.origin.get("position") not in (SURVEYED, ON_MAP, BY_OTHERS)

    def __deepcopy__(self, memo: dict[int, object]) -> "Frame":
        """Itself: nobody changes a frame."""
        return self


def last_time(frames: Iterable[Frame]) -> float | None:
    """Time of the last of some frames, UTC epoch seconds; None if no time is known."""
    return max((frame.time_s for frame in frames if frame.time_s is not None), default=None)


@dataclass(frozen=True, slots=True)
class Rejection:
    """A picture that could not become a frame, or that was left out later.

    Attributes:
        image: its name. reason: one clear sentence. vehicle, time_s: as far as known, see `Frame`.
        lacks_position: True if only a position is missing, which a later log may provide.
        detail: what is particular to this picture; the reason is the same for all that share it, so that it is counted.
    """

    image: str
    reason: str
    vehicle: str = ""
    time_s: float | None = None
    lacks_position: bool = False
    _: KW_ONLY
    detail: str = ""

    @property
    def text(self) -> str:
        """The reason with its detail."""
        return f"{self.reason} ({self.detail})" if self.detail else self.reason


@dataclass(frozen=True, slots=True)
class Ingest:
    """The result of reading a set of inputs.

    Attributes:
        frames: sorted by vehicle, then time (then name where times are unknown).
        rejected: every file with a picture's suffix, or picture of a video, that is not a frame.
        warnings: findings that a user should read, in plain words.
        unpositioned: photos that are rejected for nothing but the lack of a position (latitude and longitude of their
            fix are NaN), by vehicle, then time: surveyed points may place them.
    """

    frames: list[Frame]
    rejected: list[Rejection]
    warnings: list[str]
    unpositioned: list[Frame] = field(default_factory=list)
