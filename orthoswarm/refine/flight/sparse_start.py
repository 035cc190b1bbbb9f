"""Start values, tracks and priors for the adjustment of sparse photos.

For photos that overlap too little or too irregularly for tracking: forward overlap under about
80 %, corners, crosshatches, several sorties. Tags are evidence; the pictures decide.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Flags, Ints
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.task_runner import Progress, Run, serial
from orthoswarm.refine.bundle.block_arrays import HEIGHT, K1, WIDTH, CameraBlock, F, Tracks
from orthoswarm.refine.features.pair_matching import Pair
from orthoswarm.refine.features.sift_features import Features
from orthoswarm.refine.features.track_chaining import build_tracks, thin_tracks
from orthoswarm.refine.flight.record_findings import findings, unplaced_reasons
from orthoswarm.refine.initial.initial_orientation import InitialOrientation, find_initial_orientation
from orthoswarm.refine.initial.lens_groups import lens_per_vehicle, split_unlike_lenses
from orthoswarm.refine.initial.pair_graph import PairGraphBuilder, ReadGray, build_pair_graph
from orthoswarm.refine.initial.planar_network import LAG_SPREAD_S
from orthoswarm.refine.initial.planar_similarity import PhotoRecords
from orthoswarm.refine.initial.relative_scale import focal_by_hint
from orthoswarm.refine.initial.segments import split_segments

_SPARSE_OUTLIER_SIGMA_M: Final = 5.0  # sigma of a position by the network of pairs for an outlying receiver
_SPARSE_STATED_FLOOR_M: Final = 0.03  # added in squares to the sigma of a position that states its own
_SPARSE_POSITION_SIGMA_M: Final = 1.0
"""Sigma of a recorded position across the way; along the way a varying lag is added, so that it is less than that of
other flights (`records.position_sigma_m`). Measured on two flights with photos 75 m apart: with 1.0 and 1.5 ground is
0.91 and 0.97 m off under hard noise, 0.72 and 0.72 m under usual noise; on the map 0.037 m both."""
_SPARSE_STATED_HEIGHT_FLOOR_M: Final = 0.05  # least sigma of a height whose position states its sigma
_SPARSE_HEIGHT_SIGMA_M: Final = 0.3  # sigma of a recorded height about the common offset
_SPARSE_FREE_HEIGHT_SIGMA_M: Final = 1.5  # sigma of a height that was not recorded, about the common one


@dataclass(frozen=True, slots=True, kw_only=True)
class SparseStart:
    """Everything that the adjustment of N photos needs, in a local frame; pixels are those of the full pictures.

    Attributes:
        cameras: start values. tracks: observations of points, length 2 to 20.
        segment: int32 (N,), attitude bias, height offset and lag are common to a segment.
        component: int32 (N,), connected part of the pair graph, the largest is 0.
        position_prior: float64 (N, 3), recorded positions; the network's position where the record is an outlier.
        position_sigma: float64 (N, 3), one sigma east, north, up. height_known: bool (N,), whether heights are recorded
            and possible. velocity: float64 (N, 2), metres per second.
        log_focal: float64 (L,) by the tags (75 degrees without), pixels. log_focal_sigma: float64 (L,).
        placed: bool (N,), False where a photo has no tie points to others. reasons: photo -> why not.
        damaged: photos that cannot be decoded.
        metres_per_pixel: float64 (N,). warnings: for the report. plane: the planar start values.
        records: what the photos recorded. pairs: pairs tried and matched.
    """

    cameras: CameraBlock
    tracks: Tracks
    segment: Ints
    component: Ints
    position_prior: Array
    position_sigma: Array
    height_known: Flags
    velocity: Array
    log_focal: Array
    log_focal_sigma: Array
    placed: Flags
    reasons: dict[int, str]
    damaged: frozenset[int]
    metres_per_pixel: Array
    warnings: list[str]
    plane: InitialOrientation
    records: PhotoRecords
    pairs: tuple[int, int]


def read_photo_records(
    frames: Sequence[Frame], grid: LocalGrid, origin: Array, *, share_lenses: bool = False
) -> PhotoRecords:
    """What frames recorded, as arrays in the local frame.

    Args:
        frames: photos of one or several vehicles, of a vehicle in order of time.
        grid: the area's grid.
        origin: float64 (2,), grid coordinates of the local frame's origin.
        share_lenses: True: vehicles with the same camera name and picture size share one lens.
    """
    lat, lon = (np.array([getattr(f.fix, name) for f in frames], float) for name in ("lat_deg", "lon_deg"))
    xy = grid.to_grid(lat, lon) - origin[:2]
    convergence = grid.convergence_rad(lat, lon)
    units = [(f.vehicle, f.camera, f.width, f.height) for f in frames]
    vehicle = _numbers(units)
    lens = _numbers([unit[1:] for unit in units]) if share_lenses else vehicle
    height, altitude = _column(frames, "height_m"), _column(frames, "altitude_m")
    pitch = _column(frames, "pitch_rad")
    time_s = np.array([np.nan if f.time_s is None else f.time_s for f in frames], float)
    level = np.where(np.isfinite(height), height, altitude)
    hints = [[f.fov_hint_rad for f, k in zip(frames, lens) if k == n] for n in range(int(lens.max()) + 1)]
    return PhotoRecords(
        position=xy[:, 0] + 1j * xy[:, 1],
        position_sigma=_column(frames, "position_sigma_m"),
        time_s=time_s,
        height_m=height,
        altitude_m=altitude,
        yaw=_column(frames, "yaw_rad") - convergence,
        flight_yaw=_column(frames, "flight_yaw_rad") - convergence,
        pitch=pitch,
        roll=_column(frames, "roll_rad"),
        lens=lens,
        segment=split_segments(vehicle, time_s, level, pitch),
        vehicle=vehicle,
        width=np.array([f.width for f in frames], float),
        rows=np.array([f.height for f in frames], float),
        fov_hint=np.array([_median([h for h in group if h is not None]) for group in hints]),
    )


def sparse_start(
    frames: Sequence[Frame],
    records: PhotoRecords,
    read_gray: ReadGray,
    run: Run = serial,
    progress: Progress | None = None,
) -> SparseStart:
    """Match photos with each other and find start values of all of them.

    Args:
        frames: N photos, of a vehicle in order of time.
        records: see `read_photo_records`.
        read_gray: returns a photo's grey values, uint8 (rows, columns), at any size (reduced decoding saves time); may
            raise PictureError.
        run: executes the feature and matching tasks; the result does not depend on it.
        progress: called with stage, number done, total.
    """
    builder = PairGraphBuilder(frames=frames, records=records, read_gray=read_gray, run=run, progress=progress)
    start = build_pair_graph(builder)
    if len(records.fov_hint) <= int(records.vehicle.max()):  # vehicles share lenses by name
        alone = find_initial_orientation(lens_per_vehicle(records), builder.pairs(), builder.features)
        records = split_unlike_lenses(records, alone)
        if records is not builder.records:
            start = find_initial_orientation(records, builder.pairs(), builder.features)
    return assemble(
        frames,
        records,
        builder.features,
        pairs=builder.pairs(),
        start=start,
        damaged=builder.damaged,
        tried=len(builder.tried),
    )


def assemble(
    frames: Sequence[Frame],
    records: PhotoRecords,
    features: Sequence[Features],
    *,
    pairs: Sequence[Pair],
    start: InitialOrientation,
    damaged: Mapping[int, str],
    tried: int,
) -> SparseStart:
    """Assemble the start of the adjustment.

    Args:
        frames: N photos.
        records: what they recorded.
        features: of each photo.
        pairs: E matched pairs.
        start: initial orientation from these pairs.
        damaged: photos that could not be read -> reason.
        tried: number of pairs tried.
    """
    trusted = [pair for pair, ok in zip(pairs, start.pair_ok, strict=True) if ok]
    tracks = thin_tracks(build_tracks(features, trusted), records.width, records.rows)
    position, sigma, known = _position_priors(records, start)
    log_focal, log_focal_sigma = focal_by_hint(records)
    held = np.zeros(len(frames), bool)
    held[np.unique(tracks.camera)] = True
    velocity = records.velocity()
    return SparseStart(
        cameras=_camera_block(records, start),
        tracks=tracks,
        segment=records.segment,
        component=start.component,
        position_prior=position,
        position_sigma=sigma,
        height_known=known,
        velocity=np.stack([velocity.real, velocity.imag], axis=1),
        log_focal=log_focal,
        log_focal_sigma=log_focal_sigma,
        placed=held,
        reasons=unplaced_reasons(frames, records, held, damaged),
        damaged=frozenset(damaged),
        metres_per_pixel=start.metres,
        warnings=findings(frames, records, start),
        plane=start,
        records=records,
        pairs=(tried, len(pairs)),
    )


def _camera_block(records: PhotoRecords, start: InitialOrientation) -> CameraBlock:
    position = np.stack([start.position.real, start.position.imag, start.height], axis=1)
    lens = np.zeros((len(start.focal), 8))
    first = [int(np.argmax(records.lens == k)) for k in range(len(start.focal))]
    lens[:, F], lens[:, K1] = start.focal, start.k1
    lens[:, WIDTH], lens[:, HEIGHT] = records.width[first], records.rows[first]
    return CameraBlock(position, start.rotation(), records.lens.astype(np.int32), lens)


def _position_priors(records: PhotoRecords, start: InitialOrientation) -> tuple[Array, Array, Flags]:
    """Recorded positions with their sigmas (N, 3) east, north, up, and where heights are recorded and possible.

    Positions with a stated sigma (RTK) lag by the same time in all photos, others by a varying time.
    """
    position = np.stack([records.position.real, records.position.imag, start.height], axis=1)
    known = np.isfinite(records.height_m) & np.isfinite(start.recorded_focal)[records.lens]
    position[known, 2] = records.height_m[known]
    velocity = records.velocity()
    stated = np.isfinite(records.position_sigma)
    across = np.where(stated, np.hypot(records.position_sigma, _SPARSE_STATED_FLOOR_M), _SPARSE_POSITION_SIGMA_M)
    along = np.where(stated, 0.0, LAG_SPREAD_S)
    recorded_up = np.where(stated, np.maximum(across, _SPARSE_STATED_HEIGHT_FLOOR_M), _SPARSE_HEIGHT_SIGMA_M)
    up = np.where(known, recorded_up, _SPARSE_FREE_HEIGHT_SIGMA_M)
    sigma = np.stack([np.hypot(across, along * velocity.real), np.hypot(across, along * velocity.imag), up], axis=1)
    off = ~start.gps_ok
    position[off, 0], position[off, 1] = start.position.real[off], start.position.imag[off]
    sigma[off, :2] = _SPARSE_OUTLIER_SIGMA_M
    return position, sigma, known


def _numbers(keys: Sequence[object]) -> Ints:
    order = {key: n for n, key in enumerate(dict.fromkeys(keys))}
    return np.array([order[key] for key in keys], np.int32)


def _column(frames: Sequence[Frame], name: str) -> Array:
    values = (getattr(f.fix, name) for f in frames)
    return np.array([np.nan if v is None else float(v) for v in values])


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")
