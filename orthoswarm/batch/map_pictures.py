"""The rasters of a run: selection of the frames of each, and rendering as COGs."""

import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from orthoswarm.batch.run_state import COARSE, CONFIDENCE, ORTHOIMAGE, SEAMLINES, RunContext, RunState
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.compute.workers import trim_memory
from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.catalog.tiled_raster import copy_tiled, in_tiles, product_file, remove_tiles, write_tiled
from orthoswarm.export.cog import write_cog
from orthoswarm.export.footprint_layer import write_seamlines
from orthoswarm.export.product_files import describe_frame
from orthoswarm.export.temperature import TEMPERATURE, write_temperature
from orthoswarm.export.value_raster import write_confidence
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import last_time
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import PlacedFrame, Refinement, Solution, Terrain
from orthoswarm.mosaic.confidence import confidence, drawn_cells, trim_edge
from orthoswarm.mosaic.extent import drawn_window, ground_level, placed_bounds
from orthoswarm.mosaic.footprint import default_gsd, rejection
from orthoswarm.mosaic.kernels.downsampling import reduction
from orthoswarm.mosaic.key_pictures import key_pictures
from orthoswarm.mosaic.oblique import stray_warning, strays, weakly_held_warning
from orthoswarm.mosaic.radiometry import NO_MAP_TONE, estimate_fields, tone_warning
from orthoswarm.mosaic.realtime import mosaic
from orthoswarm.mosaic.renderer import Layer, RenderStats, Seams, render, render_layers
from orthoswarm.raster.grey_pictures import working_factor
from orthoswarm.raster.height_model import DEM_MOST_NODES, HeightModel
from orthoswarm.refine.flight.record_findings import NAMED_MOST

_PREVIEW_PX: Final = 4000
"""Pixels along the path of a real-time picture that refined ones follow: as much as is looked at meanwhile."""

_QUICK: Final = 4.0  # ground pixel of a quick look, in those of the map

_Map = tuple[Sequence[PlacedFrame], Terrain | None]
"""Frames and the ground under them: what a map is drawn from."""


def refined_pictures(run: RunContext, state: RunState, refinement: Refinement | None) -> list[PlacedFrame]:
    """Draw coarse.tif and orthoimage.tif; returns the frames as last placed."""
    drawn = any(run.space.recall(name) is not None for name in (COARSE, ORTHOIMAGE))  # in full, by an interrupted run
    coarser = _QUICK if run.options.quick and not drawn else 1.0
    if refinement is None:
        state.gsd_m *= coarser
        placed = _looking_down(run, state, state.recorded.placed)
        name = ORTHOIMAGE if run.options.until == "fine" else COARSE
        with run.clock.stage(f"final: {name.removesuffix('.tif')}", len(placed)):
            stats = draw(run, name, key_pictures(placed, 0.0, state.thumbnails), Terrain.flat(), state)
        if name == ORTHOIMAGE:
            _copy_coarse(run, state)
        state.drawn = stats.drawn
        state.leave_out(stats.rejected, placed)
        return [p for p in placed if p.frame.image not in state.rejected]
    terrain = state.terrain = _ground(run, state, refinement)
    state.warnings += refinement.warnings
    for solution in refinement.fine:
        reasons = dict(solution.dropped)
        state.leave_out(reasons, state.recorded.placed)
    state.warnings += vehicles_warnings([(s.vehicle, w) for s in refinement.fine for w in s.warnings])
    on_map = any(p.stage == "fine" for s in refinement.fine for p in s.placed)
    with_map = state.basemap is not None and run.options.until == "fine"
    if with_map and not on_map:
        state.warnings.append("no vehicle was found on the basemap; the orthoimage lies where the receivers say")
    fine = _looking_down(run, state, [p for s in refinement.fine for p in s.placed] + state.still)
    state.warnings += weakly_held_warning(fine, state.odd)
    level = ground_level(fine, terrain)
    if run.options.gsd_m is None:
        state.gsd_m = default_gsd([p.camera for p in fine], level)
    state.gsd_m *= coarser
    shown = key_pictures(fine, level, state.thumbnails)
    if run.options.gains:
        with run.clock.stage("final: gains", len(shown)):
            tone = state.basemap if run.options.tone == "map" and with_map and on_map else None
            ground, threads = terrain or Terrain.flat(), run.drawers.count
            state.gains = estimate_fields(shown, state.thumbnails, ground, tone=tone, threads=threads)
        trim_memory()
        if run.options.tone == "map":
            state.warnings.append(tone_warning(state.gains) if tone else NO_MAP_TONE)
    if run.options.until != "fine":
        _picture(run, state, COARSE, shown, terrain)
    elif with_map:
        names = {p.frame.image for p in shown}
        coarse = [p for s in refinement.coarse for p in s.placed] + state.still
        coarse = [p for p in coarse if p.frame.image in names]
        _both(run, state, (coarse, _shared_terrain(refinement.coarse)), (shown, terrain))
    else:
        _picture(run, state, ORTHOIMAGE, shown, terrain)
        _copy_coarse(run, state)
    return [p for p in fine if p.frame.image not in state.rejected]


def _looking_down(run: RunContext, state: RunState, placed: Sequence[PlacedFrame]) -> list[PlacedFrame]:
    """The frames without strongly oblique ones among nadir ones, which are left out."""
    aside = strays(placed)
    state.leave_out(aside, placed)
    state.warnings += stray_warning(aside)
    return [p for p in placed if p.frame.image not in aside]


def _ground(run: RunContext, state: RunState, refinement: Refinement) -> Terrain | None:
    """The ground under the pictures: found from them, or the user's height model at their level."""
    if run.options.dem is None or state.dem is not None:  # the refiner has used it
        return refinement.terrain
    fine = [p for s in refinement.fine for p in s.placed]
    level = ground_level(fine, refinement.terrain)
    bounds, cameras = placed_bounds(fine, level, level), np.array([[*p.camera.nadir, np.nan] for p in fine])
    model = HeightModel.open(run.options.dem, state.grid.epsg, bounds, cameras)
    ground = model.window(bounds, DEM_MOST_NODES).terrain
    return replace(ground, z=ground.z + np.float32(level))


def _both(run: RunContext, state: RunState, coarse: _Map, fine: _Map) -> None:
    """Render both refined maps at once, each picture read once, unless an interrupted run has one of them."""
    if any(run.space.recall(name) is not None for name in (COARSE, ORTHOIMAGE)):
        _picture(run, state, COARSE, *coarse)
        _picture(run, state, ORTHOIMAGE, *fine)
        return
    coarse_ground, fine_ground = coarse[1] or Terrain.flat(), fine[1] or Terrain.flat()
    with (
        run.clock.stage("final: coarse and orthoimage", len(fine[0])) as stage,
        _canvas(run, ORTHOIMAGE, fine[0], fine_ground, state, gsd_m=state.gsd_m) as second,
    ):
        with _canvas(run, COARSE, coarse[0], coarse_ground, state, gsd_m=state.gsd_m) as first:
            reading, gains = _DecodedSizes(state.gsd_m, [*coarse[0], *fine[0]], fine_ground), state.gains
            drawn = [reading.frames(frames) for frames in (coarse[0], fine[0])]
            layers = [
                Layer(frames=drawn[0], terrain=coarse_ground, canvas=first, gains=gains),
                Layer(frames=drawn[1], terrain=fine_ground, canvas=second, gains=gains, seams=_seams(run, state)),
            ]
            stats = render_layers(layers, **reading.how(run, state, "drawing orthoimage"))
            _write(run, first, COARSE, coarse[0])
        _write(run, second, ORTHOIMAGE, fine[0])
        _write_about(run, state, second, fine[0], fine_ground)
    run.space.clear_scratch()
    state.drawn = stats[1].drawn
    if not run.options.quick:
        run.space.remember(ORTHOIMAGE, (stats[1].rejected, state.drawn, state.trust, stage))
        run.space.remember(COARSE, (stats[0].rejected, stats[0].drawn, {}, replace(stage, wall_s=0.0, cpu_s=0.0)))
    for s in stats:
        state.leave_out(s.rejected, fine[0])


def _picture(
    run: RunContext, state: RunState, name: str, placed: Sequence[PlacedFrame], terrain: Terrain | None
) -> None:
    """Render one product, unless an interrupted run has."""
    known = run.space.recall(name)
    if known is not None and product_file(run.out, name) is not None:
        rejected, state.drawn, state.trust, stage = known
        run.clock.stages.append(stage)
    else:
        label = "orthoimage" if name == ORTHOIMAGE else "coarse picture"
        with run.clock.stage(f"final: {label}", len(placed)) as stage:
            stats = draw(run, name, placed, terrain or Terrain.flat(), state)
        rejected, state.drawn = stats.rejected, stats.drawn
        if not run.options.quick:
            run.space.remember(name, (rejected, state.drawn, state.trust, stage))
    state.leave_out(rejected, placed)


def draw(
    run: RunContext,
    name: str,
    placed: Sequence[PlacedFrame],
    terrain: Terrain,
    state: RunState,
    *,
    realtime: bool = False,
) -> RenderStats:
    """Render frames on their own canvas and write it as a COG."""
    preview = realtime and run.options.until != "realtime" and run.options.gsd_m is None
    gsd_m = _preview_gsd(placed) if preview else state.gsd_m
    reading = _DecodedSizes(gsd_m, placed, terrain)
    with _canvas(run, name, placed, terrain, state, gsd_m=gsd_m) as canvas:
        how = reading.how(run, state, f"drawing {name.removesuffix('.tif')}")
        if realtime:
            stats = mosaic(reading.frames(placed), canvas, previews=state.previews, **how)
        else:
            seams = _seams(run, state) if name == ORTHOIMAGE else None
            stats = render(reading.frames(placed), terrain, canvas, gains=state.gains, seams=seams, **how)
        if name == ORTHOIMAGE and run.options.edge == "trim":
            trim_edge(canvas, placed, terrain)
        _write(run, canvas, name, placed)
        if name == ORTHOIMAGE:
            _write_about(run, state, canvas, placed, terrain)
    run.space.clear_scratch()
    return stats


def _seams(run: RunContext, state: RunState) -> Seams | None:
    """How the seams of the orthoimage are chosen."""
    if state.previews is None:
        return None
    return Seams(
        state.previews,
        run.options.blend,
        level=run.options.gains,
        feather_px=run.options.config.mosaic.feather_px,
    )


class _DecodedSizes:
    """How pictures are read for a map: reduced as they are decoded where its pixel is coarse enough for that.

    gsd_m: the map's pixel. placed: the frames. terrain: under them.
    """

    def __init__(self, gsd_m: float, placed: Sequence[PlacedFrame], terrain: Terrain) -> None:
        heights = terrain.height(np.array([p.camera.nadir for p in placed]).reshape(-1, 2))
        self._factor = {}
        for p, z in zip(placed, heights.tolist(), strict=True):
            factor = working_factor(p.frame)
            most = reduction(gsd_m, (p.camera.position[2] - z) / p.camera.lens.focal_px)
            while factor > most:
                factor //= 2
            self._factor[p.frame.image] = factor

    def frames(self, placed: Sequence[PlacedFrame]) -> list[PlacedFrame]:
        """Frames with their pictures as they are read."""
        return [p.reduced(self._factor[p.frame.image]) for p in placed]

    def how(self, run: RunContext, state: RunState, doing: str) -> dict[str, Any]:
        """Arguments of the renderer; parts are kept of whole pictures."""
        parts = state.parts if max(self._factor.values(), default=1) == 1 else None
        return {
            "read": state.read_rgb(),
            "parts": parts,
            "run": run.drawers.map,
            "progress": partial(run.progress, doing),
        }


def _preview_gsd(placed: Sequence[PlacedFrame]) -> float:
    """The ground pixel of the real-time picture that refined ones follow, metres."""
    working = default_gsd([p.reduced(working_factor(p.frame)).camera for p in placed])
    area = BoundingBox.around_points([p.camera.nadir for p in placed])
    return max(working, area.width / _PREVIEW_PX, area.height / _PREVIEW_PX)


def _canvas(
    run: RunContext, name: str, placed: Sequence[PlacedFrame], terrain: Terrain, state: RunState, *, gsd_m: float
) -> Canvas:
    """An empty canvas for a product of these frames."""
    low, high = float(terrain.z.min()), float(terrain.z.max())
    usable = [p for p in placed if rejection(p.camera, float(terrain.height(p.camera.nadir)), gsd_m) is None]
    if not usable:
        reason = rejection(placed[0].camera, low, gsd_m) if placed else "there is none"
        raise OrthoSwarmError(f"no picture can be drawn: {reason}")
    grid = GroundGrid.around(state.grid.epsg, placed_bounds(usable, low, high), gsd_m)
    folder, memory_mb = run.space.scratch(name.removesuffix(".tif")), run.options.config.compute.canvas_mb
    return Canvas.create(folder, grid, plane="frame", memory_mb=memory_mb)


def _write(run: RunContext, canvas: Canvas, name: str, placed: Sequence[PlacedFrame]) -> None:
    """Write a canvas as a COG, a large one in tiles; its date is that of the last of these frames."""
    last = last_time(p.frame for p in placed)
    written = partial(run.progress, f"writing {name}")
    window, threads = drawn_window(canvas), run.drawers.count
    if in_tiles(run.options.tiles, window):
        drawn = map(canvas.tile_bounds, canvas.changed_since(0))
        write_tiled(canvas, run.out, name, window=window, drawn=drawn, progress=written, threads=threads, time_s=last)
        return
    write_cog(canvas, run.out / name, window=window, progress=written, threads=threads, time_s=last)
    remove_tiles(run.out, name)


def _write_about(
    run: RunContext, state: RunState, canvas: Canvas, placed: Sequence[PlacedFrame], terrain: Terrain
) -> None:
    """Write which picture shows which ground, and how far it can be trusted."""
    write_seamlines(run.out / SEAMLINES, canvas, [partial(describe_frame, p) for p in placed], run=run.drawers.map)
    gains = [state.gains.get(p.frame.image) for p in placed]
    found = confidence(*drawn_cells(canvas), placed, terrain, gains)
    write_confidence(run.out / CONFIDENCE, found)
    state.trust = found.figures()
    if run.options.temperature is not None:
        scratch, kelvin = run.space.scratch("values"), run.options.temperature
        write_temperature(run.out / TEMPERATURE, canvas, placed, terrain, kelvin=kelvin, scratch=scratch)


def _copy_coarse(run: RunContext, state: RunState) -> None:
    """Without a map the orthoimage is the coarse product, too: one file under both names where the disk can do that."""
    whole, coarse = run.out / ORTHOIMAGE, run.out / COARSE
    if whole.exists():
        if not (coarse.exists() and coarse.samefile(whole)):
            with atomic_write(coarse) as part:
                try:
                    os.link(whole, part)
                except OSError:
                    shutil.copyfile(whole, part)
        remove_tiles(run.out, COARSE)
    else:
        copy_tiled(run.out, ORTHOIMAGE, COARSE)
    moved = state.control is not None and state.control.by_receivers is not None
    received = any(frame.has_own_position for frame in state.ingest.frames)
    if run.options.basemap is None and received and not moved:
        state.warnings.append("there is no basemap: the orthoimage lies where the drones' receivers say")


def _shared_terrain(solutions: Sequence[Solution]) -> Terrain | None:
    """The common ground of coarse solutions, None if there is none."""
    return next((s.terrain for s in solutions if s.terrain is not None), None)


def vehicles_warnings(said: Iterable[tuple[str, str]]) -> list[str]:
    """Warnings with their vehicles' names before them; what is the same for several is told once for all.

    Args:
        said: vehicle and warning; one that begins with the vehicle's name is its own.
    """
    vehicles: dict[str, list[str]] = {}
    for vehicle, warning in said:
        vehicles.setdefault(warning, []).append("" if warning.startswith(vehicle) else vehicle)
    told, most = [], NAMED_MOST
    for warning, names in vehicles.items():
        if not all(names):
            told.append(warning)
        elif len(names) == 1:
            told.append(f"{names[0]}: {warning}")
        else:
            rest = f" and {len(names) - most} more" if len(names) > most else ""
            told.append(f"{len(names)} vehicles ({', '.join(names[:most])}{rest}), of each: {warning}")
    return told
