"""The real-time module (paper III.B): every map pixel takes the picture that sees it most orthogonally, no blending.

The homography of a frame follows in closed form from its recorded pose and an assumed field of view (theta-hat, below
the smallest that any camera has), so no picture is matched to anything and each is done in about a millisecond.
`RealtimeMosaic` draws one frame at a time as the daemon receives them; `mosaic` draws many at once, and samples each
map pixel only once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.camera import Camera
from orthoswarm.errors import InputError
from orthoswarm.mosaic.canvas import Canvas
from orthoswarm.mosaic.footprint import convex, footprint, half_planes, reach, rejection
from orthoswarm.mosaic.fuse import fuse, touches
from orthoswarm.mosaic.passes import Read
from orthoswarm.mosaic.reduce import pack, reduction
from orthoswarm.mosaic.render import Progress, RenderStats, Run, render, serial
from orthoswarm.mosaic.tiles import Key
from orthoswarm.picture import read_rgb
from orthoswarm.placement import PlacedFrame, Terrain

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Added:
    """What became of a frame.

    Attributes:
        tiles: the tiles (row, column) that changed.
        won: how many map pixels it took.
        reason: why it was not drawn, None if it was (also when it won nothing).
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
        self._reals = np.empty((3, canvas.tile_px), np.float32)
        self._integers = np.empty((2, canvas.tile_px), np.uint32)

    def add(self, picture: Bytes, camera: Camera, ground_z_m: float = 0.0) -> Added:
        """Draw one frame.

        Args:
            picture: uint8 (H, W, 3) RGB, or (H, W, 4) RGBA with alpha 255 (saves a copy), as read by read_rgb.
            camera: where it was; its lens has the picture's size.
            ground_z_m: height of the ground plane, same datum as the camera.

        Raises:
            ValueError: if the picture has not the lens's size.
            OrthoSwarmError: if the disk is full.
        """
        canvas, lens = self.canvas, camera.lens
        if picture.shape[:2] != (lens.height, lens.width):
            raise ValueError(f"the picture is {picture.shape[1::-1]}, its lens {(lens.width, lens.height)} pixels")
        reason = rejection(camera, ground_z_m, canvas.grid.gsd_m)
        if reason is not None:
            return Added([], 0, reason)
        polygon = footprint(camera, ground_z_m)
        polygon = canvas.grid.to_pixel(polygon if lens.is_pinhole else convex(polygon))
        window = _tile_window(polygon, canvas)
        if window is None:
            return Added([], 0, "it lies outside the map's area")
        height = float(camera.position[2]) - ground_z_m
        packed, factor = pack(picture, reduction(canvas.grid.gsd_m, height / lens.focal_px))
        shot = _Shot(
            picture=packed,
            planes=half_planes(polygon),
            centre=canvas.grid.to_pixel(camera.nadir),
            radius=reach(camera, ground_z_m) / canvas.grid.gsd_m,
            matrix=ground_to_camera(camera, ground_z_m, canvas.grid.gsd_m),
            lens=_reduced_lens(camera, factor),
        )
        changed, won = [], 0
        for key in [(r, c) for r in range(*window[:2]) for c in range(*window[2:])]:
            count = self._draw(key, shot)
            if count:
                changed.append(key)
                won += count
        return Added(changed, won)

    def _draw(self, key: Key, shot: "_Shot") -> int:
        canvas, t = self.canvas, self.canvas.tile_px
        row, column = key[0] * t, key[1] * t
        rows, columns = min(t, canvas.grid.height - row), min(t, canvas.grid.width - column)
        centre, planes = shot.centre - (column, row), shot.planes.copy()
        planes[:, 2] -= planes[:, 0] * column + planes[:, 1] * row
        if not touches(planes, centre, shot.radius, rows, columns):
            return 0
        matrix = shot.matrix.copy()
        matrix[:, 2] -= matrix[:, :2] @ centre
        tile = canvas.begin(key)
        packed, score = tile.packed[:rows, :columns], tile.plane[:rows, :columns]
        gsd = canvas.grid.gsd_m
        won = fuse(
            packed,
            score,
            shot.picture,
            planes,
            centre,
            shot.radius,
            matrix,
            shot.lens,
            gsd,
            self._reals,
            self._integers,
        )
        if won:
            canvas.commit(key)
        return int(won)


@dataclass(frozen=True, slots=True)
class _Shot:
    """A picture ready for `fuse`; planes and centre in canvas pixels, matrix about the nadir point."""

    picture: NDArray[np.uint32]
    planes: Array
    centre: Array
    radius: float
    matrix: Array
    lens: Array


def ground_to_camera(camera: Camera, ground_z_m: float, gsd_m: float) -> Array:
    """Matrix (3, 3) from map pixels about the nadir point (column, row, 1) to undistorted normalised coordinates.

    The inverse of the paper's homography (III.B) in closed form: d = R^T (P - C). Its third row is the depth in metres,
    positive before the camera whatever the tilt, and no large easting enters.
    """
    drop = ground_z_m - float(camera.position[2])
    return np.asarray(camera.rotation.T @ np.diag([gsd_m, -gsd_m, drop]))


def _reduced_lens(camera: Camera, factor: int) -> Array:
    lens = camera.lens
    u, v = ((c + 0.5) / factor - 0.5 for c in lens.principal_point)
    return np.array([lens.k1, lens.k2, lens.k3, lens.focal_px / factor, u, v])


def _tile_window(polygon: Array, canvas: Canvas) -> tuple[int, int, int, int] | None:
    """Tiles (row0, row1, col0, col1) under the box of a polygon of canvas pixels; None outside the canvas."""
    low, high = np.ceil(polygon.min(0)), np.floor(polygon.max(0))
    c0, r0 = max(0, int(low[0])), max(0, int(low[1]))
    c1, r1 = min(canvas.grid.width - 1, int(high[0])), min(canvas.grid.height - 1, int(high[1]))
    if c0 > c1 or r0 > r1:
        return None
    t = canvas.tile_px
    return r0 // t, r1 // t + 1, c0 // t, c1 // t + 1


def mosaic(
    frames: Sequence[PlacedFrame],
    canvas: Canvas,
    ground_z_m: float = 0.0,
    *,
    read: Read = read_rgb,
    run: Run = serial,
    progress: Progress | None = None,
) -> RenderStats:
    """Draw many frames at once by the same rule: which frame wins where is decided first, without the pictures.

    Each picture is then read once, and not at all if it wins nothing, and each map pixel sampled once: the same mosaic
    as by adding frame after frame (interpolated better), at little more than the cost of reading the pictures.

    Args:
        frames: with the recorded poses and the assumed field of view; "weak" means nothing here.
        canvas: made with plane "frame".
        ground_z_m: height of the ground plane.
        read: see render.
        run: see render.
        progress: see render.

    Raises:
        InputError: if the canvas has another plane.
        OrthoSwarmError: if the disk is full.
    """
    alike = [replace(frame, weak=False) for frame in frames]
    return render(alike, Terrain.flat(ground_z_m), canvas, read=read, run=run, progress=progress)
