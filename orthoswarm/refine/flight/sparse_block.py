"""The relative block of sparse photos, adjusted without a map, as a Flight for the same further steps."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Flags, Indices
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.task_runner import Progress, Run, serial
from orthoswarm.refine.bundle import flight_records
from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.block_arrays import CX, CY, HEIGHT, WIDTH, F, Tracks
from orthoswarm.refine.features.flow_calibration import Calibration
from orthoswarm.refine.features.working_pictures import Pictures
from orthoswarm.refine.flight.record_findings import height_findings
from orthoswarm.refine.flight.relative_block import Flight
from orthoswarm.refine.flight.sparse_adjustment import (
    SPARSE_STAGE_C,
    datum_prior,
    heights_above_ground,
    solve_sparse,
    trusted_heights,
)
from orthoswarm.refine.flight.sparse_start import SparseStart, read_photo_records, sparse_start
from orthoswarm.refine.initial.pair_graph import ReadGray
from orthoswarm.refine.initial.segments import photo_legs


def open_sparse_flight(
    frames: Sequence[Frame],
    grid: LocalGrid,
    origin: Array,
    read: ReadGray,
    *,
    run: Run = serial,
    progress: Progress | None = None,
) -> Flight:
    """Match a vehicle's photos with each other and adjust them without a map.

    The counterpart of `open_flight` for photos that cannot be tracked; its adjustment is already solved.

    Args:
        frames: of one vehicle and one lens, in order of time.
        grid: the area's grid.
        origin: float64 (2,), of the local frame.
        read: returns a photo's grey values at full size.
        run: executes the feature and matching tasks; the result does not depend on it.
        progress: called with stage, number done, total.
    """
    frames = [replace(frame, camera=frames[0].camera) for frame in frames]
    start = sparse_start(frames, read_photo_records(frames, grid, origin), read, run, progress)
    adjustment = solve_sparse(start)
    trusted = trusted_heights(adjustment, start)
    warnings = [*start.warnings, *height_findings(frames, start.records, start.plane, adjustment)]
    return make_flight(
        frames, grid, origin, read, start=start, rows=np.arange(len(frames)), adjustment=adjustment,
        trusted_height=trusted, warnings=warnings,
    )  # fmt: skip


def make_flight(
    frames: Sequence[Frame],
    grid: LocalGrid,
    origin: Array,
    read: ReadGray,
    *,
    start: SparseStart,
    rows: Indices,
    adjustment: Adjustment,
    trusted_height: Flags,
    warnings: Sequence[str],
    focal_sigma: float = 0.0,
) -> Flight:
    """Make a vehicle's flight from photos adjusted alone or with others.

    Args:
        frames: of the vehicle.
        grid: the area's grid.
        origin: float64 (2,), of the local frame.
        read: returns a photo's grey values at full size.
        start: of all photos that were matched together.
        rows: which of them are the vehicle's.
        adjustment: of the vehicle's photos alone, in pixels of the full pictures.
        trusted_height: bool, of all photos, True where the final adjustment used the recorded height.
        warnings: for the report of this vehicle.
        focal_sigma: of a lens found together with other vehicles, see `Flight`.
    """
    records = flight_records.read_records(frames, grid, origin)
    pictures = Pictures(frames, read)
    adjustment = in_reduced_pixels(adjustment, pictures.scale, pictures.size)
    number = {int(row): k for k, row in enumerate(rows)}
    pictures.damaged.update({number[k]: start.reasons[k] for k in sorted(start.damaged) if k in number})
    yaw = wrap_rad(start.plane.yaw[rows])
    mine = list(warnings)
    calibration = Calibration(
        focal_px=float(adjustment.cameras.lens[0, F]),
        height_m=float(np.median(heights_above_ground(adjustment))),
        yaw_offset=wrap_rad(yaw - records.yaw),
        trusted_height=bool(trusted_height[rows].any()),
        pairs=start.pairs[1],
        warnings=mine,
    )
    leg = photo_legs(start.plane.position[rows], start.segment[rows], start.records.time_s[rows])
    held = start.placed[rows].astype(np.float64)
    return Flight(
        frames=frames,
        records=records.with_yaw(yaw),
        leg=leg,
        pictures=pictures,
        calibration=calibration,
        adjustment=adjustment,
        survived=held,
        warnings=list(mine),
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
    common_lens = out.common[: out.layout.lens_columns].reshape(-1, 6)
    common_lens[:, 4:] /= step
    # a step computes the weights and normal equations of the new adjustment
    out.step(
        SPARSE_STAGE_C[-1],
        datum_prior(out, float(np.median(out.points[:, 2])) if len(out.points) else 0.0),
    )
    return out
