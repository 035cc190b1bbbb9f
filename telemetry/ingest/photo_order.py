"""The order of exposure of photos, even if the camera's clock was set in between."""

import re
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from telemetry.ingest.discovery import natural_key
from telemetry.photos.photo_tags import Photo
from telemetry.samples.course import ground_track, length_m
from telemetry.samples.findings import Finding, plural
from telemetry.samples.wild_fixes import TIME_RESOLUTION_S

SHIFTED: Final = "shifted after a jump"
"""Said in the origin of a photo's time that was moved to follow the photos before it."""
CLOCK_JUMP_S: Final = 60.0  # a step back in the photos' times by more than this is a jump of the camera's clock


def in_order(photos: Sequence[Photo], vehicle: str, findings: list[Finding]) -> list[Photo]:
    """Sort photos by time, or by name where the clock jumped.

    Where the two orders differ, the one with the shorter track is used; times are then shifted after each jump so
    that they continue, which preserves intervals within each part.
    """
    by_name = sorted(photos, key=lambda p: natural_key(p.path.name))
    by_time = sorted(by_name, key=lambda p: float("inf") if p.time_s is None else p.time_s)
    if by_time == by_name or any(p.time_s is None or p.lat_deg is None for p in photos):
        return by_time
    times = np.array([p.time_s for p in by_name], dtype=np.float64)
    steps = np.diff(times)
    back = np.flatnonzero(steps < 0.0)
    if len(back) > 3 or steps[back].min() > -CLOCK_JUMP_S:
        return by_time
    if length_m(ground_track(by_name)) > 0.7 * length_m(ground_track(by_time)):
        return by_time
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    for at in back:
        shift = times[at] + usual - times[at + 1]
        times[at + 1 :] += shift
    for photo, time_s in zip(by_name, times.tolist(), strict=True):
        if photo.time_s != time_s:
            photo.time_s = time_s
            photo.origin["time"] = f"{photo.origin.get('time', 'camera clock')}, {SHIFTED}"
    text = (
        f"the camera's clock jumped back {plural(len(back), 'time')} during the flight; the order of the file names is "
        "used, and times after a jump are shifted"
    )
    findings.append(Finding("clock-jump", text, vehicle))
    return by_name


def clock_went_back(photos: Sequence[Photo]) -> bool:
    """Whether the clock was set back between photos: runs of names, in order within, of which two share some time.

    Runs one after the other are no sign of it: numbers begin anew after the last one.
    """
    series: dict[str, list[float]] = {}  # by the names without their number: two cameras in one folder are two
    for p in sorted(photos, key=lambda p: natural_key(p.path.name)):
        if p.time_s is not None:
            series.setdefault(re.sub(r"\d+\D*$", "", p.path.stem), []).append(p.time_s)
    return any(_went_back(np.array(times)) for times in series.values())


def _went_back(times: NDArray[np.float64]) -> bool:
    back = np.flatnonzero(np.diff(times) < -TIME_RESOLUTION_S) + 1
    if not 0 < len(back) <= 3:  # more: names that are not in the order of exposure
        return False
    spans = sorted((run.min(), run.max()) for run in np.split(times, back))
    return any(later[0] < earlier[1] for earlier, later in pairwise(spans))
