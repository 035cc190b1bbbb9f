"""First focal length and headings, by comparing the pictures' flow with the distance flown.

The ground scale comes from the distance flown, never from an altitude, which may be wrong; headings that contradict the
flow (a yaw tag that flips) are corrected.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Complex, Gray, Indices, Ints
from orthoswarm.model.camera import fov_rad
from orthoswarm.model.frame import DEFAULT_HEIGHT_M
from orthoswarm.model.robust import mad_sigma
from orthoswarm.refine.bundle.flight_records import FlightRecords

_CALIBRATION_PAIRS: Final = 24  # about so many pairs of pictures of a flight, evenly over its legs (its cost)
_CALIBRATION_PAIRS_PER_LEG: Final = 3  # ... at least so many of each leg
_CALIBRATION_FLOW_SHARE: Final = 0.2  # expected flow of a pair, as a share of the picture's rows
_CALIBRATION_SPAN_PHOTOS: Final = 8  # a pair lies no more photos apart
_CALIBRATION_REDUCED_FROM_PX: Final = 400  # pictures of more columns are halved first (its cost)
_CALIBRATION_RESPONSE: Final = 0.03  # least response of the pair's phase correlation
_CALIBRATION_LEAST_PREDICTED_PX: Final = 2.0  # a pair with less predicted flow gives no scale
_CALIBRATION_LEAST_FLOW_PX: Final = 1.0  # a pair with less measured flow gives no scale
_CALIBRATION_RATIO: Final = 10.0  # measured over predicted flow beyond this factor, either way, is a wrong peak
_CALIBRATION_FOV_DEG: Final = (35.0, 135.0)  # a focal length outside these fields of view does not exist
_CALIBRATION_LEAST_HEIGHT_M: Final = 3.0  # a median recorded height below this is none: the takeoff's, or a missing one
_CALIBRATION_SIGMA: Final = 0.03  # relative sigma of the focal length by flow: receivers drift and lag by some per cent
_HEADING_RATIO: Final = 0.25  # pairs whose flow differs from the median by more than this share give no heading
_HEADING_LEAST_PAIRS: Final = 3  # fewest pairs of a leg that give its heading
_HEADING_SPREAD_DEG: Final = 20.0  # without a recorded yaw the flow gives headings where its pairs agree to this
_HEADING_WRONG_DEG: Final = 40.0  # a recorded yaw that is off by more is corrected
_HEADING_WRONG_SPREAD_DEG: Final = 8.0  # ... if the pairs agree to this
_HEADING_FLIP_DEG: Final = 150.0  # from here on it is said to be turned by 180 degrees (words only)


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Focal length and headings of one vehicle from the pictures' flow.

    Attributes:
        focal_px: focal length in working pixels. height_m: height above ground consistent with it.
        yaw_offset: float64 (N,), to be added to the recorded yaw (radians): flips, and headings taken from the course.
        trusted_height: False if the recorded height had to be replaced. pairs: number of picture pairs with a result.
        spread: robust relative sigma of the pairs' results, infinite if there are too few.
    """

    focal_px: float
    height_m: float
    yaw_offset: Array
    trusted_height: bool
    pairs: int
    warnings: list[str]
    spread: float = float("inf")

    @property
    def focal_sigma(self) -> float:
        """Relative sigma of the focal length."""
        return float(np.hypot(_CALIBRATION_SIGMA, self.spread / np.sqrt(max(self.pairs, 1))))


def calibrate(
    records: FlightRecords, leg: Ints, gray: Callable[[int], Gray], size: tuple[int, int], fov_start: float
) -> Calibration:
    """Compare the flow of picture pairs along each leg with the flow that the records predict.

    leg: int32 (N,), -1 in turns. gray: picture at working scale. size: its (width, height). fov_start: assumed
    horizontal field of view, radians.
    """
    width = size[0]
    f0 = 0.5 * width / np.tan(0.5 * fov_start)
    h0 = float(np.median(records.position[:, 2]))
    usable = h0 > _CALIBRATION_LEAST_HEIGHT_M and bool(records.has_height.any())
    if not usable:
        h0 = DEFAULT_HEIGHT_M
    rotation = records.rotation()
    legs = [np.flatnonzero(leg == k) for k in range(int(leg.max()) + 1)] if len(leg) else []
    per_leg = max(_CALIBRATION_PAIRS_PER_LEG, _CALIBRATION_PAIRS // max(len(legs), 1))
    ratios: list[complex] = []
    owners: list[int] = []
    for k, members in enumerate(legs):
        for a, b in _pairs(records, members, f0 / h0, size[1], per_leg):
            move = records.position[b] - records.position[a]
            ratio = _flow_ratio(gray(a), gray(b), rotation[a], rotation[b], move=move, focal=f0, height=h0)
            if ratio is not None:
                ratios.append(ratio)
                owners.append(k)
    if len(ratios) < 2:
        return Calibration(
            focal_px=f0, height_m=h0, yaw_offset=np.zeros(len(leg)), trusted_height=usable, pairs=len(ratios),
            warnings=[],
        )  # fmt: skip
    r = np.array(ratios)
    offset, warnings = _heading(records, leg, r, np.array(owners))
    factor = np.abs(r)
    scale = float(np.median(factor))
    narrowest, widest = np.radians(_CALIBRATION_FOV_DEG)
    by_lens = usable and narrowest < fov_rad(f0 * scale, width) < widest  # else the height is wrong
    if usable and not by_lens:
        warnings.append(
            f"the recorded height of {h0:.0f} m contradicts the pictures and the path; {h0 / scale:.0f} m is assumed"
        )
    return Calibration(
        focal_px=f0 * scale if by_lens else f0,
        height_m=h0 if by_lens else h0 / scale,
        yaw_offset=offset,
        trusted_height=by_lens,
        pairs=len(r),
        warnings=warnings,
        spread=mad_sigma(factor / scale - 1.0),
    )


def _heading(records: FlightRecords, leg: Ints, ratio: Complex, owner: Array) -> tuple[Array, list[str]]:
    """Offset to the recorded yaw of each frame: legs whose yaw is flipped, or headings taken from the course."""
    offset = np.zeros(len(leg))
    warnings: list[str] = []
    angle = -np.angle(ratio)  # a flow rotated against its prediction means a camera rotated the other way
    usual = float(np.median(np.abs(ratio)))
    wrong = np.radians(_HEADING_WRONG_DEG)
    for k in range(int(leg.max()) + 1):
        mine = angle[(owner == k) & (np.abs(np.abs(ratio) / usual - 1.0) < _HEADING_RATIO)]
        last = 0.0
        if len(mine) >= _HEADING_LEAST_PAIRS:
            turn = float(np.angle(np.median(np.cos(mine)) + 1j * np.median(np.sin(mine))))
            spread = float(np.median(np.abs(wrap_rad(mine - turn))))
            if not records.has_yaw.any() and spread < np.radians(_HEADING_SPREAD_DEG):
                last = turn
            elif abs(turn) > wrong and spread < np.radians(_HEADING_WRONG_SPREAD_DEG):
                last = turn
                flipped = abs(turn) > np.radians(_HEADING_FLIP_DEG)
                what = "turned by 180 deg" if flipped else f"off by {np.degrees(turn):.0f} deg"
                first = int(np.flatnonzero(leg == k)[0])
                warnings.append(
                    f"the yaw tags of the leg from frame {first} on are {what}; corrected from the pictures"
                )
        offset[leg == k] = last
    inside, turns = np.flatnonzero(leg >= 0), np.flatnonzero(leg < 0)
    if len(inside) and len(turns):
        offset[turns] = offset[inside[np.abs(inside[None, :] - turns[:, None]).argmin(1)]]
    return offset, warnings


def _pairs(records: FlightRecords, members: Indices, px_per_m: float, rows: int, most: int) -> list[tuple[int, int]]:
    """At most so many pairs along a leg, as far apart as gives the wished flow."""
    if len(members) < 2:
        return []
    step = float(np.median(np.hypot(*np.diff(records.position[members, :2], axis=0).T)))
    if step <= 1e-3:
        return []
    longest = max(1, min(_CALIBRATION_SPAN_PHOTOS, len(members) - 1))
    span = int(np.clip(round(_CALIBRATION_FLOW_SHARE * rows / (px_per_m * step)), 1, longest))
    starts = np.unique(np.linspace(0, len(members) - 1 - span, most).astype(int))
    return [(int(members[s]), int(members[s + span])) for s in starts if s >= 0]


def _flow_ratio(
    first: Gray, second: Gray, ra: Array, rb: Array, *, move: Array, focal: float, height: float
) -> complex | None:
    """Measured flow divided by predicted flow, complex (scale and rotation); None without agreement."""
    shape = first.shape
    if second.shape != shape or not np.isfinite(move).all():
        return None
    centre = np.array([0.0, 0.0, 1.0])
    turned = rb.T @ ra @ centre
    spin = focal * turned[:2] / max(turned[2], 0.2)  # flow caused by rotation alone
    shift = -focal / height * (rb.T @ move)[:2]
    factor = 0.5 if shape[1] > _CALIBRATION_REDUCED_FROM_PX else 1.0
    dx, dy, response = phase_shift(first, second, factor)
    if response < _CALIBRATION_RESPONSE:
        return None
    flow = complex(dx / factor - spin[0], dy / factor - spin[1])
    expected = complex(shift[0], shift[1])
    if abs(expected) < _CALIBRATION_LEAST_PREDICTED_PX or abs(flow) < _CALIBRATION_LEAST_FLOW_PX:
        return None
    ratio = flow / expected
    return ratio if 1.0 / _CALIBRATION_RATIO < abs(ratio) < _CALIBRATION_RATIO else None


def phase_shift(first: Gray, second: Gray, factor: float) -> tuple[float, float, float]:
    """Shift (columns, rows) between two pictures reduced by a factor, and the response of their phase correlation."""
    a, b = (
        cv2.resize(g, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA).astype(np.float32)
        for g in (first, second)
    )
    (dx, dy), response = cv2.phaseCorrelate(a, b, cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F))
    return dx, dy, response
