"""Photos without a position join the run where control points, or photos beside them, place them."""

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.batch.run_state import RunContext
from orthoswarm.evaluation.checkpoints import Checkpoint, read_checkpoints
from orthoswarm.evaluation.misread_points import require_places
from orthoswarm.model.frame import Frame, Ingest
from orthoswarm.raster.grey_pictures import WORK_WIDTH_PX
from orthoswarm.raster.picture_file import read_gray, reduction
from orthoswarm.refine.flight.record_findings import NAMED_MOST
from orthoswarm.refine.strategy.unpositioned_photos import place_unpositioned

_BESIDE_PHOTOS: Final = 15
"""Photos with a position before and after, of the same flight, that may show the ground of one without (its cost)."""


def with_found_positions(run: RunContext, ingest: Ingest) -> Ingest:
    """Inputs with the photos without a position that the points of --control, or photos beside them, place.

    Raises:
        InputError: the points cannot be read, or a mark lies outside its photo.
    """
    options = run.options
    photos, positioned, points = ingest.unpositioned, ingest.frames, list[Checkpoint]()
    if options.control is not None:
        points = read_checkpoints(options.control, options.pixel_scale)
        require_places((point.name, point.surveyed) for point in points)
    else:
        photos, positioned = _beside(ingest)
    tasks = run.workers.map
    placed, left = place_unpositioned(photos, positioned, points, read_gray=_reduced, run=tasks, progress=run.progress)
    names = {frame.image for frame in placed}
    by = "control points" if points else "the photos beside them"
    said = [f"{len(placed)} photos without a position were placed by {by}"] if placed else []
    said += _left_out(len(photos) - len(placed), left) if points else []
    return replace(
        ingest,
        frames=_in_order([*ingest.frames, *placed], ingest),
        rejected=[r for r in ingest.rejected if r.image not in names],
        warnings=[*ingest.warnings, *said],
        unpositioned=[f for f in ingest.unpositioned if f.image not in names],
    )


def _left_out(count: int, blocks: list[list[str]]) -> list[str]:
    """What is said about photos that control points could not place."""
    said = [
        f"{len(block)} photos without a position ({_first_of(block)}) show ground in common, but nothing tells where "
        "it is: two control points, some way apart, must be seen in them; they are left out"
        for block in blocks
    ]
    alone = count - sum(map(len, blocks))
    if alone:
        said.append(f"{alone} photos without a position show nothing that other photos show, and are left out")
    return said


def _beside(ingest: Ingest) -> tuple[list[Frame], list[Frame]]:
    """Photos without a position, of a size that their flight's others have, and those with one next to them in time."""
    flights = {(frame.vehicle, frame.width, frame.height) for frame in ingest.frames}
    photos = [f for f in ingest.unpositioned if (f.vehicle, f.width, f.height) in flights]
    lost = {frame.image for frame in photos}
    near: dict[str, Frame] = {}
    for vehicle in {frame.vehicle for frame in photos}:
        order = [f for f in _in_order([*ingest.frames, *photos], ingest) if f.vehicle == vehicle]
        known = np.flatnonzero([f.image not in lost for f in order])
        for k in np.flatnonzero([f.image in lost for f in order]):
            at = int(np.searchsorted(known, k))
            for n in known[max(at - _BESIDE_PHOTOS, 0) : at + _BESIDE_PHOTOS]:
                near[order[n].image] = order[n]
    return photos, list(near.values())


def _first_of(images: list[str]) -> str:
    more = f" and {len(images) - NAMED_MOST} more" if len(images) > NAMED_MOST else ""
    return ", ".join(images[:NAMED_MOST]) + more


def _reduced(frame: Frame) -> NDArray[np.uint8]:
    return read_gray(frame.path, reduction(frame.width, frame.height, WORK_WIDTH_PX))


def _in_order(frames: list[Frame], ingest: Ingest) -> list[Frame]:
    """By vehicle and time; where times are unknown, photos keep the order of their names."""
    vehicles = {f.vehicle: k for k, f in reversed(list(enumerate([*ingest.frames, *ingest.unpositioned])))}
    return sorted(frames, key=lambda f: (vehicles[f.vehicle], math.inf if f.time_s is None else f.time_s, f.image))
