"""Photos without a position join the run where control points place them."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.batch.run_state import RunContext
from orthoswarm.config import active
from orthoswarm.evaluation.checkpoints import read_checkpoints
from orthoswarm.model.frame import Frame, Ingest
from orthoswarm.raster.picture_file import read_gray, reduction
from orthoswarm.refine.flight.record_findings import NAMED_MOST
from orthoswarm.refine.strategy.unpositioned_photos import place_unpositioned


def with_control_positions(run: RunContext, ingest: Ingest) -> Ingest:
    """Inputs with the photos without a position that the points of --control place.

    Raises:
        InputError: the points cannot be read, or a mark lies outside its photo.
    """
    options = run.options
    assert options.control is not None
    points = read_checkpoints(options.control, options.pixel_scale)
    tasks = run.workers.map
    placed, left = place_unpositioned(
        ingest.unpositioned, ingest.frames, points, read_gray=_reduced, run=tasks, progress=run.progress
    )
    names = {frame.image for frame in placed}
    said = [f"{len(placed)} photos without a position were placed by control points"] if placed else []
    said += [
        f"{len(block)} photos without a position ({_first_of(block)}) lie right to each other, but nothing tells "
        "where on the ground: two control points, some way apart, must be seen in them; they are left out"
        for block in left
    ]
    alone = len(ingest.unpositioned) - len(placed) - sum(map(len, left))
    if alone:
        said.append(f"{alone} photos without a position show nothing that other photos show, and are left out")
    return replace(
        ingest,
        frames=_in_order([*ingest.frames, *placed], ingest),
        rejected=[r for r in ingest.rejected if r.image not in names],
        warnings=[*ingest.warnings, *said],
        unpositioned=[f for f in ingest.unpositioned if f.image not in names],
    )


def _first_of(images: list[str]) -> str:
    more = f" and {len(images) - NAMED_MOST} more" if len(images) > NAMED_MOST else ""
    return ", ".join(images[:NAMED_MOST]) + more


def _reduced(frame: Frame) -> NDArray[np.uint8]:
    return read_gray(frame.path, reduction(frame.width, frame.height, active().features.work_width_px))


def _in_order(frames: list[Frame], ingest: Ingest) -> list[Frame]:
    """By vehicle and time; where times are unknown, photos keep the order of their names."""
    vehicles = {f.vehicle: k for k, f in reversed(list(enumerate([*ingest.frames, *ingest.unpositioned])))}
    return sorted(frames, key=lambda f: (vehicles[f.vehicle], math.inf if f.time_s is None else f.time_s, f.image))
