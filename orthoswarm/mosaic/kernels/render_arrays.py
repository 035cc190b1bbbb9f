"""Cameras and terrain as the compiled kernels of the renderer want them: plain arrays about a tile's corner.

A tile's frame: x east and y SOUTH in metres from its upper left corner, so that both grow with column and row;
heights as they are. Terrain enters as a lattice of heights every LATTICE_PX pixels, see drawn_heights.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Array, Flags, Ints
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import LEAST_RADIAL_SLOPE, Camera
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.kernels.lens_arrays import K1, K2, K3, F, U, V, lens_row

LATTICE_PX = 2  # pixels between heights of a tile's lattice (bilinear between them)
MARGIN_PX = 0.0
"""How far inside the outermost pixel centres a picture is used. At the very border the outermost pixels stand in for
the neighbours that interpolation misses; a pixel's margin would cost a lone small picture 4 % of its ground."""


@dataclass(frozen=True, slots=True)
class Shots:
    """Cameras as arrays; positions are grid coordinates (subtract the tile's corner before use).

    position: float64 (N, 3). rotation: float64 (N, 3, 3), camera to ground. lens: float64 (N, 18), see above. size:
    int32 (N, 2), columns and rows of the pictures. weak: bool (N,), used only where no other sees.
    """

    position: Array
    rotation: Array
    lens: Array
    size: Ints
    weak: Flags

    @classmethod
    def of(cls, cameras: Sequence[Camera], weak: Sequence[bool], margin_px: float = MARGIN_PX) -> "Shots":
        """The arrays of cameras."""
        n = len(cameras)
        return cls(
            np.array([c.position for c in cameras], float).reshape(n, 3),
            np.array([c.rotation for c in cameras], float).reshape(n, 3, 3),
            np.array([lens_row(c.lens, margin_px) for c in cameras], float).reshape(n, 18),
            np.array([(c.lens.width, c.lens.height) for c in cameras], np.int32).reshape(n, 2),
            np.array(weak, bool).reshape(n),
        )

    def __len__(self) -> int:
        return len(self.position)

    def take(self, index: NDArray[np.integer]) -> "Shots":
        """Some of the cameras."""
        return Shots(self.position[index], self.rotation[index], self.lens[index], self.size[index], self.weak[index])

    def about(self, west: float, north: float) -> tuple[Array, Array]:
        """Positions (N, 3) and ground-to-camera rotations (N, 3, 3) in the frame of a tile's corner."""
        position = self.position * (1.0, -1.0, 1.0) + (-west, north, 0.0)
        return position, np.ascontiguousarray(self.rotation.transpose(0, 2, 1) * (1.0, -1.0, 1.0))


def crop(terrain: Terrain, bounds: BoundingBox) -> Terrain:
    """The part of a terrain that heights within bounds (west, south, east, north) depend on."""
    rows, cols = terrain.z.shape
    c0 = int(np.clip(np.floor((bounds[0] - terrain.west) / terrain.step_m) - 2, 0, cols - 2))
    c1 = int(np.clip(np.ceil((bounds[2] - terrain.west) / terrain.step_m) + 3, c0 + 2, cols))
    r0 = int(np.clip(np.floor((bounds[1] - terrain.south) / terrain.step_m) - 2, 0, rows - 2))
    r1 = int(np.clip(np.ceil((bounds[3] - terrain.south) / terrain.step_m) + 3, r0 + 2, rows))
    step = terrain.step_m
    drawn = replace(terrain, tops=None)
    return drawn.changed(
        lambda z: z[r0:r1, c0:c1].copy(), west=terrain.west + c0 * step, south=terrain.south + r0 * step
    )


@in_place_kernel
def lattice_height(lattice, row, column):  # type: ignore[no-untyped-def]
    """Height at a pixel centre, bilinear in a tile's lattice (whose nodes lie on pixel CORNERS)."""
    y, x = (row + 0.5) / LATTICE_PX, (column + 0.5) / LATTICE_PX
    i, j = int(y), int(x)
    fy, fx = y - i, x - j
    top = lattice[i, j] * (1.0 - fx) + lattice[i, j + 1] * fx
    low = lattice[i + 1, j] * (1.0 - fx) + lattice[i + 1, j + 1] * fx
    return top * (1.0 - fy) + low * fy


@in_place_kernel
def project(position, rotation, lens, x, y, z):  # type: ignore[no-untyped-def]
    """Pixel (u, v) of a point in the tile's frame; (-1e9, -1e9) where it cannot be seen.

    position, rotation: float64 (3,), (3, 3), see Shots.about. lens: float64 (18,). x, y: metres east and SOUTH of the
    tile's corner. z: height.
    """
    dx, dy, dz = x - position[0], y - position[1], z - position[2]
    depth = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz
    if depth < 1e-3:
        return -1e9, -1e9
    px = (rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz) / depth
    py = (rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz) / depth
    r2 = px * px + py * py
    if 1.0 + r2 * (3.0 * lens[K1] + r2 * (5.0 * lens[K2] + r2 * 7.0 * lens[K3])) < LEAST_RADIAL_SLOPE:
        return -1e9, -1e9
    s = lens[F] * (1.0 + r2 * (lens[K1] + r2 * (lens[K2] + r2 * lens[K3])))
    return s * px + lens[U], s * py + lens[V]
