"""Start values, tracks and priors for the adjustment of sparse photos.

For photos that overlap too little or too irregularly for tracking: forward overlap under about
80 %, corners, crosshatches, several sorties. Tags are evidence; the pictures decide.

Thresholds without another source were chosen on four real flights.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array, Complex, Flags, Ints
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.robust import mad_sigma
from orthoswarm.model.task_runner import Progress, Run, serial
from orthoswarm.refine.bundle.block_arrays import HEIGHT, K1, WIDTH, CameraBlock, F, Tracks
from orthoswarm.refine.bundle.flight_records import column
from orthoswarm.refine.features.pair_matching import build_tracks, thin_tracks
from orthoswarm.refine.features.working_pictures import ReadGray
from orthoswarm.refine.flight.record_findings import findings
from orthoswarm.refine.initial.initial_orientation import InitialOrientation, find_initial_orientation
from orthoswarm.refine.initial.pair_graph import PairGraphBuilder, build_pair_graph
from orthoswarm.refine.initial.planar_network import LAG_SPREAD_S
from orthoswarm.refine.initial.planar_similarity import PhotoRecords
from orthoswarm.refine.initial.relative_scale import focal_by_hint
from orthoswarm.trajectory.legs import PAUSE_S

_SPARSE_OUTLIER_SIGMA_M: Final = 5.0  # sigma of a position by the network of pairs for an outlying receiver
_SPARSE_STATED_FLOOR_M: Final = 0.03  # added in squares to the sigma of a position that states its own
_SPARSE_POSITION_SIGMA_M: Final = 1.0
"""Sigma of a recorded position across the way; along the way a varying lag is added, so that it is less than that of
other flights (`records.position_sigma_m`). Measured on two flights with photos 75 m apart: with 1.0 and 1.5 ground is
0.91 and 0.97 m off under hard noise, 0.72 and 0.72 m under usual noise; on the map 0.037 m both."""
_SPARSE_STATED_HEIGHT_FLOOR_M: Final = 0.05  # least sigma of a height whose position states its sigma
_SPARSE_HEIGHT_SIGMA_M: Final = 0.3  # sigma of a recorded height about the common offset
_SPARSE_FREE_HEIGHT_SIGMA_M: Final = 1.5  # sigma of a height that was not recorded, about the common one
_UNLIKE_SIGMAS: Final = 2.5  # vehicles' focal lengths that differ by more sigmas are of two lenses
_UNLIKE_SHARE: Final = 0.06  # ... and by more than this share
_ONE_WAY_CONCENTRATION: Final = 0.9  # mean unit vector of headings from which shapes give no focal length
_SEGMENT_GAP_S: Final = 180.0  # a longer pause ends a segment: landing, battery
_SEGMENT_CLIMB_M: Final = 5.0  # a larger jump of the recorded height ends a segment
_SEGMENT_TILT_DEG: Final = 1.5  # A larger jump of the recorded tilt ends it: the gimbal was turned
_SEGMENT_JUMP_SIGMAS: Final = 5.0  # a jump must exceed so many sigmas of the record's own noise as well
_LEG_STILL_M: Final = 1.5  # shorter steps have no direction
_LEG_TURN_DEG: Final = 35.0  # a leg ends where a step leaves the mean of its steps by more than this


@dataclass(frozen=True, slots=True, kw_only=True)
class SparseStart:
    """Everything that the adjustment of N photos needs, in a local frame; pixels are those of the full pictures.

    Attributes:
        cameras: start values. tracks: observations of points, length 2 to 20.
        position_prior: float64 (N, 3), recorded positions; the network's position where the record is an outlier.
        position_sigma: float64 (N, 3), one sigma east, north, up. height_known: bool (N,), whether heights are recorded
            and possible. velocity: float64 (N, 2), metres per second.
        log_focal: float64 (L,) by the tags (75 degrees without), pixels. log_focal_sigma: float64 (L,).
        damaged: photos that cannot be used, and why.
        warnings: for the report. plane: the planar start values.
        records: what the photos recorded. pairs: pairs tried and matched.
    """

    cameras: CameraBlock
    tracks: Tracks
    position_prior: Array
    position_sigma: Array
    height_known: Flags
    velocity: Array
    log_focal: Array
    log_focal_sigma: Array
    damaged: dict[int, str]
    warnings: list[str]
    plane: InitialOrientation
    records: PhotoRecords
    pairs: tuple[int, int]


def read_photo_records(
    frames: Sequence[Frame], grid: LocalGrid, origin: Array, *, share_lenses: bool = False
) -> PhotoRecords:
    """What frames recorded, as arrays in the local frame with its origin (2,).

    frames: photos of one or several vehicles, of a vehicle in order of time. share_lenses: True: vehicles with the same
    camera name and picture size share one lens.
    """
    lat, lon = (np.array([getattr(f.fix, name) for f in frames], float) for name in ("lat_deg", "lon_deg"))
    xy = grid.to_grid(lat, lon) - origin[:2]
    convergence = grid.convergence_rad(lat, lon)
    units = [(f.vehicle, f.camera, f.width, f.height) for f in frames]
    vehicle = _numbers(units)
    lens = _numbers([unit[1:] for unit in units]) if share_lenses else vehicle

    def said(name: str) -> Array:
        return column([getattr(f.fix, name) for f in frames])

    height, altitude, pitch = said("height_m"), said("altitude_m"), said("pitch_rad")
    time_s = column([f.time_s for f in frames])
    level = np.where(np.isfinite(height), height, altitude)
    hints = [
        [f.fov_hint_rad for f, k in zip(frames, lens) if k == n and f.fov_hint_rad is not None]
        for n in range(int(lens.max()) + 1)
    ]
    return PhotoRecords(
        position=xy[:, 0] + 1j * xy[:, 1],
        position_sigma=said("position_sigma_m"),
        time_s=time_s,
        height_m=height,
        altitude_m=altitude,
        yaw=said("yaw_rad") - convergence,
        flight_yaw=said("flight_yaw_rad") - convergence,
        pitch=pitch,
        roll=said("roll_rad"),
        lens=lens,
        segment=split_segments(vehicle, time_s, level, pitch),
        vehicle=vehicle,
        width=np.array([f.width for f in frames], float),
        rows=np.array([f.height for f in frames], float),
        fov_hint=np.array([np.median(group) if group else np.nan for group in hints], float),
    )


def sparse_start(
    frames: Sequence[Frame], records: PhotoRecords, read_gray: ReadGray, run: Run = serial,
    progress: Progress | None = None,
) -> SparseStart:  # fmt: skip
    """Match photos with each other and find start values; run: executes tasks, the result does not depend on it."""
    builder = PairGraphBuilder(frames=frames, records=records, read_gray=read_gray, run=run, progress=progress)
    start = build_pair_graph(builder)
    if len(records.fov_hint) <= int(records.vehicle.max()):  # vehicles share lenses by name
        alone = find_initial_orientation(lens_per_vehicle(records), builder.pairs(), builder.features)
        records = split_unlike_lenses(records, alone)
        if records is not builder.records:
            start = find_initial_orientation(records, builder.pairs(), builder.features)
    return assemble(builder, records, start)


def assemble(builder: PairGraphBuilder, records: PhotoRecords, start: InitialOrientation) -> SparseStart:
    """The start of the adjustment from matched pairs and the initial orientation that they give."""
    frames, pairs = builder.frames, builder.pairs()
    trusted = [pair for pair, ok in zip(pairs, start.pair_ok, strict=True) if ok]
    tracks = thin_tracks(build_tracks(builder.features, trusted), records.width, records.rows)
    position, sigma, known = _position_priors(records, start)
    log_focal, log_focal_sigma = focal_by_hint(records)
    velocity = records.velocity()
    below = np.stack([start.position.real, start.position.imag, start.height], axis=1)
    first = [int(np.argmax(records.lens == k)) for k in range(len(start.focal))]
    lens = np.zeros((len(start.focal), 8))
    lens[:, F], lens[:, K1] = start.focal, start.k1
    lens[:, WIDTH], lens[:, HEIGHT] = records.width[first], records.rows[first]
    return SparseStart(
        cameras=CameraBlock(below, start.rotation(), records.lens.astype(np.int32), lens),
        tracks=tracks,
        position_prior=position,
        position_sigma=sigma,
        height_known=known,
        velocity=np.stack([velocity.real, velocity.imag], axis=1),
        log_focal=log_focal,
        log_focal_sigma=log_focal_sigma,
        damaged=dict(builder.damaged),
        warnings=findings(frames, records, start),
        plane=start,
        records=records,
        pairs=(len(builder.tried), len(pairs)),
    )


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


def lens_per_vehicle(records: PhotoRecords) -> PhotoRecords:
    """The records with a separate lens for each vehicle."""
    first = np.unique(records.vehicle, return_index=True)[1]
    return replace(records, lens=records.vehicle.copy(), fov_hint=records.fov_hint[records.lens[first]])


def split_unlike_lenses(records: PhotoRecords, alone: InitialOrientation) -> PhotoRecords:
    """Share lenses between vehicles as far as the pictures allow.

    alone: start values of the same photos with a lens for each vehicle (see `lens_per_vehicle`). The same records come
    back if no vehicle's focal length differs from that of others with its camera name.
    """
    vehicles = len(alone.focal)
    name = np.array([int(records.lens[records.vehicle == v][0]) for v in range(vehicles)])
    together = [abs(np.exp(1j * alone.yaw[records.vehicle == v]).mean()) for v in range(vehicles)]
    sure = np.array(together) < _ONE_WAY_CONCENTRATION
    lens = np.zeros(vehicles, np.int32)
    count = 0
    for k in np.unique(name):
        members = np.flatnonzero(name == k)
        group = group_focal_lengths(np.log(alone.focal[members]), alone.focal_sigma[members], sure[members])
        lens[members] = count + group
        count += int(group.max()) + 1
    if count == len(records.fov_hint):
        return records
    hint = np.array([records.fov_hint[name[lens == k][0]] for k in range(count)])
    return replace(records, lens=lens[records.vehicle], fov_hint=hint)


def group_focal_lengths(log_focal: Array, sigma: Array, sure: Flags) -> Ints:
    """Group of each vehicle (V,): in order of certainty, with a new group for a value unlike all existing groups."""
    group = np.zeros(len(log_focal), np.int32)
    weight, mean = np.zeros(0), np.zeros(0)
    for v in sorted(range(len(log_focal)), key=lambda v: (not sure[v], sigma[v])):
        off = np.abs(log_focal[v] - mean)
        near = int(off.argmin()) if len(off) else -1
        limit = np.inf
        if sure[v] and near >= 0:
            limit = max(_UNLIKE_SHARE, _UNLIKE_SIGMAS * float(np.hypot(sigma[v], weight[near] ** -0.5)))
        if near < 0 or off[near] > limit:
            group[v] = len(mean)
            weight, mean = np.append(weight, sigma[v] ** -2), np.append(mean, log_focal[v])
            continue
        group[v] = near
        total = weight[near] + sigma[v] ** -2
        mean[near] += (log_focal[v] - mean[near]) * sigma[v] ** -2 / total
        weight[near] = total
    return group


def split_segments(group: NDArray[np.integer], time_s: Array, height_m: Array, pitch_rad: Array) -> Ints:
    """Number of the segment of each photo, int32 (N,), from 0 in order of first appearance.

    A segment ends at a long pause (landing, battery), and at a jump of the recorded height or tilt (the gimbal was
    moved) that exceeds the record's own noise. A jump that the next photo reverses is a wrong tag and ends none.

    group: integers (N,), vehicle and lens; photos of a group are in order of time. The others: float64 (N,), NaN where
    unknown; height_m: height or altitude.
    """
    tilt_rad = float(np.radians(_SEGMENT_TILT_DEG))
    segment = np.zeros(len(group), np.int32)
    used = 0
    for g in dict.fromkeys(group.tolist()):
        rows = np.flatnonzero(group == g)
        cut = np.zeros(len(rows), bool)
        cut[1:] = np.diff(time_s[rows]) > _SEGMENT_GAP_S
        cut |= _jumps(height_m[rows], _SEGMENT_CLIMB_M) | _jumps(pitch_rad[rows], tilt_rad)
        number = np.cumsum(cut)
        segment[rows] = used + number
        used += int(number[-1]) + 1
    return segment


def _jumps(value: Array, limit: float) -> Flags:
    """Where a sequence jumps by more than the limit and does not return with the next value."""
    jump = np.zeros(len(value), bool)
    known = np.flatnonzero(np.isfinite(value))
    v = value[known]
    if len(v) > 2:
        noise = mad_sigma(np.diff(v)) / np.sqrt(2.0)
        limit = max(limit, _SEGMENT_JUMP_SIGMAS * noise)
    level = 0
    for k in range(1, len(v)):
        if abs(v[k] - v[level]) <= limit:
            level = k
        elif k + 1 == len(v) or abs(v[k + 1] - v[level]) > limit:
            jump[known[k]] = True
            level = k
    return jump


def photo_legs(position: Complex, segment: Ints, time_s: Array) -> Ints:
    """Leg of each photo, int32 (N,), numbered in order: runs of photos along a straight course; every photo has one.

    For photos far apart: two photos make a leg, and the path between two legs belongs to neither. A leg lies in one
    segment, and a pause ends it. position: complex (N,), east + i north, in order of time. time_s: float64 (N,), or
    NaN.
    """
    turn_rad = float(np.radians(_LEG_TURN_DEG))
    leg = np.zeros(len(position), np.int32)
    way = 0j
    for k in range(1, len(position)):
        step = complex(position[k] - position[k - 1])
        still = abs(step) < _LEG_STILL_M
        turned = not still and abs(way) > 0 and abs(np.angle(step * np.conj(way))) > turn_rad
        new = segment[k] != segment[k - 1] or time_s[k] - time_s[k - 1] > PAUSE_S or turned
        leg[k] = leg[k - 1] + int(new)
        way = 0j if new else way + (0j if still else step)
    return leg
