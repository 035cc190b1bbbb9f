"""The real-time module (paper III.B): every map pixel takes the picture that sees it most orthogonally, no blending.

The homography of a frame follows in closed form from its recorded pose and an assumed field of view (theta-hat, below
the smallest that any camera has), so no picture is matched to anything. `RealtimeMosaic` draws one frame at a time as
the daemon receives them; `mosaic` draws many at once, and samples each map pixel only once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.canvas.tile_store import Key
from orthoswarm.model.arrays import Array, Bytes
from orthoswarm.model.camera import Camera
from orthoswarm.model.errors import InputError
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.mosaic.footprint import LEAST_DESCENT, reach, rejection
from orthoswarm.mosaic.kernels.downsampling import pack, reduction
from orthoswarm.mosaic.kernels.lens_arrays import INNER, OUTER, lens_row
from orthoswarm.mosaic.kernels.realtime_kernel import RUN, aim, fuse, touches
from orthoswarm.mosaic.render_passes import Read
from orthoswarm.mosaic.renderer import Progress, RenderStats, Run, render, serial
from orthoswarm.mosaic.seams.previews import PreviewFile
from orthoswarm.raster.picture_file import read_rgb
from orthoswarm.raster.picture_parts import PictureParts

_BY_RECEIVER = 1e4  # as if it were so many times farther: it loses against any that is not
_WEAK = 1e8  # farther than any other


@dataclass(frozen=True, slots=True)
class Added:
    """What became of a frame.

    tiles: the tiles (row, column) that changed. won: how many map pixels it took. reason: why it was not drawn, None if
    it was (also when it won nothing).
    """

    tiles: list[Key]
    won: int
    reason: str | None = None


class RealtimeMosaic:
    """Draws frames one at a time on a canvas with an orthogonality plane.

    The result depends on the order of frames only where two are at exactly the same distance: the earlier stays.

    Args:
        canvas: made with plane "orthogonality". One thread adds.

    Raises:
        InputError: if the canvas has another plane.
    """

    def __init__(self, canvas: Canvas) -> None:
        if canvas.plane != "orthogonality":
            raise InputError(f"the canvas in {canvas.path} was rendered, not drawn in real time; use another folder")
        self.canvas = canvas
        self._reals = np.empty((3, canvas.tile_px + RUN), np.float32)
        self._integers = np.empty((6, canvas.tile_px + RUN), np.uint32)

    def add(
        self,
        picture: Bytes,
        camera: Camera,
        ground_z_m: float = 0.0,
        *,
        weak: bool = False,
        by_receiver: bool = False,
    ) -> Added:
        """Draw one frame.

        Args:
            picture: uint8 (H, W, 4) RGBA with alpha 255, as read by read_rgba, or (H, W, 3) RGB (costs a copy).
            camera: where it was; its lens has the picture's size.
            ground_z_m: height of the ground plane, same datum as the camera.
            weak: True to draw it only where no picture is yet, and to give way to any that comes.
            by_receiver: True to draw it only where no picture is yet that lies on the basemap by evidence, and to give
                way to any that does.

        Raises:
            ValueError: if the picture has not the lens's size.
            OrthoSwarmError: if the disk is full.
        """
        grid, lens = self.canvas.grid, camera.lens
        if picture.shape[:2] != (lens.height, lens.width):
            raise ValueError(f"the picture is {picture.shape[1::-1]}, its lens {(lens.width, lens.height)} pixels")
        reason = rejection(camera, ground_z_m, grid.gsd_m)
        if reason is not None:
            return Added([], 0, reason)
        planes, box = np.empty((8, 3)), np.empty(4)
        outer = np.array(lens_row(lens, 0.0)[OUTER:INNER])
        number = aim(
            camera.position, camera.rotation, outer, ground_z_m, LEAST_DESCENT, grid.west, grid.north, grid.gsd_m,
            planes, box,
        )  # fmt: skip
        keys = self._tiles_in(box) if number else []
        if not keys:
            return Added([], 0, "it lies outside the map's area")
        east, north, up = camera.position.tolist()
        packed, factor = pack(picture, reduction(grid.gsd_m, (up - ground_z_m) / lens.focal_px))
        shot = _Shot(
            picture=packed,
            planes=planes[:number],
            centre=np.array([(east - grid.west) / grid.gsd_m - 0.5, (grid.north - north) / grid.gsd_m - 0.5]),
            radius=reach(camera, ground_z_m) / grid.gsd_m,
            matrix=ground_to_camera(camera, ground_z_m, grid.gsd_m),
            lens=_reduced_lens(camera, factor),
            handicap=_WEAK if weak else _BY_RECEIVER if by_receiver else 1.0,
        )
        counts = [self._draw(key, shot) for key in keys]
        return Added([key for key, count in zip(keys, counts) if count], sum(counts))

    def _tiles_in(self, box: Array) -> list[Key]:
        """Tiles under a box (column low and high, row low and high), in canvas pixels."""
        grid, t = self.canvas.grid, self.canvas.tile_px
        c0, c1 = max(0, math.ceil(box[0])), min(grid.width - 1, math.floor(box[1]))
        r0, r1 = max(0, math.ceil(box[2])), min(grid.height - 1, math.floor(box[3]))
        if c0 > c1 or r0 > r1:
            return []
        return [(r, c) for r in range(r0 // t, r1 // t + 1) for c in range(c0 // t, c1 // t + 1)]

    def _draw(self, key: Key, shot: "_Shot") -> int:
        grid, t = self.canvas.grid, self.canvas.tile_px
        row, column = key[0] * t, key[1] * t
        rows, columns = min(t, grid.height - row), min(t, grid.width - column)
        if not touches(shot.planes, shot.centre, shot.radius, row, column, rows, columns):
            return 0
        tile = self.canvas.begin(key)
        part, gsd = (row, column, rows, columns), grid.gsd_m
        won = fuse(
            tile.packed, tile.plane, part, shot.picture, shot.planes, shot.centre, shot.radius, shot.matrix, shot.lens,
            gsd * shot.handicap, self._reals, self._integers,
        )  # fmt: skip
        if won:
            self.canvas.commit(key)
        return int(won)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shot:
    """A picture ready for `fuse`; planes and centre in canvas pixels, matrix about the nadir point.

    The handicap multiplies its pixels' distances from the nadir point, by which pictures compete.
    """

    picture: NDArray[np.uint32]
    planes: Array
    centre: Array
    radius: float
    matrix: Array
    lens: Array
    handicap: float


def ground_to_camera(camera: Camera, ground_z_m: float, gsd_m: float) -> Array:
    """Matrix (3, 3) from map pixels about the nadir point (column, row, 1) to undistorted normalised coordinates.

    The inverse of the paper's homography (III.B) in closed form: d = R^T (P - C). Its third row is the depth in metres,
    positive before the camera whatever the tilt, and no large easting enters.
    """
    drop = ground_z_m - float(camera.position[2])
    return np.asarray(camera.rotation.T * (gsd_m, -gsd_m, drop))


def _reduced_lens(camera: Camera, factor: int) -> Array:
    lens = camera.lens
    edges = (*lens.principal_point, 0.0, lens.width - 1.0, 0.0, lens.height - 1.0)
    return np.array([lens.k1, lens.k2, lens.k3, lens.focal_px / factor, *((e + 0.5) / factor - 0.5 for e in edges)])


def mosaic(
    frames: Sequence[PlacedFrame],
    canvas: Canvas,
    ground_z_m: float = 0.0,
    *,
    previews: PreviewFile | None = None,
    read: Read = read_rgb,
    parts: PictureParts | None = None,
    run: Run = serial,
    progress: Progress | None = None,
) -> RenderStats:
    """Draw many frames at once by the same rule: which frame wins where is decided first, without the pictures.

    The same mosaic as by adding frame after frame (interpolated better), at little more than the cost of reading each
    picture that wins something once. Canvases, errors and arguments as for `render`; `weak` means nothing here, but
    damaged pictures are drawn only where no other sees.
    """
    unmarked = [replace(frame, weak=False) for frame in frames]
    ground = Terrain.flat(ground_z_m)
    return render(unmarked, ground, canvas, previews=previews, read=read, parts=parts, run=run, progress=progress)
