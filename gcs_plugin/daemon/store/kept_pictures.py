"""What is kept of a sortie's pictures until it is refined: decoded grey values, and tracks through them.

Nothing in here is needed: what is missing is made again from the pictures, with the same result.
"""

import contextlib
import shutil
import threading
from collections.abc import Sequence
from pathlib import Path

from orthoswarm.config import active
from orthoswarm.model.frame import Frame
from orthoswarm.raster.grey_pictures import stored_bytes

Key = tuple[str, int | None]


class KeptPictures:
    """A folder for each sortie that is not refined yet; all together at most `grey_pictures_mb` megabytes.

    Args:
        folder: emptied, as another version of the program may have written what is in there.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock = folder, threading.Lock()
        self._bytes: dict[Key, int] = {}
        self._made = 0
        self._names: dict[Key, str] = {}
        shutil.rmtree(folder, ignore_errors=True)

    def of(self, vehicle: str, sortie: int | None, frames: Sequence[Frame]) -> Path | None:
        """The folder for a sortie's pictures; None if they would take too much, or it cannot be made.

        Args:
            frames: those so far. A vehicle's other sorties are not kept any longer.
        """
        for other in [key for key in list(self._names) if key[0] == vehicle and key[1] != sortie]:
            self.drop(*other)
        key = (vehicle, sortie)
        with self._lock:
            size = max(stored_bytes(frames), self._bytes.get(key, 0))
            if size + sum(b for k, b in self._bytes.items() if k != key) > active().raster.grey_pictures_mb * 1e6:
                return None
            if key not in self._names:
                self._made += 1
                self._names[key] = str(self._made)
            self._bytes[key] = size
            path = self._folder / self._names[key]
            try:
                path.mkdir(parents=True, exist_ok=True)
            except OSError:
                return None
            return path

    def drop(self, vehicle: str, sortie: int | None) -> None:
        """Remove what is kept of a sortie."""
        with self._lock:
            self._bytes.pop((vehicle, sortie), None)
            name = self._names.pop((vehicle, sortie), None)
        if name is not None:
            with contextlib.suppress(OSError):
                shutil.rmtree(self._folder / name)
