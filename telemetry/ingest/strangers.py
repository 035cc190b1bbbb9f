"""Pictures in a folder that are not of its flight: screenshots, smaller copies, another camera's, another day's.

Each would be drawn as if the flight's camera had taken it. What most photos of the folder are is the flight; only few
others are strangers: as many as the flight's are another flight, which is mapped, too.
"""

from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Final

import numpy as np

from telemetry.photos.flight_checks import OTHER_DAY_S
from telemetry.photos.photo_tags import Photo
from telemetry.samples.course import local_metres

_FEW_SHARE: Final = 0.1  # strangers are at most this share of a folder's photos
_OTHER_CAMERA_MOST: Final = 2  # photos of another camera: more are a flight's second camera
_SMALLER: Final = 0.75  # a copy has at most this share of the photo's columns
_ELSEWHERE_M: Final = 500.0  # ... and elsewhere, if they are farther than this from all others

Reasons = dict[int, tuple[str, str]]
"""Photos by their index: why they are left out, one reason for all that share it, and a detail."""


def strangers(photos: Sequence[Photo]) -> Reasons:
    """The photos of a folder that are not of its flight."""
    found: Reasons = {}
    for rule in (_without_camera, _smaller_copies, _other_camera, _other_day):
        left = [i for i in range(len(photos)) if i not in found]
        found |= {left[k]: why for k, why in rule([photos[i] for i in left]).items()}
    return found


def _few(count: int, photos: Sequence[Photo]) -> bool:
    return 0 < count <= _FEW_SHARE * len(photos)


def _without_camera(photos: Sequence[Photo]) -> Reasons:
    """Pictures of another size of which no tag says anything: they have neither camera, time nor position."""
    sizes = {(p.width, p.height) for p in photos if p.make or p.model}
    why = "the picture has no position; it has no camera's tags either, as a screenshot or an edited picture"
    return {
        i: (why, "")
        for i, p in enumerate(photos)
        if sizes
        and (p.width, p.height) not in sizes
        and not (p.make or p.model)
        and p.time_s is None
        and p.lat_deg is None
    }


def _smaller_copies(photos: Sequence[Photo]) -> Reasons:
    """Pictures of the same camera, time and place to the last digit as a larger one."""
    same: dict[tuple[object, ...], list[int]] = {}
    for i, p in enumerate(photos):
        if p.time_s is not None and p.lat_deg is not None:
            same.setdefault((p.make, p.model, p.time_s, p.lat_deg, p.lon_deg), []).append(i)
    found: Reasons = {}
    for group in same.values():
        largest = max(group, key=lambda i: photos[i].width * photos[i].height)
        for i in group:
            if photos[i].width <= _SMALLER * photos[largest].width:
                found[i] = "a smaller picture of the same exposure as another one here", photos[largest].path.name
    return found


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
