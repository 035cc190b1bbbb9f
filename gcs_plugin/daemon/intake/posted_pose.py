"""The pose of a posted picture: a JSON object with degrees, as the journal keeps it, and the frame that it makes.

Poses from files and links take the same form.
"""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from gcs_plugin.daemon.store.frame_rows import FrameRow
from gcs_plugin.daemon.store.picture_store import PictureStore
from orthoswarm.model.earth import distance_m
from orthoswarm.model.errors import InputError
from orthoswarm.model.frame import Frame
from telemetry.live.live_poses import LinkPoses
from telemetry.samples.held_fixes import LOST_SIGMA_M, stated_sigma_m
from telemetry.samples.sample import Sample, sample_of
from telemetry.samples.sample import frame_of as frame_of_sample

MOST_TEXT: Final = 1 << 20
_OPTIONAL: Final = {
    "height_m": 1e5, "altitude_m": 1e5, "yaw_deg": 1e5, "pitch_deg": 1e5, "roll_deg": 1e5, "flight_yaw_deg": 1e5,
    "position_sigma_m": 1e6, "fov_deg": 179.0, "gps_fix": 8,
}  # fmt: skip
_FIELDS: Final = {
    "lat_deg": "lat_deg", "lon_deg": "lon_deg", "height_m": "height_m", "altitude_m": "altitude_m",
    "yaw_deg": "yaw_deg", "pitch_deg": "pitch_deg", "roll_deg": "roll_deg", "flight_yaw_deg": "flight_yaw_deg",
    "fov_deg": "fov_deg", "position_sigma_m": "sigma_m",
}  # fmt: skip
"""Key of the JSON object -> field of a sample; both in degrees and metres."""
_FIX_2D: Final = 2
_NOWHERE_DEG: Final = 1e-3


@dataclass(frozen=True, slots=True)
class PostedPose:
    """The pose posted with a picture.

    Attributes:
        vehicle: id; image: name, as posted. time_s: UTC epoch seconds, None if not given.
        values: lat_deg, lon_deg and further known values, in degrees and metres; `gps_fix`: MAVLink's GPS_FIX_TYPE;
            `damaged`: True for a picture that lost parts; `held_m`: how far the vehicle may have flown since its
            receiver had news, where that is more than a receiver's noise.
        origin: sources of position, height, angles and time, as far as known.
        by_link: it comes from the vehicle's link, which has left out positions that its receiver only repeats.
    """

    vehicle: str
    image: str
    time_s: float | None
    values: dict[str, float]
    origin: dict[str, str] = field(default_factory=dict)
    _: KW_ONLY
    by_link: bool = False

    @property
    def has_fix(self) -> bool:
        """Whether the position is valid."""
        return is_position(self.values)


def is_position(values: Mapping[str, Any]) -> bool:
    """Whether a pose has a valid position: without a fix a receiver sends 0, 0, an old fix, or one below 2D."""
    if values.get("held_m", 0.0) > LOST_SIGMA_M:
        return False
    lat, lon = float(values["lat_deg"]), float(values["lon_deg"])
    return values.get("gps_fix", _FIX_2D) >= _FIX_2D and not (abs(lat) < _NOWHERE_DEG and abs(lon) < _NOWHERE_DEG)


def parse_pose(document: Any, image: str | None = None) -> PostedPose:
    """Check a pose.

    Args:
        document: the JSON object; `vehicle`, `lat_deg` and `lon_deg` are required.
        image: the file's name, for a pose without it.

    Raises:
        InputError: a value is missing or wrong.
    """
    if not isinstance(document, Mapping):
        raise InputError(
            "the pose is not a JSON object; send vehicle, image, time, lat_deg, lon_deg, height_m, yaw_deg"
        )
    vehicle, name = _text(document, "vehicle"), _text(document, "image", image)
    values = {"lat_deg": _number(document, "lat_deg", 90.0), "lon_deg": _number(document, "lon_deg", 360.0)}
    for key, largest in _OPTIONAL.items():
        if document.get(key) is not None:
            values[key] = _number(document, key, largest)
    if "fov_deg" in values and values["fov_deg"] < 1.0:
        raise InputError("fov_deg of the pose is not a field of view; leave it out or send degrees")
    return PostedPose(vehicle, name, parse_time(document.get("time")), values)


def parse_time(value: Any) -> float | None:
    """UTC epoch seconds of an ISO 8601 text (UTC where it names no zone) or a number; None for None.

    Raises:
        InputError: it is neither.
    """
    if value is None:
        return None
    try:
        if isinstance(value, bool):
            raise ValueError
        if isinstance(value, int | float):
            seconds = float(value)
        else:
            text = str(value).strip()
            moment = datetime.fromisoformat(text[:-1] + "+00:00" if text[-1:] in ("Z", "z") else text)
            seconds = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
        if not -6e10 < seconds < 2.5e11:
            raise ValueError
    except (ValueError, OverflowError, TypeError):
        raise InputError("the time is neither ISO 8601 nor a number of seconds; send as 2026-05-04T10:20:30Z") from None
    return seconds


def frame_of(values: Mapping[str, Any], *, image: str, path: Path, vehicle: str, time_s: float | None,
             size: tuple[int, int]) -> Frame:  # fmt: skip
    """The frame of a stored picture with the pose values from `parse_pose`, and their `origin` if known."""
    sample = Sample(time_s=time_s, **{field: values[key] for key, field in _FIELDS.items() if key in values})
    sample.height_is_ground = bool(values.get("height_is_ground"))
    if "held_m" in values:
        sample.sigma_m = stated_sigma_m(sample.sigma_m, values["held_m"])
    if not is_position(values):
        sample.lat_deg = sample.lon_deg = 0.0  # kept without a place, until the vehicle's link says where it was
    frame = frame_of_sample(sample, image=image, path=path, vehicle=vehicle, width=size[0], height=size[1])
    assert frame is not None
    return replace(frame, origin=values.get("origin", {}), damaged=bool(values.get("damaged")))


def pose_values(sample: Sample) -> dict[str, float] | None:
    """What the journal keeps of a sample; None without a position."""
    if not sample.has_position:
        return None
    values = {key: float(v) for key, field in _FIELDS.items() if (v := getattr(sample, field)) is not None}
    if sample.height_is_ground:
        values["height_is_ground"] = True
    return values


def _text(document: Mapping[str, Any], key: str, default: str | None = None) -> str:
    value = document.get(key, default)
    if not isinstance(value, str) or not value:
        raise InputError(f"the pose has no {key}; send it as a text")
    if len(value) > MOST_TEXT:
        raise InputError(f"{key} of the pose is longer than a million characters; send a shorter one")
    return value


def _number(document: Mapping[str, Any], key: str, largest: float) -> float:
    value = document.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= largest:
        raise InputError(f"{key} of the pose is missing or out of range; send a number, at most {largest:g}")
    return float(value)


def apart_m(a: Mapping[str, float], b: Mapping[str, float]) -> float:
    """Metres between the places of two poses."""
    return distance_m(a["lat_deg"], a["lon_deg"], b["lat_deg"], b["lon_deg"])


def linked_pose(poses: LinkPoses, vehicle: str, name: str, time_s: float | None) -> PostedPose | None:
    """What a vehicle's link and bus say of a picture as if it had been posted; None without a time or a position."""
    linked = None if time_s is None else poses.at(vehicle, time_s)
    values = None if linked is None else pose_values(linked.sample)
    return (
        None
        if linked is None or values is None
        else PostedPose(vehicle, name, time_s, values, linked.origin, by_link=True)
    )


def posted_frame(frame: Frame, vehicle: str, name: str) -> PostedPose:
    """A frame of a file as if it had been posted."""
    values = pose_values(sample_of(frame)) or {}
    if frame.damaged:
        values["damaged"] = True
    return PostedPose(vehicle, name, frame.time_s, values, dict(frame.origin))


def frame_of_row(row: FrameRow, store: PictureStore) -> Frame:
    """The frame of a journal's row."""
    return frame_of(
        row.pose, image=row.image, path=store.path(row.path), vehicle=row.vehicle, time_s=row.time_s, size=row.size
    )
