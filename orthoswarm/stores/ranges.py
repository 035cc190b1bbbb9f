"""Parts of a file, local or in a store, read one after the other: headers and tags, without the rest."""

import mmap
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Protocol

from orthoswarm.stores.addresses import is_stored
from orthoswarm.stores.listing import known, look_up
from orthoswarm.stores.local_copies import local_file
from orthoswarm.stores.requests import request

_BLOCK = 1 << 16
_WHOLE_BYTES: Final = 512 * 1024
"""A file of no more is fetched as a whole when its tags are read, since it is needed later anyhow: its transfer takes
no longer than a second request."""


class Parts(Protocol):
    """A file of which parts are read."""

    size: int  # bytes
    is_file: bool  # False for a pipe or a device

    def read(self, offset: int, length: int) -> bytes:
        """Bytes from an offset, fewer at the end."""

    def whole_file(self) -> mmap.mmap:
        """All bytes, mapped; to be closed."""


class _LocalParts:
    """Parts of a local file."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        state = os.fstat(fd)
        self.size, self.is_file = state.st_size, stat.S_ISREG(state.st_mode)

    def read(self, offset: int, length: int) -> bytes:
        """See Parts."""
        os.lseek(self._fd, offset, os.SEEK_SET)
        return os.read(self._fd, length)

    def whole_file(self) -> mmap.mmap:
        """See Parts."""
        return mmap.mmap(self._fd, 0, access=mmap.ACCESS_READ)


class _StoredParts:
    """Parts of a file in a store, by blocks of 64 KB, each of which is asked for once."""

    is_file = True

    def __init__(self, path: Path, size: int) -> None:
        self._path, self.size = path, size
        self._blocks: dict[int, bytes] = {}

    def read(self, offset: int, length: int) -> bytes:
        """See Parts."""
        end = min(offset + length, self.size)
        first, last = offset // _BLOCK, (max(end, offset + 1) - 1) // _BLOCK
        missing = [i for i in range(first, last + 1) if i not in self._blocks]
        if offset >= self.size or end <= offset:
            return b""
        if missing:
            begin, stop = missing[0] * _BLOCK, min((missing[-1] + 1) * _BLOCK, self.size)
            if offset >= begin and end == self.size and len(missing) == last - first + 1:
                begin = offset  # the end of a file is short: not from the block's beginning
                return request(self._path, lambda system, key: _range(system, key, begin, stop))
            data = request(self._path, lambda system, key: _range(system, key, begin, stop))
            for i in range(missing[0], missing[-1] + 1):
                self._blocks[i] = data[i * _BLOCK - begin : (i + 1) * _BLOCK - begin]
        joined = b"".join(self._blocks[i] for i in range(first, last + 1))
        return joined[offset - first * _BLOCK : end - first * _BLOCK]

    def whole_file(self) -> mmap.mmap:
        """See Parts."""
        with local_file(self._path).open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


@contextmanager
def open_parts(path: Path) -> Iterator[Parts]:
    """A file for reading parts of it; closed at the end of the context.

    Raises OSError: if a local file cannot be opened or read. Else see `requests.request`.
    """
    if is_stored(path):
        size = (known(path) or look_up(path)).size
        if size is not None and size > _WHOLE_BYTES:
            yield _StoredParts(path, size)
            return
        path = local_file(path)
    fd = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0))
    try:
        yield _LocalParts(fd)
    finally:
        os.close(fd)


def _range(system: object, key: str, begin: int, stop: int) -> bytes:
    data: bytes = system.cat_file(key, start=begin, end=stop)  # type: ignore[attr-defined]
    if len(data) != stop - begin:
        raise OSError(f"{stop - begin} bytes were asked for and {len(data)} came")
    return data
