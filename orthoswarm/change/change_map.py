"""The change of an area against its pre-disaster map, block by block of cells, so that memory is bounded.

The map itself lies beside its place by small local offsets, and its leaning buildings hide ground.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.change.evidence import measured, probabilities
from orthoswarm.change.looks import FINE, ToneModel, cell_looks, on_cells
from orthoswarm.change.seen_ground import Read, heights_on, seen_ground
from orthoswarm.change.structure import blurred, structure
from orthoswarm.coverage.view import View
from orthoswarm.model.arrays import Bytes, Flags, Floats
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain
from orthoswarm.raster.basemap import Basemap

_BLOCK: Final = 448  # cells along the side of a block
_MARGIN: Final = 16  # cells around it that are measured, too: two sigmas of the largest surroundings
_MOST_CELLS: Final = 16_000_000  # cells are larger where there would be more (memory)
_SCENE_CELLS: Final = 1_000_000  # of the whole scene, on which its tones are compared
_APART: Final = 0.25  # distance of the pictures that are used, in heights above the ground: four see each place
_THICK: Final = 0.6  # share of haze that hides the ground
_SEEN: Final = 0.5  # share of a cell that pictures must see
_RIM_M: Final = 3.0  # along the edges of the map's data there are edges that the ground does not have
_DISTORTED_PX: Final = 1.0  # offsets of the map below this are those of what leans, not of the map
_TILE_PX: Final = 64  # side of the parts whose offset is measured
_FARTHEST_PX: Final = 4  # offsets: a map's own distortion is up to 3 m
_CLEAR: Final = 6.0  # a peak so many sigmas above the others' is believed
_HIDES_M: Final = 2.0  # what is higher than the line of sight by this hides


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedScene:
    """What is compared."""

    views: Sequence[View]  # refined pictures, in the map's grid
    terrain: Terrain  # the ground they lie on
    basemap: Basemap  # the pre-disaster map
    orthoimage: Path  # the refined one
    read: Read  # gives a view's grey values
    lean: tuple[float, float]  # of the map, metres a metre of height


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeMap:
    """The change of an area; all (rows, columns)."""

    grid: GroundGrid  # its cells
    probability: Bytes  # uint8, that the ground changed, 0 to 255
    visible: Flags  # bool, where that can be said
    inside: Flags  # bool, where the orthoimage shows the ground
    case: Bytes  # uint8, the likeliest of CASES but the first
    height: Floats  # float32, what stands above the bare ground now, metres

    @classmethod
    def blank(cls, grid: GroundGrid) -> "ChangeMap":
        """A map of nothing."""
        shape = (grid.height, grid.width)
        chance, case = np.zeros((2, *shape), np.uint8)
        visible, inside = np.zeros((2, *shape), bool)
        height = np.zeros(shape, np.float32)
        return cls(grid=grid, probability=chance, visible=visible, inside=inside, case=case, height=height)


class MeasuredBlock(NamedTuple):
    """What is measured of a block of an area's cells."""

    rows: slice  # which cells
    columns: slice  # which cells
    values: Floats  # float32 (rows, columns, features), what the probability is computed from
    seen: Floats  # float32, 0 to 1, how much of each pictures see and the map has
    veil: Floats  # share of its light that is haze, less that of the map
    # drawn, hidden: bool, where the orthoimage shows them, and where the map shows what stands before them
    drawn: Flags
    hidden: Flags
    height: Floats  # float32, what stands above the bare ground now, metres


def map_change(
    scene: ComparedScene, *, want_m: float, progress: Callable[[int, int], None] = lambda done, of: None
) -> ChangeMap:
    """Find where the ground is no longer what the map shows.

    Args:
        scene: what is compared. want_m: side of a cell, metres; that of the map's pixel where it is larger.
        progress: called with blocks done and in all.
    """
    grid = cells_of(scene, want_m)
    out = ChangeMap.blank(grid)
    of = -(-grid.height // _BLOCK) * -(-grid.width // _BLOCK)
    for done, block in enumerate(measured_blocks(scene, grid), start=1):
        window, chance = (block.rows, block.columns), probabilities(block.values)
        out.inside[window] = block.drawn
        out.probability[window] = np.round(255 * (1.0 - chance[..., 0]))
        out.visible[window] = block.drawn & (block.seen > _SEEN) & (block.veil < _THICK) & ~block.hidden
        out.case[window] = 1 + cv2.medianBlur(chance[..., 1:].argmax(-1).astype(np.uint8), 5)
        out.height[window] = block.height
        progress(done, of)
    return out


def cells_of(scene: ComparedScene, want_m: float) -> GroundGrid:
    """The cells of what both the orthoimage and the map show."""
    import rasterio

    with rasterio.open(scene.orthoimage) as file:
        bounds = BoundingBox(*file.bounds).intersection(scene.basemap.bounds)
    most = float(np.sqrt(max(bounds.width * bounds.height, 0.0) / _MOST_CELLS))
    return GroundGrid.around(scene.basemap.epsg, bounds, max(want_m, scene.basemap.native_gsd_m, most))


def measured_blocks(scene: ComparedScene, grid: GroundGrid) -> Iterator[MeasuredBlock]:
    """Measure the cells of a scene, block by block."""
    per_cell = 2 if grid.gsd_m >= 1.5 * scene.basemap.native_gsd_m else 1
    scene, tone = replace(scene, views=_thinned(scene.views, scene.terrain)), _tone(scene, grid)
    for row in range(0, grid.height, _BLOCK):
        for column in range(0, grid.width, _BLOCK):
            rows = slice(row, min(row + _BLOCK, grid.height))
            columns = slice(column, min(column + _BLOCK, grid.width))
            yield _measured_block(scene, tone, grid, (rows, columns), per_cell)


def _measured_block(
    scene: ComparedScene, tone: ToneModel, grid: GroundGrid, window: tuple[slice, slice], per_cell: int
) -> MeasuredBlock:
    (rows, columns), cell = window, grid.gsd_m
    own = replace(
        grid, west=grid.west + (columns.start - _MARGIN) * cell, north=grid.north - (rows.start - _MARGIN) * cell,
        width=columns.stop - columns.start + 2 * _MARGIN, height=rows.stop - rows.start + 2 * _MARGIN,
    )  # fmt: skip
    picture, alpha = orthoimage_window(scene.orthoimage, own, FINE)
    drawn = on_cells((alpha > 127).astype(np.float32), FINE) > _SEEN
    pixels = replace(own, gsd_m=cell / per_cell, width=own.width * per_cell, height=own.height * per_cell)
    terrain, views = scene.terrain, scene.views if drawn.any() else ()
    seen = seen_ground(views, pixels, heights_on(pixels, terrain, terrain.z), scene.read)
    fine, known = scene.basemap.rgb(BoundingBox(*own.bounds), cell / FINE)
    gray = on_cells(cv2.cvtColor(fine, cv2.COLOR_RGB2GRAY), FINE // per_cell).astype(np.float32)
    valid = on_cells(known.astype(np.float32), FINE // per_cell) > _SEEN
    rim = 2 * int(np.ceil(_RIM_M / pixels.gsd_m)) + 1
    valid = cv2.erode(valid.astype(np.uint8), np.ones((rim, rim), np.uint8), borderValue=1) > 0
    before = structure(gray, pixels.gsd_m)
    offset = local_offsets(before.field, seen.field)
    if float(np.abs(offset).max()) > _DISTORTED_PX:
        offset[np.hypot(offset[..., 0], offset[..., 1]) < _DISTORTED_PX] = 0.0
        gray = shifted(gray, offset)
        before = structure(gray, pixels.gsd_m)
    values, shown, veil = measured(
        seen, before, gray, valid, now=cell_looks(picture), then=cell_looks(fine), drawn=drawn, tone=tone,
        per_cell=per_cell, cell_m=cell,
    )  # fmt: skip
    height = np.zeros(drawn.shape, np.float32)
    if terrain.bare is not None:
        height = heights_on(own, terrain, terrain.z - terrain.bare)
    inner = np.s_[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
    hidden = hidden_on_map(height, scene.lean, cell)
    return MeasuredBlock(
        rows, columns, values[inner], shown[inner], veil[inner], drawn[inner], hidden[inner], height[inner]
    )


def _thinned(views: Sequence[View], terrain: Terrain) -> list[View]:
    """Pictures some way apart, refined and sure ones first: all of a flight's see each place many times."""
    order = sorted(
        range(len(views)), key=lambda i: (not views[i].placed, round(np.nan_to_num(views[i].sigma_m, nan=9), 1), i)
    )
    taken: dict[tuple[int, int], list[View]] = {}
    out: list[View] = []
    level = float(np.median(terrain.z))
    apart = _APART * float(np.median([max(v.position[2] - level, 1.0) for v in views]))
    for view in (views[i] for i in order):
        key = (int(view.position[0] // apart), int(view.position[1] // apart))
        near = (v for i in (-1, 0, 1) for j in (-1, 0, 1) for v in taken.get((key[0] + i, key[1] + j), ()))
        if all(np.hypot(*(v.position[:2] - view.position[:2])) >= apart for v in near):
            taken.setdefault(key, []).append(view)
            out.append(view)
    return out


def _tone(scene: ComparedScene, grid: GroundGrid) -> ToneModel:
    """How the scene's colours have changed where it is the same."""
    factor = max(2.0, float(np.sqrt(grid.width * grid.height / _SCENE_CELLS)))
    coarse = GroundGrid.around(grid.epsg, grid.bounds, grid.gsd_m * factor)
    picture, alpha = orthoimage_window(scene.orthoimage, coarse, 1)
    before, valid = scene.basemap.rgb(BoundingBox(*coarse.bounds), coarse.gsd_m)
    return ToneModel.of(before.astype(np.float32), picture.astype(np.float32), (alpha > 127) & valid)


def orthoimage_window(path: Path, cells: GroundGrid, per_cell: int) -> tuple[Bytes, Bytes]:
    """Colours (rows, columns, 3) and alpha (rows, columns) of an orthoimage on the pixels of cells, uint8."""
    import rasterio
    from rasterio.windows import Window

    pixel = cells.gsd_m / per_cell
    rows, columns = cells.height * per_cell, cells.width * per_cell
    with rasterio.open(path) as file:
        gsd, left, top = float(file.res[0]), file.bounds.left, file.bounds.top
        factor = max(1, 2 ** int(np.floor(np.log2(max(pixel / gsd, 1.0)))))  # an overview that is finer
        size = np.array([file.width, file.height])
        low = (np.array([cells.west - left, top - cells.north]) / gsd).astype(int) // factor * factor - factor
        high = low + np.ceil(np.array([columns, rows]) * pixel / gsd / factor).astype(int) * factor + 3 * factor
        low, high = np.clip(low, 0, size), np.clip(high, 0, size)
        wide, tall = (int(v) for v in -(-(high - low) // factor))
        if wide < 1 or tall < 1:
            return np.zeros((rows, columns, 3), np.uint8), np.zeros((rows, columns), np.uint8)
        window = Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
        bands = np.moveaxis(file.read((1, 2, 3, 4), window=window, out_shape=(4, tall, wide)), 0, 2)
    # Where the pixels of the cells lie in what was read.
    step = gsd * (high - low) / [wide, tall]
    scale = pixel / step
    first = (np.array([cells.west - left, top - cells.north]) - low * gsd) / step + 0.5 * scale - 0.5
    place = np.array([[scale[0], 0.0, first[0]], [0.0, scale[1], first[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    out = cv2.warpAffine(np.ascontiguousarray(bands), place, (columns, rows), flags=flags)
    return np.ascontiguousarray(out[..., :3]), out[..., 3]


def local_offsets(before: Floats, now: Floats) -> Floats:
    """How far a map's structure lies from the pictures', float32 (rows, columns, 2): columns and rows, in pixels.

    Parts of _TILE_PX are correlated; what is not clear is taken from its neighbours, 0 where there is none.

    before, now: structure of map and pictures, float32 (rows, columns, 2 or more), gradients first.
    """
    rows, columns = (max(1, side // _TILE_PX) for side in before.shape[:2])
    found = np.zeros((rows, columns, 3), np.float32)
    taper = np.outer(*[np.hanning(_TILE_PX + 2)[1:-1]] * 2).astype(np.float32)
    for r in range(rows):
        for c in range(columns):
            part = np.s_[r * _TILE_PX : (r + 1) * _TILE_PX, c * _TILE_PX : (c + 1) * _TILE_PX]
            a, b = (np.ascontiguousarray(f[part][..., :2]).view(np.complex64)[..., 0] for f in (before, now))
            if a.shape == taper.shape:
                found[r, c] = _peak(a * taper, b * taper)
    weight = found[..., 2].copy()
    near = blurred(weight, 0.8)
    smooth = np.dstack([blurred(found[..., k] * weight, 0.8) for k in range(2)]) / np.maximum(near, 1e-6)[..., None]
    smooth[near < 1e-3] = 0.0
    size = (before.shape[1], before.shape[0])
    return np.asarray(cv2.resize(smooth.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))


def _peak(before: NDArray[Any], now: NDArray[Any]) -> tuple[float, float, float]:
    """Offset of one part, columns and rows, and its weight, 0 where it is not clear; complex gradients."""
    both = np.fft.ifft2(np.fft.fft2(before) * np.conj(np.fft.fft2(now))).real
    spread = float(both.std())
    n = _FARTHEST_PX
    near = np.roll(both, (n, n), (0, 1))[: 2 * n + 1, : 2 * n + 1]
    row, column = np.unravel_index(int(near.argmax()), near.shape)
    clear = float(near[row, column]) / max(spread, 1e-9)
    if clear < _CLEAR or row in (0, 2 * n) or column in (0, 2 * n):
        return 0.0, 0.0, 0.0

    def between(low: float, middle: float, high: float) -> float:
        bend = low - 2 * middle + high
        return 0.5 * (low - high) / bend if bend < 0 else 0.0

    dy = between(*near[row - 1 : row + 2, column])
    dx = between(*near[row, column - 1 : column + 2])
    return column - n + dx, row - n + dy, clear


def shifted(values: Floats, offset: Floats) -> Floats:
    """Values taken at each pixel plus an offset (columns, rows), float32 (rows, columns, 2)."""
    row, column = (a.astype(np.float32) for a in np.indices(values.shape[:2]))
    return np.asarray(
        cv2.remap(
            values, column + offset[..., 0], row + offset[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
    )


def hidden_on_map(height: Floats, lean: tuple[float, float], gsd_m: float) -> Flags:
    """Where the map shows what stands before the ground, bool (rows, columns).

    Args:
        height: above the bare ground, float32, metres. lean: shift on the map a metre of height, (east, north).
        gsd_m: of the pixels.
    """
    slope, top = float(np.hypot(*lean)), float(height.max())
    hidden = np.zeros(height.shape, bool)
    if slope < 1e-3 or top < _HIDES_M:
        return hidden
    # Ground at p is hidden by what stands at p - lean * h, as that is shown at p.
    for k in range(1, int(np.ceil(top * slope / gsd_m)) + 1):
        away = k * gsd_m / slope
        dx, dy = round(-lean[0] / slope * k), round(lean[1] / slope * k)
        hidden |= (
            cv2.warpAffine(height, np.array([[1, 0, -dx], [0, 1, -dy]], np.float32), height.shape[::-1])
            > away + _HIDES_M
        )
    return hidden
