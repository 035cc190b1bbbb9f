"""The batch: from frames to orthoimages, placements and report, stage by stage, each stage resumable.

load -> real time (paper III.B) -> coarse and fine refinement, vehicle by vehicle (III.C, III.D) -> final pictures.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.batch import map_pictures, refinement_stage, run_report
from orthoswarm.batch.run_state import (
    REALTIME,
    Load,
    MapOptions,
    RunContext,
    RunState,
)
from orthoswarm.batch.unreferenced import PART, keep_picture
from orthoswarm.batch.workspace import Workspace, run_key
from orthoswarm.compute.stage_times import Clock
from orthoswarm.compute.workers import Workers, prepare_process, usage_of, workers
from orthoswarm.control.control_observations import absent_marks, check_control
from orthoswarm.evaluation.checkpoints import Checkpoint, read_checkpoints, shared_points, shared_warning
from orthoswarm.evaluation.misread_points import require_places
from orthoswarm.export.atomic_file import disk_error
from orthoswarm.export.catalog.tiled_raster import product_file
from orthoswarm.export.temperature import read_temperatures
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.frame import Frame, Ingest, Rejection
from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.model.task_runner import Progress
from orthoswarm.mosaic.extent import partial_cover, placed_bounds
from orthoswarm.mosaic.footprint import default_gsd
from orthoswarm.mosaic.key_pictures import key_pictures
from orthoswarm.mosaic.oblique import stray_warning, strays
from orthoswarm.mosaic.recorded_pose import Recorded, area_grid, in_one_area, nothing_to_map, recorded_cameras
from orthoswarm.mosaic.seams.previews import PreviewFile
from orthoswarm.raster.basemap import Basemap
from orthoswarm.raster.grey_pictures import WORK_WIDTH_PX, GreyPictures
from orthoswarm.raster.height_model import HeightModel
from orthoswarm.raster.picture_file import read_gray, reduction
from orthoswarm.raster.picture_parts import PictureParts
from orthoswarm.refine.flight.record_findings import NAMED_MOST
from orthoswarm.refine.flight.unsolved_pictures import hovering_vehicles
from orthoswarm.refine.registration.photos_on_map import SearchedMap
from orthoswarm.refine.strategy.unpositioned_photos import pictures_moved, place_unpositioned
from orthoswarm.stores.addresses import address_of
from orthoswarm.stores.listing import exists
from orthoswarm.trajectory.legs import split_legs

_SPOT_DEG: Final = 0.001  # records farther apart than 110 m are none of a vehicle that hovers
_QUICK_LOOK: Final = "a quick look at a quarter of the detail; the same command without --quick goes on from it"
_MARKS: Final = "two control points, some way apart, must be seen in them"
_APART: Final = "none with the largest part, of which the picture is made"
_NOT_FOUND: Final = "they were not found on the basemap within the radius of --near"
_BESIDE_PHOTOS: Final = 15
"""Photos with a position before and after, of the same flight, that may show the ground of one without (its cost)."""


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
    if options.unreferenced:
        apart = replace(options, tiles="no")
        report = _run(load, out / PART, apart, workers, progress, drawers=drawers, publish=None)
        return keep_picture(out, report)
    return _run(load, out, options, workers, progress, drawers=drawers, publish=publish)


def _run(
    load: Load,
    out: Path,
    options: MapOptions,
    workers: Workers,
    progress: Progress,
    *,
    drawers: Workers | None,
    publish: Callable[[], None] | None,
) -> dict[str, Any]:
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
        if space.begin(run_key(state.ingest.frames, options, *files)) and not space.recall("quick look", False):
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
        if options.quick:
            state.warnings.append(_QUICK_LOOK)
        report = run_report.write_products(context, state, placed, refinement)
        if publish is not None and state.fault is None:
            publish()
        if options.quick:
            space.remember("quick look", True)
        else:
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
    ingest = without_false_spots(run, in_one_area(ingest))
    beside = bool(ingest.frames) and run.options.until != "realtime"  # photos that may tell where others were taken
    told = run.options.control is not None or run.options.near is not None or run.options.unreferenced
    if run.options.unreferenced and ingest.frames:
        raise InputError(f"{len(ingest.frames)} pictures have a position: leave out --unreferenced to map them")
    if ingest.unpositioned and (beside or told):
        ingest = with_found_positions(run, ingest)
    elif run.options.near is not None:
        ingest = replace(ingest, warnings=[*ingest.warnings, "--near was not used: every picture has a position"])
    if not ingest.frames:
        raise nothing_to_map(ingest)
    if run.options.temperature is not None:
        read_temperatures(ingest.frames[0].path, run.options.temperature)  # refused now, and not when all is drawn
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
    cameras = np.column_stack([at[:, :2], np.where(has_height, at[:, 2], np.nan)])
    model = HeightModel.open(path, grid.epsg, bounds, cameras)
    return model if run.options.refine == "swarm" else None


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
            shown = placed if run.options.until == "realtime" else key_pictures(placed, 0.0)
            stats = map_pictures.draw(run, REALTIME, shown, Terrain.flat(), state, realtime=True)
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


def make_map(
    frames: Ingest | Sequence[Frame],
    out: Path,
    options: MapOptions | None = None,
    *,
    processes: int | None = 1,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Make orthoimage, refined poses and report of pictures, as `orthoswarm mosaic` does.

    Args:
        frames: the pictures with their recorded poses; what `telemetry.load` gives, or frames of your own.
        out: output folder; a run that was interrupted there goes on.
        options: basemap, ground pixel and so on, see MapOptions.
        processes: how many compute at once, None for one a core. With more than one the calling script needs the guard
            `if __name__ == "__main__":`, as always with processes. The products do not depend on it.
        progress: called during the work with what is done, how many, and of how many.

    Returns:
        The content of report.json.

    Raises:
        InputError: no picture has a position, or a file of the options cannot be used.
        OrthoSwarmError: nothing could be made of them.
    """
    prepare_process()
    ingest = frames if isinstance(frames, Ingest) else Ingest(list(frames), [], [])
    options = options or MapOptions()
    pool = workers(processes)
    try:
        return run(lambda _: ingest, out, options, pool, progress or (lambda *_: None))
    finally:
        pool.close()


def legs_as_vehicles(frames: Sequence[Frame], grid: LocalGrid) -> list[Frame]:
    """Frames with each straight leg renamed to a separate vehicle (`id/leg1`); turns belong to the leg before."""
    members: dict[str, list[Frame]] = {}
    for frame in frames:
        members.setdefault(frame.vehicle, []).append(frame)
    out: list[Frame] = []
    for vehicle, own in members.items():
        ground = grid.to_grid([f.fix.lat_deg for f in own], [f.fix.lon_deg for f in own])
        leg = split_legs(ground)
        last = 0
        for frame, number in zip(own, leg.tolist(), strict=True):
            last = number if number >= 0 else last
            out.append(replace(frame, vehicle=f"{vehicle}/leg{last + 1}"))
    return out


def without_false_spots(run: RunContext, ingest: Ingest) -> Ingest:
    """Inputs whose vehicles recorded one spot only where they hovered; others' photos have no position.

    Their pictures drawn on one another would be no map.
    """
    members: dict[str, list[Frame]] = {}
    for frame in ingest.frames:
        members.setdefault(frame.vehicle, []).append(frame)
    lost = [own for own in members.values() if _at_one_spot(own) and _moved(run, own)]
    if not lost:
        return ingest
    images = {frame.image for own in lost for frame in own}
    why = (
        "the picture has no position: its receiver told one spot, but the pictures show that it flew on; put a geo.txt "
        "next to it, or give its log as well"
    )
    told = [
        f"{own[0].vehicle}: all {len(own)} pictures were recorded at one spot, but they show that it flew on: these "
        "positions are not used"
        for own in lost
    ]
    return replace(
        ingest,
        frames=[f for f in ingest.frames if f.image not in images],
        rejected=[*ingest.rejected, *(Rejection(f.image, why, f.vehicle, f.time_s, True) for own in lost for f in own)],
        unpositioned=[*ingest.unpositioned, *(_nowhere(f) for own in lost for f in own)],
        warnings=[*ingest.warnings, *told],
    )


def _nowhere(frame: Frame) -> Frame:
    return replace(frame, fix=replace(frame.fix, lat_deg=math.nan, lon_deg=math.nan, position_sigma_m=None))


def _at_one_spot(frames: Sequence[Frame]) -> bool:
    """Whether a vehicle hovered by its records."""
    north, east = np.ptp([(f.fix.lat_deg, f.fix.lon_deg) for f in frames], axis=0)
    if max(north, east * math.cos(math.radians(frames[0].fix.lat_deg))) > _SPOT_DEG:
        return False
    return bool(hovering_vehicles(recorded_cameras(frames, area_grid(frames)).placed))


def _moved(run: RunContext, frames: Sequence[Frame]) -> bool:
    return pictures_moved(frames, read_gray=_reduced, run=run.workers.map)


def with_found_positions(run: RunContext, ingest: Ingest) -> Ingest:
    """Inputs with the photos without a position that the points of --control, the basemap, or photos beside them place.

    Raises:
        InputError: the points or the basemap cannot be read, or a mark lies outside its photo.
        OrthoSwarmError: there are no other photos, and the basemap does not show these.
    """
    options, searched = run.options, None
    photos, positioned, points = ingest.unpositioned, ingest.frames, list[Checkpoint]()
    if options.control is not None:
        points = read_checkpoints(options.control, options.pixel_scale)
        require_places((point.name, point.surveyed) for point in points)
    if options.near is not None:
        searched = _searched_map(options)
    if options.control is None and searched is None and not options.unreferenced:
        photos, positioned = _beside(ingest)
    placed, left = place_unpositioned(
        photos,
        positioned,
        points,
        searched=searched,
        anywhere=options.unreferenced,
        read_gray=_reduced,
        run=run.workers.map,
        progress=run.progress,
    )
    if options.unreferenced and not placed:
        raise OrthoSwarmError(f"no two of {len(photos)} photos without a position show ground in common")
    if searched is not None and not placed and not ingest.frames:
        raise OrthoSwarmError(f"{len(photos)} photos have no position, and {_NOT_FOUND}; give another place or radius")
    names = {frame.image for frame in placed}
    by = "control points" if points else "the photos beside them" if searched is None else "the basemap"
    said = [f"{len(placed)} photos without a position were placed by {by}"] if placed else []
    if options.unreferenced:
        said = _left_out(len(photos) - len(placed), left, _APART)
    elif points or searched is not None:
        why = f"nothing tells where it is: {_MARKS if searched is None else _NOT_FOUND}"
        said += _left_out(len(photos) - len(placed), left, why)
    return replace(
        ingest,
        frames=_in_order([*ingest.frames, *placed], ingest),
        rejected=[r for r in ingest.rejected if r.image not in names],
        warnings=[*ingest.warnings, *said],
        unpositioned=[f for f in ingest.unpositioned if f.image not in names],
    )


def _searched_map(options: MapOptions) -> SearchedMap:
    """The part of the basemap in which photos without a position are looked for."""
    assert options.near is not None and options.basemap is not None  # the command line has asked for both
    lat, lon, radius_m = options.near
    epsg = area_epsg([lat], [lon])
    middle = LocalGrid(epsg).to_grid(lat, lon)
    area = BoundingBox.around_points(middle, radius_m)
    return SearchedMap(Basemap.open(options.basemap, epsg, area), middle, radius_m)


def _left_out(count: int, blocks: list[list[str]], why: str) -> list[str]:
    """What is said about photos that control points, the basemap or others could not place."""
    said = [
        f"{len(block)} photos without a position ({_first_of(block)}) show ground in common, but {why}; they are left "
        "out"
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
