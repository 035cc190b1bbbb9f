"""The pictures of a folder that are not mapped: of another sensor or band, copies, another camera's, another day's.

A map of wide, zoom, thermal and near-infrared pictures shows nothing truly, and each kind has its own lens.
"""

import math
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.frame import Frame, Rejection
from telemetry.ingest.survey import SourceInfo
from telemetry.photos.flight_checks import OTHER_DAY_S
from telemetry.photos.photo_tags import SENSORS, Photo
from telemetry.samples.course import local_metres

_FEW_SHARE: Final = 0.1  # strangers are at most this share of a folder's photos
_OTHER_CAMERA_MOST: Final = 2  # photos of another camera: more are a flight's second camera
_SMALLER: Final = 0.75  # a copy has at most this share of the photo's columns
_SAME_SHAPE: Final = 0.02  # ... and its sides' ratio, but for rounding (logarithm)
_ELSEWHERE_M: Final = 500.0  # ... and elsewhere, if they are farther than this from all others
BANDS: Final = ("", "green", "red", "blue", "nir", "red edge")
"""Spectral bands by how well they show the ground; "" is a colour picture."""
_TOGETHER_S: Final = 1.0  # sensors of one press write times that differ by this, in whole seconds
_TOGETHER_M: Final = 30.0  # ... and places that differ by less than the way between two pictures of a vehicle
_TOGETHER_SHARE: Final = 0.8  # so many pictures of one sensor have one of the other: presses fail, seldom

Reasons = dict[int, tuple[str, str]]
"""Photos by their index: why they are left out, one reason for all that share it, and a detail."""


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


def of_other_kinds(photos: Sequence[Photo], sensor: str = "", band: str = "") -> Reasons:
    """The photos of a vehicle that are not of the kind that is mapped.

    A zoom's pictures stay beside those of the wide camera unless both were taken at one press.

    Args:
        sensor: that is wanted, one of SENSORS; "" for the widest that sees colours.
        band: the spectral band that is wanted; "" for colour pictures, else the one that shows the ground best.
    """
    found = _of_other_sensors(photos, sensor)
    left = [i for i in range(len(photos)) if i not in found]
    return found | {left[k]: why for k, why in _of_other_bands([photos[i] for i in left], band).items()}


def _of_other_sensors(photos: Sequence[Photo], wanted: str) -> Reasons:
    sensors = {photo.sensor for photo in photos if photo.sensor}
    if len(sensors) < 2 and (not wanted or sensors <= {wanted}):
        return {}
    mapped = wanted or next(sensor for sensor in SENSORS if sensor in sensors)
    pressed = Counter(photo.path.stem.rpartition("_")[0] for photo in photos)
    beside = {"wide", "zoom"} if not wanted and max(pressed.values()) < 2 else {mapped}
    said = f"of each exposure the {mapped} pictures are mapped (--camera)"
    return {
        i: (f"a picture of the {photo.sensor} camera; {said}", "")
        for i, photo in enumerate(photos)
        if photo.sensor and photo.sensor not in beside
    }


def _of_other_bands(photos: Sequence[Photo], wanted: str) -> Reasons:
    bands = {photo.band.lower() for photo in photos}
    mapped = wanted or next((band for band in BANDS if band in bands), min(bands, default=""))
    if bands <= {mapped}:
        return {}
    said = f"of each exposure {f'that of band {mapped}' if mapped else 'the colour picture'} is mapped (--band)"
    return {
        i: (f"a picture of one spectral band ({photo.band or 'colour'}); {said}", "")
        for i, photo in enumerate(photos)
        if photo.band.lower() != mapped
    }


def of_other_sources(sources: Sequence[SourceInfo], sensor: str = "", band: str = "") -> list[tuple[SourceInfo, str]]:
    """Folders and videos of another kind than others show, and why they are left out; arguments as `of_other_kinds`."""
    with_frames = [source for source in sources if source.frames]
    thermal = {source.sees[0] == "thermal" for source in with_frames}
    found = []
    if len(thermal) > 1 and not sensor:
        why = "a picture of the thermal camera; the others see colours, and are mapped (--camera)"
        found = [(source, why) for source in with_frames if source.sees[0] == "thermal"]
    bands = {source.sees[1] for source in with_frames}
    if len(bands) > 1 and not band:
        mapped = next((band for band in BANDS if band in bands), min(bands))
        others = f"those of band {mapped}" if mapped else "the colour pictures"
        why = f"a picture of one spectral band; {others} are mapped (--band)"
        found += [(source, why) for source in with_frames if source.sees[1] != mapped]
    return found


def of_second_cameras(photos: Sequence[Photo]) -> Reasons:
    """Pictures of a second camera that took one at each press of the first, whatever its files are called."""
    timed = [i for i, p in enumerate(photos) if p.time_s is not None and p.lat_deg is not None]
    cameras = Counter(photos[i].camera for i in timed)
    if len(cameras) < 2:
        return {}
    ground = np.full((len(photos), 2), np.nan)
    ground[timed] = local_metres([photos[i].lat_deg or 0.0 for i in timed], [photos[i].lon_deg or 0.0 for i in timed])
    members = {camera: [i for i in timed if photos[i].camera == camera] for camera in cameras}
    best = sorted(cameras, key=lambda camera: _showing(photos[members[camera][0]]), reverse=True)
    found: Reasons = {}
    for k, camera in enumerate(best):
        for first in best[:k]:
            if members[first][0] not in found and _together(photos, ground, members[camera], members[first]):
                said = f"a picture of a second camera ({camera}) at the press of the first ({first}), which is mapped"
                found |= dict.fromkeys(members[camera], (said, ""))
                break
    return found


def _showing(photo: Photo) -> tuple[bool, int]:
    """How well a camera shows the ground: thermal ones less, then by pixels."""
    return photo.sensor != "thermal", photo.width * photo.height


def _together(photos: Sequence[Photo], ground: Array, some: Sequence[int], others: Sequence[int]) -> bool:
    """Whether most of some photos were taken when and where another camera took one."""
    times = np.array([photos[i].time_s for i in others], dtype=np.float64)
    order = np.argsort(times)
    times, places = times[order], ground[others][order]
    beside = 0
    for i in some:
        now = photos[i].time_s or 0.0
        a, b = np.searchsorted(times, (now - _TOGETHER_S, now + _TOGETHER_S + 1e-6))
        beside += bool((np.hypot(*(places[a:b] - ground[i]).T) <= _TOGETHER_M).any())
    return beside >= _TOGETHER_SHARE * len(some)
