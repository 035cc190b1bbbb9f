"""One vehicle's dense flight up to the map: records, calibration, tracks, relative adjustment (RECIPE.md 1 to 3)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.model.camera import fov_rad
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.legs import leads_one_way, split_legs
from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.block_arrays import K1, CameraBlock, Tracks
from orthoswarm.refine.bundle.flight_records import FlightRecords, read_records
from orthoswarm.refine.bundle.observation_selection import BestViews, best_views
from orthoswarm.refine.bundle.priors import GroupPriors, Priors
from orthoswarm.refine.bundle.rotation_vectors import log_rotation
from orthoswarm.refine.features.flow_calibration import Calibration, calibrate
from orthoswarm.refine.features.grey_pictures import Pictures
from orthoswarm.refine.features.tracks import follow, predicted_homography

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

STRONG_K1 = 0.12
FEW = 100
"""Flights of fewer pictures are followed at four times as many corners."""
FEWEST = 10
FOLLOWED_OVERLAP = 0.78
"""Fewer pictures, or less forward overlap, are matched in pairs instead of being followed."""
UNBROKEN = 0.3
"""Share of tracks that survive into each picture of an unbroken chain. Photos without a height mostly have no angles
either, and what lies behind a break is then held by positions alone."""
HEIGHT_SIGMA_M = (0.1, 2.0)
ATTITUDE_SIGMA_RAD = (np.radians(0.05), np.radians(3.0))
"""Least and greatest sigma that recorded heights and attitudes are given after a look at their noise."""
HEIGHT_BEGIN_M, LEAP_M = 0.5, 5.0
"""Sigma of a recorded height to begin with, and how far one must leave those around it not to be taken as it is."""


@dataclass(slots=True)
class Flight:
    """A vehicle's frames with everything that was found out about them so far.

    Attributes:
        frames: in order. records: what they recorded (headings already corrected). leg: int32 (N,).
        pictures: grey pictures. calibration: first guess. adjustment: the cameras and points.
        survived: float64 (N,), share of tracks that survived into each picture.
        warnings: findings in plain words. sparse: True where photos were matched in pairs, not followed.
        focal_sigma: relative one sigma of a lens found together with other vehicles and held since (else 0).
    """

    frames: Sequence[Frame]
    records: FlightRecords
    leg: NDArray[np.int32]
    pictures: Pictures
    calibration: Calibration
    adjustment: Adjustment
    survived: Array
    warnings: list[str]
    sparse: bool = False
    focal_sigma: float = 0.0

    def cameras(self) -> CameraBlock:
        """The vehicle's own cameras now (neighbours that an adjustment holds are left out; lenses may be more)."""
        return self.adjustment.cameras.take(slice(0, len(self.frames)))

    def best_views(self, some: NDArray[np.bool_] | None = None) -> BestViews:
        """Summaries of the points' observations; pictures are chosen among the vehicle's own, or some (N,) of them."""
        adj = self.adjustment
        own = np.zeros(len(adj.cameras), bool)
        own[: len(self.frames)] = True if some is None else some
        return best_views(adj.cameras, adj.tracks, adj.points, adj.obs_weight, own)


def open_flight(
    frames: Sequence[Frame], grid: LocalGrid, origin: Array, read: Callable[[Frame], Gray], fov_start: float
) -> Flight | None:
    """Track a vehicle's pictures and set up its adjustment; nothing is solved yet.

    None where the pictures cannot be followed from one to the next (those are matched in pairs instead, see
    `sparse_flight`): too little overlap, a height that contradicts the scale, or, where no height was recorded, a chain
    that breaks and a single straight way, on which drift and scale stand for each other.
    """
    if len(frames) < FEWEST:
        return None
    records = read_records(frames, grid, origin)
    leg = split_legs(records.position, records.time_s if records.timed else None)
    pictures = Pictures(frames, read)
    calibration = calibrate(records, leg, pictures.gray, pictures.size, fov_start)
    steps = np.hypot(*records.steps()[1:, :2].T)
    flow = float(np.median(steps)) * calibration.focal_px / calibration.height_m / pictures.size[1]
    if calibration.pairs < 3 or flow > 1.0 - FOLLOWED_OVERLAP:
        return None
    unknown = not records.has_height.any()
    if leads_one_way(records.position, leg) if unknown else not calibration.trusted_height:
        return None
    records = records.with_yaw(records.yaw + calibration.yaw_offset)
    tracks, survived = _track(records, pictures, calibration)
    if np.median(survived[1:]) < 0.5 or tracks.count < 3 * len(frames) ** 0.5:
        return None
    if unknown and survived[1:].min() < UNBROKEN:
        return None
    adjustment = _begin(records, pictures, calibration, tracks)
    return Flight(frames, records, leg, pictures, calibration, adjustment, survived, list(calibration.warnings))


def weigh_records(flight: Flight) -> None:
    """Give heights and attitudes the sigmas that they show: pictures tell well how one differs from the next.

    Positions that scatter more than theirs say get larger ones, too. Heights that were doubtful to begin with stay so.
    """
    adj = flight.adjustment
    p = adj.priors
    height = adj.cameras.position[:, 2] - p.position[:, 2]
    attitude = log_rotation(np.swapaxes(p.rotation, 1, 2) @ adj.cameras.rotation)
    z = float(np.clip(_jitter(height[:, None])[0], *HEIGHT_SIGMA_M))
    turn = np.clip(_jitter(attitude), *ATTITUDE_SIGMA_RAD)
    sigma = p.position_sigma.copy()
    if flight.calibration.trusted_height:
        sigma[:, 2] = np.where(sigma[:, 2] > HEIGHT_BEGIN_M, sigma[:, 2], z)
    off = adj.position_residuals()[:, :2] / np.maximum(sigma[:, :2], 1e-9)
    sigma[:, :2] *= max(1.0, 1.4826 * float(np.median(np.abs(off))))
    known = np.column_stack([flight.records.has_tilt, flight.records.has_tilt, flight.records.has_yaw])
    adj.priors = replace(p, position_sigma=sigma, rotation_sigma=np.where(known, turn, p.rotation_sigma))


def distorts_strongly(flight: Flight) -> bool:
    """True if the lens distorts so much that two parameters do not describe it."""
    return bool(np.abs(flight.adjustment.cameras.lens[:, K1]).max() >= STRONG_K1)


def free_full_lens(flight: Flight) -> bool:
    """Give a strongly distorting lens all its parameters; a weak one keeps two, which is better held.

    Returns:
        True if more parameters are free now (some more steps are due).
    """
    adj = flight.adjustment
    if not distorts_strongly(flight):
        return False
    width = flight.pictures.size[0]
    sigma = np.tile([0.3, 0.3, 0.2, 0.3, 0.012 * width, 0.012 * width], (len(adj.cameras.lens), 1))
    adj.priors = replace(adj.priors, lens_sigma=sigma)
    return True


def _jitter(values: Array) -> Array:
    """Robust sigma of each column of a sequence's noise from one picture to the next."""
    step = np.diff(values, axis=0)
    return np.asarray(1.4826 * np.median(np.abs(step - np.median(step, axis=0)), axis=0) / np.sqrt(2.0))


def _track(records: FlightRecords, pictures: Pictures, calibration: Calibration) -> tuple[Tracks, Array]:
    rotation, steps = records.rotation(), records.steps()
    width, height = pictures.size
    f = calibration.focal_px
    matrix = np.array([[f, 0, 0.5 * (width - 1)], [0, f, 0.5 * (height - 1)], [0, 0, 1.0]])
    reach = 0.8 * height / f * calibration.height_m

    def prediction(i: int) -> Array | None:
        if i == 0 or np.hypot(*steps[i, :2]) > reach:
            return None
        step = np.array([steps[i, 0], steps[i, 1], 0.0])
        return predicted_homography(rotation[i - 1], rotation[i], calibration.height_m, step, matrix)

    cell_px = active().features.cell_px
    few = len(rotation) < FEW
    return follow(len(rotation), pictures.gray, prediction, cell_px=cell_px // 2 if few else cell_px)


def _begin(records: FlightRecords, pictures: Pictures, calibration: Calibration, tracks: Tracks) -> Adjustment:
    n = len(records.position)
    width, height = pictures.size
    position = records.position.copy()
    position[:, 2], z_sigma = _height_prior(records, calibration)
    rotation = records.rotation()
    lens = np.array([[calibration.focal_px, 0, 0, 0, 0, 0, width, height]], float)
    cameras = CameraBlock(position.copy(), rotation.copy(), np.zeros(n, np.int32), lens)
    horizontal = np.where(
        np.isfinite(records.position_sigma),
        np.maximum(records.position_sigma, 0.02),
        active().records.position_sigma_m,
    )
    tilt = np.where(records.has_tilt, np.radians(0.2), np.radians(3.0))
    yaw = np.where(records.has_yaw, np.radians(0.2), np.radians(5.0))
    model = GroupPriors(
        height_sigma=1.0 if calibration.trusted_height else active().bundle.unknown_height_sigma_m,
        lag_sigma=0.5 if records.timed else 0.3,
        drift_sigma=15.0 if not np.isfinite(records.position_sigma).all() else 0.0,
    )
    priors = Priors(
        position,
        np.column_stack([horizontal, horizontal, z_sigma]),
        rotation,
        np.column_stack([tilt, tilt, yaw]),
        records.velocity(),
        np.zeros(n, np.int32),
        (model,),
        np.array([[np.log(calibration.focal_px), 0, 0, 0, 0, 0]]),
        np.array([[0.3, 0.1, 0.03, 0, 0, 0]]),
    )
    return Adjustment.begin(cameras, tracks, priors, first_points(cameras, tracks))


def first_points(cameras: CameraBlock, tracks: Tracks) -> Array:
    """Where the rays of each track meet the level ground, averaged: float64 (P, 3)."""
    ground = cameras.to_ground(tracks.camera, tracks.uv, np.zeros(len(tracks.camera)))
    ok = np.isfinite(ground).all(1)
    count = np.maximum(np.bincount(tracks.point[ok], minlength=tracks.count), 1)
    xy = [np.bincount(tracks.point[ok], ground[ok, a], minlength=tracks.count) / count for a in range(2)]
    return np.column_stack([*xy, np.zeros(tracks.count)])


def _height_prior(records: FlightRecords, calibration: Calibration) -> tuple[Array, Array]:
    """Heights over the ground as recorded and their sigmas; one height where the record cannot be trusted.

    A height that leaves those around it may be a spike, or the climb after the takeoff: the height of the others is
    as good a guess, as doubtful as they differ, and the pictures tell which it is.
    """
    z = records.position[:, 2]
    if not calibration.trusted_height:
        return np.full(len(z), calibration.height_m), np.full(len(z), HEIGHT_BEGIN_M)
    smooth = np.array([np.median(z[max(0, i - 3) : i + 4]) for i in range(len(z))])
    off = np.abs(z - smooth)
    leaps = off > LEAP_M
    return np.where(leaps, smooth, z), np.where(leaps, off, HEIGHT_BEGIN_M)


def fov_deg(flight: Flight) -> float:
    """The vehicle's field of view now, degrees."""
    return float(np.degrees(fov_rad(float(flight.adjustment.cameras.lens[0, 0]), flight.pictures.size[0])))
