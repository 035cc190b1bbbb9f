"""Sparse photos of several vehicles matched and adjusted together, then split into flights.

Alone, each vehicle would have its own scale, tilt and drift: legs and vehicles only fit each other if the photos on
both sides are adjusted together. Cameras of the same name share a lens until the end; then each vehicle gets its own
lens, close to the shared one.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Array, Indices
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.task_runner import Progress, Run, serial
from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.block_arrays import WIDTH, Tracks
from orthoswarm.refine.bundle.height_consistency import log_focal_sigmas
from orthoswarm.refine.bundle.priors import GroupPriors, Priors
from orthoswarm.refine.flight.record_findings import height_findings
from orthoswarm.refine.flight.relative_block import Flight
from orthoswarm.refine.flight.sparse_adjustment import datum_prior, solve_sparse, trusted_heights
from orthoswarm.refine.flight.sparse_block import make_flight, open_sparse_flight
from orthoswarm.refine.flight.sparse_start import SparseStart, read_photo_records, sparse_start
from orthoswarm.refine.initial.pair_graph import ReadGray

_JOINT_MOST_VEHICLES: Final = 16  # of more vehicles those with the same camera name share one lens (cost)
_JOINT_LENS_STEPS: Final = 4  # steps with a lens for each vehicle
_JOINT_LENS_SIGMA: Final = (0.01, 0.01, 0.01, 0.05)
"""Sigma of log f, k1, k2, k3 of a vehicle's lens about the common one."""
_JOINT_PRINCIPAL_POINT_SHARE: Final = 0.004  # sigma of its principal point about the common one, in picture widths
_JOINT_LENS_C: Final = 9.0  # robust scale c of those steps, squared sigmas
_HELD_POSITION_SIGMA_M: Final = 0.3  # sigma of positions found together, in the block of one vehicle
_HELD_ATTITUDE_SIGMA_DEG: Final = 0.3  # sigma of attitudes found together
_HELD_LENS_SIGMA: Final = 0.003  # sigma of lens parameters found together


def open_sparse_flights(
    units: Sequence[Sequence[Frame]],
    grid: LocalGrid,
    origin: Array,
    read: ReadGray,
    *,
    run: Run = serial,
    progress: Progress | None = None,
) -> list[Flight]:
    """Match the photos of several vehicles with each other and adjust them together, without a map.

    Args:
        units: frames of one vehicle and one lens each, in order of time.
        grid: the area's grid.
        origin: float64 (2,), of the local frame.
        read: returns a photo's grey values at full size.
        run: executes the feature and matching tasks; the result does not depend on it.
        progress: called with stage, number done, total.

    Returns:
        A flight for each unit. Its adjustment contains its own photos only, with priors at the joint solution: it
        may be moved rigidly (onto a map), but keeps its shape.
    """
    if len(units) == 1:
        return [open_sparse_flight(units[0], grid, origin, read, run=run, progress=progress)]
    units = [[replace(frame, camera=part[0].camera) for frame in part] for part in units]
    frames = [frame for part in units for frame in part]
    records = read_photo_records(frames, grid, origin, share_lenses=True)
    start = sparse_start(frames, records, read, run, progress)
    adjustment = solve_sparse(start)
    trusted = trusted_heights(adjustment, start)
    focal_sigma = log_focal_sigmas(adjustment)[adjustment.cameras.lens_id]
    if int(records.vehicle.max()) < _JOINT_MOST_VEHICLES:
        adjustment = own_lenses(adjustment, start)
        focal_sigma = np.hypot(focal_sigma, log_focal_sigmas(adjustment)[adjustment.cameras.lens_id])
    found = height_findings(frames, start.records, start.plane, adjustment)
    by_unit = _by_unit([*start.warnings, *found], [part[0].vehicle for part in units])
    flights, first = [], 0
    for part, warnings in zip(units, by_unit, strict=True):
        rows = np.arange(first, first + len(part))
        first += len(part)
        alone = _extract_block(adjustment, start, rows)
        sigma = float(focal_sigma[rows[0]])
        flights.append(
            make_flight(
                part, grid, origin, read, start=start, rows=rows, adjustment=alone, trusted_height=trusted,
                warnings=warnings, focal_sigma=sigma,
            )
        )  # fmt: skip
    return flights


def _by_unit(warnings: Sequence[str], names: Sequence[str]) -> list[list[str]]:
    """Warnings by unit; those about several units go to the first one."""
    by_unit: list[list[str]] = [[] for _ in names]
    for text in warnings:
        own = [k for k, name in enumerate(names) if text.startswith(f"{name}:")]
        by_unit[own[0] if own else 0].append(text)
    return by_unit


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
    points, point = np.unique(t.point[observations], return_inverse=True)
    tracks = Tracks(
        local[t.camera[observations]], point.reshape(-1).astype(np.int32), t.uv[observations], t.sigma_px[observations]
    )
    cameras = adjustment.cameras.take(rows)
    lens_row = int(cameras.lens_id[0])
    cameras = replace(cameras, lens=cameras.lens[lens_row : lens_row + 1].copy(), lens_id=np.zeros(len(rows), np.int32))
    lens = np.concatenate([[np.log(cameras.lens[0, 0])], cameras.lens[0, 1:6]])[None]
    free = adjustment.priors.lens_sigma[lens_row] > 0
    width = cameras.lens[0, WIDTH]
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
