"""Sparse photos of several vehicles matched and adjusted together, then taken apart into flights.

Each vehicle alone would leave its own scale, tilt and drift: seams between legs and vehicles close only if the photos
on both sides of them are adjusted together. Cameras that go by the same name share a lens until all else is found; then
each vehicle has its own, close to the common one.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.task_runner import Run, serial
from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.block_arrays import Tracks
from orthoswarm.refine.bundle.height_consistency import log_focal_sigmas
from orthoswarm.refine.bundle.priors import GroupPriors, Priors
from orthoswarm.refine.flight.record_findings import height_findings
from orthoswarm.refine.flight.relative_block import Flight
from orthoswarm.refine.flight.sparse_adjustment import datum_prior, solve_sparse, trusted_heights
from orthoswarm.refine.flight.sparse_block import make_flight, open_sparse_flight
from orthoswarm.refine.flight.sparse_start import SparseStart, read_photo_records, sparse_start
from orthoswarm.refine.initial.pair_graph import Progress, ReadGray
from orthoswarm.refine.initial.planar_similarity import Array

_MOST_LENSES = 16
_OWN_LENS_STEPS = 4
_OWN_LENS_SIGMA = (0.01, 0.01, 0.01, 0.05)
"""Of log f, k1, k2, k3 about the common lens."""
_OWN_CENTRE_SHARE = 0.004
_HELD_POSITION_M = 0.3
_HELD_ATTITUDE = float(np.radians(0.3))
_HELD_LENS = 0.003
_MOVABLE = GroupPriors(
    bias_sigma=(_HELD_ATTITUDE, _HELD_ATTITUDE, _HELD_ATTITUDE), height_sigma=1.0, lag_sigma=0.0, drift_sigma=15.0,
    drift_bend=0.5, knot_every=60,
)  # fmt: skip


def open_sparse_flights(
    units: Sequence[Sequence[Frame]],
    grid: LocalGrid,
    origin: Array,
    read: ReadGray,
    run: Run = serial,
    progress: Progress | None = None,
) -> list[Flight]:
    """Match the photos of several vehicles with each other and adjust them together, without a map.

    Args:
        units: frames of one vehicle and one lens each, in order of time.
        grid: the area's grid.
        origin: float64 (2,), of the local frame.
        read: gives a photo's grey values at full size.
        run: where features are found and matched; the result does not depend on it.
        progress: called with stage, done, all.

    Returns:
        A flight for each unit. Its adjustment holds its own photos only, with priors at what was found together: it
        may be moved as a whole (onto a map), but keeps its shape.
    """
    if len(units) == 1:
        return [open_sparse_flight(units[0], grid, origin, read, run, progress)]
    units = [[replace(frame, camera=part[0].camera) for frame in part] for part in units]
    frames = [frame for part in units for frame in part]
    records = read_photo_records(frames, grid, origin, share_lenses=True)
    start = sparse_start(frames, records, read, run, progress)
    adjustment = solve_sparse(start)
    believed = trusted_heights(adjustment, start)
    focal_sigma = log_focal_sigmas(adjustment)[adjustment.cameras.lens_id]
    if int(records.vehicle.max()) < _MOST_LENSES:
        adjustment = own_lenses(adjustment, start)
        focal_sigma = np.hypot(focal_sigma, log_focal_sigmas(adjustment)[adjustment.cameras.lens_id])
    found = height_findings(frames, start.records, start.plane, adjustment)
    told = _by_unit([*start.warnings, *found], [part[0].vehicle for part in units])
    flights, first = [], 0
    for part, warnings in zip(units, told, strict=True):
        rows = np.arange(first, first + len(part))
        first += len(part)
        alone = _extract_block(adjustment, start, rows)
        sigma = float(focal_sigma[rows[0]])
        flights.append(make_flight(part, grid, origin, read, start, rows, alone, believed, warnings, sigma))
    return flights


def _by_unit(warnings: Sequence[str], names: Sequence[str]) -> list[list[str]]:
    """Findings by unit; those that concern several go with the first one."""
    told: list[list[str]] = [[] for _ in names]
    for text in warnings:
        own = [k for k, name in enumerate(names) if text.startswith(f"{name}:")]
        told[own[0] if own else 0].append(text)
    return told


def own_lenses(adjustment: Adjustment, start: SparseStart) -> Adjustment:
    """Let every vehicle have its own lens, close to the one that it shared, and adjust on."""
    vehicle = start.records.vehicle
    first = [int(np.argmax(vehicle == v)) for v in range(int(vehicle.max()) + 1)]
    lens = adjustment.cameras.lens[adjustment.cameras.lens_id[first]].copy()
    p = adjustment.priors
    sigma = np.empty((len(lens), 6))
    sigma[:, :4] = _OWN_LENS_SIGMA
    sigma[:, 4:] = _OWN_CENTRE_SHARE * lens[:, 6:7]
    sigma[p.lens_sigma[adjustment.cameras.lens_id[first]] == 0] = 0.0
    cameras = replace(adjustment.cameras, lens=lens, lens_id=vehicle.astype(np.int32))
    priors = replace(p, lens=np.column_stack([np.log(lens[:, 0]), lens[:, 1:6]]), lens_sigma=sigma)
    own = Adjustment.begin(cameras, adjustment.tracks, priors, adjustment.points)
    own.common[own.layout.lens_columns :] = adjustment.common[adjustment.layout.lens_columns :]
    for _ in range(_OWN_LENS_STEPS):
        own.step(9.0, datum_prior(own))
    return own


def _extract_block(adjustment: Adjustment, start: SparseStart, rows: NDArray[np.int64]) -> Adjustment:
    """The adjustment of some photos by themselves, as found together with all others."""
    local = np.full(len(adjustment.cameras), -1, np.int32)
    local[rows] = np.arange(len(rows), dtype=np.int32)
    t = adjustment.tracks
    mine = local[t.camera] >= 0
    count = np.bincount(t.point[mine], minlength=len(adjustment.points))
    kept = np.flatnonzero(mine & (count[t.point] >= 2))
    points, point = np.unique(t.point[kept], return_inverse=True)
    tracks = Tracks(local[t.camera[kept]], point.reshape(-1).astype(np.int32), t.uv[kept], t.sigma_px[kept])
    cameras = adjustment.cameras.take(rows)
    lens_row = int(cameras.lens_id[0])
    cameras = replace(cameras, lens=cameras.lens[lens_row : lens_row + 1].copy(), lens_id=np.zeros(len(rows), np.int32))
    lens = np.concatenate([[np.log(cameras.lens[0, 0])], cameras.lens[0, 1:6]])[None]
    free = adjustment.priors.lens_sigma[lens_row] > 0
    priors = Priors(
        position=cameras.position.copy(),
        position_sigma=np.full((len(rows), 3), _HELD_POSITION_M),
        rotation=cameras.rotation.copy(),
        rotation_sigma=np.full((len(rows), 3), _HELD_ATTITUDE),
        velocity=start.velocity[rows],
        group=np.zeros(len(rows), np.int32),
        models=(_MOVABLE,),
        lens=lens,
        lens_sigma=np.where(free, _HELD_LENS * np.array([1, 1, 1, 1, cameras.lens[0, 6], cameras.lens[0, 6]]), 0.0)[
            None
        ],
    )
    return Adjustment.begin(cameras, tracks, priors, adjustment.points[points])
