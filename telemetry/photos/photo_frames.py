"""Frames of one vehicle's photos: their tags are compared with each other, impossible values removed."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.model.earth import distance_m
from orthoswarm.model.frame import Frame
from telemetry.photos.attitude import check_legs, decide
from telemetry.photos.maker_angles import Angles
from telemetry.photos.photo_tags import HEMISPHERE_UNKNOWN, Photo, mirrored
from telemetry.samples.course import courses_deg, ground_track, straight_legs
from telemetry.samples.findings import Finding, metres, plural
from telemetry.samples.sample import Sample
from telemetry.samples.sample_frame import fix_of

LEAST_HEIGHT_M: Final = 1.0  # recorded heights below this were never filled in


def frames_of(
    photos: Sequence[Photo], vehicle: str, name: Callable[[Path], str], findings: list[Finding]
) -> list[Frame]:
    """Frames of one vehicle's photos (in order of time), after comparing their tags.

    Args:
        photos: with positions. vehicle: id. name: maps a file to its name in the products.
        findings: are appended here.
    """
    ground = ground_track(photos)
    course = courses_deg(ground)
    heights = _heights(photos, findings, vehicle)
    unsigned = sum(p.origin.get("position", "").endswith(HEMISPHERE_UNKNOWN) for p in photos)
    if unsigned:
        text = (
            f"the GPS tags of {plural(unsigned, 'photo')} do not say whether north or south, east or west "
            "(GPSLatitudeRef, GPSLongitudeRef), and are taken as north and east; give a geo.txt if that is wrong"
        )
        findings.append(Finding("position-hemisphere", text, vehicle))
    chosen: dict[int, tuple[Angles, str]] = {}
    for model in sorted({p.model for p in photos}):
        index = [i for i, p in enumerate(photos) if p.model == model]
        decided = decide([photos[i] for i in index], course[index], vehicle)
        findings += decided.findings
        chosen.update((i, (angles, decided.yaw_origin)) for i, angles in zip(index, decided.angles, strict=True))
    yaw = np.array([math.nan if (y := chosen[i][0][0]) is None else y for i in range(len(photos))])
    findings += check_legs(yaw, straight_legs(ground, least_frames=4), vehicle)
    frames = []
    for i, photo in enumerate(photos):
        angles, yaw_origin = chosen[i]
        image = name(photo.path)
        frames.append(_frame(photo, vehicle, image, height_m=heights[i], angles=angles, yaw_origin=yaw_origin))
    return frames


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
        lat_deg=photo.lat_deg,
        lon_deg=photo.lon_deg,
        height_m=height_m,
        altitude_m=photo.altitude_m,
        yaw_deg=angles[0],
        pitch_deg=angles[1],
        roll_deg=angles[2],
        flight_yaw_deg=photo.flight_deg[0],
        sigma_m=photo.position_sigma_m,
        height_is_ground=photo.height_is_ground,
    )
    return Frame(
        image=image,
        path=photo.path,
        vehicle=vehicle,
        time_s=photo.time_s,
        fix=fix_of(recorded),
        width=photo.width,
        height=photo.height,
        camera=photo.camera,
        fov_hint_rad=photo.fov_hint_rad,
        origin=origin,
        damaged=photo.damaged,
        ambiguous=photo.ambiguous,
    )


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
