"""Coarse cameras of one vehicle (paper III.C): legs, their lines, positions on the lines, one field of view."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from time import process_time
from typing import Final

import numpy as np

from orthoswarm.matchers import picture_matcher
from orthoswarm.model.arrays import Array, Ints
from orthoswarm.model.camera import focal_px
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.paper.ground_scale import SCALE_LEAST_PAIRS, choose_pairs, estimate_fov
from orthoswarm.paper.leg_lines import Line, find_legs, fit_line
from orthoswarm.raster.picture_file import read_gray
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock, F
from orthoswarm.refine.bundle.flight_records import read_records
from orthoswarm.refine.features.working_pictures import Pictures
from orthoswarm.refine.strategy.vehicle_passes import START_FOV_DEG

RECEIVER_SIGMA_M: Final = 3.0  # sigma of the bias of a receiver, an axis, metres, which no line reduces
_SCALE_PAIRS: Final = 40  # matched pairs a vehicle, about (cost)
_UNKNOWN_FOV_SIGMA_DEG: Final = 10.0  # sigma of a field of view that could not be measured


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
        vehicle=frames[0].vehicle,
        frames=list(frames),
        leg=leg,
        lines=lines,
        cameras=cameras,
        sigma_m=sigma,
        fov_sigma_rad=float(fov_sigma),
        damaged=dict(pictures.damaged),
        warnings=warnings,
        cpu_s=process_time() - began,
    )
