"""The relative block of one vehicle with overlapping pictures: records, calibration, tracks, start values."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Flags, Indices, Ints
from orthoswarm.model.frame import UNSTATED_SIGMA_M, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.robust import mad_sigma, mad_sigmas
from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.block_arrays import K1, CameraBlock, F, Tracks, log_rotation
from orthoswarm.refine.bundle.flight_records import FlightRecords, read_records
from orthoswarm.refine.bundle.height_consistency import UNKNOWN_HEIGHT_SIGMA_M
from orthoswarm.refine.bundle.priors import DRIFT_SIGMA_M, HEIGHT_OFFSET_SIGMA_M, LAG_SIGMA_S, GroupPriors, Priors
from orthoswarm.refine.features.flow_calibration import Calibration, calibrate
from orthoswarm.refine.features.tracks import CELL_PX, Tracker, predicted_homography
from orthoswarm.refine.features.working_pictures import Pictures, ReadGray
from orthoswarm.refine.flight.kept_tracks import Followed, KeptTracks
from orthoswarm.trajectory.legs import leads_one_way, split_legs

_FOLLOWED_PHOTOS: Final = 10  # flights of fewer photos are matched in pairs instead of being followed
_FOLLOWED_OVERLAP: Final = 0.78
"""Flights of less forward overlap are matched in pairs: of 150 corners 106 to 127 survive at an overlap of 0.90, 76 to
109 at 0.81, 51 at 0.72, 15 to 42 at 0.52 (measured on real and simulated sets)."""
_FOLLOWED_CALIBRATION_PAIRS: Final = 3  # with fewer pairs for the first focal length a flight is matched in pairs
_FOLLOWED_SURVIVAL: Final = 0.5  # least median share of tracks that survive into the next picture
_FOLLOWED_TRACKS_FACTOR: Final = 3.0  # least number of tracks, times the square root of the number of photos
_UNBROKEN_SURVIVAL: Final = 0.3
"""Least share of tracks that survive into each picture of an unbroken chain. Photos without a height mostly have no
angles either, and what lies behind a break is then held by positions alone."""
FEW_PHOTOS: Final = 100  # flights of fewer photos are followed at four times as many corners
_PREDICTED_STEP_SHARE: Final = 0.8  # step longer than this share of the picture's height is not predicted by the record
_STATED_POSITION_FLOOR_M: Final = 0.02  # least sigma of a position that states its own (RTK)
_HEIGHT_LEAP_M: Final = 5.0
"""A recorded height that leaves those around it by more than this is a spike, which is replaced by theirs, or a
climb."""
_FASTEST_CLIMB_M_S: Final = 10.0  # faster changes of height are spikes and no climb (multirotors: up to 8)
_HEIGHT_REACH_PHOTOS: Final = 3  # photos before and after whose median is compared with a recorded height
_HEIGHT_SIGMA_RANGE_M: Final = (0.1, 2.0)  # range of the sigma of recorded heights after a look at their noise
_ATTITUDE_SIGMA_RANGE_DEG: Final = (0.05, 3.0)  # range of the sigma of recorded attitudes after a look at their noise
_TILT_SIGMA_DEG: Final = 0.2  # first sigma of recorded pitch and roll about their common bias
_FREE_TILT_SIGMA_DEG: Final = 3.0  # sigma of pitch and roll that were not recorded
_YAW_SIGMA_DEG: Final = 0.2  # first sigma of recorded headings about their common bias
_FREE_YAW_SIGMA_DEG: Final = 5.0  # sigma of headings that were not recorded
_UNTIMED_LAG_SIGMA_S: Final = 0.3  # sigma of the lag of positions of photos without time, in steps between them
_LENS_SIGMA: Final = (0.3, 0.1, 0.03)  # sigma of log f, k1, k2 of a lens
_STRONG_K1: Final = 0.12  # a lens with a larger |k1| distorts so much that two parameters do not describe it
_STRONG_LENS_SIGMA: Final = (0.3, 0.3, 0.2, 0.3)  # sigma of log f, k1, k2, k3 of such a lens
PRINCIPAL_POINT_SHARE: Final = 0.012  # sigma of the principal point of lenses solved in full, in picture widths
_HEADING_REACH_PHOTOS: Final = 7  # heading that was not recorded follows from those of so many photos before and after
_HEADING_LEAST_CORNERS: Final = 10  # fewest tracked corners that tell how far a photo is turned from the one before
FIRST_HEIGHT_SIGMA_M: Final = 0.5  # sigma of a recorded height to begin with
INLIER_WEIGHT: Final = 0.5  # an observation counts as an inlier from this robust weight on


@dataclass(frozen=True, slots=True)
class BestViews:
    """For each point the inlier observation nearest to its camera's nadir, and the quality of the point's observations.

    camera: int32 (P,), of that observation, -1 where there is none. count: int32 (P,), inlier observations.
    mean_weight: float64 (P,), mean robust weight.
    """

    camera: Ints
    count: Ints
    mean_weight: Array


@dataclass(slots=True, kw_only=True)
class FlightBlock:
    """A vehicle's frames and their present solution.

    Attributes:
        frames: in order. records: their records (headings already corrected). leg: int32 (N,).
        pictures: grey pictures. calibration: first guess. adjustment: the cameras and points.
        warnings: for the report. sparse: True if photos were matched in pairs instead of tracked.
        focal_sigma: relative sigma of a focal length found together with other vehicles and fixed since (else 0).
    """

    frames: Sequence[Frame]
    records: FlightRecords
    leg: Ints
    pictures: Pictures
    calibration: Calibration
    adjustment: Adjustment
    warnings: list[str]
    sparse: bool = False
    focal_sigma: float = 0.0

    def cameras(self) -> CameraBlock:
        """The vehicle's own cameras (without neighbours that the adjustment holds fixed; there may be more lenses)."""
        return self.adjustment.cameras.take(slice(0, len(self.frames)))

    @property
    def height_m(self) -> float:
        """Median height of the cameras above the takeoff level, metres."""
        return float(np.median(self.adjustment.cameras.position[: len(self.frames), 2]))

    @property
    def focal_px(self) -> float:
        """Focal length of the first lens, working pixels."""
        return float(self.adjustment.cameras.lens[0, F])

    def best_views(self, some: Flags | None = None) -> BestViews:
        """Best view of each tie point, chosen among the vehicle's own pictures, or among some (N,) of them."""
        adj, n = self.adjustment, len(self.adjustment.points)
        camera, point, weight = adj.tracks.camera, adj.tracks.point, adj.obs_weight
        own = np.zeros(len(adj.cameras), bool)
        own[: len(self.frames)] = True if some is None else some
        inlier = weight > INLIER_WEIGHT
        usable = inlier & own[camera]
        distance = np.hypot(*(adj.cameras.position[camera, :2] - adj.points[point, :2]).T)
        order = np.lexsort((np.where(usable, distance, np.inf), point))
        best = order[np.minimum(np.searchsorted(point[order], np.arange(n)), len(order) - 1)]
        total = np.bincount(point, minlength=n)
        shown = np.where((total > 0) & usable[best], camera[best], -1).astype(np.int32)
        count = np.bincount(point[inlier], minlength=n).astype(np.int32)
        return BestViews(shown, count, np.bincount(point, weight, minlength=n) / np.maximum(total, 1))

    def one_per_cell(self, seen: BestViews, usable: Flags, cost: Array | Ints, cell_m: float) -> Indices:
        """The usable point of least cost in each ground cell of each leg, of those seen: indices, sorted."""
        use = np.flatnonzero(usable & (seen.camera >= 0))
        cell = np.floor(self.adjustment.points[use, :2] / cell_m).astype(np.int64)
        order = np.lexsort((use, cost[use]))
        key = np.column_stack([cell, self.leg[seen.camera[use]]])
        _, first = np.unique(key[order], axis=0, return_index=True)
        return np.sort(use[order[first]])


def open_flight(
    frames: Sequence[Frame], grid: LocalGrid, origin: Array, read: ReadGray, fov_start: float, *,
    kept: KeptTracks | None = None,
) -> FlightBlock | None:  # fmt: skip
    """Track corners through a vehicle's pictures, in order, and set up its adjustment, without solving it.

    fov_start: assumed horizontal field of view, radians. kept: where the tracks are kept, and found again.

    Returns None where pictures are matched in pairs instead (see `open_sparse_flights`): too little overlap, a height
    that contradicts the scale, or, where no height was recorded, a chain that breaks, or a single straight line, on
    which drift and scale cannot be separated.
    """
    if len(frames) < _FOLLOWED_PHOTOS:
        return None
    records = read_records(frames, grid, origin)
    leg = split_legs(records.position, records.time_s if records.timed else None)
    pictures = Pictures(frames, read)
    file = None if kept is None else kept.file(frames, grid.epsg, origin, fov_start)
    followed = None if kept is None or file is None else kept.read(file)
    if followed is not None:
        pictures.restore(followed.small, followed.damaged)
    else:
        followed = _follow(records, leg, pictures, fov_start)
        if followed is None:
            return None
        if kept is not None and file is not None:
            kept.write(file, followed)
    calibration = followed.calibration
    records = with_measured_headings(replace(records, yaw=records.yaw + calibration.yaw_offset), followed.tracks)
    return FlightBlock(
        frames=frames,
        records=records,
        leg=leg,
        pictures=pictures,
        calibration=calibration,
        adjustment=_begin(records, pictures, calibration, followed.tracks),
        warnings=list(calibration.warnings),
    )


def _follow(records: FlightRecords, leg: Ints, pictures: Pictures, fov_start: float) -> Followed | None:
    """Measure the flow and track the corners of a flight's pictures; None where they cannot be tracked."""
    calibration = calibrate(records, leg, pictures.gray, pictures.size, fov_start)
    steps = np.hypot(*records.steps()[1:, :2].T)
    flow = float(np.median(steps)) * calibration.focal_px / calibration.height_m / pictures.size[1]
    if calibration.pairs < _FOLLOWED_CALIBRATION_PAIRS or flow > 1.0 - _FOLLOWED_OVERLAP:
        return None
    unknown = not records.has_height.any()
    if leads_one_way(records.position, leg) if unknown else not calibration.trusted_height:
        return None

    def hopeless(survived: Array) -> bool:
        broken = unknown and survived[1:].min() < _UNBROKEN_SURVIVAL
        return bool(broken or np.median(survived[1:]) < _FOLLOWED_SURVIVAL)

    turned = replace(records, yaw=records.yaw + calibration.yaw_offset)
    tracks = _track(turned, pictures, calibration, hopeless)
    if tracks is None or tracks.count < _FOLLOWED_TRACKS_FACTOR * len(records.position) ** 0.5:
        return None
    return Followed(calibration=calibration, tracks=tracks, small=pictures.reduced(), damaged=dict(pictures.damaged))


def weigh_records(flight: FlightBlock) -> None:
    """Estimate the sigmas of recorded heights and attitudes from the differences between consecutive adjusted cameras.

    Positions that scatter more than their sigmas get larger sigmas, too. Heights with a loose prior keep it.
    """
    adj = flight.adjustment
    p = adj.priors
    height = adj.cameras.position[:, 2] - p.position[:, 2]
    attitude = log_rotation(np.swapaxes(p.rotation, 1, 2) @ adj.cameras.rotation)
    z = float(np.clip(_step_sigma(height[:, None])[0], *_HEIGHT_SIGMA_RANGE_M))
    turn = np.clip(_step_sigma(attitude), *np.radians(_ATTITUDE_SIGMA_RANGE_DEG))
    sigma = p.position_sigma.copy()
    if flight.calibration.trusted_height:
        sigma[:, 2] = np.where(sigma[:, 2] > FIRST_HEIGHT_SIGMA_M, sigma[:, 2], z)
    off = adj.position_residuals()[:, :2] / np.maximum(sigma[:, :2], 1e-9)
    sigma[:, :2] *= max(1.0, mad_sigma(off))
    known = np.column_stack([flight.records.has_tilt, flight.records.has_tilt, flight.records.has_yaw])
    adj.priors = replace(p, position_sigma=sigma, rotation_sigma=np.where(known, turn, p.rotation_sigma))


def distorts_strongly(flight: FlightBlock) -> bool:
    """True if the distortion is too strong for two parameters."""
    return bool(np.abs(flight.adjustment.cameras.lens[:, K1]).max() >= _STRONG_K1)


def free_full_lens(flight: FlightBlock) -> bool:
    """Free all parameters of a lens if it distorts strongly; others keep two, which are better determined."""
    adj = flight.adjustment
    if not distorts_strongly(flight):
        return False
    centre_px = PRINCIPAL_POINT_SHARE * flight.pictures.size[0]
    sigma = np.tile([*_STRONG_LENS_SIGMA, centre_px, centre_px], (len(adj.cameras.lens), 1))
    adj.priors = replace(adj.priors, lens_sigma=sigma)
    return True


def _step_sigma(values: Array) -> Array:
    """Robust sigma of each column of a sequence's noise from one picture to the next."""
    step = np.diff(values, axis=0)
    return np.asarray(mad_sigmas(step - np.median(step, axis=0)) / np.sqrt(2.0))


def _track(
    records: FlightRecords, pictures: Pictures, calibration: Calibration, hopeless: Callable[[Array], bool]
) -> Tracks | None:
    """Tracks; None once the shares of them that survived into each picture, 1 to begin with, are hopeless."""
    rotation, steps = records.rotation(), records.steps()
    width, height = pictures.size
    f, height_m = calibration.focal_px, calibration.height_m
    matrix = np.array([[f, 0, 0.5 * (width - 1)], [0, f, 0.5 * (height - 1)], [0, 0, 1.0]])
    reach = _PREDICTED_STEP_SHARE * height / f * height_m
    tracker = Tracker(cell_px=CELL_PX // 2 if len(rotation) < FEW_PHOTOS else CELL_PX)
    survived = np.ones(len(rotation))
    for i in range(len(rotation)):
        predicted = None  # tracking starts afresh
        if i > 0 and np.hypot(*steps[i, :2]) <= reach:
            step = np.array([steps[i, 0], steps[i, 1], 0.0])
            predicted = predicted_homography(rotation[i - 1], rotation[i], height_m, step, matrix)
        survived[i] = tracker.add(i, pictures.gray(i), predicted)
        if hopeless(survived):
            return None
    return tracker.tracks()


def _begin(records: FlightRecords, pictures: Pictures, calibration: Calibration, tracks: Tracks) -> Adjustment:
    n = len(records.position)
    width, height = pictures.size
    position = records.position.copy()
    position[:, 2], z_sigma = height_prior(records, calibration)
    rotation = records.rotation()
    lens = np.array([[calibration.focal_px, 0, 0, 0, 0, 0, width, height]], float)
    cameras = CameraBlock(position.copy(), rotation.copy(), np.zeros(n, np.int32), lens)
    stated = np.maximum(records.position_sigma, _STATED_POSITION_FLOOR_M)
    horizontal = np.where(np.isfinite(records.position_sigma), stated, UNSTATED_SIGMA_M)
    tilt = np.where(records.has_tilt, np.radians(_TILT_SIGMA_DEG), np.radians(_FREE_TILT_SIGMA_DEG))
    yaw = np.where(records.has_yaw, np.radians(_YAW_SIGMA_DEG), np.radians(_FREE_YAW_SIGMA_DEG))
    model = GroupPriors(
        height_sigma=HEIGHT_OFFSET_SIGMA_M if calibration.trusted_height else UNKNOWN_HEIGHT_SIGMA_M,
        lag_sigma=LAG_SIGMA_S if records.timed else _UNTIMED_LAG_SIGMA_S,
        drift_sigma=DRIFT_SIGMA_M if not np.isfinite(records.position_sigma).all() else 0.0,
    )
    priors = Priors(
        position=position,
        position_sigma=np.column_stack([horizontal, horizontal, z_sigma]),
        rotation=rotation,
        rotation_sigma=np.column_stack([tilt, tilt, yaw]),
        velocity=records.velocity(),
        group=np.zeros(n, np.int32),
        models=(model,),
        lens=np.array([[np.log(calibration.focal_px), 0, 0, 0, 0, 0]]),
        lens_sigma=np.array([[*_LENS_SIGMA, 0, 0, 0]]),
    )
    return Adjustment.begin(cameras, tracks, priors, first_points(cameras, tracks))


def first_points(cameras: CameraBlock, tracks: Tracks) -> Array:
    """Mean intersection of each track's rays with the level ground: float64 (P, 3)."""
    ground = cameras.to_ground(tracks.camera, tracks.uv, np.zeros(len(tracks.camera)))
    ok = np.isfinite(ground).all(1)
    count = np.maximum(np.bincount(tracks.point[ok], minlength=tracks.count), 1)
    xy = [np.bincount(tracks.point[ok], ground[ok, a], minlength=tracks.count) / count for a in range(2)]
    return np.column_stack([*xy, np.zeros(tracks.count)])


def height_prior(records: FlightRecords, calibration: Calibration) -> tuple[Array, Array]:
    """Recorded heights above the ground and their sigmas; one common height if the record is not trusted.

    A height unlike those around it may be a spike or the climb after takeoff: its sigma becomes as large as the
    difference, and the pictures decide. A spike, at which no vehicle arrives in the time that it has, also gets the
    others' height.
    """
    z = records.position[:, 2]
    if not calibration.trusted_height:
        return np.full(len(z), calibration.height_m), np.full(len(z), FIRST_HEIGHT_SIGMA_M)
    reach = _HEIGHT_REACH_PHOTOS
    smooth = np.array([np.median(z[max(0, i - reach) : i + reach + 1]) for i in range(len(z))])
    off = np.abs(z - smooth)
    leaps = off > _HEIGHT_LEAP_M
    climbed = np.zeros(len(z), bool)  # heights that a vehicle reaches from those before and after in its time
    if records.timed:
        can = np.abs(np.diff(z)) <= _FASTEST_CLIMB_M_S * np.diff(records.time_s)
        climbed = np.concatenate([[True], can]) & np.concatenate([can, [True]])
    return np.where(leaps & ~climbed, smooth, z), np.where(leaps, off, FIRST_HEIGHT_SIGMA_M)


def with_measured_headings(records: FlightRecords, tracks: Tracks) -> FlightRecords:
    """Records whose assumed headings are those that most pictures around them agree on.

    A picture without a recorded heading is assumed to point along the path, which at a bend may be half a corner off.
    Each picture's heading follows from each neighbour's and from how the pictures turned between the two; the median is
    taken.
    """
    if records.has_yaw.all():
        return records
    turn = turns(tracks, len(records.yaw))
    broken = np.isnan(turn)
    chain, heading = np.cumsum(broken), np.cumsum(np.where(broken, 0.0, turn))
    yaw = records.yaw.copy()
    for i in np.flatnonzero(~records.has_yaw):
        near = slice(max(0, i - _HEADING_REACH_PHOTOS), i + _HEADING_REACH_PHOTOS + 1)
        from_others = records.yaw[near] + heading[i] - heading[near] - records.yaw[i]
        yaw[i] += _median_angle(from_others[chain[near] == chain[i]])
    return replace(records, yaw=wrap_rad(yaw))


def turns(tracks: Tracks, count: int) -> Array:
    """Turn of each picture's heading from the one before, radians, clockwise (count,); NaN where few corners tell."""
    order = np.argsort(tracks.camera, kind="stable")
    edges = np.searchsorted(tracks.camera[order], np.arange(count + 1))
    seen = [order[a:b] for a, b in pairwise(edges)]
    out = np.full(count, np.nan)
    for i in range(1, count):
        _, before, now = np.intersect1d(tracks.point[seen[i - 1]], tracks.point[seen[i]], return_indices=True)
        if len(before) < _HEADING_LEAST_CORNERS:
            continue
        p, q = (uv - np.median(uv, axis=0) for uv in (tracks.uv[seen[i - 1]][before], tracks.uv[seen[i]][now]))
        away = np.hypot(*p.T) > np.median(np.hypot(*p.T))  # those near the middle say little
        a, b = (z[away, 0] + 1j * z[away, 1] for z in (p, q))
        out[i] = -_median_angle(np.angle(b / a))  # the ground turns the other way in the picture
    return out


def _median_angle(angle: Array) -> float:
    """The angle from which the others are least far in sum, radians."""
    far = np.abs(wrap_rad(angle[:, None] - angle)).sum(axis=1)
    first = angle[int(far.argmin())]
    return float(wrap_rad(first + np.median(wrap_rad(angle - first))))
