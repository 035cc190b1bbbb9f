"""Checks of a flight's tags for mapping: gaps, coarse times, lens distortion, geometry.

Nothing is changed here; most findings are notes, not errors.
"""

import math
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.frame import THETA_HAT_DEG, Frame
from telemetry.photos.photo_tags import Photo
from telemetry.samples.course import Straight, ground_track, straight_legs
from telemetry.samples.findings import Finding, metres, plural
from telemetry.samples.times import YEAR_2000_S, ZONE_UNKNOWN

_OUTLYING_POSITION_M: Final = 100.0  # a photo farther from those beside it (and 15 steps) has a wrong position
OTHER_DAY_S: Final = 43_200.0  # photos farther apart in time than half a day are of another day
_LOW_SHARE: Final = 0.4  # a few photos lower than this share of the usual height are reported


def flight_findings(photos: Sequence[Photo], frames: Sequence[Frame], vehicle: str) -> list[Finding]:
    """Findings on one vehicle's photos (in order, with the frames made of them)."""
    if len(frames) < 2:
        return []
    ground = ground_track([f.fix for f in frames])
    legs = straight_legs(ground)
    found = [
        _maker_notes(photos),
        _distortion(photos),
        _accurate_positions(frames),
        *_times(frames, ground),
        _outlying_positions(frames, ground),
        _standing(ground),
        _missing_numbers(frames),
        _spacing(frames, ground, legs),
        _one_height(frames),
        _low(frames),
    ]
    return [Finding(f.code, f.message, vehicle, f.note) for f in found if f is not None]


def times_without_zone(frames: Iterable[Frame]) -> list[Finding]:
    """A finding on the frames, of all vehicles, whose times came without a zone; none if all have one."""
    zoneless = sum(ZONE_UNKNOWN in frame.origin.get("time", "") for frame in frames)
    if not zoneless:
        return []
    text = (
        f"times of {plural(zoneless, 'picture')} have no zone and are taken as UTC: where the clock showed local "
        "time, all times of the products are off by its offset"
    )
    return [Finding("time-without-zone", text)]


def _maker_notes(photos: Sequence[Photo]) -> Finding | None:
    count = sum(p.origin.get("angles") == "DJI MakerNotes" for p in photos)
    if not count:
        return None
    text = f"{plural(count, 'photo')} have no XMP; their attitude comes from DJI's MakerNotes"
    return Finding("attitude-makernotes", text, note=True)


def _distortion(photos: Sequence[Photo]) -> Finding | None:
    known = [p.dewarp_k1 for p in photos if p.dewarp_k1 is not None]
    if not known:
        return None
    text = (
        f"the pictures are not dewarped; their tags state a radial distortion of k1 = {np.median(known):+.3f}, "
        "which is estimated anew"
    )
    return Finding("lens-distortion", text, note=True)


def _accurate_positions(frames: Sequence[Frame]) -> Finding | None:
    known = [f.fix.position_sigma_m for f in frames if f.fix.position_sigma_m is not None]
    if len(known) < 0.5 * len(frames) or np.median(known) > 0.1:
        return None
    text = f"positions are accurate (RTK): one sigma {100 * float(np.median(known)):.1f} cm (median)"
    return Finding("rtk", text, note=True)


def _times(frames: Sequence[Frame], ground: Array) -> list[Finding]:
    times = np.array([np.nan if f.time_s is None else f.time_s for f in frames])
    if np.isnan(times).all():
        return [Finding("time-missing", "the pictures have no times; they are taken in the order of their names")]
    found: list[Finding] = []
    step, flown = np.diff(times), np.hypot(*np.diff(ground, axis=0).T)
    moving = (step > 0) & (step < 120) & (flown > 2.0)
    speed = float(np.median(flown[moving] / step[moving])) if moving.any() else 0.0
    if np.nanmax(np.abs(times - np.round(times))) < 1e-3 and speed > 1.0:
        text = (
            f"times have whole seconds only, and positions may lag by as much: at {speed:.1f} m/s that is up to "
            f"{speed:.0f} m along the track"
        )
        found.append(Finding("time-whole-seconds", text, note=True))
    jumps = int((step > 3600).sum())
    if jumps:
        hours = float(step.max()) / 3600
        text = (
            f"the times jump {plural(jumps, 'time')} (by up to {hours:.1f} h): several flights or a clock that was set"
            f"{_days(times)}"
        )
        found.append(Finding("time-gap", text))
    numbers = [number_of(f.image) for f in frames]
    known = [n for n in numbers if n is not None]
    if len(known) == len(frames) and len(frames) > 4:
        back = int((np.diff(np.array(known)) < 0).sum())
        if 0 < back < len(frames) // 10 + 2:
            text = (
                f"the order of times is not that of the file names ({plural(back, 'step')} back); "
                "the clock may have jumped"
            )
            found.append(Finding("time-order", text))
    return found


def _days(times: Array) -> str:
    """What is said about photos of several days: what is drawn may have changed in between."""
    known = np.sort(times[times > YEAR_2000_S])
    days = [d for d in np.split(known, np.flatnonzero(np.diff(known) > OTHER_DAY_S) + 1) if len(d)]
    if len(days) < 2:
        return ""
    named = ", ".join(f"{len(day)} of {datetime.fromtimestamp(float(day[0]), UTC):%Y-%m-%d}" for day in days)
    return f" ({named}); if the ground changed in between, map each day by itself"


def number_of(image: str) -> int | None:
    """The last number in a picture's name, None where there is none."""
    match = re.search(r"(\d{1,9})\D*$", image.rsplit("/", 1)[-1].rsplit(".", 1)[0])
    return int(match[1]) if match else None


def _outlying_positions(frames: Sequence[Frame], ground: Array) -> Finding | None:
    """Pictures far from both neighbours, which are near each other: their position is wrong."""
    if len(ground) < 3:
        return None
    step = np.hypot(*np.diff(ground, axis=0).T)
    across = np.hypot(*(ground[2:] - ground[:-2]).T)
    least = np.minimum(step[:-1], step[1:])
    far = np.flatnonzero((least > _OUTLYING_POSITION_M) & (least > 15.0 * np.median(step)) & (least > 3.0 * across)) + 1
    if not len(far):
        return None
    away_m = float(least[far - 1].max())
    text = (
        f"{plural(len(far), 'picture')} lie up to {metres(away_m)} away from the pictures before and after "
        f"({frames[int(far[0])].image} first); their positions are wrong"
    )
    return Finding("position-astray", text)


def _standing(ground: Array) -> Finding | None:
    step = np.hypot(*np.diff(ground, axis=0).T)
    still = int((step < 0.3).sum())
    if still < max(3, 0.1 * len(ground)):
        return None
    return Finding("standing", f"{plural(still, 'picture')} were taken where the one before was", note=True)


def _missing_numbers(frames: Sequence[Frame]) -> Finding | None:
    numbers = sorted({n for f in frames if "#" not in f.image and (n := number_of(f.image)) is not None})
    if len(numbers) < 5:
        return None
    steps = np.diff(np.array(numbers))
    usual = int(np.median(steps))
    missing = int(np.sum(steps // max(usual, 1) - 1))
    if missing < max(2, 0.15 * len(numbers)):
        return None
    text = f"{missing} of {missing + len(numbers)} pictures are missing by their numbers; there are gaps"
    return Finding("gaps", text)


def _spacing(frames: Sequence[Frame], ground: Array, legs: Sequence[Straight]) -> Finding | None:
    """Spacing of pictures along the legs compared with their footprint."""
    heights = [f.fix.height_m for f in frames if f.fix.height_m is not None]
    if not heights or not legs:
        return None
    height = float(np.median(heights))
    step = np.concatenate([np.hypot(*np.diff(ground[g.first : g.last + 1], axis=0).T) for g in legs])
    usual = float(np.median(step))
    first = frames[0]
    fov_rad = first.fov_hint_rad or math.radians(THETA_HAT_DEG)
    footprint = 2.0 * height * math.tan(0.5 * fov_rad) * first.height / first.width
    if usual < 0.1 * height:
        text = (
            f"pictures are {usual:.1f} m apart at {height:.0f} m height, a short base: neighbours see heights of the "
            "ground weakly"
        )
        return Finding("short-base", text, note=True)
    overlap = 1.0 - usual / footprint
    if overlap < 0.7:
        text = (
            f"pictures are {usual:.0f} m apart along the legs and overlap by about {100 * max(0.0, overlap):.0f} % "
            f"only (the largest step is {float(step.max()):.0f} m)"
        )
        return Finding("sparse", text)
    return None


def _one_height(frames: Sequence[Frame]) -> Finding | None:
    """Flat ground, one height and nadir views: focal length and height cannot be separated."""
    heights = np.array([f.fix.height_m for f in frames if f.fix.height_m is not None])
    tilt = [abs(math.degrees(f.fix.pitch_rad) + 90.0) for f in frames if f.fix.pitch_rad is not None]
    if len(heights) < 3 or len(tilt) < 3 or np.ptp(heights) > 0.02 * np.median(heights) or max(tilt) > 2.0:
        return None
    text = (
        f"all pictures look straight down from {float(np.median(heights)):.1f} m: the field of view cannot be "
        "separated from the height; only their combined scale is known"
    )
    return Finding("focal-and-height", text, note=True)


def _low(frames: Sequence[Frame]) -> Finding | None:
    """A few pictures from far below the others: takeoff, landing, inspection."""
    heights = np.array([np.nan if f.fix.height_m is None else f.fix.height_m for f in frames])
    if np.isnan(heights).mean() > 0.5:
        return None
    usual = float(np.nanmedian(heights))
    low = np.flatnonzero(heights < _LOW_SHARE * usual)
    if not 0 < len(low) <= 0.2 * len(frames):
        return None
    text = (
        f"{plural(len(low), 'picture')} taken at {np.nanmin(heights):.0f} m, the others at {usual:.0f} m "
        f"({frames[int(low[0])].image} first)"
    )
    return Finding("low", text)
