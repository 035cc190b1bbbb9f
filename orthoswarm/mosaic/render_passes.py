"""The two passes of the renderer as functions of one picklable argument, so that they can run in any process.

A label task owns one tile; sample tasks write disjoint pixels (their own labels) of tiles that they may share.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthoswarm.canvas.tile_store import Key, TileStore
from orthoswarm.model.arrays import Bytes, Floats, Indices, Ints
from orthoswarm.model.errors import OrthoSwarmError, RunInterruptedError, StorageError
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.kernels.downsampling import bearable, reduced, reduced_exactly
from orthoswarm.mosaic.kernels.drawn_heights import heights
from orthoswarm.mosaic.kernels.pixel_sampling import (
    AFTER,
    BEFORE,
    SPOT_PX,
    WEIGHTS,
    blend,
    drawn_again,
    place,
    place_listed,
    widen,
)
from orthoswarm.mosaic.kernels.render_arrays import Shots
from orthoswarm.mosaic.seam_labels import label_tile, label_windows, write_labels
from orthoswarm.mosaic.seams.feather import labels_around, mix, transition
from orthoswarm.mosaic.seams.leveling import TileColors, TileFactors, tile_colors
from orthoswarm.mosaic.seams.previews import write_preview
from orthoswarm.mosaic.seams.seam_pixels import SeamPixels
from orthoswarm.mosaic.seams.seam_tiles import SeamCells, seam_labels
from orthoswarm.raster.grey_pictures import WORK_WIDTH_PX
from orthoswarm.raster.picture_file import PictureError
from orthoswarm.raster.picture_parts import Box, Part, PictureParts
from orthoswarm.stores.local_copies import copy_ahead

Read = Callable[[Path, int], Bytes]
"""Reads a picture, uint8 (rows, columns, 3), reduced to the longer side that is given, see picture_file.read_rgb."""

THUMBNAIL = (12, 16)  # rows and columns of a picture's thumbnail
TWICE_M: Final = 0.5  # what a picture shows at places farther apart than this is drawn twice, metres
_NUMBERS = 8  # frame, row and column of the tile, rows and columns of the window (4), pixels
_TILES_MB: Final = 64.0  # memory that a drawing task keeps of the tiles that it writes


@dataclass(frozen=True, slots=True)
class TilePlace:
    """Where tiles are: their folder, their side, and the grid under them."""

    folder: Path
    tile_px: int
    grid: GroundGrid

    def store(self) -> TileStore:
        """The tiles; only a few are mapped into memory at a time, since a task goes from tile to tile."""
        return TileStore(self.folder, tile_px=self.tile_px, dtype=np.int32, memory_mb=_TILES_MB)

    @property
    def seams(self) -> Path:
        """Folder of the files of `seam_file`."""
        return self.folder / "seams"

    def seam_file(self, key: Key) -> Path:
        """The file of a tile's pixels near seams, see SeamPixels."""
        return self.seams / f"{key[0]:06d}" / f"{key[1]:06d}"

    def corner(self, key: Key) -> tuple[float, float]:
        """West and north of a tile."""
        side = self.tile_px * self.grid.gsd_m
        return self.grid.west + key[1] * side, self.grid.north - key[0] * side

    def shape(self, key: Key) -> tuple[int, int]:
        """Rows and columns of a tile that lie in the grid."""
        return (
            min(self.tile_px, self.grid.height - key[0] * self.tile_px),
            min(self.tile_px, self.grid.width - key[1] * self.tile_px),
        )

    def heights(self, key: Key, terrain: Terrain) -> Floats:
        """A tile's lattice of heights."""
        return heights(terrain, *self.corner(key), self.grid.gsd_m, self.tile_px)


class Window(NamedTuple):
    """Where in a tile a frame won: rows row0 to row1, columns col0 to col1, and how many pixels.

    A tuple, since tasks take thousands of them along, and a tuple is made and copied several times as fast.
    """

    key: Key
    row0: int
    row1: int
    col0: int
    col1: int
    pixels: int

    @property
    def is_listed(self) -> bool:
        """Whether its pixels are those of the tile's SeamPixels."""
        return self.row1 == self.row0

    @classmethod
    def of(cls, key: Key, box: NDArray[np.integer]) -> "Window":
        """The window of a row of `label_windows`."""
        row0, row1, col0, col1, pixels = (int(value) for value in box)
        return cls(key=key, row0=row0, row1=row1, col0=col0, col1=col1, pixels=pixels)


class FrameWindows(Mapping[int, list[Window]]):
    """Windows by frame, frames and tiles in order, as a few numbers each: a large map has millions of them.

    results: of tasks, pairs of a frame and its window in a tile.
    """

    def __init__(self, results: Iterable[Iterable[tuple[int, Window]]] = ()) -> None:
        tables = [_table(result) for result in results]
        table = np.concatenate([np.empty((0, _NUMBERS), np.int32), *tables])
        self._table = table[np.lexsort((table[:, 2], table[:, 1], table[:, 0]))]
        frames, first = np.unique(self._table[:, 0], return_index=True)
        ends = [*first.tolist(), len(self._table)]
        self._row = {frame: slice(*both) for frame, both in zip(frames.tolist(), pairwise(ends), strict=True)}

    def __getitem__(self, frame: int) -> list[Window]:
        own = self._table[self._row[frame]]
        return [
            Window(key=(r, c), row0=row0, row1=row1, col0=col0, col1=col1, pixels=pixels)
            for _, r, c, row0, row1, col0, col1, pixels in own.tolist()
        ]

    def __iter__(self) -> Iterator[int]:
        return iter(self._row)

    def __len__(self) -> int:
        return len(self._row)


def _table(result: Iterable[tuple[int, Window]]) -> Ints:
    rows = [(i, *w.key, w.row0, w.row1, w.col0, w.col1, w.pixels) for i, w in result]
    return np.array(rows, np.int32).reshape(-1, _NUMBERS)


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelTask:
    """Label a tile.

    Attributes:
        place: where. key: the tile.
        ids: int32 (K,), indices of the candidate frames. shots: their cameras. terrain: the ground there.
        again: int32, frames that turned out to be unreadable: only their pixels are labelled anew.
        seams: what seam lines are chosen by; None takes the nearest nadir point alone.
    """

    place: TilePlace
    key: Key
    ids: Ints
    shots: Shots
    terrain: Terrain
    again: Ints
    seams: SeamCells | None = None


def label_pass(task: LabelTask) -> list[tuple[int, Window]]:
    """Label a tile in its file (frame index + 1); gives what each frame won, frames in order."""
    place, store = task.place, task.place.store()
    rows, cols = place.shape(task.key)
    west, north = place.corner(task.key)
    local = np.zeros((rows, cols), np.int32)
    old = store.get(task.key) if len(task.again) else None
    if old is not None:
        owner = old.plane[:rows, :cols]
        lost = np.isin(owner, task.again + 1)
        local[~lost] = -1
        old.rgba[:rows, :cols][lost] = 0
        owner[lost] = 0
    elif task.seams is not None:
        local = seam_labels(
            store,
            task.key,
            (rows, cols),
            west=west,
            north=north,
            gsd_m=place.grid.gsd_m,
            ids=task.ids,
            shots=task.shots,
            seams=task.seams,
        )
    if not local.all():
        marks = np.arange(1, len(task.ids) + 1, dtype=np.int32)
        lattice = place.heights(task.key, task.terrain)
        label_tile(local, task.shots, marks, lattice=lattice, west=west, north=north, gsd_m=place.grid.gsd_m)
    boxes = label_windows(local, len(task.ids))
    won = np.nonzero(boxes[:, 4])[0]
    if len(won):
        tile = store.get(task.key, create=True)
        assert tile is not None
        write_labels(local, task.ids, tile.plane)
    return [(int(task.ids[k]), Window.of(task.key, boxes[k])) for k in won]


@dataclass(frozen=True, slots=True)
class FeatherTask:
    """Find or mix what lies near the seams of a tile.

    place: where. key: the tile. width_px: how far from a seam pictures are mixed.
    """

    place: TilePlace
    key: Key
    width_px: int


def feather_pass(task: FeatherTask) -> list[tuple[int, Window]]:
    """Label the pixels near a tile's seams with the other picture; gives where each frame is wanted.

    To be called once all tiles are labelled.
    """
    around = labels_around(task.place.store(), task.key, task.width_px)
    if around.min() == around.max():  # one picture shows all of the tile
        return []
    other, share = transition(around, task.width_px)
    rows, cols = task.place.shape(task.key)
    other[rows:], other[:, cols:] = 0, 0
    try:
        near = SeamPixels.create(task.place.seam_file(task.key), other, share)
    except OSError as error:
        raise StorageError(f"the seams cannot be written ({error.strerror}); free some disk space") from None
    found = [] if near is None else near.counts()
    return [(label - 1, Window(task.key, 0, 0, 0, 0, pixels)) for label, pixels in found]


@dataclass(frozen=True, slots=True)
class ColorTask:
    """Sum the colours of a tile. place: where. key: the tile. cell_px: side of the cells."""

    place: TilePlace
    key: Key
    cell_px: int


def color_pass(task: ColorTask) -> tuple[Key, TileColors]:
    """What a tile shows by cell, and at its seams, once all are drawn."""
    tile = task.place.store().get(task.key)
    assert tile is not None
    return task.key, tile_colors(task.key, tile, SeamPixels.open(task.place.seam_file(task.key)), task.cell_px)


@dataclass(frozen=True, slots=True)
class FinishTask:
    """Level and mix a tile.

    place: where. key: the tile. factors: of its pictures, None to leave them. mixed: whether they are mixed near seams.
    """

    place: TilePlace
    key: Key
    factors: TileFactors | None
    mixed: bool


def finish_pass(task: FinishTask) -> None:
    """Level the pictures of a tile and mix them near its seams, once all are drawn."""
    tile, near = task.place.store().get(task.key), SeamPixels.open(task.place.seam_file(task.key))
    assert tile is not None
    if task.factors is not None:
        task.factors.apply(tile, near)
    if near is not None and task.mixed:
        mix(tile.packed, near.index, near.share, near.colors)


@dataclass(frozen=True, slots=True)
class PreviewTask:
    """Write previews of pictures: the file, and each picture's path and record; read reads a picture."""

    previews: Path
    pictures: list[tuple[Path, int]]
    read: Read


def preview_pass(task: PreviewTask) -> None:
    """Write previews; a picture that cannot be read is left without, and is found out when it is drawn."""
    copy_ahead(path for path, _ in task.pictures)
    for path, row in task.pictures:
        with contextlib.suppress(PictureError):
            write_preview(task.previews, row, task.read(path, WORK_WIDTH_PX))


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """A picture's share of a layer.

    Attributes:
        layer: which of the task's layers. row: of its camera there. index: of its frame.
        field: float32 (3, 6), factors of its colours, see radiometry. factor: how much to reduce it first.
        windows: where it won. near_seams: where it is wanted beyond that, to be mixed in.
        preview: file and record for its preview; None where none is wanted.
    """

    layer: int
    row: int
    index: int
    field: Floats
    factor: int
    windows: list[Window]
    near_seams: list[Window]
    preview: tuple[Path, int] | None = None


@dataclass(frozen=True, slots=True)
class TaskLayer:
    """What a task has to know of one of the maps that are drawn.

    place: where. shots: the cameras of the task's pictures. terrain: the ground by tile.
    """

    place: TilePlace
    shots: Shots
    terrain: dict[Key, Terrain]


@dataclass(frozen=True, slots=True)
class SampleTask:
    """Read pictures and colour what they won.

    layers: the maps that are drawn. pictures: files, and where each goes. read: reads a picture. parts: what is kept of
    the pictures between drawings; None to read them.
    """

    layers: list[TaskLayer]
    pictures: list[tuple[Path, list[Shot]]]
    read: Read
    parts: PictureParts | None = None


@dataclass(frozen=True, slots=True)
class Sampled:
    """What became of a picture in a layer: its thumbnail if it was read, or the reason why it could not be used.

    twice: pixels that show what it shows more than `TWICE_M` away as well.
    """

    layer: int
    index: int
    thumbnail: Bytes | None
    reason: str | None = None
    twice: int = 0


class _Ground:
    """A layer while it is drawn: its tiles, their heights, and the cameras about each tile."""

    def __init__(self, layer: TaskLayer) -> None:
        self.layer, self.store = layer, layer.place.store()
        self.near: dict[Key, SeamPixels] = {}
        self.lattices = {key: layer.place.heights(key, terrain) for key, terrain in layer.terrain.items()}
        self.about = {key: layer.shots.about(*layer.place.corner(key)) for key in layer.terrain}

    def place(self, shot: Shot) -> "tuple[list[_Placed], int]":
        """Where the pixels of a picture's windows lie in it, and how many of them show what others show, too."""
        layer = self.layer
        size = np.array(layer.shots.size[shot.row], np.int32)
        factor = bearable(shot.factor, int(size.min()))
        size //= np.int32(factor)
        placed, own = [], []
        for w in (*shot.windows, *shot.near_seams):
            position, rotation = self.about[w.key]
            camera = position[shot.row], rotation[shot.row], layer.shots.lens[shot.row]
            ground = self.lattices[w.key], layer.place.grid.gsd_m
            if w.is_listed:
                near = self.near.get(w.key) or SeamPixels.open(layer.place.seam_file(w.key))
                assert near is not None
                self.near[w.key] = near
                some = near.of(shot.index + 1)
                target = near.colors[:, some]
                found = place_listed(near.index[some], layer.place.tile_px, *camera, *ground, size, factor)
            else:
                tile = self.store.get(w.key)
                assert tile is not None
                target, window = tile.packed, np.array([w.row0, w.row1, w.col0, w.col1], np.int32)
                found = place(tile.plane, shot.index + 1, window, *camera, *ground, size, factor)
            if len(found[0]):
                own += [] if w.is_listed else [(w.key, *found)]
                placed.append(_Placed(target, *found, size=size, factor=factor, field=shot.field))
        return placed, self._twice(own)

    def _twice(self, own: list[tuple[Key, Ints, Ints, Floats, Ints]]) -> int:
        """How many pixels of a picture's windows show what is drawn elsewhere in them already."""
        if not own:
            return 0
        boxes, side = np.array([box for *_, box in own]), self.layer.place.tile_px
        low = (boxes[:, [2, 0]].min(0) // SPOT_PX).astype(np.int32)
        first = np.full((*(boxes[:, [3, 1]].max(0) // SPOT_PX - low + 1), 2), -1, np.int32)
        far_px = TWICE_M / self.layer.place.grid.gsd_m + 2 * SPOT_PX
        corners = [np.array(key, np.int32) * np.int32(side) for key, *_ in own]
        return sum(
            drawn_again(index, spots, side, corner, far_px, low, first)
            for corner, (_, index, spots, *_) in zip(corners, own, strict=True)
        )


class _Placed:
    """Pixels of a tile and where they lie in a picture, see pixel_sampling.place; its size and factor of reduction.

    needs: what must be known of the picture to draw them.
    """

    def __init__(
        self,
        target: NDArray[np.uint32],
        index: Ints,
        spots: Ints,
        sights: Floats,
        box: Ints,
        *,
        size: Ints,
        factor: int,
        field: Floats,
    ) -> None:
        self._target, self._index, self._spots, self._sights = target, index, spots, sights
        self._box, self._size, self._factor, self._field = box, size, factor, field
        left, right, top, bottom = box.tolist()
        width, height = size.tolist()
        self.needs = Box(
            left=max(left - BEFORE, 0) * factor,
            right=min(right + AFTER + 1, width) * factor - 1,
            top=max(top - BEFORE, 0) * factor,
            bottom=min(bottom + AFTER + 1, height) * factor - 1,
        )

    def draw(self, part: Part, scratch: "_Scratch") -> None:
        """Colour the pixels from a part of the picture that has what it needs."""
        pixels, corner = part.pixels, np.array(part.corner, np.int32)
        if self._factor > 1:
            pixels = reduced_exactly(part.cut(self.needs), self._factor)
            corner = np.array([self.needs.left, self.needs.top], np.int32) // np.int32(self._factor)
        left, right, top, bottom = self._box.tolist()
        around = BEFORE + AFTER + 1
        lanes = scratch.words(bottom - top + around, right - left + around)
        widen(pixels, corner, self._box, self._size, lanes)
        blend(self._target, self._index, self._spots, self._sights, lanes, self._box, self._field, WEIGHTS)


class _Scratch:
    """Memory that is used again and again: fresh memory costs more than what is done with it."""

    def __init__(self) -> None:
        self._words = np.empty(0, np.int64)

    def words(self, rows: int, columns: int) -> Indices:
        """Of int64, not set."""
        if self._words.size < rows * columns:
            self._words = np.empty(rows * columns, np.int64)
        return self._words[: rows * columns].reshape(rows, columns)


def sample_pass(task: SampleTask) -> list[Sampled]:
    """Colour the pixels of some frames in the tiles' files, each picture read at most once for all layers."""
    grounds, scratch = [_Ground(layer) for layer in task.layers], _Scratch()
    copy_ahead(path for path, _ in task.pictures)
    results = []
    for path, shots in task.pictures:
        found = [grounds[shot.layer].place(shot) for shot in shots]
        placed = [p for windows, _ in found for p in windows]
        needs = Box.around([p.needs for p in placed])
        part = None
        if task.parts is not None and all(shot.preview is None for shot in shots):
            part = task.parts.get(path, needs)
        small = None
        if part is None:
            try:
                picture = _read(task.read, path, grounds[shots[0].layer].layer.shots.size[shots[0].row])
            except RunInterruptedError:
                raise
            except OrthoSwarmError as error:
                reason = error.reason if isinstance(error, PictureError) else str(error)
                results += [Sampled(shot.layer, shot.index, None, reason) for shot in shots]
                continue
            for to in {shot.preview for shot in shots if shot.preview is not None}:
                write_preview(*to, picture)
            if task.parts is not None:
                task.parts.keep(path, picture, needs)
            small = thumbnail(reduced(picture, shots[0].factor)[0])
            part = Part(picture, (0, 0))
        for window in placed:
            window.draw(part, scratch)
        results += [
            Sampled(shot.layer, shot.index, small, twice=twice) for shot, (_, twice) in zip(shots, found, strict=True)
        ]
    return results


def _read(read: Read, path: Path, size: Ints) -> Bytes:
    picture = read(path, int(size.max()))
    if picture.shape[:2] != (size[1], size[0]):
        raise PictureError.of(
            path,
            f"is {picture.shape[1]}x{picture.shape[0]} pixels and not {size[0]}x{size[1]} as it was; do not change "
            "pictures while they are mapped",
        )
    return np.ascontiguousarray(picture[..., :3])


def thumbnail(picture: Bytes) -> Bytes:
    """The means of the parts of a picture, uint8 (rows, columns, 3 or 4), from 160 x 120 of its pixels.

    Returns:
        uint8 (12, 16, 3).
    """
    import cv2

    small = cv2.resize(picture, (160, 120), interpolation=cv2.INTER_NEAREST)
    return np.ascontiguousarray(cv2.resize(small, THUMBNAIL[::-1], interpolation=cv2.INTER_AREA)[..., :3])
