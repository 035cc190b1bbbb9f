"""The batch: from frames to orthoimages, placements and report, stage by stage, each stage resumable.

load -> real time (paper III.B) -> coarse and fine refinement, vehicle by vehicle (III.C, III.D) -> final pictures.
"""

import logging
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from orthoswarm.batch.batch_refinement import Refinement, append_carried, named, shared_terrain, split_time
from orthoswarm.batch.split_legs import legs_as_vehicles
from orthoswarm.batch.workspace import Workspace, run_key
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.compute.stage_times import Clock, Stage
from orthoswarm.compute.workers import Workers, trim_memory
from orthoswarm.config import Overrides, override
from orthoswarm.export.atomic_file import disk_error, written_whole
from orthoswarm.export.cog import write_cog
from orthoswarm.export.product_files import image_root, leg_rows, stage_row, vehicle_rows, write_frames, write_json
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.frame import Frame, Ingest, Rejection
from orthoswarm.model.geo import GroundGrid, LocalGrid
from orthoswarm.model.placement import PlacedFrame, Solution, Terrain
from orthoswarm.mosaic.extent import drawn_window, from_takeoff, ground_level, map_offset, partial_cover, placed_bounds
from orthoswarm.mosaic.footprint import default_gsd, rejection
from orthoswarm.mosaic.oblique import loose, strays, told
from orthoswarm.mosaic.radiometry import estimate_fields
from orthoswarm.mosaic.realtime import mosaic
from orthoswarm.mosaic.recorded_pose import Recorded, area_grid, hint_lone_photos, nothing_to_map, recorded_cameras
from orthoswarm.mosaic.renderer import Layer, RenderStats, render, render_layers
from orthoswarm.raster.basemap import Basemap
from orthoswarm.raster.height_model import HeightModel, check_dem, read_dem
from orthoswarm.raster.map_check import UnreadableMapError
from orthoswarm.refine.flight.unsolved_pictures import place_by_neighbours, split_refinable
from orthoswarm.report.page import write_page

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Progress = Callable[[str, int, int], None]
"""Called with what is being done, how many are done, how many there are."""
Load = Callable[[Progress], Ingest]
_Map = tuple[Sequence[PlacedFrame], Terrain | None]
"""Frames and the ground under them: what a map is drawn from."""

_CANVAS_MB = 48.0
_REFINERS = {"swarm": "orthoswarm.refine.strategy.swarm_refiner", "paper": "orthoswarm.paper.paper_refiner"}
REALTIME, COARSE, ORTHOIMAGE = "realtime.tif", "coarse.tif", "orthoimage.tif"
PRODUCTS = (REALTIME, COARSE, ORTHOIMAGE, "frames.jsonl", "footprints.gpkg", "report.json", "report.html")


@dataclass(frozen=True, slots=True)
class Options:
    """What to make of the frames.

    Attributes:
        basemap: the pre-disaster map, None to stay in the receivers' frame.
        refine: which refiner. until: the last stage to run.
        fov_min_deg: theta-hat, the assumed field of view of the real-time stage; None takes hints, else 70.
        gsd_m: ground pixel of the products; None for the median ground pixel at nadir.
        dem: raster of ground heights. split_legs: a leg of a vehicle is a vehicle of its own.
        gains: even out brightness between pictures.
        config: thresholds of the refiner in the place of their defaults.
    """

    basemap: Path | None = None
    refine: Literal["swarm", "paper"] = "swarm"
    until: Literal["realtime", "coarse", "fine"] = "fine"
    fov_min_deg: float | None = None
    gsd_m: float | None = None
    dem: Path | None = None
    split_legs: bool = False
    gains: bool = True
    config: Overrides = field(default_factory=dict)


@dataclass(slots=True)
class _State:
    """What is known so far in a run."""

    ingest: Ingest
    grid: LocalGrid
    recorded: Recorded
    gsd_m: float
    basemap: Basemap | None
    dem: HeightModel | None = None
    warnings: list[str] = field(default_factory=list)
    rejected: dict[str, Rejection] = field(default_factory=dict)
    thumbnails: dict[str, Bytes] = field(default_factory=dict)
    gains: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    still: list[PlacedFrame] = field(default_factory=list)
    odd: list[PlacedFrame] = field(default_factory=list)
    terrain: Terrain | None = None
    drawn: tuple[float, float] = (0.0, 1.0)
    equation_5: dict[str, float] | None = None
    undrawn: Mapping[str, str] = field(default_factory=dict)
    fault: str | None = None


def run(load: Load, out: Path, options: Options, workers: Workers, progress: Progress) -> dict[str, Any]:
    """Make all products of a set of inputs.

    Args:
        load: reads the inputs, calling a progress function meanwhile.
        out: output folder; holds `PRODUCTS` afterwards.
        options: see Options.
        workers: where work runs; the products do not depend on their number.
        progress: called during long work.

    Returns:
        The content of report.json.

    Raises:
        InputError: if the inputs hold no picture with a position, or the basemap is of no use.
        OrthoSwarmError: if nothing could be made, or the refinement failed by a fault of the program: then the
            real-time picture, the frames as recorded and the report with the fault stand, and no orthoimage that would
            pass for a refined one.
    """
    return _Batch(out, options, workers, progress).run(load)


class _Batch:
    """One run: what its stages share."""

    def __init__(self, out: Path, options: Options, workers: Workers, progress: Progress) -> None:
        self.out, self.options, self.workers, self.progress = out, options, workers, progress
        self.clock = Clock(workers.usage)

    def run(self, load: Load) -> dict[str, Any]:
        if self.options.basemap is not None and not self.options.basemap.exists():
            raise InputError(f"the basemap {self.options.basemap} does not exist; check the path")
        override(self.options.config)
        with Workspace(self.out) as self.space:
            with self.clock.stage("load") as stage:
                state = self.load(load)
                stage.items = len(state.ingest.frames) + len(state.ingest.rejected)
            key = run_key(state.ingest.frames, self.options, self.options.basemap, self.options.dem)
            if self.space.begin(key):
                state.warnings.append("this run was interrupted before and was continued")
            placed = self.realtime(state)
            refinement = None
            if self.options.until != "realtime":
                refinement = self.refine(state)
                if state.fault is None:
                    placed = self.pictures(state, refinement)
                else:
                    self.leave_out(state, state.undrawn, state.recorded.placed)
            report = self.finish(state, placed, refinement)
            self.space.complete()
            if state.fault is not None:
                raise OrthoSwarmError(
                    f"{state.fault}; {REALTIME} stands, but there is no orthoimage: report this fault"
                )
        return report

    # -- stages ---------------------------------------------------------------------------------------------------

    def load(self, load: Load) -> _State:
        """Frames, grid, recorded cameras, ground pixel, basemap."""
        try:
            ingest = load(self.progress)
        except OSError as error:  # pictures of videos are written
            raise disk_error(error, self.out) from None
        if not ingest.frames:
            raise InputError(nothing_to_map(ingest))
        grid = area_grid(ingest.frames)
        if self.options.split_legs:
            ingest = replace(ingest, frames=legs_as_vehicles(ingest.frames, grid))
        fov = self.options.fov_min_deg
        recorded = recorded_cameras(ingest.frames, grid, None if fov is None else float(np.radians(fov)))
        cameras = [p.camera for p in recorded.placed]
        gsd = self.options.gsd_m or default_gsd(cameras)
        basemap = None
        warnings = [*ingest.warnings, *recorded.warnings]
        if self.options.basemap is not None:
            near = placed_bounds(recorded.placed, 0.0, 0.0)
            basemap = Basemap.open(self.options.basemap, grid.epsg, near)
            basemap.require_readable(near)
            warnings += partial_cover(basemap, recorded.placed)
        dem = None if self.options.dem is None else self.height_model(self.options.dem, grid, recorded)
        rejected = {r.image: r for r in (*ingest.rejected, *recorded.rejected)}
        return _State(ingest, grid, recorded, gsd, basemap, dem, warnings, rejected)

    def height_model(self, path: Path, grid: LocalGrid, recorded: Recorded) -> HeightModel | None:
        """The outside height model for the refiner that uses one; a useless one is told now, not after hours."""
        bounds = placed_bounds(recorded.placed, 0.0, 0.0)
        at = np.array([p.camera.position for p in recorded.placed])
        told = np.array([p.frame.fix.height_m is not None for p in recorded.placed])
        if self.options.refine != "swarm":
            check_dem(path, grid.epsg, bounds, at[told])
            return None
        return HeightModel.open(path, grid.epsg, bounds, np.column_stack([at[:, :2], np.where(told, at[:, 2], np.nan)]))

    def realtime(self, state: _State) -> list[PlacedFrame]:
        """The picture from recorded poses; the frames that it holds."""
        aside = strays(state.recorded.placed)
        placed = [p for p in state.recorded.placed if p.frame.image not in aside]
        known = self.space.recall("realtime")
        if known is not None and (self.out / REALTIME).exists():
            stats, stage = known
            self.clock.stages.append(stage)
        else:
            with self.clock.stage("realtime", len(placed)) as stage:
                stats = self.draw(REALTIME, placed, Terrain.flat(), state, realtime=True)
            if not stats.pixels.any():
                reason = next(iter(stats.rejected.values()), "no picture sees the ground")
                raise OrthoSwarmError(f"no picture could be drawn: {reason}")
            self.space.remember("realtime", (stats, stage))
        state.thumbnails, state.drawn = stats.thumbnails, (stats.drawn_m2, stats.covered_share)
        state.undrawn = {**aside, **stats.rejected}
        if self.options.until == "realtime":
            self.leave_out(state, state.undrawn, state.recorded.placed)
            state.warnings += told(aside)
        return [p for p in placed if p.frame.image not in stats.rejected]

    def refine(self, state: _State) -> Refinement | None:
        """Coarse and fine cameras of all vehicles; None where the refiner could make nothing of them."""
        by_kind = split_refinable(state.recorded.placed)
        state.still, state.odd = by_kind.still, by_kind.odd
        state.warnings += by_kind.warnings
        if not by_kind.fit:
            if state.basemap is not None and self.options.until == "fine":
                state.warnings.append("the basemap was not used; the orthoimage lies where the receivers say")
            return None
        known: tuple[Refinement, list[Stage]] | None = self.space.recall("refinement")
        if known is not None:
            self.clock.stages += known[1]
            state.basemap = None if known[0].map_lost else state.basemap
            return known[0]
        outer = Clock(self.workers.usage)
        frames = hint_lone_photos(by_kind.fit)
        with outer.stage("refine", len(frames)) as stage:
            try:
                refinement = self.refined(frames, state)
            except OrthoSwarmError as error:
                state.warnings.append(f"the pictures could not be refined ({error}); the map is the real-time one")
                return None
            except Exception as error:  # in the field a rough map is better than none; the fault is told in full
                logging.getLogger(__name__).exception("the refinement failed")
                state.fault = f"the refinement failed ({type(error).__name__}: {error})"
                state.warnings.append(f"{state.fault}; the map is the real-time one")
                return None
        for solutions in (refinement.coarse, refinement.fine):
            placed = [p for s in solutions for p in s.placed]
            append_carried(solutions, place_by_neighbours(by_kind.odd, by_kind.fit, placed))
        stages = split_time(stage, refinement, self.options.until, state.basemap is not None)
        self.clock.stages += stages
        self.space.remember("refinement", (refinement, stages))
        return refinement

    def refined(self, frames: Sequence[Frame], state: _State) -> Refinement:
        """The refinement; without the map where that turns out to be unreadable after its check.

        The photos adjusted to each other are worth more than the real-time picture, and hours may have gone into it.
        """
        try:
            return self.call_refiner(frames, state)
        except UnreadableMapError as error:
            lost = f"{error}: it was not used, the orthoimage is the coarse one and lies where the receivers say"
        state.basemap = None
        refinement = self.call_refiner(frames, state)
        refinement.warnings.append(lost)
        refinement.map_lost = True
        return refinement

    def call_refiner(self, frames: Sequence[Frame], state: _State) -> Refinement:
        # Only the one that is asked for: the other's imports would cost memory in every run.
        refine: Any = import_module(_REFINERS[self.options.refine]).refine_all
        vehicles: dict[str, list[Frame]] = {}
        for frame in frames:
            vehicles.setdefault(frame.vehicle, []).append(frame)
        basemap = state.basemap if self.options.until == "fine" else None
        # Results with a map that was lost are others than those without it.
        lost = state.basemap is None and self.options.basemap is not None
        run = self.space.remembering("vehicle without map" if lost else "vehicle", self.workers.map)
        if state.dem is not None:
            options = import_module(_REFINERS["swarm"]).Options(dem=state.dem)
            refined = refine(vehicles, basemap, state.grid, options, run=run, progress=self.progress)
        else:
            refined = refine(vehicles, basemap, state.grid, run=run, progress=self.progress)
        if self.options.refine == "paper":
            state.equation_5 = refined.equation_5()
        strip = [[replace(s, state=None) for s in solutions] for solutions in (refined.coarse, refined.fine)]
        terrain, warnings = refined.terrain, list(getattr(refined, "warnings", []))
        del refined  # with the states of all vehicles
        trim_memory()
        return Refinement(strip[0], strip[1], terrain, warnings)

    def pictures(self, state: _State, refinement: Refinement | None) -> list[PlacedFrame]:
        """coarse.tif and orthoimage.tif; gives the frames as last placed."""
        if refinement is None:
            placed = self.looking_down(state, state.recorded.placed)
            name = ORTHOIMAGE if self.options.until == "fine" else COARSE
            with self.clock.stage(f"final: {name.removesuffix('.tif')}", len(placed)):
                stats = self.draw(name, placed, Terrain.flat(), state)
            if name == ORTHOIMAGE:
                self.copy_coarse(state)
            state.drawn = (stats.drawn_m2, stats.covered_share)
            self.leave_out(state, stats.rejected, placed)
            return [p for p in placed if p.frame.image not in state.rejected]
        terrain = state.terrain = self.ground(state, refinement)
        state.warnings += refinement.warnings
        for solution in refinement.fine:
            reasons = dict(solution.dropped)
            self.leave_out(state, reasons, state.recorded.placed)
            state.warnings += [named(solution.vehicle, w) for w in solution.warnings]
        on_map = any(p.stage == "fine" for s in refinement.fine for p in s.placed)
        state.warnings += map_offset(state.recorded.placed, [p for s in refinement.fine for p in s.placed])
        with_map = state.basemap is not None and self.options.until == "fine"
        if with_map and not on_map:
            state.warnings.append("no vehicle was found on the basemap; the orthoimage lies where the receivers say")
        fine = self.looking_down(state, [p for s in refinement.fine for p in s.placed] + state.still)
        coarse = [p for s in refinement.coarse for p in s.placed] + state.still
        coarse = [p for p in coarse if p.frame.image not in state.rejected]
        state.warnings += loose(fine, state.odd)
        if self.options.gsd_m is None:
            state.gsd_m = default_gsd([p.camera for p in fine], ground_level(fine, terrain))
        if self.options.gains:
            with self.clock.stage("final: gains", len(fine)):
                state.gains = estimate_fields(fine, state.thumbnails, terrain or Terrain.flat())
        if self.options.until != "fine":
            self.picture(state, COARSE, fine, terrain)
        elif with_map:
            self.both(state, (coarse, shared_terrain(refinement.coarse)), (fine, terrain))
        else:
            self.picture(state, ORTHOIMAGE, fine, terrain)
            self.copy_coarse(state)
        return [p for p in fine if p.frame.image not in state.rejected]

    def looking_down(self, state: _State, placed: Sequence[PlacedFrame]) -> list[PlacedFrame]:
        """The frames without those that look far aside among others, which are left out."""
        aside = strays(placed)
        self.leave_out(state, aside, placed)
        state.warnings += told(aside)
        return [p for p in placed if p.frame.image not in aside]

    def ground(self, state: _State, refinement: Refinement) -> Terrain | None:
        """The ground under the pictures: found from them, or an outside height model brought to their level."""
        if self.options.dem is None or state.dem is not None:  # the refiner has used it
            return refinement.terrain
        fine = [p for s in refinement.fine for p in s.placed]
        level = ground_level(fine, refinement.terrain)
        nadirs = np.array([p.camera.nadir for p in fine])
        model = read_dem(self.options.dem, state.grid.epsg, placed_bounds(fine, level, level), takeoff=nadirs)
        return replace(model, z=model.z + np.float32(level))

    def both(self, state: _State, coarse: _Map, fine: _Map) -> None:
        """Render both refined maps at once, each picture read once, unless an interrupted run has one of them."""
        if any(self.space.recall(name) is not None for name in (COARSE, ORTHOIMAGE)):
            self.picture(state, COARSE, *coarse)
            self.picture(state, ORTHOIMAGE, *fine)
            return
        coarse_ground, fine_ground = coarse[1] or Terrain.flat(), fine[1] or Terrain.flat()
        with (
            self.clock.stage("final: coarse and orthoimage", len(fine[0])) as stage,
            self.canvas(ORTHOIMAGE, fine[0], fine_ground, state) as second,
        ):
            with self.canvas(COARSE, coarse[0], coarse_ground, state) as first:
                layers = [
                    Layer(coarse[0], coarse_ground, first, state.gains),
                    Layer(fine[0], fine_ground, second, state.gains),
                ]
                drawn = partial(self.progress, "drawing orthoimage")
                stats = render_layers(layers, run=self.workers.map, progress=drawn)
                self.write(first, COARSE)
            self.write(second, ORTHOIMAGE)
        self.space.clear_scratch()
        state.drawn = (stats[1].drawn_m2, stats[1].covered_share)
        self.space.remember(ORTHOIMAGE, (stats[1].rejected, state.drawn, stage))
        self.space.remember(
            COARSE,
            (stats[0].rejected, (stats[0].drawn_m2, stats[0].covered_share), replace(stage, wall_s=0.0, cpu_s=0.0)),
        )
        for s in stats:
            self.leave_out(state, s.rejected, fine[0])

    def picture(self, state: _State, name: str, placed: Sequence[PlacedFrame], terrain: Terrain | None) -> None:
        """Render one product, unless an interrupted run has."""
        known = self.space.recall(name)
        if known is not None and (self.out / name).exists():
            rejected, state.drawn, stage = known
            self.clock.stages.append(stage)
        else:
            label = "orthoimage" if name == ORTHOIMAGE else "coarse picture"
            with self.clock.stage(f"final: {label}", len(placed)) as stage:
                stats = self.draw(name, placed, terrain or Terrain.flat(), state)
            rejected, state.drawn = stats.rejected, (stats.drawn_m2, stats.covered_share)
            self.space.remember(name, (rejected, state.drawn, stage))
        self.leave_out(state, rejected, placed)

    def draw(
        self, name: str, placed: Sequence[PlacedFrame], terrain: Terrain, state: _State, *, realtime: bool = False
    ) -> RenderStats:
        """Render frames on a canvas of their own and write it as a COG."""
        drawn = partial(self.progress, f"drawing {name.removesuffix('.tif')}")
        with self.canvas(name, placed, terrain, state) as canvas:
            if realtime:
                stats = mosaic(placed, canvas, run=self.workers.map, progress=drawn)
            else:
                stats = render(placed, terrain, canvas, gains=state.gains, run=self.workers.map, progress=drawn)
            self.write(canvas, name)
        self.space.clear_scratch()
        return stats

    def canvas(self, name: str, placed: Sequence[PlacedFrame], terrain: Terrain, state: _State) -> Canvas:
        """An empty canvas for a product of these frames."""
        low, high = float(terrain.z.min()), float(terrain.z.max())
        usable = [p for p in placed if rejection(p.camera, float(terrain.height(p.camera.nadir)), state.gsd_m) is None]
        if not usable:
            reason = rejection(placed[0].camera, low, state.gsd_m) if placed else "there is none"
            raise OrthoSwarmError(f"no picture can be drawn: {reason}")
        grid = GroundGrid.around(state.grid.epsg, placed_bounds(usable, low, high), state.gsd_m)
        return Canvas.create(self.space.scratch(name.removesuffix(".tif")), grid, plane="frame", memory_mb=_CANVAS_MB)

    def write(self, canvas: Canvas, name: str) -> None:
        """Write a canvas as a COG."""
        written = partial(self.progress, f"writing {name}")
        write_cog(canvas, self.out / name, window=drawn_window(canvas), progress=written, threads=self.workers.count)

    def copy_coarse(self, state: _State) -> None:
        """Without a map the orthoimage is the coarse product, too."""
        with written_whole(self.out / COARSE) as part:
            shutil.copyfile(self.out / ORTHOIMAGE, part)
        if self.options.basemap is None:
            state.warnings.append("there is no basemap: the orthoimage lies where the drones' receivers say")

    def leave_out(self, state: _State, reasons: Mapping[str, str], placed: Iterable[PlacedFrame]) -> None:
        """Move frames to the rejected ones."""
        frames = {p.frame.image: p.frame for p in placed} if reasons else {}
        for image, reason in reasons.items():
            frame = frames.get(image)
            vehicle, time_s = (frame.vehicle, frame.time_s) if frame else ("", None)
            state.rejected.setdefault(image, Rejection(image, reason, vehicle, time_s))

    # -- products -------------------------------------------------------------------------------------------------

    def finish(self, state: _State, placed: list[PlacedFrame], refinement: Refinement | None) -> dict[str, Any]:
        """frames.jsonl, footprints and the report."""
        for name in PRODUCTS:  # of an earlier run with other options
            if name not in self.made(state.fault is not None):
                (self.out / name).unlink(missing_ok=True)
        with self.clock.stage("final: report", len(placed)) as stage:
            stated, z = from_takeoff(placed, ground_level(placed, state.terrain))
            write_frames(self.out, stated, list(state.rejected.values()), state.grid, z)
            report = self.report(state, placed, refinement.fine if refinement else [], z)
            left_out = list(state.rejected.values())
            try:
                write_page(self.out, report, stated, left_out, state.basemap)
            except InputError as error:  # a map that is damaged where only the report's pictures read it
                report["warnings"].append(f"the report's pictures are without the map: {error}")
                write_page(self.out, report, stated, left_out, None)
        wall, cpu, memory = self.clock.totals()
        report |= {"wall_s": wall, "cpu_s": cpu, "peak_rss_mb": memory}
        report["stages"].append(stage_row(stage))
        write_json(self.out / "report.json", report)
        return report

    def made(self, faulty: bool) -> set[str]:
        names = set(PRODUCTS)
        if self.options.until != "fine" or faulty:
            names.discard(ORTHOIMAGE)
        if self.options.until == "realtime" or faulty:
            names.discard(COARSE)
        return names

    def report(
        self, state: _State, placed: Sequence[PlacedFrame], solutions: Sequence[Solution], ground_z_m: float
    ) -> dict[str, Any]:
        """The content of report.json so far."""
        wall, cpu, memory = self.clock.totals()
        count, left_out = len(placed), len(state.rejected)
        return {
            "frames": {"input": count + left_out, "used": count, "rejected": left_out},
            "vehicles": vehicle_rows(solutions, placed),
            "legs": leg_rows(solutions),
            "stages": [stage_row(s) for s in self.clock.stages],
            "wall_s": wall,
            "cpu_s": cpu,
            "peak_rss_mb": memory,
            "ground_z_m": ground_z_m,
            "refine": self.options.refine if solutions else "none",
            "warnings": list(dict.fromkeys(state.warnings)),
            "epsg": state.grid.epsg,
            "gsd_m": state.gsd_m,
            "area_ha": state.drawn[0] / 1e4,
            "covered_share": state.drawn[1],
            "basemap": str(self.options.basemap) if state.basemap else None,
            "until": self.options.until,
            "config": {stage: dict(values) for stage, values in self.options.config.items()},
            "map_lean_m_per_m": list(solutions[0].map_lean) if solutions else [0.0, 0.0],
            "root": image_root(state.ingest.frames),
            **({"equation_5": state.equation_5} if state.equation_5 else {}),
        }
