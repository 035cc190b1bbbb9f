"""Cameras by their records alone: the real-time stage's exterior orientation (paper III.B), with defaults for gaps.

Positions as recorded, an assumed field of view (theta-hat) where no tag gives one, straight down where no attitude is
recorded, yaw from the course flown where none is recorded. A warning names what was assumed.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.camera import NADIR_PITCH_RAD, Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.model.earth import on_sphere
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.frame import (
    DEFAULT_HEIGHT_M,
    TAGGED_TILT_SIGMA,
    THETA_HAT_DEG,
    UNSTATED_SIGMA_M,
    Frame,
    Ingest,
    Rejection,
)
from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.model.placement import PlacedFrame
from orthoswarm.trajectory.legs import MOVED_M, course

_USUAL_HEIGHTS_M: Final = (50.0, 150.0)
"""Heights between which mapping flights are flown: where the photos' spacing gives a height."""
_USUAL_OVERLAP: Final = 0.75  # forward overlap as flight planners propose it: it makes spacing a height
_FAR_M: Final = 20_000.0  # a position this far from the median of its set cannot be true: no small drone flies farther
_FAR_SPREADS: Final = 10.0  # ... and so many times the median distance: a set may be larger than that
_LARGEST_AREA_M: Final = 100_000.0  # no position lies farther from where most are, however they spread
_UNTAGGED_TILT_SIGMA: Final = 0.1  # tilt without a recorded attitude: 6 degrees of sway about straight down


@dataclass(frozen=True, slots=True)
class Recorded:
    """Frames after the real-time stage.

    placed: in the order of the frames. rejected: frames whose position cannot be true. warnings: sentences that name
    what was assumed.
    """

    placed: list[PlacedFrame]
    rejected: list[Rejection]
    warnings: list[str]


def area_grid(frames: Sequence[Frame]) -> LocalGrid:
    """The UTM grid of the area that frames cover.

    Raises:
        InputError: if the positions lie outside UTM.
    """
    return LocalGrid(area_epsg([f.fix.lat_deg for f in frames], [f.fix.lon_deg for f in frames]))


def in_one_area(ingest: Ingest) -> Ingest:
    """Inputs without the frames that lie on another continent than most, by `_LARGEST_AREA_M`; they are rejected.

    Raises:
        InputError: as many lie in one place as in another.
    """
    frames = ingest.frames
    if len(frames) < 2:
        return ingest
    limit = _LARGEST_AREA_M
    at = on_sphere([f.fix.lat_deg for f in frames], [f.fix.lon_deg for f in frames])
    # Coarse cells first: many photos are compared with few places.
    _, first, cell, count = np.unique(
        np.floor(at / (0.1 * limit)), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    place = at[first]
    around = np.array([count[np.linalg.norm(place - p, axis=1) <= limit].sum() for p in place])
    best = int(np.argmax(around))
    away = np.linalg.norm(at - place[best], axis=1)
    far = away > limit
    if not far.any():
        return ingest
    rival = int(around[np.unique(cell.ravel()[far])].max())
    km = float(np.median(away[far])) / 1000
    if rival >= around[best]:
        raise InputError(
            f"{rival} of {len(frames)} photos lie about {km:,.0f} km from {around[best]} others, and nothing tells "
            "which are in the right place; correct the positions (a lost E or W, N or S, perhaps), or map the places "
            "one by one"
        )
    lost = [_far_from_others(frames[i], away[i] / 1000) for i in np.nonzero(far)[0].tolist()]
    kept = [f for f, is_far in zip(frames, far.tolist(), strict=True) if not is_far]
    elsewhere = Counter(rejection.vehicle for rejection in lost)
    named = ", ".join(f"{count} of {vehicle}" for vehicle, count in elsewhere.items())
    text = f"pictures that lie about {km:,.0f} km from the others are left out, {named}: map each place by itself"
    return replace(ingest, frames=kept, rejected=[*ingest.rejected, *lost], warnings=[*ingest.warnings, text])


def recorded_cameras(frames: Sequence[Frame], grid: LocalGrid, fov_rad: float | None = None) -> Recorded:
    """Place frames as recorded.

    frames: sorted by vehicle, then time. grid: the area's. fov_rad: theta-hat, an assumed horizontal field of view for
    all; None takes the pictures' tags, else the default.
    """
    lat = np.array([f.fix.lat_deg for f in frames])
    lon = np.array([f.fix.lon_deg for f in frames])
    ground = grid.to_grid(lat, lon)
    away = np.hypot(*(ground - np.median(ground, axis=0)).T)
    near = np.isfinite(away) & (away <= max(_FAR_M, _FAR_SPREADS * float(np.median(away))))
    rejected = [_far_from_others(frames[i], float(away[i]) / 1000) for i in np.nonzero(~near)[0].tolist()]
    convergence = grid.convergence_rad(lat, lon)
    placed: list[PlacedFrame] = []
    warnings: list[str] = []
    members: dict[str, list[int]] = {}
    for i in np.nonzero(near)[0].tolist():
        members.setdefault(frames[i].vehicle, []).append(i)
    for vehicle, index in members.items():
        own = [frames[i] for i in index]
        cameras, assumed = _vehicle(vehicle, own, ground[index], convergence[index], fov_rad)
        warnings += assumed
        placed += [
            PlacedFrame(frame, camera, "realtime", _sigma(frame, camera))
            for frame, camera in zip(own, cameras, strict=True)
        ]
    return Recorded(placed, rejected, warnings)


def hint_lone_photos(placed: Sequence[PlacedFrame]) -> list[Frame]:
    """Frames of recorded cameras; a vehicle's only photo gets the assumed field of view as its hint.

    The field of view of a flight is estimated from its own pictures; that of a single photo cannot be.
    """
    count = Counter(p.frame.vehicle for p in placed)
    return [
        replace(p.frame, fov_hint_rad=p.camera.lens.fov_rad) if count[p.frame.vehicle] == 1 else p.frame for p in placed
    ]


def _vehicle(
    vehicle: str, frames: Sequence[Frame], ground: Array, convergence: Array, fov_rad: float | None
) -> tuple[list[Camera], list[str]]:
    """Cameras of one vehicle's frames, and what was assumed."""
    warnings = []
    lenses = [_lens(frame, fov_rad) for frame in frames]
    heights = np.array([np.nan if f.fix.height_m is None else f.fix.height_m for f in frames])
    heights[~(heights > 0)] = np.nan
    if np.isnan(heights).any():
        known = heights[np.isfinite(heights)]
        filled = float(np.median(known)) if len(known) else usual_height(ground, lenses)
        if not len(known):
            warnings.append(
                f"{vehicle}: no photo has a height above ground; the real-time picture assumes {filled:.0f} m"
            )
        heights = np.where(np.isnan(heights), filled, heights)
    yaws = np.array([np.nan if f.fix.yaw_rad is None else f.fix.yaw_rad for f in frames]) - convergence
    if np.isnan(yaws).any():
        yaws = np.where(np.isnan(yaws), course(ground), yaws)
        warnings.append(
            f"{vehicle}: photos without a heading are assumed to point along the flight"
            if len(frames) > 1
            else f"{vehicle}: its only photo has no heading and is assumed to point north"
        )
    pitches = np.array([NADIR_PITCH_RAD if f.fix.pitch_rad is None else f.fix.pitch_rad for f in frames])
    rolls = np.array([f.fix.roll_rad or 0.0 for f in frames])
    rotations = rotation_from_angles(yaws, pitches, rolls)
    positions = np.column_stack([ground, heights])
    return [Camera(p, r, lens) for p, r, lens in zip(positions, rotations, lenses, strict=True)], warnings


def _lens(frame: Frame, fov_rad: float | None) -> Lens:
    if fov_rad is None and frame.fov_hint_rad:
        return Lens(frame.width, frame.height, focal_px(frame.fov_hint_rad, frame.width))
    # theta-hat belongs to the longer side, so that a portrait picture of the same camera has the same focal length
    long_side = max(frame.width, frame.height)
    return Lens(frame.width, frame.height, focal_px(fov_rad or float(np.radians(THETA_HAT_DEG)), long_side))


def usual_height(ground: Array, lenses: Sequence[Lens]) -> float:
    """The height at which consecutive photos would overlap as usual, for a vehicle without recorded heights, metres."""
    if len(ground) < 3:
        return DEFAULT_HEIGHT_M
    step = float(np.median(np.hypot(*np.diff(ground, axis=0).T)))
    short = float(np.median([min(lens.width, lens.height) / lens.focal_px for lens in lenses]))
    if step <= MOVED_M:
        return DEFAULT_HEIGHT_M
    return float(np.clip(step / (1.0 - _USUAL_OVERLAP) / short, *_USUAL_HEIGHTS_M))


def _sigma(frame: Frame, camera: Camera) -> float:
    """One sigma of the ground point at the photo's centre, metres."""
    position = frame.fix.position_sigma_m or UNSTATED_SIGMA_M
    share = _UNTAGGED_TILT_SIGMA if frame.fix.pitch_rad is None else TAGGED_TILT_SIGMA
    return float(np.hypot(position, share * float(camera.position[2])))


def _far_from_others(frame: Frame, away_km: float) -> Rejection:
    where = f"{away_km:,.0f} km from the others" if np.isfinite(away_km) else "on the other side of the world"
    reason = "its position is far from the others; correct it or map it by itself"
    return Rejection(frame.image, reason, frame.vehicle, frame.time_s, detail=where)


def nothing_to_map(ingest: Ingest) -> OrthoSwarmError:
    """Why inputs without a single frame cannot be mapped: wrong inputs, or pictures that lack their positions."""
    if not ingest.rejected:
        return InputError("no picture was found in the input; name a folder of photos or a video")
    reason, count = Counter(r.reason for r in ingest.rejected).most_common(1)[0]
    said = f"none of the {len(ingest.rejected)} pictures can be used; {count} of them: {reason}"
    if not ingest.unpositioned:
        return InputError(said)
    return OrthoSwarmError(
        f"{said}; or mark at least two surveyed points in them (--control), "
        "say where they were taken, with a basemap (--near, --basemap), or make a picture without coordinates of them "
        "(--unreferenced)"
    )
