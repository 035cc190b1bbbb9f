"""Photos without a position join the run where control points place them."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.batch.run_state import RunContext
from orthoswarm.evaluation.checkpoints import read_checkpoints
from orthoswarm.model.frame import Frame, Ingest
from orthoswarm.raster.grey_pictures import WORK_WIDTH_PX
from orthoswarm.raster.picture_file import read_gray, reduction
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
    placed = place_unpositioned(
        ingest.unpositioned, ingest.frames, points, read_gray=_reduced, run=tasks, progress=run.progress
    )
    names = {frame.image for frame in placed}
    left = len(ingest.unpositioned) - len(placed)
    said = [f"{len(placed)} photos without a position were placed by control points"] if placed else []
    if left:
        said.append(
            f"{left} photos without a position could not be placed: two control points must be seen in them or in "
            "photos that overlap with them"
        )
    return replace(
        ingest,
        frames=_in_order([*ingest.frames, *placed], ingest),
        rejected=[r for r in ingest.rejected if r.image not in names],
        warnings=[*ingest.warnings, *said],
        unpositioned=[f for f in ingest.unpositioned if f.image not in names],
    )


def _reduced(frame: Frame) -> NDArray[np.uint8]:
    return read_gray(frame.path, reduction(frame.width, frame.height, WORK_WIDTH_PX))


def _in_order(frames: list[Frame], ingest: Ingest) -> list[Frame]:
    """By vehicle and time; where times are unknown, photos keep the order of their names."""
    vehicles = {f.vehicle: k for k, f in reversed(list(enumerate([*ingest.frames, *ingest.unpositioned])))}
    return sorted(frames, key=lambda f: (vehicles[f.vehicle], math.inf if f.time_s is None else f.time_s, f.image))
