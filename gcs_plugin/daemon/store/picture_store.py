"""Pictures on disk: one file each, named by a hash of vehicle and picture; stored completely and synced."""

import contextlib
import hashlib
import json
import os
import threading
from pathlib import Path
from typing import Final

from orthoswarm.export.atomic_file import atomic_write, disk_error
from orthoswarm.model.errors import InputError
from orthoswarm.raster import kept_ranges, picture_file

MOST_PICTURE_BYTES: Final = 96_000_000
"""Larger files are refused, posted or read from a vehicle: twice the largest JPEG of a drone's camera (chosen)."""
_SUFFIXES: Final = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png", "WEBP": ".webp", "TIFF": ".tif", "BMP": ".bmp"}
_FORMATS: Final = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")  # a JPEG with several pictures opens as MPO


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
