"""How far each place of an orthoimage can be trusted: the distance from where it is drawn to where it is.

On a map that is the distance on it. Without one all pictures have the receivers' error in common; it is stated once for
all of them, and each place's is that against the others.

Three things move what a picture shows: the error of its camera; things on the ground too low to be measured; and what
stands there without being drawn on its top, which leans away from the camera. The last is followed along the line of
sight through the measured surface: what the picture shows at a place is what that line meets first.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import cv2
import numpy as np

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Array, Flags, Floats, Ints
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.mosaic.extent import drawn_window
from orthoswarm.mosaic.footprint import footprint
from orthoswarm.mosaic.kernels.line_of_sight import HIDES_M
from orthoswarm.mosaic.radiometry import Field

GOOD_TO_M: Final = (0.2, 0.5, 2.0)
"""The classes of error, metres. Measured on a simulated city: of the places of the first, of the first two and of all
three 94, 98 and 99 of 100 are drawn as near as this to where they are; houses that were not found lean."""
ORIENTATION_ONLY: Final = np.float32(99.0)  # what is not within the last of them
_LENGTH_SIGMAS: Final = 2.2  # 98 % of errors are shorter: 2.8 sigmas of an axis, see STATED_SIGMA_FACTOR
_LOW_THINGS_M: Final = 0.3  # sigma of the height of what is not measured: kerbs, cars, shrubs
UNMEASURED_M: Final = 3.0  # what may stand where heights were not measured, or not found: a hedge, a small house
_LEAST_PICTURES: Final = 3  # that heights are measured from
_LEANS_M: Final = 0.5  # what stands may be so far from where it is drawn: more than the half of a car
_CELL_M: Final = 1.0  # least side of a cell
_MOST_CELLS: Final = 2_000_000  # cells are larger where there would be more (memory, time)
_CUT_SHARE: Final = 0.05  # a second picture with less of an object only touches its edge
_CUT_M: Final = 1.0  # objects are higher than this ...
_OBJECT_CELLS: Final = 4  # ... and as large as so many cells, else the cells do not tell by what they are drawn
_TEETH_M: Final = 6.0  # sigma by which the outline is smoothed: pictures are a few times as far apart
_SIDE: Final = 0.05  # so much of what is drawn lies along each side
_DOUBTFUL_SIDE: Final = 0.4  # share of it that makes a side one for orientation
_CHANGED_TONE: Final = 1.5  # colours that were multiplied or divided by more are not the picture's own


class Confidence(NamedTuple):
    """How far an orthoimage can be trusted, cell by cell; all (rows, columns), NaN or 0 where nothing is drawn.

    Attributes:
        grid: of the cells. good_to_m: float32, one of GOOD_TO_M or ORIENTATION_ONLY.
        pictures: int32, how many see the ground there. angle_deg: float32, off nadir, of the one that is drawn.
        sigma_m: float32, error of its camera on the ground, see PlacedFrame. lean_m: float32, how far away that
            may stand which it shows there. hidden: bool, that is drawn there, too.
        changed_tone: bool, its colours were changed much to fit the others.
        objects: how many things higher than a metre are drawn on their tops. cut: those that several pictures show.
        whole_m: error of the place of the whole orthoimage besides, metres; 0 where it lies on a map.
    """

    grid: GroundGrid
    good_to_m: Floats
    pictures: Ints
    angle_deg: Floats
    sigma_m: Floats
    lean_m: Floats
    hidden: Flags
    changed_tone: Flags
    objects: int
    cut: int
    whole_m: float

    def figures(self) -> dict[str, object]:
        """Shares of what is drawn, for the report."""
        drawn = np.isfinite(self.good_to_m)
        count = max(int(drawn.sum()), 1)
        shares = {f"{m:g}": float((self.good_to_m[drawn] <= m).sum()) / count for m in GOOD_TO_M}
        return {
            "good_to_m": shares,
            "whole_good_to_m": self.whole_m,
            "hidden_share": float(self.hidden.sum()) / count,
            "leaning_share": float((self.lean_m[drawn] > _LEANS_M).sum()) / count,
            "single_picture_share": float((self.pictures[drawn] <= 1).sum()) / count,
            "doubtful_sides": [name for name, share in self._sides().items() if share > _DOUBTFUL_SIDE],
            "objects": self.objects,
            "cut_objects": self.cut,
        }

    def _sides(self) -> dict[str, float]:
        """Which share of what is drawn along each side of the orthoimage is only for orientation."""
        row, column = np.nonzero(np.isfinite(self.good_to_m))
        if not len(row):
            return {}
        rough = self.good_to_m[row, column] == ORIENTATION_ONLY
        low, high = np.quantile(row, [_SIDE, 1.0 - _SIDE])
        left, right = np.quantile(column, [_SIDE, 1.0 - _SIDE])
        sides = {"north": row < low, "east": column > right, "south": row > high, "west": column < left}
        return {name: float(rough[of].mean()) for name, of in sides.items() if of.any()}


def confidence(
    grid: GroundGrid, shown: Ints, frames: Sequence[PlacedFrame], terrain: Terrain, gains: Sequence[Field | None]
) -> Confidence:
    """How far an orthoimage can be trusted.

    Args:
        grid, shown: its cells, and which frame each shows: index plus 1, 0 where none, int32 (rows, columns); see
            `drawn_cells`.
        frames, terrain: what it was drawn from. gains: factors of each frame's colours, None where unchanged.
    """
    row, column = np.nonzero(shown)
    of = shown[row, column] - 1
    place = np.array(grid.to_ground(np.column_stack([column, row]).astype(float)))
    position = np.array([f.camera.position for f in frames])[of]
    to_camera = np.column_stack([position[:, :2] - place, position[:, 2] - terrain.height(place)])
    tan = np.hypot(to_camera[:, 0], to_camera[:, 1]) / np.maximum(to_camera[:, 2], 1e-3)
    pictures = _pictures(grid, frames, terrain)
    common = _common_sigma(frames)
    sigma = np.array([f.sigma_m for f in frames])
    sigma = np.sqrt(sigma**2 - np.array([common**2 if f.stage == "coarse" else 0.0 for f in frames]))[of]
    unmeasured = np.where(pictures[row, column] < _LEAST_PICTURES, UNMEASURED_M, 0.0) * tan
    lean, hidden = _lean(terrain, place, to_camera)
    lean = np.maximum(lean, unmeasured)
    error = _LENGTH_SIGMAS * np.hypot(sigma, _LOW_THINGS_M * tan) + lean
    good = np.array([*GOOD_TO_M, ORIENTATION_ONLY], np.float32)[np.searchsorted(GOOD_TO_M, error)]

    def cells(values: Array) -> Floats:
        out = np.full(shown.shape, np.nan, np.float32)
        out[row, column] = values
        return out

    changed = np.array([_changed(gain) for gain in gains])
    objects, cut = _cut_objects(terrain, grid, shown)
    return Confidence(
        grid, cells(good), np.where(shown > 0, pictures, 0), cells(np.degrees(np.arctan(tan))), cells(sigma),
        cells(lean), cells(hidden) == 1.0, (shown > 0) & changed[shown - 1], objects, cut, _LENGTH_SIGMAS * common,
    )  # fmt: skip


def _common_sigma(frames: Sequence[PlacedFrame]) -> float:
    """The error that all frames have in common, metres: the receivers', where they hold each other and no map does."""
    if any(f.stage == "fine" for f in frames):
        return 0.0
    return min((f.sigma_m for f in frames if f.stage == "coarse" and np.isfinite(f.sigma_m)), default=0.0)


def cell_grid(canvas: Canvas) -> tuple[GroundGrid, int]:
    """Cells of what is drawn on a canvas, and their side in pixels: a power of two, so that a tile holds whole ones."""
    row0, row1, col0, col1 = drawn_window(canvas)
    grid, px = canvas.grid, 1
    while px < canvas.tile_px and (px * grid.gsd_m < _CELL_M or (row1 - row0) * (col1 - col0) > px * px * _MOST_CELLS):
        px *= 2
    cells = replace(
        grid, west=grid.west + col0 * grid.gsd_m, north=grid.north - row0 * grid.gsd_m, gsd_m=grid.gsd_m * px,
        width=-(-(col1 - col0) // px), height=-(-(row1 - row0) // px),
    )  # fmt: skip
    return cells, px


def drawn_cells(canvas: Canvas) -> tuple[GroundGrid, Ints]:
    """Cells of a canvas (renderer.render), and which frame is drawn in the middle of each, as of `confidence`."""
    cells, px = cell_grid(canvas)
    out = np.zeros((cells.height, cells.width), np.int32)
    row0, row1, col0, col1 = drawn_window(canvas)
    for row in range(row0, row1, canvas.tile_px):  # a row of tiles at a time, for memory
        plane = canvas.read_plane(row, min(row + canvas.tile_px, row1), col0, col1)
        some = plane[px // 2 :: px, px // 2 :: px]
        out[(row - row0) // px :][: len(some), : some.shape[1]] = some
    return cells, out


def trim_edge(canvas: Canvas, frames: Sequence[PlacedFrame], terrain: Terrain) -> None:
    """Take away from a canvas what lies outside of the ground that several frames see; no teeth of single ones remain.

    frames, terrain: what it was drawn from, as of `confidence`.
    """
    grid, shown = drawn_cells(canvas)
    count = np.where(shown > 0, _pictures(grid, frames, terrain), 0)
    usual = int(np.median(count[shown > 0])) if shown.any() else 0
    well = np.pad((count >= min(_LEAST_PICTURES, usual // 2)) & (shown > 0), 1).astype(np.float32)
    well = cv2.GaussianBlur(well, None, _TEETH_M / grid.gsd_m)
    _, parts = cv2.connectedComponents((well < 0.5).astype(np.uint8))
    well[(parts != parts[0, 0]) & (well < 0.5)] = 1.0  # what is seen by few within the map stays
    for key in canvas.changed_since(0):
        box, step = canvas.tile_bounds(key), canvas.grid.gsd_m / grid.gsd_m
        x, y = grid.to_pixel([box.west + 0.5 * canvas.grid.gsd_m, box.north - 0.5 * canvas.grid.gsd_m]) + 1.0
        to_cells = np.array([[step, 0.0, x], [0.0, step, y]])
        size, how = (canvas.tile_px, canvas.tile_px), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        away = cv2.warpAffine(well, to_cells, size, flags=how) < 0.5
        if away.any():
            tile = canvas.begin(key)
            tile.rgba[away], tile.plane[away] = 0, 0
            canvas.commit(key)


def _pictures(grid: GroundGrid, frames: Sequence[PlacedFrame], terrain: Terrain) -> Ints:
    """How many frames see each cell on level ground below each, int32 (rows, columns)."""
    count = np.zeros((grid.height, grid.width), np.int32)
    ground = terrain.bare_ground().height(np.array([f.camera.nadir for f in frames]))
    size = (grid.width, grid.height)
    for frame, z in zip(frames, ground.tolist(), strict=True):
        outline = footprint(frame.camera, z)
        if frame.weak or not len(outline):
            continue
        ring = np.round(grid.to_pixel(outline)).astype(np.int32)
        low, high = ring.min(0).clip(0, size), (ring.max(0) + 1).clip(0, size)
        if (low < high).all():
            inside = np.zeros((high - low)[::-1], np.uint8)
            cv2.fillPoly(inside, [ring - low], [1])
            count[low[1] : high[1], low[0] : high[0]] += inside
    return count


def _lean(terrain: Terrain, place: Array, to_camera: Array) -> tuple[Array, Array]:
    """How far from each place (N, 2) that may stand which its camera sees there, (N,), metres; to_camera: (N, 3).

    Tops and edges count one node farther out than they were measured. Besides, 1 where it stands on the drawn surface.
    """
    if terrain.bare is None or terrain.tops is None:
        return np.zeros(len(place)), np.zeros(len(place))
    around = np.ones((3, 3), np.uint8)
    drawn = terrain.z - terrain.bare
    may_stand = terrain.bare + cv2.dilate(terrain.tops - terrain.bare, around)
    may_fall = drawn - cv2.erode(drawn, around)
    at = np.column_stack([place[:, 1] - terrain.south, place[:, 0] - terrain.west]) / terrain.step_m
    out = np.zeros((2, len(place)))
    _first_met(may_stand, may_fall, terrain.z, terrain.step_m, at, to_camera, float(may_stand.max()), HIDES_M, *out)
    return out[0], out[1]


@in_place_kernel
def _first_met(may_stand, may_fall, z, step_m, at, to_camera, top, above, out, hidden):  # type: ignore[no-untyped-def]
    """Set `out` to the distance on the ground at which each line of sight leaves all that may stand; see _lean."""
    rows, columns = z.shape
    for k in range(len(at)):
        away = max(np.hypot(to_camera[k, 0], to_camera[k, 1]), 1e-6)
        down, right = to_camera[k, 1] / away, to_camera[k, 0] / away
        rise = max(to_camera[k, 2], 1e-3) / away * step_m
        i, j = int(at[k, 0] + 0.5), int(at[k, 1] + 0.5)
        far = 0.0
        if i >= 0 and j >= 0 and i < rows and j < columns:
            far = may_fall[i, j] / rise
            line, n = np.float64(z[i, j]) + above, 0
            while line < top:
                i, j = int(at[k, 0] + n * down + 0.5), int(at[k, 1] + n * right + 0.5)
                if i < 0 or j < 0 or i >= rows or j >= columns:
                    break
                if may_stand[i, j] > line:  # its top, or its near wall where the line comes out of it
                    far = max(far, min((may_stand[i, j] - line + above) / rise + n, n + 1.0))
                if z[i, j] > line:
                    hidden[k] = 1.0
                n += 1
                line += rise
        out[k] = far * step_m


def _cut_objects(terrain: Terrain, grid: GroundGrid, shown: Ints) -> tuple[int, int]:
    """How many objects are drawn on their tops, and how many of them by more than one picture."""
    if terrain.bare is None:
        return 0, 0
    count, objects = cv2.connectedComponents((terrain.z - terrain.bare > _CUT_M).astype(np.uint8), ltype=cv2.CV_32S)
    row, column = np.nonzero(objects)
    place = np.column_stack([terrain.west + column * terrain.step_m, terrain.south + row * terrain.step_m])
    x, y = np.round(grid.to_pixel(place)).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < grid.width) & (y < grid.height)
    of, by = objects[row, column][inside].astype(np.int64), shown[y[inside], x[inside]]
    pairs, cells = np.unique(of * (int(shown.max()) + 1) + by, return_counts=True)
    owner = pairs // (int(shown.max()) + 1)
    large = cells > _CUT_SHARE * np.bincount(of, minlength=count)[owner]
    parts = np.bincount(owner[large], minlength=count)[1:]
    wide = np.bincount(of, minlength=count)[1:] * terrain.step_m**2 >= _OBJECT_CELLS * grid.gsd_m**2
    return int(wide.sum()), int((wide & (parts > 1)).sum())


def _changed(gain: Field | None) -> bool:
    """Whether a picture's colours were changed much."""
    return gain is not None and float(np.abs(np.log(np.maximum(gain.mean(0)[0], 1e-3))).max()) > np.log(_CHANGED_TONE)
