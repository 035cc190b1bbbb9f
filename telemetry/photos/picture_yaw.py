"""The yaw measured in pictures: one match of neighbours on each straight leg.

The camera moves along the leg's course; the direction in which the ground moves through the picture gives the
azimuth of the picture's up direction. Accurate to a few degrees, which is enough to find a yaw that is flipped or
belongs to the airframe instead of the camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.angles import wrap_deg
from orthoswarm.model.frame import Frame
from telemetry.photos.flight_checks import track_of
from telemetry.photos.picture_motion import PictureFile, centre_shift, features
from telemetry.samples.course import Straight, straight_legs
from telemetry.samples.findings import Finding, plural

Array = NDArray[np.float64]

_YAW_PAIRS_A_LEG: Final = 3  # pairs of pictures by which the recorded yaw of a leg is checked
_YAW_LEAST_STEP_M: Final = 1.0  # distance flown between such pictures at least (receivers' noise)


@dataclass(frozen=True, slots=True)
class SeenHeading:
    """The yaw measured on a leg.

    Attributes:
        leg: the straight run. pair: indices of the pictures that were matched. inliers: matches that agree.
        yaw_deg: azimuth of the second picture's up direction.
    """

    leg: Straight
    pair: tuple[int, int]
    inliers: int
    yaw_deg: float


def seen_headings(frames: Sequence[Frame], *, most_legs: int = 12) -> list[SeenHeading]:
    """Yaw of each straight leg of a vehicle, measured in its pictures; legs that cannot be matched are left out."""
    ground = track_of(frames)
    legs = straight_legs(ground)
    if len(legs) > most_legs:
        legs = [legs[i] for i in np.linspace(0, len(legs) - 1, most_legs).round().astype(int)]
    found: list[SeenHeading] = []
    for leg in legs:
        middle = (leg.first + leg.last) // 2
        order = sorted(range(leg.first, leg.last), key=lambda i: abs(i - middle))
        for i in order[:_YAW_PAIRS_A_LEG]:
            seen = _match(frames[i], frames[i + 1], ground[i + 1] - ground[i])
            if seen is not None:
                found.append(SeenHeading(leg, (i, i + 1), seen[1], seen[0]))
                break
    return found


def _match(a: Frame, b: Frame, moved: Array) -> tuple[float, int] | None:
    """Yaw of the second picture in degrees and how many matches agree; None if the two cannot be matched."""
    if np.hypot(*moved) < _YAW_LEAST_STEP_M:
        return None
    one, two = (features(PictureFile(f.path, f.width, f.height)) for f in (a, b))
    matched = centre_shift(one, two) if one is not None and two is not None else None
    if matched is None:
        return None
    shift, count = matched.pixels, matched.inliers
    if np.hypot(*shift) < 4.0:
        return None
    # In the second picture the first one's centre lies in the direction the camera came from; up is opposite to the
    # rows.
    to_the_right_of_up = np.degrees(np.arctan2(-shift[0], shift[1]))
    course = np.degrees(np.arctan2(moved[0], moved[1]))
    return wrap_deg(float(course - to_the_right_of_up)), count


def heading_findings(frames: Sequence[Frame], vehicle: str) -> list[Finding]:
    """Contradictions between recorded yaw and pictures, leg by leg."""
    seen = [h for h in seen_headings(frames) if frames[h.pair[1]].fix.yaw_rad is not None]
    if not seen:
        return []
    recorded = np.array([np.degrees(frames[h.pair[1]].fix.yaw_rad or 0.0) for h in seen])
    apart = wrap_deg(recorded - np.array([h.yaw_deg for h in seen]))
    turned = np.abs(apart) > 130.0
    found: list[Finding] = []
    if turned.any():
        numbers = ", ".join(
            f"{frames[h.leg.first].image} to {frames[h.leg.last].image}" for h, t in zip(seen, turned) if t
        )
        found.append(
            Finding(
                "yaw-flip",
                "the recorded yaw is turned by 180 degrees against the pictures on "
                f"{plural(int(turned.sum()), 'leg')} of {len(seen)} ({numbers})",
                vehicle,
            )
        )
    rest = apart[~turned]
    if len(rest) and np.median(np.abs(rest)) > 25.0:
        found.append(
            Finding(
                "yaw-wrong",
                f"the recorded yaw is {float(np.median(np.abs(rest))):.0f} degrees off what the pictures show (median)",
                vehicle,
            )
        )
    elif len(rest):
        found.append(
            Finding(
                "yaw-confirmed",
                f"the pictures confirm the recorded yaw on {plural(len(rest), 'leg')} "
                f"within {float(np.abs(rest).max()):.0f} degrees",
                vehicle,
                note=True,
            )
        )
    return found
