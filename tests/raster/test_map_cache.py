"""A tiled map gives the windows that the map itself gives."""

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.geo import GroundGrid
from orthoswarm.raster.map_cache import TiledMap

# No middle of a pixel lies on it at sizes that are written with a few digits: there rounding would decide.
EDGE = 500_100.037_193


class _Plane:
    """A map whose grey value tells the place, known in the east only; counts its reads."""

    epsg = 32632
    native_gsd_m = 0.3
    bounds = BoundingBox(0.0, 0.0, 1e6, 1e7)

    def __init__(self) -> None:
        self.reads = 0

    def gray(self, bounds: BoundingBox, gsd_m: float) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        self.reads += 1
        grid = GroundGrid.around(self.epsg, bounds, gsd_m)
        east = grid.west + (np.arange(grid.width) + 0.5) * gsd_m
        north = grid.north - (np.arange(grid.height) + 0.5) * gsd_m
        gray = np.asarray((east[None, :] % 97.0) + (north[:, None] % 89.0), np.float32)
        return gray, np.broadcast_to(east > EDGE, gray.shape).copy()


@example(west=499_999.0, north=5_000_000.0, width=300.0, height=300.0, gsd=1.6)
@given(
    west=st.floats(499_000, 501_000), north=st.floats(4_999_000, 5_001_000), width=st.floats(1, 900),
    height=st.floats(1, 900), gsd=st.floats(0.2, 7.0),
)  # fmt: skip
def test_a_tiled_map_gives_what_the_map_gives(
    west: float, north: float, width: float, height: float, gsd: float
) -> None:
    if width * height > 4e5 * gsd * gsd:
        width = height = 300 * gsd
    plane = _Plane()
    bounds = BoundingBox(west, north - height, west + width, north)
    gray, valid = TiledMap(plane, gsd).gray(bounds, gsd)
    expected, known = plane.gray(bounds, gsd)
    assert np.array_equal(valid, known)
    inner = np.abs(gray - expected) < 1e-2
    # But for rounding where the pattern jumps: at most a row and a column, however small the window is.
    assert (~inner).sum() <= max(sum(gray.shape), 0.001 * inner.size)


def test_tiles_are_read_once_and_other_sizes_go_to_the_map() -> None:
    plane = _Plane()
    tiled = TiledMap(plane, 2.0)
    for shift in range(0, 60, 10):
        tiled.gray(BoundingBox(500_000.0 + shift, 5_000_000.0, 500_200.0 + shift, 5_000_200.0), 2.0)
    assert plane.reads <= 6
    reads = plane.reads
    tiled.gray(BoundingBox(500_000.0, 5_000_000.0, 500_010.0, 5_000_010.0), 1.0)
    assert plane.reads == reads + 1
    assert tiled.bounds == plane.bounds
    assert tiled.native_gsd_m == plane.native_gsd_m
