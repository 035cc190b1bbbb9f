"""Byte records by key, many in one file, for what the processes of a run hand each other through the disk.

One file a record costs more than its content: making a file takes ext4 up to 1 ms where others were deleted in the last
minutes (it looks for an inode that was not), writing 300 kB 0.1 ms.
"""

import contextlib
import io
import os
import secrets
import struct
import threading
from collections.abc import Sequence
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Bytes

_SUFFIX: Final = ".pack"
_HEAD: Final = struct.Struct("<16sQ")  # a record's key and the bytes of its content, which follows
_OPEN_FOLDERS: Final = 8


class PackedRecords:
    """The records in a folder. Any number of processes may read and write at the same time.

    Each process appends to a file of its own and finds the records of others by reading the heads in their files. A
    record that a killed process left unfinished counts as none. Nothing stays open, so a folder can be removed at any
    time; what was in it counts as never written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock = folder, threading.Lock()
        self._places: dict[bytes, tuple[str, int, int]] = {}  # key -> file, start and bytes of the content
        self._read: dict[str, int] = {}  # file -> how far its heads are known
        self._own: tuple[int, str, int] | None = None  # process, file, its end

    def get(self, name: Path) -> Bytes | None:
        """What is kept under a name, uint8 (bytes,), which the caller may change; None if nothing is."""
        key = _key(name)
        with self._lock:
            place = self._find(key)
            if place is None:
                return None
            file, start, size = place
            head, content = bytearray(_HEAD.size), np.empty(size, np.uint8)
            try:
                got = _read_at(self._folder / file, start - _HEAD.size, memoryview(head), content.data)
            except OSError:
                got = 0
            if got == _HEAD.size + size and _HEAD.unpack(head) == (key, size):
                return content
            del self._places[key]  # the file was removed, or is not what it was
            return None

    def __contains__(self, name: Path) -> bool:
        with self._lock:
            return self._find(_key(name)) is not None

    def put(self, name: Path, *parts: Bytes) -> None:
        """Keep parts, one after the other, under a name; nothing happens where they cannot be written.

        parts: C-contiguous uint8 arrays of any shape.
        """
        key, size = _key(name), sum(part.nbytes for part in parts)
        pieces = [memoryview(_HEAD.pack(key, size)), *(part.data.cast("B") for part in parts)]
        with self._lock, contextlib.suppress(OSError):
            file, end = self._append(pieces)
            self._places[key] = (file, end - size, size)

    def _append(self, pieces: Sequence[memoryview]) -> tuple[str, int]:
        """Append to this process's file; its name and new end."""
        file, name, end = self._open_own()
        size = sum(piece.nbytes for piece in pieces)
        with file:
            if sum(file.write(piece) or 0 for piece in pieces) != size:  # the disk is full: more is written there next
                file.truncate(end)
                raise OSError("no space left")
        self._own = (os.getpid(), name, end + size)
        return name, end + size

    def _open_own(self) -> tuple[io.FileIO, str, int]:
        """This process's file, its name and end; a new file where nobody or another process has one."""
        if self._own is not None and self._own[0] == os.getpid():
            _, name, end = self._own
            with contextlib.suppress(FileNotFoundError):
                file = io.FileIO(self._folder / name, "r+")
                if file.seek(0, os.SEEK_END) == end:
                    return file, name, end
                file.close()  # it was changed by others, so heads in it may be torn
        name = f"{os.getpid()}-{secrets.token_hex(4)}{_SUFFIX}"
        file = io.FileIO(self._folder / name, "x")
        self._own = (os.getpid(), name, 0)
        return file, name, 0

    def _find(self, key: bytes) -> tuple[str, int, int] | None:
        if key not in self._places:
            with contextlib.suppress(OSError), os.scandir(self._folder) as entries:
                for entry in entries:
                    if entry.name.endswith(_SUFFIX):
                        self._read_heads(entry.name, entry.stat().st_size)
        return self._places.get(key)

    def _read_heads(self, file: str, size: int) -> None:
        """Find the records that were appended to a file since the last time; the last one may be unfinished."""
        at = self._read.get(file, 0)
        if at + _HEAD.size > size:
            return
        with io.FileIO(self._folder / file) as records:
            records.seek(at)
            while len(head := records.read(_HEAD.size)) == _HEAD.size:
                key, content = _HEAD.unpack(head)
                if at + _HEAD.size + content > size:
                    break
                self._places[key] = (file, at + _HEAD.size, content)
                at = records.seek(at + _HEAD.size + content)
        self._read[file] = at


@lru_cache(maxsize=_OPEN_FOLDERS)
def records(folder: Path) -> PackedRecords:
    """The records in a folder, with what this process knows of them already."""
    return PackedRecords(folder)


def _key(name: Path) -> bytes:
    return blake2b(os.fsencode(name), digest_size=16).digest()


def _read_at(path: Path, at: int, *into: memoryview) -> int:
    with io.FileIO(path) as file:
        file.seek(at)
        return sum(file.readinto(part) or 0 for part in into)
