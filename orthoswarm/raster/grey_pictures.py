"""Grey pictures of a run on disk, so that each file is decoded once for all stages that read its grey values."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from orthoswarm.model.arrays import Bytes
from orthoswarm.model.frame import Frame
from orthoswarm.raster.packed_records import records
from orthoswarm.raster.picture_file import read_gray, read_rgb, reduction

_SHAPE = np.dtype("<i4")
WORK_WIDTH_PX: Final = 960  # longer side of the pictures on which corners are followed


@dataclass(frozen=True, slots=True)
class GreyPictures:
    """Grey pictures as they were decoded first; what cannot be written is decoded again.

    They have the refiner's working size, and come from the colours of that size where these are read for drawing. Any
    number of processes may use a store at the same time.

    folder: where the files are; an existing folder.
    """

    folder: Path

    @classmethod
    def create(cls, folder: Path, frames: Iterable[Frame], most_mb: float) -> "GreyPictures | None":
        """A store for these frames, with what an earlier run left in the folder.

        Returns:
            None where it would take more than `most_mb` megabytes, or the folder cannot be made.
        """
        if stored_bytes(frames) > most_mb * 1e6:
            return None
        try:
            folder.mkdir(exist_ok=True)
        except OSError:
            return None
        return cls(folder)

    def rgb(self, path: Path, longest: int) -> Bytes:
        """See `read_rgb`; not smaller than the working size, and the grey values of one of that size are stored."""
        picture = read_rgb(path, max(longest, WORK_WIDTH_PX))
        height, width = picture.shape[:2]
        if reduction(width, height, WORK_WIDTH_PX) == 1 and path not in records(self.folder):
            self._store(path, np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)))
        return picture

    def gray(self, frame: Frame) -> Bytes:
        """A frame's grey picture, uint8 (rows, columns), reduced where it is larger than what the refiner works on.

        Raises:
            PictureError: see `read_gray`.
        """
        picture = self._stored(frame.path)
        if picture is None:
            picture = read_gray(frame.path, working_factor(frame))
            self._store(frame.path, picture)
        return picture

    def _stored(self, path: Path) -> Bytes | None:
        """The stored picture; None if it is not stored."""
        record = records(self.folder).get(path)
        if record is None:
            return None
        rows, columns = record[: _SHAPE.itemsize * 2].view(_SHAPE).tolist()
        return record[_SHAPE.itemsize * 2 :].reshape(rows, columns)

    def _store(self, path: Path, picture: Bytes) -> None:
        shape = np.array(picture.shape, _SHAPE).view(np.uint8)
        records(self.folder).put(path, shape, np.ascontiguousarray(picture))


def stored_bytes(frames: Iterable[Frame]) -> int:
    """How much frames take in a store."""
    return sum(frame.width * frame.height // working_factor(frame) ** 2 for frame in frames)


def working_factor(frame: Frame) -> int:
    """By how much a picture is reduced for the refiner and the preview: 1, 2, 4 or 8."""
    return reduction(frame.width, frame.height, WORK_WIDTH_PX)
