"""The batch: from frames to orthoimages, placements and report, stage by stage, each stage resumable.

load -> real time (paper III.B) -> coarse and fine refinement, vehicle by vehicle (III.C, III.D) -> final pictures.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from orthoswarm.batch import map_pictures, refinement_stage, run_report
from orthoswarm.batch.run_state import (
    COARSE,
    ORTHOIMAGE,
    PRODUCTS,
    REALTIME,
    WRITTEN,
    Load,
    MapOptions,
    RunContext,
    RunState,
    is_written,
)
from orthoswarm.batch.split_legs import legs_as_vehicles
from orthoswarm.batch.unpositioned import with_found_positions
from orthoswarm.batch.workspace import Workspace, run_key
from orthoswarm.compute.stage_times import Clock
from orthoswarm.compute.workers import Workers, usage_of
from orthoswarm.control.control_observations import absent_marks, check_control
from orthoswarm.evaluation.checkpoints import Checkpoint, read_checkpoints
from orthoswarm.evaluation.independent_points import shared_points, shared_warning
from orthoswarm.export.atomic_file import disk_error
from orthoswarm.export.catalog.tiled_raster import product_file
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.frame import Ingest
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.model.task_runner import Progress
from orthoswarm.mosaic.extent import partial_cover, placed_bounds
from orthoswarm.mosaic.footprint import default_gsd
from orthoswarm.mosaic.oblique import stray_warning, strays
from orthoswarm.mosaic.recorded_pose import Recorded, area_grid, in_one_area, nothing_to_map, recorded_cameras
from orthoswarm.mosaic.seams.previews import PreviewFile
from orthoswarm.raster.basemap import Basemap
from orthoswarm.raster.grey_pictures import GreyPictures
from orthoswarm.raster.height_model import HeightModel, check_dem
from orthoswarm.raster.picture_parts import PictureParts
from orthoswarm.stores.addresses import address_of
from orthoswarm.stores.listing import exists

__all__ = [
    "COARSE",
    "ORTHOIMAGE",
    "PRODUCTS",
    "REALTIME",
    "WRITTEN",
    "Load",
    "MapOptions",
    "Progress",
    "is_written",
    "run",
]


def run(
    load: Load,
    out: Path,
    options: MapOptions,
    workers: Workers,
    progress: Progress,
    *,
    drawers: Workers | None = None,
    publish: Callable[[], None] | None = None,
) -> dict[str, Any]:
    """Make all products of a set of inputs.

    Args:
        load: reads the inputs, calling a progress function meanwhile.
        out: output folder; holds `PRODUCTS` afterwards.
        options: see MapOptions.
        workers: run the tasks; the products do not depend on their number.
        progress: called during long work.
        drawers: run the tasks that write into the output folder, where the workers do not see it; None: the workers.
        publish: called when all products are there; the run is complete, and its results of use to no later one, only
            after it. Not called if the refinement failed: a map of an earlier run is worth more.

    Returns:
        The content of report.json.

    Raises:
        InputError: if the inputs have no picture, or the basemap cannot be used.
        OrthoSwarmError: if nothing tells where the pictures were taken.
        OrthoSwarmError: if nothing could be made, or the refinement failed by an error of the program: then the
            real-time picture, the frames as recorded and the report with the error exist, but no orthoimage, which
            would look like a refined one.
    """
    if options.basemap is not None and not exists(options.basemap):
        raise InputError(f"the basemap {address_of(options.basemap)} does not exist; check the path")
    with Workspace(out) as space:
        context = RunContext(
            out=out,
            space=space,
            options=options,
            workers=workers,
            drawers=drawers or workers,
            progress=progress,
            clock=Clock(usage_of(workers, drawers)),
        )
        with context.clock.stage("load") as stage:
            state = _load(context, load)
            stage.items = len(state.ingest.frames) + len(state.ingest.rejected)
        files = options.basemap, options.dem, options.control, options.checkpoints
        if space.begin(run_key(state.ingest.frames, options, *files)):
            state.warnings.append("this run was interrupted before and was continued")
        placed = _realtime(context, state)
        refinement = None
        if options.until != "realtime":
            refinement = refinement_stage.refine(context, state)
            if state.fault is None:
                if refinement is not None:
                    refinement = refinement_stage.onto_ground(state, refinement)
                elif state.control_points:
                    state.warnings.append("the control points were not used: the pictures could not be refined")
                placed = map_pictures.refined_pictures(context, state, refinement)
            else:
                state.leave_out(state.undrawn, state.recorded.placed)
        report = run_report.write_products(context, state, placed, refinement)
        if publish is not None and state.fault is None:
            publish()
        space.complete()
    if state.fault is not None:
        stands = f"{REALTIME} stands, but there is no orthoimage"
        if publish is not None:
            stands = f"{out / REALTIME} stands, but there is no orthoimage, and nothing was uploaded"
        raise OrthoSwarmError(f"{state.fault}; {stands}: report this fault")
    return report


def _load(run: RunContext, load: Load) -> RunState:
    """Frames, grid, recorded cameras, ground pixel, basemap."""
    try:
        ingest = load(run.progress)
    except OSError as error:  # pictures of videos are written
        raise disk_error(error, run.out) from None
    ingest = in_one_area(ingest)
    beside = bool(ingest.frames) and run.options.until != "realtime"  # photos that may tell where others were taken
    if ingest.unpositioned and (beside or run.options.control is not None):
        ingest = with_found_positions(run, ingest)
    if not ingest.frames:
        raise nothing_to_map(ingest)
    grid = area_grid(ingest.frames)
    if run.options.split_legs:
        ingest = replace(ingest, frames=legs_as_vehicles(ingest.frames, grid))
    fov = run.options.fov_min_deg
    recorded = recorded_cameras(ingest.frames, grid, None if fov is None else float(np.radians(fov)))
    cameras = [p.camera for p in recorded.placed]
    gsd = run.options.gsd_m or default_gsd(cameras)
    basemap = None
    warnings = [*ingest.warnings, *recorded.warnings]
    if run.options.basemap is not None:
        near = placed_bounds(recorded.placed, 0.0, 0.0)
        basemap = Basemap.open(run.options.basemap, grid.epsg, near)
        basemap.require_readable(near)
        warnings += partial_cover(basemap, recorded.placed)
    dem = None if run.options.dem is None else _height_model(run, run.options.dem, grid, recorded)
    rejected = {r.image: r for r in (*ingest.rejected, *recorded.rejected)}
    control, said = _control_points(run, ingest, grid, recorded, basemap)
    warnings += said
    return RunState(
        ingest=ingest,
        grid=grid,
        recorded=recorded,
        gsd_m=gsd,
        basemap=basemap,
        dem=dem,
        warnings=warnings,
        rejected=rejected,
        control_points=control,
    )


def _control_points(
    run: RunContext, ingest: Ingest, grid: LocalGrid, recorded: Recorded, basemap: Basemap | None
) -> tuple[list[Checkpoint], list[str]]:
    """Read the points of --control, and warnings; refuse unusable ones and those of --checkpoints before the work."""
    options = run.options
    checks = [] if options.checkpoints is None else read_checkpoints(options.checkpoints, options.pixel_scale)
    if options.control is None:
        return [], []
    points = read_checkpoints(options.control, options.pixel_scale)
    check_control(points, recorded.placed, grid, basemap is not None)
    shared = shared_points(checks, points, options.checkpoints.name if options.checkpoints else "")
    doubts = dict.fromkeys(f"control points: {point.doubt}" for point in points if point.doubt)
    return points, [*absent_marks(points, ingest), *doubts, *shared_warning(shared, len(checks))]


def _height_model(run: RunContext, path: Path, grid: LocalGrid, recorded: Recorded) -> HeightModel | None:
    """The user's height model for a refiner that uses one; an unusable one is refused now, not after hours."""
    bounds = placed_bounds(recorded.placed, 0.0, 0.0)
    at = np.array([p.camera.position for p in recorded.placed])
    has_height = np.array([p.frame.fix.height_m is not None for p in recorded.placed])
    if run.options.refine != "swarm":
        check_dem(path, grid.epsg, bounds, at[has_height])
        return None
    return HeightModel.open(
        path, grid.epsg, bounds, np.column_stack([at[:, :2], np.where(has_height, at[:, 2], np.nan)])
    )


def _realtime(run: RunContext, state: RunState) -> list[PlacedFrame]:
    """Draw the real-time picture from recorded poses; returns its frames."""
    aside = strays(state.recorded.placed)
    placed = [p for p in state.recorded.placed if p.frame.image not in aside]
    if run.options.until != "realtime":
        images = [p.frame.image for p in state.recorded.placed]
        state.previews = PreviewFile.create(run.space.file("previews"), images)
        state.pictures = GreyPictures.create(
            run.space.file("pictures"), state.ingest.frames, run.options.config.raster.grey_pictures_mb
        )
        state.parts = PictureParts.create(
            run.space.file("parts"), len(images), run.options.config.raster.picture_parts_mb
        )
    known = run.space.recall("realtime")
    if known is not None and product_file(run.out, REALTIME) is not None:
        stats, stage = known
        run.clock.stages.append(stage)
    else:
        with run.clock.stage("realtime", len(placed)) as stage:
            stats = map_pictures.draw(run, REALTIME, placed, Terrain.flat(), state, realtime=True)
        if not stats.pixels.any():
            reason = next(iter(stats.rejected.values()), "no picture sees the ground")
            raise OrthoSwarmError(f"no picture could be drawn: {reason}")
        run.space.remember("realtime", (stats, stage))
    state.thumbnails, state.drawn = stats.thumbnails, stats.drawn
    state.undrawn = {**aside, **stats.rejected}
    if run.options.until == "realtime":
        state.leave_out(state.undrawn, state.recorded.placed)
        state.warnings += stray_warning(aside)
    return [p for p in placed if p.frame.image not in stats.rejected]
