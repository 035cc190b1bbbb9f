"""Pictures on disk: one file each, named by a hash of vehicle and picture; stored completely and synced.

What is decoded of them and tracked through them is kept until their sortie is refined (`KeptPictures`). Nothing of that
is needed: what is missing is made again from the pictures, with the same result.
"""

import contextlib
import hashlib
import json
import os
import shutil
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from gcs_plugin.daemon.store.frame_rows import Whose
from orthoswarm.export.atomic_file import atomic_write, disk_error
from orthoswarm.model.errors import DiskFullError, InputError, StorageError
from orthoswarm.model.frame import Frame
from orthoswarm.raster import kept_ranges, picture_file
from orthoswarm.raster.grey_pictures import stored_bytes

MOST_PICTURE_BYTES: Final = 96_000_000
"""Larger files are refused, posted or read from a vehicle: twice the largest JPEG of a drone's camera (chosen)."""
_SUFFIXES: Final = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png", "WEBP": ".webp", "TIFF": ".tif", "BMP": ".bmp"}
_FORMATS: Final = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")  # a JPEG with several pictures opens as MPO
_FREE_MB: Final = 1000.0
_JOURNAL_MB: Final = 50.0


def frame_key(vehicle: str, image: str) -> bytes:
    """The 32 bytes that stand for a picture of a vehicle; equal only for equal names."""
    text = json.dumps([vehicle, image])  # ASCII for all names, and unique for each pair
    return hashlib.sha256(text.encode()).digest()


def picture_size(data: bytes) -> tuple[int, int, str]:
    """Columns, rows and file suffix of a picture, by its header.

    Raises:
        InputError: it is not a picture, or a huge one.
    """
    try:
        width, height, kind = picture_file.picture_size(data, _FORMATS)
    except picture_file.PictureError as error:
        raise InputError(f"the file cannot be taken: {error}") from None
    return width, height, _SUFFIXES[kind]


class PictureStore:
    """The folder of pictures: `ab/<64 hexadecimal digits>.jpg`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._ranges = threading.Lock()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for number in range(256):
                (folder / f"{number:02x}").mkdir(exist_ok=True)
                for part in (folder / f"{number:02x}").glob("*.part"):  # left by a killed daemon
                    part.unlink()
            _sync_folder(folder)
        except OSError as error:
            raise disk_error(error, folder) from None

    def path(self, name: str) -> Path:
        """The file of a name returned by `put`."""
        return self.folder / name

    def holds(self, name: str, data: bytes) -> bool:
        """Whether a stored file has these bytes; True if it cannot be read, as nothing else is known then."""
        path = self.path(name)
        try:
            return path.stat().st_size == len(data) and path.read_bytes() == data
        except OSError:
            return True

    def _note_range(self, data: bytes, suffix: str) -> None:
        """Keep the values that 16-bit pictures use, before the first of them is there: without it they look black."""
        if suffix not in (".png", ".tif"):
            return
        picture = picture_file.deep_picture(data)
        if picture is None:
            return
        with self._ranges:
            ranges = kept_ranges.grown(kept_ranges.read_ranges(self.folder), picture, suffix)
            if ranges is not None:
                with atomic_write(self.folder / kept_ranges.FILE) as part:
                    part.write_text(json.dumps(ranges), encoding="ascii")

    def require_space(self, size: int) -> None:
        """Refuse to fill the disk, while there is still room for the journal.

        Raises:
            StorageError: there is too little room.
        """
        try:
            free = shutil.disk_usage(self.folder).free
        except OSError as error:
            raise StorageError(f"the workspace cannot be reached ({error.strerror}); connect its disk") from None
        if free < _JOURNAL_MB * 1e6 + size:
            raise DiskFullError(f"the disk is nearly full ({free / 1e6:.0f} MB left); free some space")

    def put(self, key: bytes, suffix: str, data: bytes) -> str:
        """Write a picture; when this returns, neither a crash nor a power cut loses it.

        Returns:
            Its name within the folder.

        Raises:
            StorageError: the disk is full or gone.
        """
        digits = key.hex()
        name = f"{digits[:2]}/{digits}{suffix}"
        path = self.folder / name
        part = path.with_suffix(".part")
        self._note_range(data, suffix)
        try:
            with part.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path)
            _sync_folder(path.parent)
        except OSError as error:
            with contextlib.suppress(OSError):
                part.unlink()
            reason = disk_error(error, path)
            raise type(reason)(str(reason).replace(path.name, "a picture")) from None
        return name


def _sync_folder(folder: Path) -> None:
    """Sync a folder's new names against power cuts, where the system supports it."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class KeptPictures:
    """A folder for each sortie that is not refined yet; all together at most `most_mb` megabytes.

    Args:
        folder: emptied, as another version of the program may have written what is in there. most_mb: of all sorties.
        free_mb: nothing is kept where less is free on the disk, megabytes: new pictures need it more.
    """

    def __init__(self, folder: Path, most_mb: float, free_mb: float = _FREE_MB) -> None:
        self._folder, self._most_mb, self._free_mb, self._lock = folder, most_mb, free_mb, threading.Lock()
        self._bytes: dict[Whose, int] = {}
        self._names: dict[Whose, str] = {}
        self._made = 0
        shutil.rmtree(folder, ignore_errors=True)

    def of(self, whose: Whose, frames: Sequence[Frame]) -> Path | None:
        """The folder for a sortie's pictures; None if they would take too much, or it cannot be made.

        Args:
            frames: those so far. A vehicle's other sorties are not kept any longer.
        """
        with self._lock:
            others = [other for other in self._names if other[0] == whose[0] and other != whose]
        for other in others:
            self.drop(other)
        path = self._reserved(whose, stored_bytes(frames))
        if path is None:
            self.drop(whose)
        return path

    def _reserved(self, key: Whose, size: int) -> Path | None:
        with self._lock:
            self._bytes[key] = max(size, self._bytes.get(key, 0))
            if sum(self._bytes.values()) > self._most_mb * 1e6:
                return None
            if key not in self._names:
                self._made += 1
                self._names[key] = str(self._made)
            path = self._folder / self._names[key]
            try:
                path.mkdir(parents=True, exist_ok=True)
                return path if shutil.disk_usage(path).free > self._free_mb * 1e6 + size else None
            except OSError:
                return None

    def drop(self, whose: Whose) -> None:
        """Remove what is kept of a sortie."""
        with self._lock:
            self._bytes.pop(whose, None)
            name = self._names.pop(whose, None)
        if name is not None:
            with contextlib.suppress(OSError):
                shutil.rmtree(self._folder / name)
