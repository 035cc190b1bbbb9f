"""Remembers the files read from a watched folder, so that none is read twice, even from a card read before."""

import contextlib
import hashlib
import json
import os
from pathlib import Path
from typing import Final

_HEAD: Final = 1 << 20  # bytes at either end that identify a file

Stamp = tuple[int, int]
"""Size of a file and time of its last change, nanoseconds."""


class FolderState:
    """The files read from a folder, listed in a file of the workspace; started afresh for another journal.

    Args:
        cache: folder of the file. vehicle, folder: the watched folder.
    """

    def __init__(self, cache: Path, vehicle: str, folder: Path) -> None:
        key = hashlib.sha256(json.dumps([vehicle, str(folder)]).encode()).hexdigest()[:16]
        self._path = cache / f"taken-{key}.jsonl"
        self._stamps: dict[str, Stamp] = {}
        self._digests: dict[str, list[str]] = {}
        journal = _identity(cache.parent / "journal.db")
        lines: list[str] = []
        with contextlib.suppress(OSError, UnicodeDecodeError):
            lines = self._path.read_text(encoding="utf-8").splitlines()
        if lines and lines[0] == journal:
            for line in lines[1:]:
                with contextlib.suppress(ValueError, TypeError, KeyError):  # incomplete after a power cut
                    name, size, changed, digest = json.loads(line)
                    self._note(name, (size, changed), digest)
        else:
            with contextlib.suppress(OSError):
                cache.mkdir(parents=True, exist_ok=True)
                self._path.write_text(journal + "\n", encoding="utf-8")

    def same(self, name: str, stamp: Stamp) -> bool:
        """Whether a file was read in its present state, by size and modification time."""
        return self._stamps.get(name) == stamp

    def holds(self, name: str, digest: str) -> bool:
        """Whether this content was stored under this name."""
        return digest in self._digests.get(name, ())

    def name(self, name: str, digest: str) -> str:
        """The name to store a file under: a different one if another picture has its name (a reformatted card)."""
        if not self._digests.get(name) or self.holds(name, digest):
            return name
        stem, suffix = os.path.splitext(name)
        return f"{stem}~{digest[:8]}{suffix}"

    def add(self, name: str, stamp: Stamp, digest: str) -> None:
        """Remember a file whose pictures are all stored."""
        self._note(name, stamp, digest)
        with contextlib.suppress(OSError), self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([name, *stamp, digest]) + "\n")

    def _note(self, name: str, stamp: Stamp, digest: str) -> None:
        self._stamps[name] = stamp
        if not self.holds(name, digest):
            self._digests.setdefault(name, []).append(digest)


def _identity(path: Path) -> str:
    try:
        stat = path.stat()
    except OSError:
        return "no journal"
    return f"journal {stat.st_dev} {stat.st_ino}"


def digest_of(data: bytes) -> str:
    """Digest of a content."""
    return hashlib.sha256(data).hexdigest()[:32]


def video_digest(path: Path) -> str:
    """Digest of a video's length, beginning and end."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_HEAD)
        file.seek(max(0, size - _HEAD))
        return digest_of(str(size).encode() + head + file.read(_HEAD))
