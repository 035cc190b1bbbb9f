"""A scene: colours, surface heights, bare-ground heights, and the kind of surface of each texel."""

from dataclasses import dataclass, replace

import numpy as np

from orthoswarm.model.arrays import Bytes, Floats
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain

TEXEL_M = 0.25  # side of a texture pixel, metres
CELL_M = 0.5  # side of a cell of the height fields, metres: two texels
TILE_CELLS = 16  # cells along the side of a tile of the renderer's table of highest points

GRASS, ASPHALT, CONCRETE, SOIL, FIELD, WATER, ROOF, TREE, CAR, MARK, RUBBLE, PHOTO = range(12)
"""Kinds of surface; they decide texture, seasonal colour, and whether the surface moves (WATER)."""
KINDS = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Colours on a 0.25 m grid and heights on a 0.5 m grid over the same bounds (multiples of 3 m)."""

    grid: GroundGrid  # the texture's grid, CRS and place
    albedo: Bytes  # uint8 (rows, columns, 3), colours without light and shadow, seen from straight above
    kind: Bytes  # uint8 (rows, columns), kind of surface of each texel
    dsm: Floats  # float32 (rows/2, columns/2), height of the surface with all that stands on it, metres over takeoff
    dtm: Floats  # float32 (rows/2, columns/2), height of the bare ground
    wall: Bytes  # uint8 (rows/2, columns/2, 3), colour of a vertical face below the cell's top
    facade: Bytes  # uint8 (rows/2, columns/2), 1 where the vertical face has windows
    angle_rad: float = 0.0  # main direction of the walls, anticlockwise from east

    @classmethod
    def blank(cls, grid: GroundGrid, angle_rad: float = 0.0) -> "Scene":
        """A level, black scene on a texture grid whose sides are even."""
        rows, cols = grid.height // 2, grid.width // 2
        return cls(
            grid=grid, albedo=np.zeros((grid.height, grid.width, 3), np.uint8),
            kind=np.zeros((grid.height, grid.width), np.uint8), dsm=np.zeros((rows, cols), np.float32),
            dtm=np.zeros((rows, cols), np.float32), wall=np.zeros((rows, cols, 3), np.uint8),
            facade=np.zeros((rows, cols), np.uint8), angle_rad=angle_rad,
        )  # fmt: skip

    @property
    def wall_axis(self) -> tuple[float, float]:
        """Unit vector (columns, rows) along one of the two directions of the walls."""
        return float(np.cos(self.angle_rad)), float(-np.sin(self.angle_rad))

    @property
    def cells(self) -> GroundGrid:
        """The grid of the height fields."""
        return replace(self.grid, gsd_m=CELL_M, width=self.grid.width // 2, height=self.grid.height // 2)

    def copy(self) -> "Scene":
        """A copy whose colours and surface can be changed independently (the bare ground is shared)."""
        changed = {name: getattr(self, name).copy() for name in ("albedo", "kind", "dsm", "wall", "facade")}
        return replace(self, **changed)

    def bare_ground(self) -> Terrain:
        """Heights of the bare ground, a node in the middle of each cell."""
        g = self.cells
        south = g.north - g.gsd_m * (g.height - 0.5)
        return Terrain(g.west + 0.5 * g.gsd_m, south, g.gsd_m, self.dtm[::-1])

    def above_ground(self) -> Floats:
        """Height of the surface over the bare ground, float32 (rows/2, columns/2)."""
        return np.asarray(self.dsm - self.dtm)


def scene_grid(epsg: int, center: tuple[float, float], half_east: float, half_north: float) -> GroundGrid:
    """The texture grid around a centre, both sides a multiple of 24 m so that all levels and tiles fit."""
    width, height = (int(np.ceil(2 * h / 24.0)) * 24 for h in (half_east, half_north))
    west = float(np.floor(center[0] - width / 2))
    north = float(np.ceil(center[1] + height / 2))
    return GroundGrid(
        epsg=epsg, west=west, north=north, gsd_m=TEXEL_M, width=int(width / TEXEL_M), height=int(height / TEXEL_M)
    )
