"""Which pictures of a folder are one kind: those of one sensor, in colour or one spectral band.

A map of wide, zoom, thermal and near-infrared pictures shows nothing truly, and each kind has its own lens.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from telemetry.ingest.survey import SourceInfo
from telemetry.photos.photo_tags import SENSORS, Photo
from telemetry.samples.course import local_metres

BANDS: Final = ("", "green", "red", "blue", "nir", "red edge")
"""Spectral bands by how well they show the ground; "" is a colour picture."""
_TOGETHER_S: Final = 1.0  # sensors of one press write times that differ by this, in whole seconds
_TOGETHER_M: Final = 30.0  # ... and places that differ by less than the way between two pictures of a vehicle
_TOGETHER_SHARE: Final = 0.8  # so many pictures of one sensor have one of the other: presses fail, seldom

Reasons = dict[int, tuple[str, str]]
"""Photos by their index: why they are left out, one reason for all that share it, and a detail."""


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
