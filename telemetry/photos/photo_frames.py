"""Frames of one vehicle's photos: which of the recorded angles are the picture's, impossible values removed.

Gimbal or airframe, absolute or relative: decided by the tags of all photos of one vehicle and camera model together,
as a single photo is ambiguous.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.arrays import Array
from orthoswarm.model.earth import distance_m
from orthoswarm.model.frame import Frame
from telemetry.photos.maker_angles import Angles
from telemetry.photos.map_datum import IN_DATUM
from telemetry.photos.photo_tags import HEMISPHERE_UNKNOWN, VOID, Photo, mirrored
from telemetry.samples.course import Straight, courses_deg, ground_track, straight_legs
from telemetry.samples.findings import Finding, metres, plural
from telemetry.samples.sample import Sample, fix_of
from telemetry.samples.times import ZONE_CONTRADICTS

LEAST_HEIGHT_M: Final = 1.0  # recorded heights below this were never filled in
_RELATIVE_GIMBAL_MODELS = frozenset({"FC7203"})
"""Camera models known to record the gimbal's yaw relative to the airframe (Mavic Mini).

Measured on a flight of one: pictures turn with the sum of both (slope 1.1 on the gimbal's yaw), not with the flight
yaw alone."""

_NADIR_WITHIN_DEG: Final = 45.0  # gimbal roll near 180 degrees is a turned yaw if the camera looks within this of nadir


def frames_of(
    photos: Sequence[Photo], vehicle: str, name: Callable[[Path], str], findings: list[Finding]
) -> list[Frame]:
    """Frames of one vehicle's photos (in order of time), after comparing their tags.

    photos: with positions. vehicle: id. name: maps a file to its name in the products. findings: are appended here.
    """
    ground = ground_track(photos)
    course = courses_deg(ground)
    heights = _heights(photos, findings, vehicle)
    findings += _doubts(photos, vehicle)
    chosen: dict[int, tuple[Angles, str]] = {}
    for model in sorted({p.model for p in photos}):
        index = [i for i, p in enumerate(photos) if p.model == model]
        decided, yaw_origin = decide([photos[i] for i in index], course[index], vehicle, findings)
        chosen.update((i, (angles, yaw_origin)) for i, angles in zip(index, decided, strict=True))
    yaw = np.array([math.nan if (y := chosen[i][0][0]) is None else y for i in range(len(photos))])
    findings += check_legs(yaw, straight_legs(ground, least_frames=4), vehicle)
    frames = []
    for i, photo in enumerate(photos):
        angles, yaw_origin = chosen[i]
        image = name(photo.path)
        frames.append(_frame(photo, vehicle, image, height_m=heights[i], angles=angles, yaw_origin=yaw_origin))
    return frames


_DOUBTS: Final = (
    (HEMISPHERE_UNKNOWN, "position-hemisphere", "the GPS tags of {} do not say whether north or south, east or west "
     "(GPSLatitudeRef, GPSLongitudeRef), and are taken as north and east; give a geo.txt if that is wrong"),
    (VOID, "position-void", "the positions of {} are void by the receiver's own word (GPSStatus V); they are used, as "
     "some cameras always say so: check them"),
    (IN_DATUM, "position-datum", "the GPS tags of {} name another datum than WGS 84 (GPSMapDatum): {}"),
    (ZONE_CONTRADICTS, "time-zone", "the time zone that {} state contradicts the GPS time beside it, which counts"),
)  # fmt: skip
"""Words in the origin of a position or time that is not sure, the finding's code and text."""


def _doubts(photos: Sequence[Photo], vehicle: str) -> list[Finding]:
    """Findings on what the tags of a vehicle's photos leave open, or state wrongly."""
    origins = [p.origin.get(name, "") for p in photos for name in ("position", "time")]
    found = []
    for words, code, text in _DOUBTS:
        ends = Counter(origin.partition(words)[2] for origin in origins if words in origin)
        found += [Finding(code, text.format(plural(n, "photo"), end), vehicle) for end, n in ends.items()]
    return found


def void_fixes(photos: Sequence[Photo]) -> set[int]:
    """The photos whose receiver had no fix by its own word; none of a camera that says so of all that it placed."""
    said = [p.origin.get("position", "") for p in photos]
    tell = {p.model for p, origin in zip(photos, said) if origin.startswith(("EXIF", "XMP")) and VOID not in origin}
    return {i for i, (p, origin) in enumerate(zip(photos, said)) if VOID in origin and p.model in tell}


def settle_positions(photos: Sequence[Photo], vehicle: str, name: Callable[[Path], str]) -> list[Finding]:
    """Of photos whose tags state two places, take the one that fits the others; a finding says so.

    Where all of a vehicle's photos contradict themselves, nothing tells, and what was read first stays.
    """
    places = [(float(photo.lat_deg or 0.0), float(photo.lon_deg or 0.0)) for photo in photos]
    by_tags = [photo.origin.get("position", "").startswith(("EXIF", "XMP")) for photo in photos]
    rows = list(zip(photos, places, (p.other_position if tags else None for p, tags in zip(photos, by_tags))))
    two = [(photo, place, other) for photo, place, other in rows if other is not None]
    if not two:
        return []
    sure = [place for _, place, other in rows if other is None]
    changed = 0
    if sure:
        lat, lon = np.median(np.array(sure), axis=0)
        for photo, place, other in two:
            if distance_m(*other, lat, lon) < distance_m(*place, lat, lon):
                (photo.lat_deg, photo.lon_deg), changed = other, changed + 1
                photo.origin["position"] = "the tags that fit the other photos"
        took = f"{plural(changed, 'position')} of these are taken from the tags that fit the other photos"
    elif all(mirrored(place, other) for _, place, other in two):
        took = "their hemispheres are taken from XMP"
    else:
        took = "nothing tells which is right: give a geo.txt"
    apart_m = max(distance_m(*place, *other) for _, place, other in two)
    text = (
        f"the tags of {plural(len(two), 'photo')} state two places, up to {metres(apart_m)} apart "
        f"({name(two[0][0].path)} first); {took}"
    )
    return [Finding("position-contradicts", text, vehicle)]


def frame_without_position(photo: Photo, vehicle: str, image: str) -> Frame:
    """The frame of a photo without a position: latitude and longitude are NaN, and no angle is believed."""
    nowhere = replace(photo, lat_deg=math.nan, lon_deg=math.nan)
    return _frame(nowhere, vehicle, image, height_m=photo.height_m, angles=(None, None, None), yaw_origin="")


def _frame(photo: Photo, vehicle: str, image: str, *, height_m: float | None, angles: Angles, yaw_origin: str) -> Frame:
    origin = dict(photo.origin)
    if angles[0] is not None and yaw_origin:
        origin["yaw"] = f"{yaw_origin} ({origin.get('angles') or origin.get('flight_yaw', '')})"
    recorded = Sample(
        lat_deg=photo.lat_deg, lon_deg=photo.lon_deg, height_m=height_m, altitude_m=photo.altitude_m, yaw_deg=angles[0],
        pitch_deg=angles[1], roll_deg=angles[2], flight_yaw_deg=photo.flight_deg[0], sigma_m=photo.position_sigma_m,
        height_is_ground=photo.height_is_ground,
    )  # fmt: skip
    return Frame(
        image=image, path=photo.path, vehicle=vehicle, time_s=photo.time_s, fix=fix_of(recorded), width=photo.width,
        height=photo.height, camera=photo.camera, fov_hint_rad=photo.fov_hint_rad, origin=origin, damaged=photo.damaged,
        ambiguous=photo.ambiguous,
    )  # fmt: skip


def _heights(photos: Sequence[Photo], findings: list[Finding], vehicle: str) -> list[float | None]:
    """Plausible heights: not zero or negative, and not altitudes."""
    heights = [p.height_m if p.height_m is not None and math.isfinite(p.height_m) else None for p in photos]
    low = [h for h in heights if h is not None and h < LEAST_HEIGHT_M]
    if low:
        text = (
            f"the recorded height is below {LEAST_HEIGHT_M:g} m in {plural(len(low), 'photo')} "
            f"(down to {min(low):.1f} m); these heights are ignored"
        )
        findings.append(Finding("height-implausible", text, vehicle))
    heights = [h if h is not None and h >= LEAST_HEIGHT_M else None for h in heights]
    missing = sum(h is None for h in heights)
    if missing:
        count = f"{missing} of {plural(len(photos), 'photo')}"
        text = f"{count} without a height above ground; it is estimated from the distance flown"
        findings.append(Finding("height-missing", text, vehicle))
    two = [(p.altitude_m or 0.0, p.other_altitude_m) for p in photos if p.other_altitude_m is not None]
    if two:
        text = (
            f"the tags of {plural(len(two), 'photo')} state two altitudes, {two[0][0]:.0f} and {two[0][1]:.0f} m in "
            "the first; that of the EXIF counts, but for its sign"
        )
        findings.append(Finding("altitude-contradicts", text, vehicle))
    altitudes = np.array([p.altitude_m for p in photos if p.altitude_m is not None], dtype=np.float64)
    wrong = altitudes[(altitudes < 0.0) | (altitudes > 15_000.0)]
    if len(wrong):
        text = (
            f"the GPS altitude is {wrong.min():.0f} to {wrong.max():.0f} m in {plural(len(wrong), 'photo')}, "
            "which cannot be where it flew; altitudes are not used as heights"
        )
        findings.append(Finding("altitude-implausible", text, vehicle))
    return heights


def decide(
    photos: Sequence[Photo], course_deg: Array, vehicle: str, findings: list[Finding]
) -> tuple[list[Angles], str]:
    """Choose the picture's angles for the photos of one vehicle and model.

    photos: in order of time. course_deg: (N,) course over ground, NaN where unknown. findings: are appended here.

    Returns yaw, pitch and roll of each photo in degrees (None where unknown), and the yaw's source.
    """
    found: list[Finding] = []
    camera = _filled("gimbal", [p.camera_deg for p in photos], 1, found)
    flight = _filled("flight", [p.flight_deg for p in photos], 2, found)
    _repair_upside_down(camera, found)
    yaw, origin = _choose_yaw(camera[:, 0], flight[:, 0], course_deg, photos, found)
    pitch = camera[:, 1]
    known = pitch[np.isfinite(pitch)]
    off = float(np.median(np.abs(known + 90.0))) if len(known) else 0.0
    if off > 5.0:
        text = f"the camera looks {off:.0f} degrees off nadir (median of the recorded pitch)"
        found.append(Finding("oblique", text))
    angles: list[Angles] = [
        (_or_none(y), _or_none(p), _or_none(r)) for y, p, r in zip(wrap_deg(yaw), camera[:, 1], camera[:, 2])
    ]
    findings += [replace(finding, vehicle=vehicle) for finding in found]
    return angles, origin


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _filled(kind: str, rows: Sequence[Angles], least: int, findings: list[Finding]) -> Array:
    """(N, 3) angles, NaN where unknown.

    Angles that are exactly zero in every photo, of at least so many, were never filled in (pitch 0 would look at the
    horizon).
    """
    angles = np.array([[np.nan if v is None else v for v in row] for row in rows], dtype=np.float64).reshape(-1, 3)
    if len(angles) >= least and np.isfinite(angles).any() and np.nanmax(np.abs(angles)) == 0.0:
        text = f"all {kind} angles are zero, so they were never recorded; they are ignored"
        findings.append(Finding(f"{kind}-zero", text))
        return np.full_like(angles, np.nan)
    return angles


def _repair_upside_down(camera: Array, findings: list[Finding]) -> None:
    """Replace a roll near 180 at nadir by the equivalent yaw turned by 180 (gimbals do not hang upside down)."""
    with np.errstate(invalid="ignore"):
        flipped = (np.abs(wrap_deg(camera[:, 2] - 180.0)) < 30.0) & (camera[:, 1] < -90.0 + _NADIR_WITHIN_DEG)
    if flipped.any():
        camera[flipped, 0] += 180.0
        camera[flipped, 2] = wrap_deg(camera[flipped, 2] - 180.0)
        text = (
            f"the gimbal's roll is near 180 degrees at nadir in {plural(int(flipped.sum()), 'photo')}; "
            "read as a yaw turned by 180 degrees"
        )
        findings.append(Finding("roll-180", text))


def _choose_yaw(
    gimbal: Array, flight: Array, course: Array, photos: Sequence[Photo], findings: list[Finding]
) -> tuple[Array, str]:
    """The gimbal's yaw, unless it was recorded relative to the airframe or not at all."""
    if not np.isfinite(gimbal).any():
        return flight, "flight yaw" if np.isfinite(flight).any() else ""
    both = np.isfinite(gimbal) & np.isfinite(flight)
    if all(p.yaw_is_stated for p in photos):
        return gimbal, "camera yaw"
    if both.any():
        relative = flight + np.where(np.isfinite(gimbal), gimbal, 0.0), "flight yaw + gimbal yaw"
        # The upper quartile, as legs towards north agree with both models.
        apart = float(np.quantile(np.abs(wrap_deg(gimbal[both] - flight[both])), 0.75))
        stays = float(np.median(np.abs(wrap_deg(gimbal[both])))) < 20.0
        known = any(p.model in _RELATIVE_GIMBAL_MODELS for p in photos)
        if stays and apart > 30.0:
            spread = _circular_spread_deg(flight[both])
            if known or spread > 45.0 or _agrees(flight, course) > _agrees(gimbal, course) + 0.3:
                text = (
                    "the gimbal's yaw stays near zero while the flight yaw turns, so it is relative to the "
                    "airframe; it is added to the flight yaw"
                )
                findings.append(Finding("yaw-relative", text))
                return relative
            text = (
                f"gimbal yaw and flight yaw are {apart:.0f} degrees apart; the gimbal's is taken, "
                "the pictures have to confirm it"
            )
            findings.append(Finding("yaw-ambiguous", text))
        elif stays and known:  # flying north: both agree anyway, but the camera model is known
            return relative
    return np.where(np.isfinite(gimbal), gimbal, flight), "camera yaw"


def _circular_spread_deg(angle: Array) -> float:
    """Half the smallest arc that holds all angles, degrees."""
    ordered = np.sort(angle % 360.0)
    if len(ordered) < 2:
        return 0.0
    gaps = np.diff(np.concatenate([ordered, [ordered[0] + 360.0]]))
    return float(0.5 * (360.0 - gaps.max()))


def _agrees(yaw: Array, course: Array) -> float:
    """Share of photos whose yaw is along the course (in either direction) within 25 degrees."""
    known = np.isfinite(yaw) & np.isfinite(course)
    if not known.any():
        return 0.0
    apart = np.abs(wrap_deg(2.0 * (yaw[known] - course[known]))) / 2.0
    return float((apart < 25.0).mean())


def check_legs(yaw_deg: Array, legs: Sequence[Straight], vehicle: str) -> list[Finding]:
    """Contradictions between yaw and course that are visible in the tags.

    A camera either turns with the airframe from leg to leg or keeps its heading; a flight that does both has legs
    whose yaw may be turned by 180 degrees. So has a leg whose yaw turns half-way.
    """
    findings: list[Finding] = []
    means = [_circular_mean_deg(yaw_deg[leg.first : leg.last + 1]) for leg in legs]
    turned = stayed = 0
    for (a, yaw_a), (b, yaw_b) in pairwise(zip(legs, means, strict=True)):
        if abs(wrap_deg(b.course_deg - a.course_deg)) < 150.0:
            continue
        change = abs(wrap_deg(float(yaw_b - yaw_a)))
        turned += change > 140.0
        stayed += change < 40.0
    if turned and stayed:
        text = (
            f"the yaw turns with the course between {plural(turned, 'pair')} of legs and stays between "
            f"{stayed}; a yaw turned by 180 degrees on some legs is likely, the pictures have to tell"
        )
        findings.append(Finding("yaw-inconsistent", text, vehicle))
    for leg in legs:
        run = yaw_deg[leg.first : leg.last + 1]
        jumps = np.abs(wrap_deg(np.diff(run[np.isfinite(run)]))) > 150.0
        if jumps.any():
            text = "the yaw turns by 180 degrees within a straight leg; the pictures decide"
            findings.append(Finding("yaw-jump", text, vehicle))
            break
    return findings


def _circular_mean_deg(angle: Array) -> float:
    known = np.radians(angle[np.isfinite(angle)])
    return float(np.degrees(np.angle(np.exp(1j * known).sum()))) if len(known) else float("nan")
