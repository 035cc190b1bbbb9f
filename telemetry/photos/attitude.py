"""Which of the recorded angles are the picture's: gimbal or airframe, absolute or relative, plausible or not.

Decided for all photos of one vehicle and camera model together, as a single photo is ambiguous. Picture
content is not used here.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.angles import wrap_deg
from telemetry.photos.maker_angles import Angles
from telemetry.photos.photo_tags import PhotoTags
from telemetry.samples.course import Straight
from telemetry.samples.findings import Finding, plural

Array = NDArray[np.float64]

RELATIVE_GIMBAL_MODELS = frozenset({"FC7203"})
"""Camera models known to record the gimbal's yaw relative to the airframe (Mavic Mini).

Measured on a flight of one: pictures turn with the sum of both (slope 1.1 on the gimbal's yaw), not with the flight
yaw alone."""

_NADIR_WITHIN_DEG: Final = 45.0  # gimbal roll near 180 degrees is a turned yaw if the camera looks within this of nadir


@dataclass(frozen=True, slots=True)
class Decided:
    """Yaw, pitch and roll of each photo in degrees (None where unknown), the yaw's source, and findings."""

    angles: list[Angles]
    yaw_origin: str
    findings: list[Finding]


def decide(photos: Sequence[PhotoTags], course_deg: Array, vehicle: str) -> Decided:
    """Choose the picture's angles for the photos of one vehicle and model.

    Args:
        photos: in order of time.
        course_deg: (N,) course over ground, NaN where unknown.
        vehicle: for messages.
    """
    camera = _table([p.camera_deg for p in photos])
    flight = _table([p.flight_deg for p in photos])
    findings: list[Finding] = []
    camera, flight = _drop_unfilled(camera, flight, findings, vehicle)
    _repair_upside_down(camera, findings, vehicle)
    yaw, origin = _choose_yaw(camera[:, 0], flight[:, 0], course_deg, photos=photos, findings=findings, vehicle=vehicle)
    _note_oblique(camera[:, 1], findings, vehicle)
    angles: list[Angles] = [
        (_or_none(y), _or_none(p), _or_none(r)) for y, p, r in zip(wrap_deg(yaw), camera[:, 1], camera[:, 2])
    ]
    return Decided(angles, origin, findings)


def _table(rows: Sequence[Angles]) -> Array:
    return np.array([[np.nan if v is None else v for v in row] for row in rows], dtype=np.float64).reshape(-1, 3)


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _drop_unfilled(camera: Array, flight: Array, findings: list[Finding], vehicle: str) -> tuple[Array, Array]:
    """Angles that are exactly zero in every photo were never filled in (pitch 0 would look at the horizon)."""
    if len(camera) and np.isfinite(camera).any() and np.nanmax(np.abs(camera)) == 0.0:
        camera = np.full_like(camera, np.nan)
        findings.append(
            Finding("gimbal-zero", "all gimbal angles are zero, so they were never recorded; they are ignored", vehicle)
        )
    if len(flight) > 1 and np.isfinite(flight).any() and np.nanmax(np.abs(flight)) == 0.0:
        flight = np.full_like(flight, np.nan)
        findings.append(
            Finding("flight-zero", "all flight angles are zero, so they were never recorded; they are ignored", vehicle)
        )
    return camera, flight


def _repair_upside_down(camera: Array, findings: list[Finding], vehicle: str) -> None:
    """Replace a roll near 180 at nadir by the equivalent yaw turned by 180 (gimbals do not hang upside down)."""
    with np.errstate(invalid="ignore"):
        flipped = (np.abs(wrap_deg(camera[:, 2] - 180.0)) < 30.0) & (camera[:, 1] < -90.0 + _NADIR_WITHIN_DEG)
    if flipped.any():
        camera[flipped, 0] += 180.0
        camera[flipped, 2] = wrap_deg(camera[flipped, 2] - 180.0)
        findings.append(
            Finding(
                "roll-180",
                f"the gimbal's roll is near 180 degrees at nadir in {plural(int(flipped.sum()), 'photo')}; "
                "read as a yaw turned by 180 degrees",
                vehicle,
            )
        )


def _choose_yaw(
    gimbal: Array,
    flight: Array,
    course: Array,
    *,
    photos: Sequence[PhotoTags],
    findings: list[Finding],
    vehicle: str,
) -> tuple[Array, str]:
    """The gimbal's yaw, unless it was recorded relative to the airframe or not at all."""
    if np.isfinite(gimbal).any() and all(p.yaw_is_stated for p in photos):
        return gimbal.copy(), "camera yaw"
    if not np.isfinite(gimbal).any():
        return flight.copy(), "flight yaw" if np.isfinite(flight).any() else ""
    both = np.isfinite(gimbal) & np.isfinite(flight)
    origin = "camera yaw"
    if both.any():
        # The upper quartile, as legs towards north agree with both models.
        apart = float(np.quantile(np.abs(wrap_deg(gimbal[both] - flight[both])), 0.75))
        stays = float(np.median(np.abs(wrap_deg(gimbal[both])))) < 20.0
        known = any(p.model in RELATIVE_GIMBAL_MODELS for p in photos)
        if stays and apart > 30.0:
            spread = _circular_spread_deg(flight[both])
            if known or spread > 45.0 or _agrees(flight, course) > _agrees(gimbal, course) + 0.3:
                findings.append(
                    Finding(
                        "yaw-relative",
                        "the gimbal's yaw stays near zero while the flight yaw turns, so it is relative to the "
                        "airframe; it is added to the flight yaw",
                        vehicle,
                    )
                )
                return flight + np.where(np.isfinite(gimbal), gimbal, 0.0), "flight yaw + gimbal yaw"
            findings.append(
                Finding(
                    "yaw-ambiguous",
                    f"gimbal yaw and flight yaw are {apart:.0f} degrees apart; the gimbal's is taken, "
                    "the pictures have to confirm it",
                    vehicle,
                )
            )
        elif stays and known:  # flying north: both agree anyway, but the camera model is known
            return flight + np.where(np.isfinite(gimbal), gimbal, 0.0), "flight yaw + gimbal yaw"
    return np.where(np.isfinite(gimbal), gimbal, flight), origin


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
        findings.append(
            Finding(
                "yaw-inconsistent",
                f"the yaw turns with the course between {plural(turned, 'pair')} of legs and stays between "
                f"{stayed}; a yaw turned by 180 degrees on some legs is likely, the pictures have to tell",
                vehicle,
            )
        )
    for leg in legs:
        run = yaw_deg[leg.first : leg.last + 1]
        jumps = np.abs(wrap_deg(np.diff(run[np.isfinite(run)]))) > 150.0
        if jumps.any():
            findings.append(
                Finding("yaw-jump", "the yaw turns by 180 degrees within a straight leg; the pictures decide", vehicle)
            )
            break
    return findings


def _circular_mean_deg(angle: Array) -> float:
    known = np.radians(angle[np.isfinite(angle)])
    return float(np.degrees(np.angle(np.exp(1j * known).sum()))) if len(known) else float("nan")


def _note_oblique(pitch: Array, findings: list[Finding], vehicle: str) -> None:
    known = pitch[np.isfinite(pitch)]
    if len(known) == 0:
        return
    off = float(np.median(np.abs(known + 90.0)))
    if off > 5.0:
        findings.append(
            Finding("oblique", f"the camera looks {off:.0f} degrees off nadir (median of the recorded pitch)", vehicle)
        )
