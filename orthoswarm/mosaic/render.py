"""The orthoimage from placed frames: each ground pixel once, from the frame that sees it most orthogonally.

Two passes, both streamed, so that memory does not grow with the area or the number of frames: label every pixel with
its frame (tiles independent of each other), then read each picture once and sample it where it won (frames
independent of each other). The tiles are prepared beside the canvas and moved into it when they are done, so a viewer
sees the old ones until then. Nothing in the result depends on how the work is spread.
"""

import shutil
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthoswarm.errors import InputError
from orthoswarm.geo import GroundGrid
from orthoswarm.mosaic.canvas import Canvas
from orthoswarm.mosaic.coverage import by_tile, coverage
from orthoswarm.mosaic.footprint import rejections
from orthoswarm.mosaic.lattice import Shots, crop
from orthoswarm.mosaic.passes import LabelTask, Place, Read, SampleTask, Shot, Window, label_pass, sample_pass
from orthoswarm.mosaic.reduce import reduction
from orthoswarm.mosaic.tiles import Key
from orthoswarm.picture import read_rgb
from orthoswarm.placement import PlacedFrame, Terrain

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int32]
Bounds = tuple[float, float, float, float]
Run = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Applies a module-level function to every argument, in this process or in others; results in any order. It should
take arguments as it needs them (workers.Workers.map does), since all of them at once may be large."""
Progress = Callable[[int, int], None]

_FRAMES_PER_TASK = 64
_STAGING = "staging"
_COARSE_CELLS = 1_000_000


def serial(function: Callable[[Any], Any], arguments: Iterable[Any]) -> Iterable[Any]:
    """Run the work here, one after the other: the default Run."""
    return map(function, arguments)


@dataclass(frozen=True, slots=True)
class RenderStats:
    """What was rendered.

    Attributes:
        pixels: int64 (N,), map pixels taken from each frame.
        seen_m2: ground that any frame sees (that was not rejected), measured on cells of up to 64 pixels.
        drawn_m2: ground that was drawn; both within what was rendered.
        rejected: image -> why it was left out although it was placed (absurd pose, damaged picture).
        thumbnails: image -> uint8 (12, 16, 3), means of the picture's parts, of the frames that were read.
    """

    pixels: NDArray[np.int64]
    seen_m2: float
    drawn_m2: float
    rejected: dict[str, str]
    thumbnails: dict[str, Bytes] = field(default_factory=dict)

    @property
    def covered_share(self) -> float:
        """Share of the ground that any frame sees that was drawn; 1 where nothing is seen."""
        return min(1.0, self.drawn_m2 / self.seen_m2) if self.seen_m2 > 0 else 1.0


def render(
    frames: Sequence[PlacedFrame],
    terrain: Terrain,
    canvas: Canvas,
    *,
    gains: Mapping[str, ArrayLike] | None = None,
    bounds: Bounds | None = None,
    read: Read = read_rgb,
    run: Run = serial,
    progress: Progress | None = None,
) -> RenderStats:
    """Render frames onto a canvas.

    Each map pixel is taken from the frame with the nearest nadir point that sees it (at most 75 degrees off
    nadir; terrain and distortion honoured), from a weak frame only where no other sees, by
    bicubic interpolation of the picture, averaged first where the map is coarser. No blending.

    Args:
        frames: placed frames; their order breaks ties of distance.
        terrain: the ground's height, made smooth (bicubic) between its nodes.
        canvas: made with plane "frame"; gets colours, and per pixel the index of its frame in `frames` plus 1.
        gains: image -> factor of red, green, blue (3,); 1 where absent or None.
        bounds: renew only the tiles that touch these (west, south, east, north); all if None.
        read: reads a picture, uint8 (H, W, 3); must be picklable for `run` in other processes.
        run: where the work runs; other processes need the canvas's folder and the pictures under the same paths.
        progress: called with the number of frames done and of frames to do.

    Raises:
        InputError: if the canvas has another plane.
        OrthoSwarmError: if the disk is full.
    """
    if canvas.plane != "frame":
        raise InputError(f"the canvas in {canvas.path} belongs to the real-time module; use another folder")
    keys = None if bounds is None else _tiles_within(canvas, bounds)
    staging = canvas.path / _STAGING
    shutil.rmtree(staging, ignore_errors=True)
    try:
        job = _Job(frames, terrain, canvas, dict(gains or {}), read, run, progress)
        stats = job.render(Place(staging, canvas.tile_px, canvas.grid), keys)
        store = canvas.staging(_STAGING)
        canvas.adopt(store, sorted({*store.existing(), *canvas.changed_since(0)} if keys is None else keys))
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return stats


def _tiles_within(canvas: Canvas, bounds: Bounds) -> set[Key]:
    r0, r1, c0, c1 = canvas.window(bounds)
    t = canvas.tile_px
    return {(r, c) for r in range(r0 // t, -(-r1 // t)) for c in range(c0 // t, -(-c1 // t))}


@dataclass(slots=True)
class _Job:
    """One call of render: what its passes share."""

    frames: Sequence[PlacedFrame]
    terrain: Terrain
    canvas: Canvas
    gains: dict[str, ArrayLike]
    read: Read
    run: Run
    progress: Progress | None
    shots: Shots = field(init=False)
    ground: NDArray[np.float64] = field(init=False)
    rejected: dict[str, str] = field(default_factory=dict)
    usable: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        self.shots = Shots.of([f.camera for f in self.frames], [f.weak for f in self.frames])
        position = np.nan_to_num(self.shots.position)
        self.ground = self.terrain.height(position[:, :2])
        self.usable = np.ones(len(self.frames), bool)
        reasons = rejections([f.camera for f in self.frames], self.ground, self.canvas.grid.gsd_m)
        for i, reason in reasons.items():
            self.reject(i, reason)

    def reject(self, i: int, reason: str) -> None:
        self.rejected[self.frames[i].frame.image] = reason
        self.usable[i] = False

    def render(self, place: Place, keys: set[Key] | None) -> RenderStats:
        candidates = {k: ids for k, ids in self.candidates().items() if keys is None or k in keys}
        pixels = np.zeros(len(self.frames), np.int64)
        thumbnails: dict[str, Bytes] = {}
        failed: dict[int, str] = {}
        while True:  # once, and again for the pixels of pictures that turned out to be unreadable
            windows = self.label(place, candidates, failed)
            for i, own in windows.items():
                pixels[i] += sum(w.pixels for w in own)
            failed = self.sample(place, windows, thumbnails)
            if not failed:
                break
            for i in sorted(failed):
                self.reject(i, failed[i])
                pixels[i] = 0
            lost = {w.key for i in failed for w in windows[i]}
            candidates = {k: ids for k, ids in candidates.items() if k in lost}
        gsd = self.canvas.grid.gsd_m
        return RenderStats(pixels, self.seen_m2(keys), float(pixels.sum()) * gsd * gsd, self.rejected, thumbnails)

    def candidates(self) -> dict[Key, Ints]:
        """For each tile the usable frames that may see it."""
        index = np.nonzero(self.usable)[0].astype(np.int32)
        t = self.canvas.tile_px
        found = by_tile([self.frames[int(i)].camera for i in index], self.canvas.grid, t, self.terrain)
        return {(r // t, c // t): index[ids] for (r, c), ids in found.items()}

    def label(self, place: Place, candidates: dict[Key, Ints], again: Iterable[int]) -> dict[int, list[Window]]:
        """Label tiles; gives each frame's windows."""
        lost = np.array(sorted(again), np.int32)

        def tasks() -> Iterator[LabelTask]:
            for key, ids in candidates.items():
                good = ids[self.usable[ids]]
                yield LabelTask(place, key, good, self.shots.take(good), self.local(key), lost)

        windows: dict[int, list[Window]] = defaultdict(list)
        for result in self.run(label_pass, tasks()):
            for i, window in result:
                windows[i].append(window)
        return {i: sorted(windows[i], key=lambda w: w.key) for i in sorted(windows)}

    def local(self, key: Key) -> Terrain:
        return crop(self.terrain, self.canvas.tile_bounds(key))

    def sample(self, place: Place, windows: dict[int, list[Window]], thumbnails: dict[str, Bytes]) -> dict[int, str]:
        """Read and sample the pictures; gives those that could not be read, and why."""
        failed: dict[int, str] = {}
        done = 0
        for result in self.run(sample_pass, self.sample_tasks(place, windows)):
            for picture in result:
                if picture.reason is not None:
                    failed[picture.index] = picture.reason
                else:
                    thumbnails[self.frames[picture.index].frame.image] = picture.thumbnail
            done += len(result)
            if self.progress is not None:
                self.progress(done, len(windows))
        return failed

    def sample_tasks(self, place: Place, windows: dict[int, list[Window]]) -> Iterator[SampleTask]:
        """Pictures in an order that walks over the tiles in a serpentine, so that few tiles are mapped at once."""

        def home(i: int) -> tuple[int, int, int]:
            row, col = max(windows[i], key=lambda w: (w.pixels, w.key)).key
            return row, col if row % 2 == 0 else -col, i

        order = sorted(windows, key=home)
        for start in range(0, len(order), _FRAMES_PER_TASK):
            some = order[start : start + _FRAMES_PER_TASK]
            pictures = [self.shot(i, windows[i]) for i in some]
            terrain = {key: self.local(key) for key in sorted({w.key for p in pictures for w in p.windows})}
            yield SampleTask(place, pictures, self.shots.take(np.array(some)), terrain, self.read)

    def shot(self, i: int, windows: list[Window]) -> Shot:
        frame = self.frames[i]
        gain = np.ones(3, np.float32) * np.asarray(self.gains.get(frame.frame.image, 1.0), np.float32)
        picture_gsd = float(frame.camera.position[2] - self.ground[i]) / frame.camera.lens.focal_px
        return Shot(i, frame.frame.path, gain, reduction(self.canvas.grid.gsd_m, picture_gsd), windows)

    def seen_m2(self, keys: set[Key] | None) -> float:
        """Ground that the usable frames see, measured on coarse cells."""
        grid, t = self.canvas.grid, self.canvas.tile_px
        factor = 1
        while factor < 64 and grid.width * grid.height > factor * factor * _COARSE_CELLS:
            factor *= 2
        coarse = GroundGrid(
            grid.epsg,
            grid.west,
            grid.north,
            grid.gsd_m * factor,
            max(1, (grid.width + factor // 2) // factor),  # cells whose centre lies in the grid
            max(1, (grid.height + factor // 2) // factor),
        )
        mask = coverage([f.camera for f, good in zip(self.frames, self.usable) if good], coarse, self.terrain)
        if keys is not None:
            wanted = np.zeros((self.canvas.tile_rows, self.canvas.tile_cols), bool)
            for key in keys:
                wanted[key] = True
            side = t // factor
            mask &= wanted.repeat(side, 0).repeat(side, 1)[: coarse.height, : coarse.width]
        return float(mask.sum()) * coarse.gsd_m**2
