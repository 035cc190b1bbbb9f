"""The relative block of sparse photos, adjusted without a map, as a FlightBlock for the same further steps.

Photos of several vehicles are matched and adjusted together, then split into flights: alone, each vehicle would have
its own scale, tilt and drift. Cameras of the same name share a lens until the end; then each vehicle gets its own lens,
close to the shared one.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Flags, Indices
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.task_runner import Progress, Run, serial
from orthoswarm.refine.bundle import flight_records
from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.block_arrays import CX, CY, HEIGHT, WIDTH, F, Tracks
from orthoswarm.refine.bundle.height_consistency import log_focal_sigmas
from orthoswarm.refine.bundle.priors import GroupPriors, Priors
from orthoswarm.refine.features.flow_calibration import Calibration
from orthoswarm.refine.features.working_pictures import Pictures, ReadGray
from orthoswarm.refine.flight.record_findings import height_findings
from orthoswarm.refine.flight.relative_block import FlightBlock
from orthoswarm.refine.flight.sparse_adjustment import SPARSE_STAGE_C, datum_prior, solve_sparse, trusted_heights
from orthoswarm.refine.flight.sparse_start import SparseStart, photo_legs, read_photo_records, sparse_start

_JOINT_MOST_VEHICLES: Final = 16  # of more vehicles those with the same camera name share one lens (cost)
_JOINT_LENS_STEPS: Final = 4  # steps with a lens for each vehicle
_JOINT_LENS_SIGMA: Final = (0.01, 0.01, 0.01, 0.05)
"""Sigma of log f, k1, k2, k3 of a vehicle's lens about the common one."""
_JOINT_PRINCIPAL_POINT_SHARE: Final = 0.004  # sigma of its principal point about the common one, in picture widths
_JOINT_LENS_C: Final = 9.0  # robust scale c of those steps, squared sigmas
_HELD_POSITION_SIGMA_M: Final = 0.3  # sigma of positions found together, in the block of one vehicle
_HELD_ATTITUDE_SIGMA_DEG: Final = 0.3  # sigma of attitudes found together
_HELD_LENS_SIGMA: Final = 0.003  # sigma of lens parameters found together


def open_sparse_flight(frames: Sequence[Frame], grid: LocalGrid, origin: Array, read: ReadGray) -> FlightBlock:
    """The one flight of `open_sparse_flights`: the counterpart of `open_flight`; its adjustment is already solved."""
    return open_sparse_flights([frames], grid, origin, read)[0]


def _flight(
    frames: Sequence[Frame], grid: LocalGrid, origin: Array, read: ReadGray, *, start: SparseStart, rows: Indices,
    adjustment: Adjustment, trusted_height: Flags, warnings: list[str], focal_sigma: float,
) -> FlightBlock:  # fmt: skip
    """A vehicle's flight from photos adjusted alone or with others.

    start, trusted_height: of all photos that were matched together; rows: which of them are the vehicle's. adjustment:
    of its photos alone, in pixels of the full pictures.
    """
    records = flight_records.read_records(frames, grid, origin)
    pictures = Pictures(frames, read)
    adjustment = in_reduced_pixels(adjustment, pictures.scale, pictures.size)
    number = {int(row): k for k, row in enumerate(rows)}
    pictures.damaged.update({number[k]: start.damaged[k] for k in sorted(start.damaged) if k in number})
    yaw = wrap_rad(start.plane.yaw[rows])
    calibration = Calibration(
        focal_px=float(adjustment.cameras.lens[0, F]),
        height_m=float(np.median(adjustment.cameras.position[:, 2] - adjustment.ground_m)),
        yaw_offset=wrap_rad(yaw - records.yaw),
        trusted_height=bool(trusted_height[rows].any()),
        pairs=start.pairs[1],
        warnings=warnings,
    )
    leg = photo_legs(start.plane.position[rows], start.records.segment[rows], start.records.time_s[rows])
    return FlightBlock(
        frames=frames,
        records=replace(records, yaw=yaw),
        leg=leg,
        pictures=pictures,
        calibration=calibration,
        adjustment=adjustment,
        warnings=list(warnings),
        sparse=True,
        focal_sigma=focal_sigma,
    )


def in_reduced_pixels(adjustment: Adjustment, step: float, size: tuple[int, int]) -> Adjustment:
    """The adjustment in pixels of pictures reduced `step` times to a size (columns, rows), with recomputed weights."""
    cameras, t, p = adjustment.cameras, adjustment.tracks, adjustment.priors
    lens, lens_prior, lens_sigma = cameras.lens.copy(), p.lens.copy(), p.lens_sigma.copy()
    lens[:, [F, CX, CY]] /= step
    lens[:, WIDTH], lens[:, HEIGHT] = size
    lens_prior[:, 0] -= np.log(step)
    lens_prior[:, 4:] /= step
    lens_sigma[:, 4:] /= step
    tracks = Tracks(t.camera, t.point, (t.uv + 0.5) / step - 0.5, (t.sigma_px / np.float32(step)).astype(np.float32))
    priors = replace(p, lens=lens_prior, lens_sigma=lens_sigma)
    out = Adjustment.begin(replace(cameras, lens=lens), tracks, priors, adjustment.points)
    out.common[:] = adjustment.common
    out.common[: out.layout.lens_columns].reshape(-1, 6)[:, 4:] /= step
    # a step computes the weights and normal equations of the new adjustment
    out.step(SPARSE_STAGE_C[-1], datum_prior(out, out.ground_m))
    return out


def open_sparse_flights(
    units: Sequence[Sequence[Frame]], grid: LocalGrid, origin: Array, read: ReadGray, *, run: Run = serial,
    progress: Progress | None = None,
) -> list[FlightBlock]:  # fmt: skip
    """Match the photos of one or several vehicles with each other and adjust them together, without a map.

    units: frames of one vehicle and one lens each, in order of time. Returns a flight for each, whose adjustment
    contains its own photos only. Of several they have priors at the joint solution: such a flight may be moved rigidly
    (onto a map), but keeps its shape. run, progress: see `sparse_start`.
    """
    units = [[replace(frame, camera=part[0].camera) for frame in part] for part in units]
    frames = [frame for part in units for frame in part]
    records = read_photo_records(frames, grid, origin, share_lenses=True)
    start = sparse_start(frames, records, read, run, progress)
    adjustment = solve_sparse(start)
    trusted, focal_sigma = trusted_heights(adjustment, start), np.zeros(len(frames))
    if len(units) > 1:
        focal_sigma = log_focal_sigmas(adjustment)[adjustment.cameras.lens_id]
        if int(records.vehicle.max()) < _JOINT_MOST_VEHICLES:
            adjustment = own_lenses(adjustment, start)
            focal_sigma = np.hypot(focal_sigma, log_focal_sigmas(adjustment)[adjustment.cameras.lens_id])
    names = [part[0].vehicle for part in units]
    by_unit: list[list[str]] = [[] for _ in names]
    for text in [*start.warnings, *height_findings(frames, start.records, start.plane, adjustment)]:
        own = [k for k, name in enumerate(names) if text.startswith(f"{name}:")]
        by_unit[own[0] if own else 0].append(text)  # those about several units go to the first one
    flights, first = [], 0
    for part, warnings in zip(units, by_unit, strict=True):
        rows = np.arange(first, first + len(part))
        first += len(part)
        alone = _extract_block(adjustment, start, rows) if len(units) > 1 else adjustment
        flights.append(
            _flight(
                part, grid, origin, read, start=start, rows=rows, adjustment=alone, trusted_height=trusted,
                warnings=warnings, focal_sigma=float(focal_sigma[rows[0]]),
            )
        )  # fmt: skip
    return flights


def own_lenses(adjustment: Adjustment, start: SparseStart) -> Adjustment:
    """Give every vehicle its own lens, close to the shared one, and continue the adjustment."""
    vehicle = start.records.vehicle
    first = [int(np.argmax(vehicle == v)) for v in range(int(vehicle.max()) + 1)]
    lens = adjustment.cameras.lens[adjustment.cameras.lens_id[first]].copy()
    p = adjustment.priors
    sigma = np.empty((len(lens), 6))
    sigma[:, :4] = _JOINT_LENS_SIGMA
    sigma[:, 4:] = _JOINT_PRINCIPAL_POINT_SHARE * lens[:, 6:7]
    sigma[p.lens_sigma[adjustment.cameras.lens_id[first]] == 0] = 0.0
    cameras = replace(adjustment.cameras, lens=lens, lens_id=vehicle.astype(np.int32))
    priors = replace(p, lens=np.column_stack([np.log(lens[:, 0]), lens[:, 1:6]]), lens_sigma=sigma)
    own = Adjustment.begin(cameras, adjustment.tracks, priors, adjustment.points)
    own.common[own.layout.lens_columns :] = adjustment.common[adjustment.layout.lens_columns :]
    for _ in range(_JOINT_LENS_STEPS):
        own.step(_JOINT_LENS_C, datum_prior(own))
    return own


def _extract_block(adjustment: Adjustment, start: SparseStart, rows: Indices) -> Adjustment:
    """The part of a joint adjustment that concerns some photos."""
    local = np.full(len(adjustment.cameras), -1, np.int32)
    local[rows] = np.arange(len(rows), dtype=np.int32)
    t = adjustment.tracks
    mine = local[t.camera] >= 0
    count = np.bincount(t.point[mine], minlength=len(adjustment.points))
    observations = np.flatnonzero(mine & (count[t.point] >= 2))
    points = np.unique(t.point[observations])
    tracks = replace(t, camera=local[t.camera]).take(observations).renumbered()
    cameras = adjustment.cameras.take(rows)
    lens_row = int(cameras.lens_id[0])
    cameras = replace(cameras, lens=cameras.lens[lens_row : lens_row + 1].copy(), lens_id=np.zeros(len(rows), np.int32))
    lens = np.concatenate([[np.log(cameras.lens[0, 0])], cameras.lens[0, 1:6]])[None]
    free, width = adjustment.priors.lens_sigma[lens_row] > 0, cameras.lens[0, WIDTH]
    held = _HELD_LENS_SIGMA * np.array([1, 1, 1, 1, width, width])
    attitude = float(np.radians(_HELD_ATTITUDE_SIGMA_DEG))
    priors = Priors(
        position=cameras.position.copy(),
        position_sigma=np.full((len(rows), 3), _HELD_POSITION_SIGMA_M),
        rotation=cameras.rotation.copy(),
        rotation_sigma=np.full((len(rows), 3), attitude),
        velocity=start.velocity[rows],
        group=np.zeros(len(rows), np.int32),
        models=(GroupPriors(bias_sigma=(attitude, attitude, attitude), lag_sigma=0.0),),
        lens=lens,
        lens_sigma=np.where(free, held, 0.0)[None],
    )
    return Adjustment.begin(cameras, tracks, priors, adjustment.points[points])
