"""The map's layers: canvases that grow with the area, and generations of them that replace each other at once.

A layer that is drawn in real time changes tile by tile. A refined layer is replaced as a whole: its next generation is
made separately, sharing the files of unchanged tiles, and becomes the layer by a change of the journal. So a reader
sees all of a vehicle's old pixels or all of its new ones, and a crash leaves the one or the other.
"""

import contextlib
import json
import math
import os
import shutil
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from orthoswarm.canvas.canvas import MEMORY_MB, TILE_PX, Canvas, Plane
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.geo import GroundGrid

NAMES: Final = ("realtime", "coarse", "fine")
_HALF_PX: Final = 40_000
_HALF_M: Final = (1_500.0, 6_000.0)
_MOST_TILES: Final = 4_000_000
_GSD_M: Final = (0.005, 5.0)
_ORIGIN_STEP_M: Final = 16.0


@dataclass(frozen=True, slots=True)
class MapArea:
    """The map's area.

    Attributes:
        epsg: the area's grid. gsd_m: ground pixel of all layers.
        origin: (2,) of the refinement's local frame; the same for all vehicles.
        bounds: west, south, east, north that the layers can hold, on multiples of a tile's side.
    """

    epsg: int
    gsd_m: float
    origin: tuple[float, float]
    bounds: BoundingBox

    @classmethod
    def around(cls, epsg: int, east: float, north: float, gsd_m: float) -> "MapArea":
        """A generous area around the first picture; empty ground costs almost nothing."""
        gsd = _round_gsd(gsd_m)
        half = float(np.clip(_HALF_PX * gsd, *_HALF_M))
        origin = (round(east / _ORIGIN_STEP_M) * _ORIGIN_STEP_M, round(north / _ORIGIN_STEP_M) * _ORIGIN_STEP_M)
        return cls(epsg, gsd, origin, _on_tiles(BoundingBox(east, north, east, north).grown(half), gsd))

    def grown(self, bounds: BoundingBox) -> "MapArea":
        """The area extended to the bounds and 1.5 km beyond them.

        Raises:
            OrthoSwarmError: that would be too large for one map.
        """
        reach = _HALF_M[0]
        west, south, east, north = self.bounds
        if bounds.west < west:
            west = bounds.west - reach
        if bounds.south < south:
            south = bounds.south - reach
        if bounds.east > east:
            east = bounds.east + reach
        if bounds.north > north:
            north = bounds.north + reach
        wide = _on_tiles(BoundingBox(west, south, east, north), self.gsd_m)
        side = TILE_PX * self.gsd_m
        if wide.width * wide.height > _MOST_TILES * side * side:
            raise OrthoSwarmError("it lies too far from the other pictures for one map; use a workspace of its own")
        return MapArea(self.epsg, self.gsd_m, self.origin, wide)

    @property
    def grid(self) -> GroundGrid:
        """The grid of its layers."""
        return GroundGrid.around(self.epsg, self.bounds, self.gsd_m)

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)

    @classmethod
    def from_document(cls, values: dict[str, Any]) -> "MapArea":
        """What `document` gave."""
        origin = values["origin"]
        return cls(values["epsg"], values["gsd_m"], (origin[0], origin[1]), BoundingBox(*values["bounds"]))


def _round_gsd(gsd_m: float) -> float:
    """Two significant digits, so that tiles of 512 pixels begin on numbers without rounding errors."""
    gsd = float(np.clip(gsd_m, *_GSD_M))
    digits = 1 - math.floor(math.log10(gsd))
    return max(round(gsd, digits), 10.0**-digits)


def _on_tiles(bounds: BoundingBox, gsd_m: float) -> BoundingBox:
    side = TILE_PX * gsd_m
    west, south = (math.floor(v / side) * side for v in bounds[:2])
    east, north = (math.ceil(v / side) * side for v in bounds[2:])
    return BoundingBox(west, south, east, north)


class MapLayer:
    """One layer: at most one canvas at a time, which stays open while it is read.

    Attributes:
        name: realtime, coarse or fine.
        generation: name of the canvas's folder, empty while there is none.
    """

    def __init__(self, name: str) -> None:
        self.name, self.generation = name, ""
        self._lock = threading.Lock()
        self._canvas: Canvas | None = None
        self._users: dict[int, int] = {}
        self._retired: dict[int, tuple[Canvas, bool]] = {}

    @property
    def canvas(self) -> Canvas | None:
        """The present canvas, for its writer."""
        return self._canvas

    @contextmanager
    def reading(self) -> Iterator[Canvas | None]:
        """The present canvas, kept open meanwhile; None while there is none."""
        with self._lock:
            canvas = self._canvas
            if canvas is not None:
                self._users[id(canvas)] = self._users.get(id(canvas), 0) + 1
        try:
            yield canvas
        finally:
            if canvas is not None:
                with self._lock:
                    self._users[id(canvas)] -= 1
                    self._let_go()

    def replace(self, canvas: Canvas | None, *, remove: bool = True) -> None:
        """Replace the canvas; the old one is closed and removed when its last reader is done."""
        with self._lock:
            if self._canvas is not None:
                self._retired[id(self._canvas)] = (self._canvas, remove)
            self._canvas = canvas
            self.generation = "" if canvas is None else canvas.path.name
            self._let_go()

    def close(self) -> None:
        """Close the canvas; what was drawn stays."""
        self.replace(None, remove=False)

    @property
    def version(self) -> int:
        """Grows with every change of what is drawn."""
        with self.reading() as canvas:
            return 0 if canvas is None else canvas.version

    def _let_go(self) -> None:
        for number in [n for n in self._retired if not self._users.get(n)]:
            canvas, remove = self._retired.pop(number)
            self._users.pop(number, None)
            with contextlib.suppress(OSError, OrthoSwarmError):
                canvas.close()
            if remove:
                shutil.rmtree(canvas.path, ignore_errors=True)


def new_name(layer: str) -> str:
    """A fresh folder's name for a canvas of a layer."""
    return f"{layer}-{uuid.uuid4().hex[:12]}"


def successor(
    old: Canvas | None, path: Path, grid: GroundGrid, plane: Plane, *, share: bool, memory_mb: float = MEMORY_MB
) -> Canvas:
    """A canvas in a new folder with the old one's content, on a grid that contains the old one's.

    Args:
        old: the present canvas, or None to begin empty.
        path: new folder.
        grid: where the new canvas lies; shifted against the old one by whole tiles.
        plane: meaning of the auxiliary plane.
        share: True to share tile files with the old one, where tiles are only ever replaced as a whole.
        memory_mb: see Canvas.create.
    """
    if old is not None and old.grid == grid:
        _copy_canvas(old.path, path, share=share)
        return Canvas.open(path, memory_mb=memory_mb)
    canvas = Canvas.create(path, grid, plane=plane, memory_mb=memory_mb)
    if old is None:
        return canvas
    side = old.tile_px * old.grid.gsd_m
    down, right = round((grid.north - old.grid.north) / side), round((old.grid.west - grid.west) / side)
    source, staged = old.staging("tiles"), canvas.staging("moved")
    keys = []
    for row, col in old.changed_since(0):
        key = (row + down, col + right)
        target = staged.path(key)
        target.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            _share(source.path((row, col)), target, share=share)
            keys.append(key)
    canvas.adopt(staged, keys)
    shutil.rmtree(path / "moved", ignore_errors=True)
    return canvas


def _copy_canvas(old: Path, new: Path, *, share: bool) -> None:
    """Copy a canvas without its overviews, which are made again when needed; its header is copied last."""
    for folder, _, names in os.walk(old / "tiles"):
        target = new / Path(folder).relative_to(old)
        target.mkdir(parents=True, exist_ok=True)
        for name in names:
            if not name.endswith(".new"):
                _share(Path(folder) / name, target / name, share=share)
    new.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(old / "versions.u64", new / "versions.u64")
    part = new / "canvas.json.part"
    part.write_text(json.dumps(json.loads((old / "canvas.json").read_text())))
    os.replace(part, new / "canvas.json")


def _share(source: Path, target: Path, *, share: bool) -> None:
    if share:
        with contextlib.suppress(OSError):
            os.link(source, target)
            return
    shutil.copyfile(source, target)


def drawn_bounds(canvas: Canvas) -> BoundingBox | None:
    """West, south, east, north of the tiles that were drawn; None where nothing was."""
    row0, row1, col0, col1 = canvas.drawn
    if row1 <= row0 or col1 <= col0:
        return None
    g = canvas.grid
    return BoundingBox(
        g.west + col0 * g.gsd_m, g.north - row1 * g.gsd_m, g.west + col1 * g.gsd_m, g.north - row0 * g.gsd_m
    )  # fmt: skip
