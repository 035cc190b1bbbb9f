"""Messages for the report: contradictions between pictures and records."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Flags
from orthoswarm.model.frame import Frame
from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.height_consistency import log_focal_sigmas
from orthoswarm.refine.initial.initial_orientation import InitialOrientation
from orthoswarm.refine.initial.planar_similarity import PhotoRecords

_FLIPPED_YAW_DEG: Final = 150.0  # a recorded yaw that differs by more is reported as turned by 180 degrees
_HEADING_OFFSET_DEG: Final = 5.0  # a larger common offset of recorded headings is reported
_TILT_DIFFERENCE_DEG: Final = 2.0  # a larger difference of recorded tilts is reported
_TILT_DIFFERENCE_SIGMAS: Final = 3.0  # ... if it exceeds so many of its sigmas
_ONE_WAY_LENGTH: Final = 0.9  # mean unit vector of headings from which a tilt is like a slope of the ground
_SLOPE_DEG: Final = 6.0  # then a difference of tilts is reported only above this
_HEIGHT_DIFFERENCE_SHARE: Final = 0.15  # a recorded height that differs by more is reported, as a share
_HEIGHT_DIFFERENCE_SIGMAS: Final = 4.0  # ... and by more than so many sigmas of the focal length
_LEAST_HEIGHT_M: Final = 2.0  # a recorded height below this cannot be meant and is reported
_LAG_M: Final = 1.0  # a lag of recorded positions that moves them by more is reported
_LAG_LEAST_SPEED_M_S: Final = 0.3  # a lag is not estimated from slower photos, metres a second
NAMED_MOST: Final = 3  # runs of photos, or vehicles, that a message names


def findings(frames: Sequence[Frame], records: PhotoRecords, start: InitialOrientation) -> list[str]:
    """Sentences on records that contradict the pictures, except heights (see `height_findings`)."""
    kinds = (_yaw_findings, _tilt_findings, _position_findings)
    found = [text for kind in kinds for text in kind(frames, records, start)]
    parts = int((np.bincount(start.component) > 1).sum())
    if parts > 1:
        found.append(f"the photos fall into {parts} parts without overlap; each lies in the frame of its own positions")
    return found


def runs(names: Sequence[str], flags: Flags) -> str:
    """Runs of flagged photos as text: "A to C, F"."""
    edge = np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))
    first, last = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1) - 1
    parts = [
        names[int(a)] if a == b else f"{names[int(a)]} to {names[int(b)]}" for a, b in zip(first, last, strict=True)
    ]
    text = ", ".join(parts[:NAMED_MOST])
    return text if len(parts) <= NAMED_MOST else f"{text} and {len(parts) - NAMED_MOST} more runs"


def _name(frames: Sequence[Frame], records: PhotoRecords, vehicle: int) -> str:
    return frames[int(np.argmax(records.vehicle == vehicle))].vehicle


def _yaw_findings(frames: Sequence[Frame], records: PhotoRecords, start: InitialOrientation) -> list[str]:
    found = []
    flipped = np.zeros(len(records), bool)
    for v, tag in enumerate(start.tags):
        rows = (records.vehicle == v) & start.yaw_known
        who = _name(frames, records, v)
        if tag.source:
            off = np.abs(wrap_rad(start.yaw - getattr(records, tag.source) - tag.offset))
            flipped |= rows & (np.nan_to_num(off) > np.radians(_FLIPPED_YAW_DEG))
        if not tag.source and (rows & np.isfinite(records.yaw)).sum() >= 3:
            found.append(f"{who}: the recorded yaw does not follow the pictures; headings come from the pictures")
        elif tag.source and abs(np.degrees(tag.offset)) > _HEADING_OFFSET_DEG:
            found.append(f"{who}: recorded headings are {-np.degrees(tag.offset):+.0f} degrees off, put right")
        elif tag.source == "flight_yaw" and np.isfinite(records.yaw[rows]).any():
            found.append(f"{who}: the pictures follow the airframe's heading, not the recorded camera yaw")
    if flipped.any():
        where = runs([f.image for f in frames], flipped)
        text = f"the recorded yaw is turned by 180 degrees on {int(flipped.sum())} photos ({where})"
        found.insert(0, text)
    return found


def tilt_of(level: Array) -> Array:
    """Angle between optical axis and nadir, float64 (N,) radians, of camera-to-level rotations (N, 3, 3)."""
    return np.asarray(np.arccos(np.clip(level[:, 2, 2], -1.0, 1.0)))


def _tilt_findings(frames: Sequence[Frame], records: PhotoRecords, start: InitialOrientation) -> list[str]:
    found = []
    tagged = records.tag_level()
    between = np.degrees(tilt_of(np.asarray(start.level @ np.swapaxes(tagged, 1, 2))))
    for v in range(len(start.tags)):
        rows = records.vehicle == v
        sigma = np.degrees(start.tilt_sigma[records.segment[rows]].max())
        off, seen = float(np.median(between[rows])), float(np.degrees(np.median(tilt_of(start.level[rows]))))
        who = _name(frames, records, v)
        one_way = abs(np.exp(1j * start.yaw[rows]).mean()) > _ONE_WAY_LENGTH
        if off < max(_SLOPE_DEG if one_way else _TILT_DIFFERENCE_DEG, _TILT_DIFFERENCE_SIGMAS * sigma):
            continue
        tag = float(np.degrees(np.median(tilt_of(tagged[rows]))))
        if not np.isfinite(records.pitch[rows]).any():
            found.append(f"{who}: the camera looks {seen:.0f} degrees off nadir; no tag says so")
        elif abs(seen - tag) > 0.5 * off:
            found.append(f"{who}: the camera looks {seen:.0f} degrees off nadir where tags say {tag:.0f}")
        else:
            found.append(f"{who}: recorded pitch and roll are {off:.0f} degrees off")
    return found


def height_findings(
    frames: Sequence[Frame], records: PhotoRecords, start: InitialOrientation, adjustment: Adjustment
) -> list[str]:
    """Sentences on recorded heights that contradict pictures adjusted without a map, and on those not recorded."""
    found, without = [], []
    height = adjustment.cameras.position[:, 2] - adjustment.ground_m
    doubt = log_focal_sigmas(adjustment)[adjustment.cameras.lens_id]
    for v in range(len(start.tags)):
        rows = records.vehicle == v
        who = _name(frames, records, v)
        recorded, seen = records.height_m[rows], float(np.median(height[rows]))
        if not start.scale_known[int(records.lens[rows][0])]:
            continue
        if not np.isfinite(recorded).any():
            without.append((who, seen))
            continue
        said = float(np.nanmedian(recorded))
        limit = max(_HEIGHT_DIFFERENCE_SHARE, _HEIGHT_DIFFERENCE_SIGMAS * float(doubt[rows][0]))
        if said <= _LEAST_HEIGHT_M or abs(np.log(max(seen, 1.0) / said)) > limit:
            found.append(contradiction(who, said, seen))
    if without:
        names = ", ".join(who for who, _ in without[:NAMED_MOST]) + (" and others" if len(without) > NAMED_MOST else "")
        seen = float(np.median([height for _, height in without]))
        found.append(f"{names}: no height is recorded; {seen:.0f} m come from metres per pixel")
    return found


def contradiction(who: str, said_m: float, seen_m: float) -> str:
    """Sentence on a recorded height that contradicts the pictures."""
    return f"{who}: the recorded height of {said_m:.0f} m contradicts the pictures, which say {seen_m:.0f} m"


def _position_findings(frames: Sequence[Frame], records: PhotoRecords, start: InitialOrientation) -> list[str]:
    found = []
    off = ~start.gps_ok
    if off.any():
        worst = float(np.abs(start.gps_residual[off]).max())
        names = runs([f.image for f in frames], off)
        found.append(f"recorded positions of {int(off.sum())} photos are up to {worst:.0f} m off ({names}); replaced")
    speed = np.abs(records.velocity())
    for v, lag in enumerate(start.lag.tolist()):
        rows = records.vehicle == v
        moving = speed[rows & (speed > _LAG_LEAST_SPEED_M_S)]
        if len(moving) and abs(lag) * float(np.median(moving)) > _LAG_M:
            found.append(f"{_name(frames, records, v)}: recorded positions lag by {lag:.1f} s")
    return found
