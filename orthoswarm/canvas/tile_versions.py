"""Which version each tile of a canvas has, on disk and in memory."""

import os
from pathlib import Path

import numpy as np

from orthoswarm.canvas.tile_store import Key
from orthoswarm.model.errors import StorageError


class VersionIndex:
    """A version per tile: uint64 (tile rows, tile columns) in memory and in a file (little endian, sparse)."""

    def __init__(self, path: Path, shape: tuple[int, int], *, writable: bool) -> None:
        self._size = shape[0] * shape[1] * 8
        self._cols = shape[1]
        self._file = os.open(path, (os.O_RDWR | os.O_CREAT if writable else os.O_RDONLY) | getattr(os, "O_BINARY", 0))
        if writable and os.fstat(self._file).st_size != self._size:
            os.truncate(self._file, self._size)
        self.values = np.zeros(shape, np.uint64)
        self.reload()

    @property
    def newest(self) -> int:
        """The largest version of all tiles."""
        return int(self.values.max()) if self.values.size else 0

    def reload(self) -> None:
        """Take over what the file says now (another process may write it)."""
        os.lseek(self._file, 0, os.SEEK_SET)
        data = os.read(self._file, self._size)
        self.values.ravel()[: len(data) // 8] = np.frombuffer(data[: len(data) // 8 * 8], "<u8")

    def put(self, key: Key, version: int, *, visible: bool) -> None:
        """Record a version on disk; in memory, too, if visible.

        Raises:
            StorageError: if the disk is full.
        """
        data = version.to_bytes(8, "little")
        offset = (key[0] * self._cols + key[1]) * 8
        try:
            if hasattr(os, "pwrite"):
                os.pwrite(self._file, data, offset)
            else:  # Windows
                os.lseek(self._file, offset, os.SEEK_SET)
                os.write(self._file, data)
        except OSError as error:
            raise StorageError(f"the canvas cannot be written ({error.strerror}); free some disk space") from None
        if visible:
            self.publish(key, version)

    def publish(self, key: Key, version: int) -> None:
        """Make a version visible in memory."""
        self.values[key] = version

    def flush(self) -> None:
        """Force the file to the disk."""
        os.fsync(self._file)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)
