"""Tracks of a vehicle's pictures, kept on disk so that a refinement that follows need not make them again.

They are found by a digest of all that they depend on, so those of other records or pictures are never used.
"""

import contextlib
import hashlib
import os
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from orthoswarm.model.arrays import Array, Gray
from orthoswarm.model.frame import Frame
from orthoswarm.refine.bundle.block_arrays import Tracks
from orthoswarm.refine.features.flow_calibration import Calibration

_SUFFIX = ".tracks"
_MOST_KEPT: Final = 8  # stretches whose tracks are kept for a refinement that follows, 7 MB each


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """What was measured in the pictures of a flight (N) from one to the next.

    calibration: focal length and headings by the flow. tracks: corners that were tracked, in working pixels.
    small: index -> reduced picture. damaged: index -> why that picture cannot be used.
    """

    calibration: Calibration
    tracks: Tracks
    small: dict[int, Gray]
    damaged: dict[int, str]


@dataclass(frozen=True, slots=True)
class KeptTracks:
    """A folder of this version's tracks, a file a flight; what cannot be written or read is made again."""

    folder: Path

    def file(self, frames: Sequence[Frame], epsg: int, origin: Array, fov_start: float) -> Path:
        """Where the tracks of a flight are kept, by the frames' records, names, sizes and files."""
        asked = (frames, [_state(frame.path) for frame in frames], epsg, origin.tolist(), fov_start)
        return self.folder / (hashlib.sha256(repr(asked).encode()).hexdigest() + _SUFFIX)

    def read(self, file: Path) -> Followed | None:
        """What was written into a file; None if there is nothing."""
        try:
            found = pickle.loads(file.read_bytes())
        except Exception:  # a damaged pickle can raise anything
            return None
        return found if isinstance(found, Followed) else None

    def write(self, file: Path, followed: Followed) -> None:
        """Keep the tracks of a flight, and those of the last few before."""
        part = file.with_suffix(f".{os.getpid()}")
        try:
            part.write_bytes(pickle.dumps(followed, pickle.HIGHEST_PROTOCOL))
            part.replace(file)
            there = sorted(self.folder.glob(f"*{_SUFFIX}"), key=lambda path: path.stat().st_mtime_ns)
            for old in there[:-_MOST_KEPT]:
                old.unlink()
        except OSError:  # the disk is full: what is needed more is written there next
            with contextlib.suppress(OSError):
                part.unlink()


def _state(path: Path) -> tuple[int, int] | None:
    """A file's size and time of change, None if it is not on this machine."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns
