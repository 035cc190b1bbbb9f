"""The pictures of a folder that are not of its flight: screenshots, copies, another camera's, another day's."""

import math
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Final

import numpy as np

from orthoswarm.model.frame import Frame, Rejection
from telemetry.ingest.picture_kinds import Reasons
from telemetry.ingest.survey import SourceInfo
from telemetry.photos.flight_checks import OTHER_DAY_S
from telemetry.photos.photo_tags import Photo
from telemetry.samples.course import local_metres

_FEW_SHARE: Final = 0.1  # strangers are at most this share of a folder's photos
_OTHER_CAMERA_MOST: Final = 2  # photos of another camera: more are a flight's second camera
_SMALLER: Final = 0.75  # a copy has at most this share of the photo's columns
_SAME_SHAPE: Final = 0.02  # ... and its sides' ratio, but for rounding (logarithm)
_ELSEWHERE_M: Final = 500.0  # ... and elsewhere, if they are farther than this from all others


def strangers(photos: Sequence[Photo]) -> Reasons:
    """The photos of a folder that are not of its flight: screenshots, smaller copies, another camera's, another day's.

    Each would be drawn as if the flight's camera had taken it. What most photos of the folder are is the flight; only
    few others are strangers: as many as the flight's are another flight, which is mapped, too.
    """
    found: Reasons = {}
    for rule in (_without_camera, _copies, _other_camera, _other_day):
        left = [i for i in range(len(photos)) if i not in found]
        found |= {left[k]: why for k, why in rule([photos[i] for i in left]).items()}
    return found


def _few(count: int, photos: Sequence[Photo]) -> bool:
    return 0 < count <= _FEW_SHARE * len(photos)


def _without_camera(photos: Sequence[Photo]) -> Reasons:
    """Pictures of which no tag says anything, of another size than the photos or called like one of these."""
    tagged = [p for p in photos if p.make or p.model]
    sizes = {(p.width, p.height) for p in tagged}
    stems = sorted((p.path.stem.lower() for p in tagged), key=len, reverse=True)
    why = "the picture has no position; it has no camera's tags either, as a screenshot or an edited picture"
    return {
        i: (why, "")
        for i, p in enumerate(photos)
        if sizes
        and not (p.make or p.model)
        and p.time_s is None
        and p.lat_deg is None
        and ((p.width, p.height) not in sizes or any(_named_after(p.path.stem.lower(), stem) for stem in stems))
    }


def _named_after(stem: str, other: str) -> bool:
    """Whether a file is called like another but for its suffix, or with words added: "DJI_0001_edited"."""
    before, named, after = stem.partition(other)
    return bool(named) and not (before + after).strip("_- ").isdigit()


def _copies(photos: Sequence[Photo]) -> Reasons:
    """Pictures of the same camera, time and place to the last digit as another: smaller, of another format, edited.

    A receiver says the same at two exposures within a second, too: of equal size are copies only those named after
    the other.
    """
    same: dict[tuple[object, ...], list[int]] = {}
    for i, p in enumerate(photos):
        if p.time_s is not None and p.lat_deg is not None:
            same.setdefault((p.make, p.model, p.time_s, p.lat_deg, p.lon_deg), []).append(i)
    found: Reasons = {}
    for group in same.values():
        best, *others = sorted(group, key=lambda i: _preference(photos[i]))
        for i in others:
            if not _one_shape(photos[i].width, photos[i].height, photos[best].width, photos[best].height):
                continue
            if photos[i].width <= _SMALLER * photos[best].width:
                found[i] = "a smaller picture of the same exposure as another one here", photos[best].path.name
            elif _named_after(photos[i].path.stem.lower(), photos[best].path.stem.lower()):
                found[i] = "another file of the same exposure as one here", photos[best].path.name
    return found


def _preference(photo: Photo) -> tuple[int, int, str]:
    """Sorts pictures of one exposure: by pixels, then shorter names, then JPEG before others."""
    return -photo.width * photo.height, len(photo.path.name), photo.path.suffix.lower()


def copies_in_other_folders(sources: Sequence[SourceInfo]) -> list[tuple[SourceInfo, dict[str, Rejection]]]:
    """Smaller pictures of exposures that another folder has (thumbnails), by source and image, and why."""
    largest: dict[tuple[object, ...], Frame] = {}
    photos = [(source, frame) for source in sources if source.kind == "photos" for frame in source.frames]
    for _, frame in photos:
        if frame.time_s is not None:
            first = largest.setdefault(_exposure(frame), frame)
            if frame.width > first.width:
                largest[_exposure(frame)] = frame
    found: dict[int, tuple[SourceInfo, dict[str, Rejection]]] = {}
    for source, frame in photos:
        best = largest.get(_exposure(frame), frame)
        if frame.width <= _SMALLER * best.width and _one_shape(frame.width, frame.height, best.width, best.height):
            why = "a smaller picture of the same exposure as one in another folder"
            lost = Rejection(frame.image, why, frame.vehicle, frame.time_s, detail=best.image)
            found.setdefault(id(source), (source, {}))[1][frame.image] = lost
    return list(found.values())


def _exposure(frame: Frame) -> tuple[object, ...]:
    return frame.time_s, frame.fix.lat_deg, frame.fix.lon_deg


def _one_shape(width: int, height: int, other_width: int, other_height: int) -> bool:
    """Whether two pictures have the same sides but for their size; either may be turned."""
    shapes = [max(w, h) / max(1, min(w, h)) for w, h in ((width, height), (other_width, other_height))]
    return abs(math.log(shapes[0] / shapes[1])) < _SAME_SHAPE


def _other_camera(photos: Sequence[Photo]) -> Reasons:
    """The odd photo of another camera that knows neither its height nor where it looks: a phone's, from the ground."""
    counts = Counter((p.make, p.model) for p in photos)
    flown, _ = counts.most_common(1)[0] if counts else (("", ""), 0)
    found: Reasons = {}
    for i, p in enumerate(photos):
        key = p.make, p.model
        odd = any(key) and key != flown and counts[key] <= _OTHER_CAMERA_MOST and _few(counts[key], photos)
        if odd and p.height_m is None and p.camera_deg == p.flight_deg == (None, None, None):
            why = "taken with another camera than the flight's, which tells neither height nor direction"
            found[i] = why, " ".join(key).strip()
    return found


def _other_day(photos: Sequence[Photo]) -> Reasons:
    """The few photos of another day that were taken elsewhere."""
    known = [i for i, p in enumerate(photos) if p.time_s is not None and p.lat_deg is not None]
    if len(known) < 2:
        return {}
    order = sorted(known, key=lambda i: photos[i].time_s or 0.0)
    times = np.array([photos[i].time_s for i in order], float)
    days = np.split(np.array(order), np.flatnonzero(np.diff(times) > OTHER_DAY_S) + 1)
    flight = max(days, key=len)
    ground = local_metres([photos[i].lat_deg or 0.0 for i in known], [photos[i].lon_deg or 0.0 for i in known])
    at = dict(zip(known, ground))
    flown = np.array([at[i] for i in flight.tolist()])
    found: Reasons = {}
    for day in days:
        away = np.array([np.hypot(*(flown - at[i]).T).min() for i in day.tolist()])
        if day is not flight and _few(len(day), photos) and (away > _ELSEWHERE_M).all():
            dates = {i: f"{datetime.fromtimestamp(photos[i].time_s or 0.0, UTC):%Y-%m-%d}" for i in day.tolist()}
            found |= {i: ("taken on another day and elsewhere than the others here", date) for i, date in dates.items()}
    return found
