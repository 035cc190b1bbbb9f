"""Tiles on disk: one memory-mapped file per touched tile, with a bound on how much is mapped at once.

A tile file holds two planes one after the other, each 4 bytes a pixel: RGBA, then one auxiliary value per pixel
(the orthogonality or the frame that won it, see canvas.Plane). A file appears complete under its name (filled with
zeros: transparent, nothing won). The zeros are written, so that a full disk is an error when the tile is made and never
a bus error when a pixel is written.
"""

import contextlib
import errno
import mmap
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.errors import StorageError

Key = tuple[int, int]
_SUFFIX = ".tile"


@dataclass(frozen=True, slots=True)
class Tile:
    """One mapped tile. Its arrays stay valid as long as they are referenced, also after the tile was evicted.

    Attributes:
        rgba: uint8 (T, T, 4); alpha 0 where nothing was drawn, else 255.
        plane: float32 or int32 (T, T), the auxiliary value.
        map: the mapping under both.
    """

    rgba: NDArray[np.uint8]
    plane: NDArray[Any]
    map: mmap.mmap

    @property
    def packed(self) -> NDArray[np.uint32]:
        """The colours as one uint32 per pixel (T, T), in memory order R, G, B, A."""
        return self.rgba.view(np.uint32)[..., 0]


class TileStore:
    """Tiles by (row, column) in a folder; the least recently used maps are let go beyond a memory bound.

    Args:
        folder: where the tile files lie; made when the first tile is.
        tile_px: side of a tile in pixels.
        dtype: type of the auxiliary plane (4 bytes).
        memory_mb: bound on the mapped tiles, megabytes; at least one tile is always mapped.
        writable: False maps read-only and never makes a tile.
        on_evict: called with the key and the tile before its map is let go.
    """

    def __init__(
        self,
        folder: Path,
        *,
        tile_px: int,
        dtype: type[np.generic],
        memory_mb: float,
        writable: bool = True,
        on_evict: Callable[[Key, Tile], None] | None = None,
    ) -> None:
        self.folder = folder
        self.tile_px = tile_px
        self.dtype = np.dtype(dtype)
        self._bytes = 8 * tile_px * tile_px
        self._limit = max(1, int(memory_mb * 1e6 / self._bytes))
        self._writable = writable
        self._on_evict = on_evict
        self._open: OrderedDict[Key, Tile] = OrderedDict()
        self._lock = threading.RLock()

    def path(self, key: Key) -> Path:
        """The file of a tile, whether it is there or not."""
        return self.folder / f"{key[0]:06d}" / f"{key[1]:06d}{_SUFFIX}"

    def existing(self) -> Iterator[Key]:
        """The tiles that exist on disk, in order of row and column."""
        for row in sorted(self.folder.glob("[0-9]" * 6)):
            for file in sorted(row.glob("[0-9]" * 6 + _SUFFIX)):
                yield int(row.name), int(file.name.removesuffix(_SUFFIX))

    @property
    def mapped(self) -> int:
        """How many tiles are mapped now."""
        return len(self._open)

    def get(self, key: Key, *, create: bool = False) -> Tile | None:
        """A tile; None if it does not exist and is not to be made.

        Raises:
            StorageError: if the disk is full or the folder cannot be written.
        """
        with self._lock:
            tile = self._open.get(key)
            if tile is not None:
                self._open.move_to_end(key)
                return tile
            path = self.path(key)
            if create and not path.exists():
                self._make(path)
            try:
                tile = self._map(path)
            except FileNotFoundError:
                return None
            self._open[key] = tile
            while len(self._open) > self._limit:
                old, evicted = self._open.popitem(last=False)
                if self._on_evict is not None:
                    self._on_evict(old, evicted)
            return tile

    def opened(self) -> list[tuple[Key, Tile]]:
        """The tiles that are mapped now, least recently used first."""
        with self._lock:
            return list(self._open.items())

    def forget(self, key: Key) -> None:
        """Let go of a tile's map, so that the next get sees what its file is now."""
        with self._lock:
            self._open.pop(key, None)

    def flush(self) -> None:
        """Force mapped tiles to the disk (against loss of power; a killed process loses nothing anyway)."""
        with self._lock:
            for tile in self._open.values():
                tile.map.flush()

    def close(self) -> None:
        """Let go of all maps."""
        with self._lock:
            while self._open:
                key, tile = self._open.popitem(last=False)
                if self._on_evict is not None:
                    self._on_evict(key, tile)

    def _map(self, path: Path) -> Tile:
        with path.open("r+b" if self._writable else "rb") as file:
            access = mmap.ACCESS_WRITE if self._writable else mmap.ACCESS_READ
            mapped = mmap.mmap(file.fileno(), self._bytes, access=access)
        t = self.tile_px
        rgba = np.frombuffer(mapped, np.uint8, 4 * t * t).reshape(t, t, 4)
        plane = np.frombuffer(mapped, self.dtype, t * t, offset=4 * t * t).reshape(t, t)
        return Tile(rgba, plane, mapped)

    def _make(self, path: Path) -> None:
        new = path.with_suffix(".new")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_zeros(new, self._bytes)
            os.replace(new, path)
        except OSError as error:
            with contextlib.suppress(OSError):
                new.unlink()
            raise StorageError(
                f"the canvas in {self.folder} cannot grow ({error.strerror}); free some disk space"
            ) from None


def _write_zeros(path: Path, size: int) -> None:
    """Write a file of zeros in one piece: so the page cache takes large folios, and faulting them in costs a tenth."""
    with path.open("wb", buffering=0) as file:
        if file.write(_zeros(size)) != size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@lru_cache(maxsize=1)
def _zeros(size: int) -> bytes:
    return bytes(size)
