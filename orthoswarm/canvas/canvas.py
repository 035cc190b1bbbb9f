"""The out-of-core canvas: an RGBA raster of any size on the ground; only drawn tiles use disk space.

100 km2 at 0.1 m is 10^10 pixels in 38,000 tiles: making such a canvas writes a few hundred kilobytes, drawing maps
single tiles (tile_store.TileStore), a view of all of it reads the reduced copies (overviews.Overview).

Crash safety (a killed process, not a power cut, which needs `flush`): a tile's new version goes to disk before its
first pixel changes and into memory after its last one, and whoever draws writes a pixel's colour before its score. So
after a kill the canvas opens again, no viewer holds a version that misses a change, and adding the interrupted
frame once more repairs what was half drawn.
"""

import json
import os
import threading
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from orthoswarm.canvas.overviews import FACTORS, Overview, reduce_rgba
from orthoswarm.canvas.tile_store import Key, Tile, TileStore
from orthoswarm.canvas.tile_versions import VersionIndex
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError, StorageError
from orthoswarm.model.geo import GroundGrid

Bytes = NDArray[np.uint8]
Plane = Literal["orthogonality", "frame"]
TILE_PX = 512
MEMORY_MB = 128.0
"""Bound on the tiles that a canvas keeps mapped."""
_FORMAT = "orthoswarm-canvas-1"
_DTYPES: dict[str, type[np.generic]] = {"orthogonality": np.float32, "frame": np.int32}


@dataclass(frozen=True, slots=True)
class Header:
    """The content of `canvas.json`.

    Attributes:
        grid: where the canvas lies.
        tile_px: side of a tile.
        plane: meaning of the auxiliary plane: "orthogonality" (float32, 1/distance^2 to the nadir point in 1/m^2,
            0 = nothing) of the real-time module, or "frame" (int32, index of the frame + 1, 0 = none) of the renderer.
    """

    grid: GroundGrid
    tile_px: int
    plane: Plane


class Canvas:
    """A tiled RGBA raster on disk with versions per tile. One writer; any number of reading threads or processes.

    Make one with `create`, `open` or `at`.

    Attributes:
        path: its folder.
        grid: where it lies on the ground.
        plane: meaning of the auxiliary plane, see Header.
        tile_px: side of a tile in pixels.
        tile_rows: rows of tiles. tile_cols: columns of tiles.
    """

    def __init__(self, path: Path, header: Header, *, memory_mb: float, writable: bool) -> None:
        self.path = path
        self.grid = header.grid
        self.plane: Plane = header.plane
        self.tile_px = header.tile_px
        self.tile_rows = -(-header.grid.height // header.tile_px)
        self.tile_cols = -(-header.grid.width // header.tile_px)
        self._writable = writable
        self._lock = threading.RLock()
        self._store = TileStore(
            path / "tiles",
            tile_px=header.tile_px,
            dtype=_DTYPES[header.plane],
            memory_mb=memory_mb,
            writable=writable,
            # a rendered tile is drawn once and reduced while it is mapped; a real-time one changes with every picture
            # and is reduced when it is read
            on_evict=self._evicted if writable and header.plane == "frame" else None,
        )
        self._overview = Overview(path, self.tile_rows, self.tile_cols, self.tile_px, writable=writable)
        self._index = VersionIndex(path / "versions.u64", (self.tile_rows, self.tile_cols), writable=writable)
        self._reduced = VersionIndex(path / "reduced.u64", (self.tile_rows, self.tile_cols), writable=writable)
        if writable and self._index.newest == 0:  # a lost index: all existing tiles count as changed once
            for key in self._store.existing():
                self._index.put(key, 1, visible=True)
        self._version = self._index.newest
        self._seen: dict[Key, int] = {}

    # -- making and opening ---------------------------------------------------------------------------------------

    @classmethod
    def create(
        cls,
        path: Path,
        grid: GroundGrid,
        *,
        plane: Plane = "orthogonality",
        tile_px: int = TILE_PX,
        memory_mb: float = MEMORY_MB,
    ) -> "Canvas":
        """A new, empty canvas in a folder. The grid may be generous: empty ground costs 16 bytes a tile.

        Args:
            path: folder; made if absent.
            grid: where the canvas lies.
            plane: meaning of the auxiliary plane, see Header.
            tile_px: side of a tile, a multiple of 64.
            memory_mb: bound on mapped tiles (2 MB each at 512 px).

        Raises:
            InputError: if there is a canvas already.
            StorageError: if the folder cannot be written.
        """
        if tile_px < 64 or tile_px % 64:
            raise InputError(f"a tile of {tile_px} pixels is not a multiple of 64")
        header = path / "canvas.json"
        if header.exists():
            raise InputError(f"{path} holds a canvas already; open it or choose another folder")
        text = json.dumps({"format": _FORMAT, "tile_px": tile_px, "plane": plane, "grid": asdict(grid)}, indent=1)
        try:
            path.mkdir(parents=True, exist_ok=True)
            cls._reset(path)
            new = path / "canvas.json.new"
            new.write_text(text)
            canvas = cls(path, Header(grid, tile_px, plane), memory_mb=memory_mb, writable=True)
            os.replace(new, header)
        except OSError as error:
            raise StorageError(f"no canvas can be made in {path} ({error.strerror})") from None
        return canvas

    @classmethod
    def open(cls, path: Path, *, memory_mb: float = MEMORY_MB, writable: bool = True) -> "Canvas":
        """Open the canvas of a folder, also one left by a killed process.

        Args:
            path: folder.
            memory_mb: bound on mapped tiles.
            writable: False for a second process that only reads.

        Raises:
            InputError: if there is no canvas or it is of another format.
        """
        try:
            text = json.loads((path / "canvas.json").read_text())
            if text["format"] != _FORMAT:
                raise ValueError(text["format"])
            header = Header(GroundGrid(**text["grid"]), int(text["tile_px"]), text["plane"])
            _DTYPES[header.plane]
        except FileNotFoundError:
            raise InputError(f"{path} holds no canvas; give the folder that contains canvas.json") from None
        except (ValueError, KeyError, TypeError):
            raise InputError(f"{path / 'canvas.json'} is of an unknown format; make the canvas anew") from None
        return cls(path, header, memory_mb=memory_mb, writable=writable)

    @classmethod
    def at(
        cls, path: Path, grid: GroundGrid, *, plane: Plane = "orthogonality", memory_mb: float = MEMORY_MB
    ) -> "Canvas":
        """The canvas of a folder, made if there is none.

        Raises:
            InputError: if the folder's canvas lies on another grid or has another plane.
        """
        if not (path / "canvas.json").exists():
            return cls.create(path, grid, plane=plane, memory_mb=memory_mb)
        canvas = cls.open(path, memory_mb=memory_mb)
        if canvas.grid != grid or canvas.plane != plane:
            canvas.close()
            raise InputError(f"the canvas in {path} lies on another grid; remove the folder or choose another one")
        return canvas

    @staticmethod
    def _reset(path: Path) -> None:
        """Remove the remains of an interrupted creation."""
        for name in ("versions.u64", "reduced.u64", *(f"overview{factor}.rgba" for factor in FACTORS)):
            (path / name).unlink(missing_ok=True)

    def close(self) -> None:
        """Update the overviews of rendered tiles and close all files."""
        with self._lock:
            self._store.close()
            self._overview.close()
            self._index.close()
            self._reduced.close()

    def __enter__(self) -> "Canvas":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def flush(self) -> None:
        """Sync drawn tiles to the disk against power cuts."""
        self._store.flush()
        self._index.flush()

    @property
    def mapped_mb(self) -> float:
        """Size of the mapped tiles, megabytes."""
        return self._store.mapped * 8e-6 * self.tile_px**2

    # -- drawing --------------------------------------------------------------------------------------------------

    def begin(self, key: Key) -> Tile:
        """A tile to draw on, made if it was empty; end with `commit`. For one writing thread.

        Raises:
            StorageError: if the disk is full.
        """
        with self._lock:
            tile = self._store.get(key, create=True)
            assert tile is not None
            self._index.put(key, self._version + 1, visible=False)
            return tile

    def commit(self, key: Key) -> int:
        """Publish changes of a tile since `begin`; returns its new version."""
        with self._lock:
            self._version += 1
            self._index.publish(key, self._version)
            return self._version

    def adopt(self, staged: "TileStore", keys: Iterable[Key]) -> None:
        """Replace tiles by those of another store of the same layout (moved, one at a time and each at once).

        Args:
            staged: store of the new tiles, on the same file system; its maps are released.
            keys: the tiles to replace; one that the store does not have becomes empty.
        """
        staged.close()
        for key in keys:
            source, target = staged.path(key), self._store.path(key)
            with self._lock:
                if not source.exists() and not target.exists():
                    continue
                self._index.put(key, self._version + 1, visible=False)
                self._store.forget(key)
                try:
                    if source.exists():
                        target.parent.mkdir(parents=True, exist_ok=True)
                        os.replace(source, target)
                    else:
                        target.unlink()
                except OSError as error:
                    raise StorageError(f"the canvas in {self.path} cannot be written ({error.strerror})") from None
                self.commit(key)

    def staging(self, name: str, *, memory_mb: float = MEMORY_MB) -> TileStore:
        """A store of the same layout in a sub-folder, for preparing tiles for `adopt`."""
        return TileStore(
            self.path / name, tile_px=self.tile_px, dtype=_DTYPES[self.plane], memory_mb=memory_mb, writable=True
        )

    # -- versions -------------------------------------------------------------------------------------------------

    @property
    def version(self) -> int:
        """The newest version of any tile; 0 for an empty canvas."""
        self._follow()
        return self._version

    def changed_since(self, version: int) -> list[Key]:
        """The tiles (row, column) that changed after a version, oldest change first. 0 gives all that were drawn."""
        self._follow()
        rows, cols = np.nonzero(self._index.values > np.uint64(version))
        order = np.argsort(self._index.values[rows, cols], kind="stable")
        return [(int(r), int(c)) for r, c in zip(rows[order], cols[order])]

    def newest(self, bounds: BoundingBox) -> int:
        """The newest version of the tiles under bounds (west, south, east, north); 0 where nothing was drawn."""
        self._follow()
        r0, r1, c0, c1 = self.window(bounds)
        t = self.tile_px
        part = self._index.values[r0 // t : -(-r1 // t), c0 // t : -(-c1 // t)]
        return int(part.max()) if part.size else 0

    def tile_bounds(self, key: Key) -> BoundingBox:
        """West, south, east, north of a tile (the last row and column reach beyond the grid)."""
        side = self.tile_px * self.grid.gsd_m
        west, north = self.grid.west + key[1] * side, self.grid.north - key[0] * side
        return BoundingBox(west, north - side, west + side, north)

    @property
    def drawn(self) -> tuple[int, int, int, int]:
        """Rows and columns (row0, row1, col0, col1) that hold all tiles that were drawn; zeros when none was."""
        rows, cols = np.nonzero(self._index.values)
        if len(rows) == 0:
            return 0, 0, 0, 0
        t = self.tile_px
        return (
            int(rows.min()) * t,
            min(self.grid.height, (int(rows.max()) + 1) * t),
            int(cols.min()) * t,
            min(self.grid.width, (int(cols.max()) + 1) * t),
        )

    def _follow(self) -> None:
        if not self._writable:  # written by another process
            self._index.reload()
            self._version = self._index.newest

    # -- reading --------------------------------------------------------------------------------------------------

    def window(self, bounds: BoundingBox) -> tuple[int, int, int, int]:
        """Rows and columns (row0, row1, col0, col1), clipped to the grid, of all pixels that touch bounds."""
        west, south, east, north = bounds
        g, s = self.grid, self.grid.gsd_m
        row0, row1 = np.floor((g.north - north) / s + 1e-6), np.ceil((g.north - south) / s - 1e-6)
        col0, col1 = np.floor((west - g.west) / s + 1e-6), np.ceil((east - g.west) / s - 1e-6)
        r0, r1 = int(np.clip(row0, 0, g.height)), int(np.clip(row1, 0, g.height))
        c0, c1 = int(np.clip(col0, 0, g.width)), int(np.clip(col1, 0, g.width))
        return r0, max(r0, r1), c0, max(c0, c1)

    def read(self, row0: int, row1: int, col0: int, col1: int) -> Bytes:
        """Colours of a window, uint8 (row1 - row0, col1 - col0, 4); transparent where nothing was drawn."""
        out = np.zeros((max(0, row1 - row0), max(0, col1 - col0), 4), np.uint8)
        self._gather(out, "rgba", row0=row0, row1=row1, col0=col0, col1=col1)
        return out

    def read_plane(self, row0: int, row1: int, col0: int, col1: int) -> NDArray[Any]:
        """The auxiliary plane of a window, float32 or int32 (rows, columns); 0 where nothing was drawn."""
        out = np.zeros((max(0, row1 - row0), max(0, col1 - col0)), self._store.dtype)
        self._gather(out, "plane", row0=row0, row1=row1, col0=col0, col1=col1)
        return out

    def read_reduced(self, factor: int, row0: int, row1: int, col0: int, col1: int) -> Bytes:
        """Colours of a window of the canvas reduced by a factor, uint8; alpha is the drawn share.

        The window counts reduced pixels. At 8 and beyond only the reduced copies are read.

        Args:
            factor: 1, 2, 4, 8, ... (a power of two up to 64 times the largest number of pixels wanted).
            row0: first reduced row.
            row1: past the last.
            col0: first reduced column.
            col1: past the last.
        """
        if factor == 1:
            return self.read(row0, row1, col0, col1)
        base = max((f for f in (1, *FACTORS) if f <= factor), default=1)
        rest = factor // base
        window = (row0 * rest, row1 * rest, col0 * rest, col1 * rest)
        part = self.read(*window) if base == 1 else self._read_overview(base, *window)
        return part if rest == 1 else reduce_rgba(part, rest)

    def read_ground(self, bounds: BoundingBox, gsd_m: float | None = None) -> tuple[Bytes, GroundGrid]:
        """Colours of the pixels that touch bounds, at a pixel no coarser than asked, and their grid.

        Args:
            bounds: west, south, east, north in the canvas's CRS.
            gsd_m: wanted ground pixel; the canvas's own if None. The result is the canvas reduced by the largest power
                of two that is not coarser.
        """
        factor = 1
        while gsd_m is not None and factor < 1 << 20 and self.grid.gsd_m * factor * 2 <= gsd_m * 1.001:
            factor *= 2
        r0, r1, c0, c1 = self.window(bounds)
        r0, c0, r1, c1 = r0 // factor, c0 // factor, -(-r1 // factor), -(-c1 // factor)
        step = self.grid.gsd_m * factor
        grid = GroundGrid(
            epsg=self.grid.epsg,
            west=self.grid.west + c0 * step,
            north=self.grid.north - r0 * step,
            gsd_m=step,
            width=c1 - c0,
            height=r1 - r0,
        )
        return self.read_reduced(factor, r0, r1, c0, c1), grid

    def _gather(self, out: NDArray[Any], part: str, *, row0: int, row1: int, col0: int, col1: int) -> None:
        self._follow()
        t = self.tile_px
        for tr in range(max(0, row0 // t), min(self.tile_rows, -(-row1 // t))):
            for tc in range(max(0, col0 // t), min(self.tile_cols, -(-col1 // t))):
                tile = self._tile_to_read((tr, tc))
                if tile is None:
                    continue
                r0, r1 = max(row0, tr * t), min(row1, (tr + 1) * t)
                c0, c1 = max(col0, tc * t), min(col1, (tc + 1) * t)
                source = getattr(tile, part)[r0 - tr * t : r1 - tr * t, c0 - tc * t : c1 - tc * t]
                out[r0 - row0 : r1 - row0, c0 - col0 : c1 - col0] = source

    def _tile_to_read(self, key: Key) -> Tile | None:
        version = int(self._index.values[key])
        if version == 0:
            return None
        if not self._writable and self._seen.get(key) != version:
            self._store.forget(key)  # the writer may have put another file under this name
            self._seen[key] = version
        return self._store.get(key)

    # -- overviews ------------------------------------------------------------------------------------------------

    def _read_overview(self, factor: int, row0: int, row1: int, col0: int, col1: int) -> Bytes:
        side = self.tile_px // factor
        tr0, tr1 = max(0, row0 // side), min(self.tile_rows, -(-row1 // side))
        tc0, tc1 = max(0, col0 // side), min(self.tile_cols, -(-col1 // side))
        out = np.zeros((max(0, row1 - row0), max(0, col1 - col0), 4), np.uint8)
        if tr0 >= tr1 or tc0 >= tc1:
            return out
        self.update_overviews((tr0, tr1, tc0, tc1))
        blocks = self._overview.read(factor, tr0, tr1, tc0, tc1)
        top, left = tr0 * side, tc0 * side
        r0, c0 = max(row0, top), max(col0, left)
        r1, c1 = min(row1, tr1 * side), min(col1, tc1 * side)
        out[r0 - row0 : r1 - row0, c0 - col0 : c1 - col0] = blocks[r0 - top : r1 - top, c0 - left : c1 - left]
        return out

    def update_overviews(self, tiles: tuple[int, int, int, int] | None = None) -> None:
        """Renew the reduced copies of the tiles that changed, in a window of tiles (row0, row1, col0, col1) or all.

        Reading does this by itself; rendered tiles that were mapped and let go have been done then.
        """
        if not self._writable:
            return
        tr0, tr1, tc0, tc1 = tiles or (0, self.tile_rows, 0, self.tile_cols)
        stale = self._index.values[tr0:tr1, tc0:tc1] != self._reduced.values[tr0:tr1, tc0:tc1]
        for r, c in zip(*np.nonzero(stale)):
            key = (tr0 + int(r), tc0 + int(c))
            with self._lock:
                self._reduce(key, self._store.get(key))

    def _evicted(self, key: Key, tile: Tile) -> None:
        if self._index.values[key] != self._reduced.values[key]:
            self._reduce(key, tile)

    def _reduce(self, key: Key, tile: Tile | None) -> None:
        version = int(self._index.values[key])  # read first: what is drawn meanwhile counts as not yet reduced
        self._overview.put(*key, None if tile is None else tile.rgba)
        self._reduced.put(key, version, visible=True)
