"""The orthoimage from placed frames: each ground pixel once, from the frame that sees it most orthogonally.

Two passes, both streamed, so that memory does not grow with the area or the number of frames: label every pixel with
its frame (tiles independent of each other), then read each picture once and sample it where it won (frames
independent of each other). Several maps of the same pictures (coarse and fine) share the reading. The tiles are
prepared beside the canvas and moved into it when they are done, so a viewer sees the old ones until then. Nothing in
the result depends on how the work is spread.
"""

import shutil
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.canvas.tile_store import Key
from orthoswarm.model.arrays import Bytes, Indices, Ints
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.mosaic.footprint import rejections
from orthoswarm.mosaic.kernels.downsampling import reduction
from orthoswarm.mosaic.kernels.render_arrays import Shots, crop
from orthoswarm.mosaic.radiometry import Field, uniform
from orthoswarm.mosaic.render_passes import (
    ColorTask,
    FeatherTask,
    FinishTask,
    FrameWindows,
    LabelTask,
    PreviewTask,
    Read,
    Sampled,
    SampleTask,
    Shot,
    TaskLayer,
    TilePlace,
    color_pass,
    feather_pass,
    finish_pass,
    label_pass,
    preview_pass,
    sample_pass,
)
from orthoswarm.mosaic.seams.leveling import Leveling, cell_size
from orthoswarm.mosaic.seams.previews import PreviewFile, unwritten
from orthoswarm.mosaic.seams.seam_tiles import BORDER_PX, SeamCells, cell_size_px
from orthoswarm.mosaic.visible_ground import by_tile, coverage
from orthoswarm.raster.picture_file import read_rgb
from orthoswarm.raster.picture_parts import PictureParts

Run = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Applies a module-level function to every argument, in this process or in others; results in any order. It should
take arguments as it needs them (workers.Workers.map does), since all of them at once may be large."""
Progress = Callable[[int, int], None]
Blend = Literal["none", "seam"]

_STAGING = "staging"
_UNCHANGED = uniform(np.ones(3))

_PICTURES_PER_TASK: Final = 64  # pictures that a task reads, or copies to previews: its overhead is small then
_COMPLETENESS_CELLS: Final = 1_000_000
"""The share of the ground that was drawn is measured on about so many cells at most, of 64 pixels at most (for its
time)."""


def serial(function: Callable[[Any], Any], arguments: Iterable[Any]) -> Iterable[Any]:
    """Run the work here, one after the other: the default Run."""
    return map(function, arguments)


class DrawnGround(NamedTuple):
    """What a map covers.

    area_m2: ground that was drawn. covered_share: its share of the ground that any frame sees; 1 where none does.
    twice_share: share of its pixels that show what the same picture shows more than `TWICE_M` away as well.
    """

    area_m2: float
    covered_share: float
    twice_share: float


NOTHING_DRAWN: Final = DrawnGround(area_m2=0.0, covered_share=1.0, twice_share=0.0)


@dataclass(frozen=True, slots=True)
class RenderStats:
    """What was rendered.

    Attributes:
        pixels: int64 (N,), map pixels taken from each frame.
        drawn: what the map covers, within what was rendered.
        rejected: image -> why it was left out although it was placed (absurd pose, damaged picture).
        thumbnails: image -> uint8 (12, 16, 3), means of the picture's parts, of the frames that were read.
    """

    pixels: Indices
    drawn: DrawnGround
    rejected: dict[str, str]
    thumbnails: dict[str, Bytes] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Seams:
    """How the seams of a map are chosen and drawn.

    Attributes:
        previews: of all its frames; those that are missing are made first.
        blend: "seam" mixes the two pictures over a few pixels at each seam, "none" takes every pixel from one.
        feather_px: half the width of the transition that "seam" makes, pixels.
        level: take out the steps of tone that are left at the seams, see seams.leveling; over all tiles that are drawn,
            so not together with `Layer.bounds`.
    """

    previews: PreviewFile
    blend: Blend = "seam"
    level: bool = False
    feather_px: int = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """One of the maps that are drawn together.

    Attributes:
        frames: placed frames; their order breaks ties of distance.
        terrain: the ground's height, made smooth (bicubic) between its nodes.
        canvas: made with plane "frame"; gets colours, and per pixel the index of its frame in `frames` plus 1.
        gains: image -> factors of its colours (radiometry.Field); 1 where absent.
        bounds: renew only the tiles that touch these (west, south, east, north); all if None.
        seams: how seams are chosen; None takes each pixel from the nearest nadir point (paper III.B).
        previews: previews of the pictures are written here as they are read, for the seams of a later map.
    """

    frames: Sequence[PlacedFrame]
    terrain: Terrain
    canvas: Canvas
    gains: Mapping[str, Field] = field(default_factory=dict)
    bounds: BoundingBox | None = None
    seams: Seams | None = None
    previews: PreviewFile | None = None


def render(
    frames: Sequence[PlacedFrame],
    terrain: Terrain,
    canvas: Canvas,
    *,
    gains: Mapping[str, Field] | None = None,
    bounds: BoundingBox | None = None,
    seams: Seams | None = None,
    previews: PreviewFile | None = None,
    read: Read = read_rgb,
    parts: PictureParts | None = None,
    run: Run = serial,
    progress: Progress | None = None,
) -> RenderStats:
    """Render frames onto a canvas: `render_layers` of a single layer, see there and `Layer`."""
    layer = Layer(
        frames=frames, terrain=terrain, canvas=canvas, gains=gains or {}, bounds=bounds, seams=seams, previews=previews
    )
    return render_layers([layer], read=read, parts=parts, run=run, progress=progress)[0]


def render_layers(
    layers: Sequence[Layer],
    *,
    read: Read = read_rgb,
    parts: PictureParts | None = None,
    run: Run = serial,
    progress: Progress | None = None,
) -> list[RenderStats]:
    """Render frames onto canvases, each picture read once for all of them.

    Each map pixel is taken from one frame that sees it (at most 75 degrees off nadir; terrain and distortion honoured):
    the one with the nearest nadir point, or with `Layer.seams` the one that seam lines by cost give it to; from a weak
    frame only where no other sees; by bicubic interpolation of the picture, averaged first where the map is coarser.
    Only `Seams.blend` mixes two pictures, over a few pixels at each seam.

    Args:
        layers: what to draw.
        read: reads a picture, uint8 (H, W, 3); must be picklable for `run` in other processes.
        parts: what is drawn of a picture is kept there, and taken from there if it is enough; None reads all pictures.
        run: where the work runs; other processes need the canvases' folders and the pictures under the same paths.
        progress: called with the number of pictures done and of pictures to do.

    Returns:
        What was rendered, layer by layer.

    Raises:
        InputError: if a canvas has another plane.
        OrthoSwarmError: if the disk is full.
    """
    for layer in layers:
        if layer.canvas.plane != "frame":
            raise InputError(f"the canvas in {layer.canvas.path} belongs to the real-time module; use another folder")
    staging = [layer.canvas.path / _STAGING for layer in layers]
    for folder in staging:
        shutil.rmtree(folder, ignore_errors=True)
    try:
        jobs = [_Job(layer, folder, run) for layer, folder in zip(layers, staging, strict=True)]
        _draw(jobs, read, parts, run, progress)
        for job in jobs:
            job.finish()
            job.adopt()
        return [job.stats() for job in jobs]
    finally:
        for folder in staging:
            shutil.rmtree(folder, ignore_errors=True)


def _draw(jobs: Sequence["_Job"], read: Read, parts: PictureParts | None, run: Run, progress: Progress | None) -> None:
    """Label and sample, and again for the pixels of pictures that turned out to be unreadable."""
    for job in jobs:
        job.make_previews(read)
    while True:
        for job in jobs:
            job.label()
        failed = False
        pictures = sum(1 for _ in _by_picture(jobs))
        done = 0
        for result in run(sample_pass, _sample_tasks(jobs, read, parts)):
            for sampled in result:
                jobs[sampled.layer].take(sampled)
                failed |= sampled.reason is not None
            done += len({sampled.index for sampled in result})
            if progress is not None:
                progress(min(done, pictures), pictures)
        if not failed:
            return


def _by_picture(jobs: Sequence["_Job"]) -> Iterator[tuple[Path, list[tuple[int, int]]]]:
    """Files to read, and the layers and frames that each serves.

    Their order walks over the tiles in a serpentine, so that few tiles are mapped at once.
    """
    shares: dict[Path, list[tuple[int, int]]] = defaultdict(list)
    for number, job in enumerate(jobs):
        for i in sorted(job.windows, key=job.home):
            shares[job.frames[i].frame.path].append((number, i))
    yield from shares.items()


def _sample_tasks(jobs: Sequence["_Job"], read: Read, parts: PictureParts | None) -> Iterator[SampleTask]:
    """The pictures in groups, with what is needed to draw them."""
    pictures = list(_by_picture(jobs))
    for start in range(0, len(pictures), _PICTURES_PER_TASK):
        some = pictures[start : start + _PICTURES_PER_TASK]
        own: list[list[int]] = [
            [i for _, shares in some for n, i in shares if n == number] for number in range(len(jobs))
        ]
        row = {(number, i): r for number, indices in enumerate(own) for r, i in enumerate(indices)}
        shots = [(path, [jobs[n].shot(i, n, row[n, i]) for n, i in shares]) for path, shares in some]
        yield SampleTask([job.layer_of(indices) for job, indices in zip(jobs, own, strict=True)], shots, read, parts)


def _tiles_within(canvas: Canvas, bounds: BoundingBox) -> set[Key]:
    r0, r1, c0, c1 = canvas.window(bounds)
    t = canvas.tile_px
    return {(r, c) for r in range(r0 // t, -(-r1 // t)) for c in range(c0 // t, -(-c1 // t))}


class _Job:
    """One layer while it is drawn."""

    def __init__(self, layer: Layer, staging: Path, run: Run) -> None:
        self.frames, self.terrain, self.canvas, self.run = layer.frames, layer.terrain, layer.canvas, run
        self.gains = dict(layer.gains)
        self.place = TilePlace(staging, self.canvas.tile_px, self.canvas.grid)
        self.keys = None if layer.bounds is None else _tiles_within(self.canvas, layer.bounds)
        self.shots = Shots.of([f.camera for f in self.frames], [f.weak or f.frame.damaged for f in self.frames])
        position = np.nan_to_num(self.shots.position)
        self.ground = self.terrain.height(position[:, :2])
        self.usable = np.ones(len(self.frames), bool)
        self.rejected: dict[str, str] = {}
        self.thumbnails: dict[str, Bytes] = {}
        self.pixels, self.twice = np.zeros((2, len(self.frames)), np.int64)
        self.windows = self.near_seams = FrameWindows()
        self.seams, self.previews = layer.seams, layer.previews
        self.failed: dict[int, str] = {}
        reasons = rejections([f.camera for f in self.frames], self.ground, self.canvas.grid.gsd_m)
        for i, reason in reasons.items():
            self.reject(i, reason)
        self.candidates = {k: ids for k, ids in self.seen_by().items() if self.keys is None or k in self.keys}

    def reject(self, i: int, reason: str) -> None:
        self.rejected[self.frames[i].frame.image] = reason
        self.usable[i] = False

    def seen_by(self) -> dict[Key, Ints]:
        """For each tile the usable frames that may see it."""
        index = np.nonzero(self.usable)[0].astype(np.int32)
        t = self.canvas.tile_px
        found = by_tile([self.frames[int(i)].camera for i in index], self.canvas.grid, t, self.terrain)
        return {(r // t, c // t): index[ids] for (r, c), ids in found.items()}

    def label(self) -> None:
        """Label the tiles, or those again that lost a frame; `windows` are where each frame won."""
        for i in sorted(self.failed):
            self.reject(i, self.failed[i])
            self.pixels[i] = 0
        lost = {w.key for i in self.failed for w in self.windows[i]}
        if self.failed or self.windows:
            self.candidates = {k: ids for k, ids in self.candidates.items() if k in lost}
        again = np.array(sorted(self.failed), np.int32)
        self.failed = {}

        def tasks(turn: tuple[int, int] | None) -> Iterator[LabelTask]:
            for key, ids in self.candidates.items():
                if turn is None or (key[0] % 2, key[1] % 2) == turn:
                    good = ids[self.usable[ids]]
                    seams = None if turn is None else self.seam_cells(key, good)
                    yield LabelTask(
                        place=self.place,
                        key=key,
                        ids=good,
                        shots=self.shots.take(good),
                        terrain=self.local(key),
                        again=again,
                        seams=seams,
                    )

        # Tiles of one turn do not touch; seams go on from the tiles of earlier turns, whoever works on them.
        turns = [(0, 0), (0, 1), (1, 0), (1, 1)] if self.seams is not None and not len(again) else [None]
        self.windows = FrameWindows(result for turn in turns for result in self.run(label_pass, tasks(turn)))
        for i, own in self.windows.items():
            self.pixels[i] += sum(w.pixels for w in own)
        first = self.seams is not None and (self.seams.blend == "seam" or self.seams.level) and not len(again)
        self.near_seams = FrameWindows(self.run(feather_pass, self.feather_tasks()) if first else ())

    def feather_tasks(self) -> Iterator[FeatherTask]:
        assert self.seams is not None
        width = self.seams.feather_px
        yield from (FeatherTask(self.place, key, width) for key in self.place.store().existing())

    def finish(self) -> None:
        """Level the pictures at their seams, and mix them there, where wanted."""
        if self.seams is None or not (self.seams.level or self.seams.blend == "seam"):
            return
        keys = list(self.place.store().existing())
        leveling = self.leveling(keys) if self.seams.level else None
        mixed = self.seams.blend == "seam"
        tasks = (FinishTask(self.place, k, None if leveling is None else leveling.of_tile(k), mixed) for k in keys)
        for _ in self.run(finish_pass, tasks):
            pass
        shutil.rmtree(self.place.seams, ignore_errors=True)

    def leveling(self, keys: Sequence[Key]) -> Leveling:
        """The steps at the seams of all tiles, solved together."""
        grid, tile_px = self.canvas.grid, self.place.tile_px
        wide = [
            f.camera.lens.width / f.camera.lens.focal_px * float(f.camera.position[2] - z)
            for f, z, good in zip(self.frames, self.ground, self.usable)
            if good
        ]
        cells = cell_size(float(np.median(wide or [0.0])) / grid.gsd_m, tile_px, grid.width * grid.height)
        found = self.run(color_pass, (ColorTask(self.place, key, cells.px) for key in keys))
        colors = [color for _, color in sorted(found, key=itemgetter(0))]
        return Leveling(colors, self.canvas.tile_cols * cells.across_tile, cells)

    def make_previews(self, read: Read) -> None:
        """Previews of the usable frames that have none."""
        if self.seams is None:
            return
        previews = self.seams.previews
        index = np.unique(np.concatenate([np.empty(0, np.int32), *self.candidates.values()]))
        rows = np.array([previews.row[self.frames[i].frame.image] for i in index], np.int32)
        missing = np.nonzero(unwritten(previews.path, rows))[0]
        pictures = [(self.frames[int(index[m])].frame.path, int(rows[m])) for m in missing]
        n = _PICTURES_PER_TASK
        tasks = (PreviewTask(previews.path, pictures[k : k + n], read) for k in range(0, len(pictures), n))
        for _ in self.run(preview_pass, tasks):
            pass

    def seam_cells(self, key: Key, ids: Ints) -> SeamCells:
        """What the seams of a tile are chosen by."""
        assert self.seams is not None
        images = [self.frames[int(i)].frame.image for i in ids]
        rows = np.array([self.seams.previews.row[image] for image in images], np.int32)
        tone = np.array([self.gains.get(image, _UNCHANGED).mean(0) for image in images], np.float32).reshape(-1, 6)
        west, south, east, north = self.canvas.tile_bounds(key)
        border = BORDER_PX * self.canvas.grid.gsd_m
        terrain = crop(self.terrain, BoundingBox(west - border, south - border, east + border, north + border))
        return SeamCells(self.seams.previews.path, rows, tone, self.cell_px, terrain)

    @cached_property
    def cell_px(self) -> int:
        """Side of the cells in which seams are chosen."""
        gsds = [float(f.camera.position[2] - z) / f.camera.lens.focal_px for f, z in zip(self.frames, self.ground)]
        some = [(f.camera.lens.width, gsd) for f, gsd, good in zip(self.frames, gsds, self.usable) if good]
        width, gsd = (float(v) for v in np.median(np.array(some), axis=0))
        return cell_size_px(int(width), gsd, self.canvas.grid.gsd_m)

    def local(self, key: Key) -> Terrain:
        return crop(self.terrain, self.canvas.tile_bounds(key))

    def home(self, i: int) -> tuple[int, int, int]:
        """Where in the serpentine over the tiles a frame is drawn."""
        row, col = max(self.windows[i], key=lambda w: (w.pixels, w.key)).key
        return row, col if row % 2 == 0 else -col, i

    def shot(self, i: int, number: int, row: int) -> Shot:
        """A frame's share of this layer, whose number it is among those that are drawn."""
        frame = self.frames[i]
        field = self.gains.get(frame.frame.image, _UNCHANGED)
        picture_gsd = float(frame.camera.position[2] - self.ground[i]) / frame.camera.lens.focal_px
        factor = reduction(self.canvas.grid.gsd_m, picture_gsd)
        to = None if self.previews is None else (self.previews.path, self.previews.row[frame.frame.image])
        return Shot(
            layer=number,
            row=row,
            index=i,
            field=field,
            factor=factor,
            windows=self.windows[i],
            near_seams=self.near_seams.get(i, []),
            preview=to,
        )

    def layer_of(self, indices: list[int]) -> TaskLayer:
        """What a task has to know to draw some frames."""
        keys = sorted({w.key for i in indices for w in (*self.windows[i], *self.near_seams.get(i, ()))})
        return TaskLayer(self.place, self.shots.take(np.array(indices, int)), {key: self.local(key) for key in keys})

    def take(self, sampled: Sampled) -> None:
        """Note what became of a frame."""
        if sampled.reason is not None:
            self.failed[sampled.index] = sampled.reason
            return
        self.twice[sampled.index] += sampled.twice
        if sampled.thumbnail is not None:
            self.thumbnails[self.frames[sampled.index].frame.image] = sampled.thumbnail

    def adopt(self) -> None:
        """Move the tiles into the canvas."""
        store = self.canvas.staging(_STAGING)
        keys = {*store.existing(), *self.canvas.changed_since(0)} if self.keys is None else self.keys
        self.canvas.adopt(store, sorted(keys))

    def stats(self) -> RenderStats:
        seen, pixels = self.seen_m2(), int(self.pixels.sum())
        area = pixels * self.canvas.grid.gsd_m**2
        drawn = DrawnGround(area, min(1.0, area / seen) if seen > 0 else 1.0, int(self.twice.sum()) / max(pixels, 1))
        return RenderStats(self.pixels, drawn, self.rejected, self.thumbnails)

    def seen_m2(self) -> float:
        """Ground that the usable frames see, measured on cells of up to 64 pixels."""
        grid, t = self.canvas.grid, self.canvas.tile_px
        factor, most = 1, _COMPLETENESS_CELLS
        while factor < 64 and grid.width * grid.height > factor * factor * most:
            factor *= 2
        coarse = GroundGrid(
            epsg=grid.epsg,
            west=grid.west,
            north=grid.north,
            gsd_m=grid.gsd_m * factor,
            width=max(1, (grid.width + factor // 2) // factor),  # cells whose centre lies in the grid
            height=max(1, (grid.height + factor // 2) // factor),
        )
        mask = coverage([f.camera for f, good in zip(self.frames, self.usable) if good], coarse, self.terrain)
        if self.keys is not None:
            wanted = np.zeros((self.canvas.tile_rows, self.canvas.tile_cols), bool)
            for key in self.keys:
                wanted[key] = True
            side = t // factor
            mask &= wanted.repeat(side, 0).repeat(side, 1)[: coarse.height, : coarse.width]
        return float(mask.sum()) * coarse.gsd_m**2
