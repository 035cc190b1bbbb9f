"""A vehicle's sparse photos as a Flight, adjusted without a map, for the same later steps as a dense one."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from orthoswarm.frame import Frame
from orthoswarm.geo import LocalGrid
from orthoswarm.swarm import records as dense
from orthoswarm.swarm.calibrate import Calibration
from orthoswarm.swarm.flight import Flight
from orthoswarm.swarm.heading import wrap
from orthoswarm.swarm.matching import Progress, ReadGray
from orthoswarm.swarm.pictures import Pictures
from orthoswarm.swarm.plane import Array
from orthoswarm.swarm.rig import CX, CY, HEIGHT, WIDTH, F, Tracks
from orthoswarm.swarm.segments import photo_legs
from orthoswarm.swarm.sparse import SparseStart, read_records, sparse_start
from orthoswarm.swarm.sparse_solve import heights_above_ground, solve_sparse


def open_sparse_flight(
    frames: Sequence[Frame],
    grid: LocalGrid,
    origin: Array,
    read: ReadGray,
    workers: int = 1,
    progress: Progress | None = None,
) -> Flight:
    """Match a vehicle's photos with each other and adjust them without a map.

    The counterpart of `flight.open_flight` for photos that cannot be followed, with the adjustment already solved.

    Args:
        frames: of one vehicle and one lens, in order of time.
        grid: the area's grid.
        origin: float64 (2,), of the local frame.
        read: gives a photo's grey values at full size.
        workers: threads; the result does not depend on it.
        progress: called with stage, done, all.
    """
    records = dense.read_records(frames, grid, origin)
    pictures = Pictures(frames, read)
    start = sparse_start(frames, read_records(frames, grid, origin), read, workers, progress)
    start = reduced(start, pictures.scale, pictures.size)
    adjustment = solve_sparse(start)
    pictures.damaged.update({k: reason for k, reason in start.reasons.items() if k in start.damaged})
    yaw = wrap(start.plane.yaw)
    calibration = Calibration(
        float(adjustment.rig.lens[0, F]),
        float(np.median(heights_above_ground(adjustment))),
        np.asarray(wrap(yaw - records.yaw)),
        bool(start.height_known.any()),
        start.pairs[1],
        list(start.warnings),
    )
    leg = photo_legs(start.plane.position, start.segment, start.records.time_s)
    held = start.placed.astype(np.float64)
    return Flight(frames, records.with_yaw(yaw), leg, pictures, calibration, adjustment, held, list(start.warnings))


def reduced(start: SparseStart, step: float, size: tuple[int, int]) -> SparseStart:
    """The same in pixels of pictures reduced `step` times to a size (columns, rows)."""
    lens = start.rig.lens.copy()
    lens[:, [F, CX, CY]] /= step
    lens[:, WIDTH], lens[:, HEIGHT] = size
    t = start.tracks
    tracks = Tracks(t.camera, t.point, (t.uv + 0.5) / step - 0.5, (t.sigma_px / np.float32(step)).astype(np.float32))
    rig = replace(start.rig, lens=lens)
    return replace(start, rig=rig, tracks=tracks, log_focal=start.log_focal - np.log(step))
