"""Coarse cameras of one vehicle (paper III.C): legs, their lines, positions on the lines, one field of view."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from time import process_time
from typing import Final

import numpy as np

from orthoswarm.matchers import picture_matcher
from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Ints
from orthoswarm.model.camera import focal_px
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.paper.ground_scale import SCALE_LEAST_PAIRS, choose_pairs, estimate_fov
from orthoswarm.raster.picture_file import read_gray
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock, F
from orthoswarm.refine.bundle.flight_records import FlightRecords, read_records
from orthoswarm.refine.features.working_pictures import Pictures
from orthoswarm.refine.strategy.vehicle_passes import START_FOV_DEG
from orthoswarm.trajectory.legs import split_legs

RECEIVER_SIGMA_M: Final = 3.0  # sigma of the bias of a receiver, an axis, metres, which no line reduces
_SCALE_PAIRS: Final = 40  # matched pairs a vehicle, about (cost)
_UNKNOWN_FOV_SIGMA_DEG: Final = 10.0  # sigma of a field of view that could not be measured
_LEG_HEADING_DEG: Final = 20.0  # frames of a leg differ in heading from its mean by less
_LEG_PHOTOS: Final = 3  # least photos of a leg
_LINE_DISTANCE_M: Final = 4.0  # photos before and after a leg belong to it within this distance of its line ...
_LINE_SIGMAS: Final = 3.0  # ... or within so many standard deviations of its photos across the line


@dataclass(frozen=True, slots=True)
class Line:
    """The straight line of a leg."""

    point: Array  # float64 (2,), a point on it (the middle of the positions)
    direction: Array  # float64 (2,), unit, along flight
    sigma_m: float  # standard deviation of the positions across it

    def project(self, position: Array) -> Array:
        """Eq. 3: the foot points (N, 2) of positions (N, 2) on the line."""
        along = (position - self.point) @ self.direction
        return np.asarray(self.point + along[:, None] * self.direction)

    def along(self, position: Array) -> Array:
        """Distance flown along the line, metres from its point, of positions (N, 2)."""
        return np.asarray((position - self.point) @ self.direction)


def fit_line(position: Array) -> Line:
    """Eq. 2: the line through positions (N, 2) of a leg, by TOTAL least squares.

    The paper minimises the error of y = kx + b in y. This has no solution for a leg due north (x = const) and is
    biased for steep legs. Minimising perpendicular distances has neither fault and agrees with it for legs due east.
    """
    middle = position.mean(axis=0)
    _, spread, axes = np.linalg.svd(position - middle, full_matrices=False)
    direction = axes[0] if (position[-1] - position[0]) @ axes[0] >= 0 else -axes[0]
    across = float(spread[1]) / np.sqrt(max(len(position) - 2, 1)) if len(spread) > 1 else 0.0
    return Line(middle, direction, across)


def find_legs(records: FlightRecords) -> Ints:
    """Leg of each frame, int32 (N,), -1 in turns; a leg is straight and has one camera heading."""
    path = split_legs(records.position, records.time_s if records.timed else None)
    out = np.full(len(path), -1, np.int32)
    number = 0
    for k in range(int(path.max()) + 1 if len(path) else 0):
        for run in _one_heading(np.flatnonzero(path == k).astype(np.int32), records.yaw):
            if len(run) >= _LEG_PHOTOS:
                out[run] = number
                number += 1
    return _grown(out, records)


def _grown(leg: Ints, records: FlightRecords) -> Ints:
    """Legs extended over the frames before and after them that are on their line and have the same heading.

    The path alone detects a turn a few frames too early or too late.
    """
    most_turned = np.radians(_LEG_HEADING_DEG)
    out = leg.copy()
    for k in range(int(leg.max()) + 1 if len(leg) else 0):
        members = np.flatnonzero(leg == k)
        line = fit_line(records.position[members, :2])
        reach = max(_LINE_SIGMAS * line.sigma_m, _LINE_DISTANCE_M)
        mean = np.angle(np.exp(1j * records.yaw[members]).mean())
        for start, step in ((members[-1] + 1, 1), (members[0] - 1, -1)):
            i = int(start)
            last = line.along(records.position[i - step, None, :2])[0]
            while 0 <= i < len(out) and out[i] < 0:
                offset = records.position[i, :2] - line.project(records.position[i, None, :2])[0]
                along = line.along(records.position[i, None, :2])[0]
                turned = abs(wrap_rad(float(records.yaw[i] - mean))) > most_turned
                if turned or np.hypot(*offset) > reach or (along - last) * step <= 0:
                    break
                out[i], last = k, along
                i += step
    return out


def _one_heading(members: Ints, yaw: Array) -> list[Ints]:
    """Runs of frames whose heading stays near the run's mean."""
    most_turned = np.radians(_LEG_HEADING_DEG)
    runs: list[list[int]] = []
    for i in members.tolist():
        if runs:
            mean = np.angle(np.exp(1j * yaw[runs[-1]]).mean())
            if abs(wrap_rad(float(yaw[i] - mean))) <= most_turned:
                runs[-1].append(i)
                continue
        runs.append([i])
    return [np.array(r, np.int32) for r in runs]


@dataclass(frozen=True, slots=True)
class PaperOptions:
    """How the paper's refiner works."""

    device: str = "auto"  # where matchers' networks run, see `network_device`
    picture_matcher: str | None = None  # their names; None for the best available
    map_matcher: str | None = None  # their names; None for the best available


@dataclass(slots=True, kw_only=True)
class CoarseVehicle:
    """One vehicle after the coarse stage (III.C)."""

    vehicle: str
    frames: list[Frame]  # in order
    leg: Ints  # int32 (N,), -1 in turns
    lines: list[Line]  # of each leg
    cameras: CameraBlock  # cameras in the local frame, lens in pixels of the stored pictures; ground at height 0
    sigma_m: Array  # float64 (N,), own error estimates
    fov_sigma_rad: float  # of the field of view
    damaged: dict[int, str] = field(default_factory=dict)  # index -> why its picture cannot be used
    warnings: list[str] = field(default_factory=list)  # findings
    cpu_s: float = 0.0  # CPU seconds

    def members(self, leg: int) -> Ints:
        """Indices of a leg's frames whose pictures can be used."""
        return np.array([i for i in np.flatnonzero(self.leg == leg) if i not in self.damaged], np.int32)


def coarse_vehicle(frames: Sequence[Frame], *, epsg: int, origin: Array, options: PaperOptions) -> CoarseVehicle:
    """Coarse cameras of one vehicle (one lens) in the local frame: III.C from legs to Eq. 4."""
    began = process_time()
    records = read_records(frames, LocalGrid(epsg), origin)
    pictures = Pictures(frames, lambda f: read_gray(f.path))
    leg = find_legs(records)
    count = int(leg.max()) + 1 if len(leg) else 0
    lines = [fit_line(records.position[leg == k, :2]) for k in range(count)]
    position = records.position.copy()
    sigma = np.full(len(frames), float(np.hypot(RECEIVER_SIGMA_M, RECEIVER_SIGMA_M)))
    for k, line in enumerate(lines):
        mine = leg == k
        position[mine, :2] = line.project(records.position[mine, :2])
        sigma[mine] = np.hypot(RECEIVER_SIGMA_M, line.sigma_m)
    hints = [f.fov_hint_rad for f in frames if f.fov_hint_rad is not None]
    start = float(np.median(hints) if hints else np.radians(START_FOV_DEG))  # the result, too, if nothing matches
    rotation = records.rotation()
    tilt = np.arccos(np.clip(-rotation[:, 2, 2], -1.0, 1.0))
    tasks = []
    for k, line in enumerate(lines):
        members = np.flatnonzero(leg == k)
        along = line.along(records.position[members, :2])
        share = max(SCALE_LEAST_PAIRS, round(_SCALE_PAIRS * len(members) / max(int((leg >= 0).sum()), 1)))
        tasks += choose_pairs(along, position[members, 2], tilt[members], members, share)
    warnings = []
    found = None
    if records.has_height.any():
        matcher = picture_matcher(options.picture_matcher, options.device)
        found = estimate_fov(tasks, pictures.gray, rotation, size=pictures.size, start_rad=start, matcher=matcher)
    if found is None:
        warnings.append(f"the field of view could not be measured; {np.degrees(start):.0f} degrees are used")
    fov = start if found is None else found.mean
    fov_sigma = np.radians(_UNKNOWN_FOV_SIGMA_DEG) if found is None else found.sigma / np.sqrt(max(found.inliers, 1))
    width, height = frames[0].width, frames[0].height
    lens = np.zeros((1, 8))
    lens[0, F], lens[0, WIDTH], lens[0, HEIGHT] = focal_px(fov, width), width, height
    cameras = CameraBlock(position, rotation, np.zeros(len(frames), np.int32), lens)
    return CoarseVehicle(
        vehicle=frames[0].vehicle, frames=list(frames), leg=leg, lines=lines, cameras=cameras, sigma_m=sigma,
        fov_sigma_rad=float(fov_sigma), damaged=dict(pictures.damaged), warnings=warnings, cpu_s=process_time() - began,
    )  # fmt: skip
