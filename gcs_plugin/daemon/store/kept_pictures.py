"""What is kept of a sortie's pictures until it is refined: decoded grey values, and tracks through them.

Nothing in here is needed: what is missing is made again from the pictures, with the same result.
"""

import contextlib
import shutil
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from gcs_plugin.daemon.store.frame_rows import Whose
from orthoswarm.model.frame import Frame
from orthoswarm.raster.grey_pictures import stored_bytes

_FREE_MB: Final = 1000.0


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
