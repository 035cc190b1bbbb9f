"""Parts of pictures on disk, so that a picture of which a part is drawn again need not be decoded again."""

import contextlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active

Bytes = NDArray[np.uint8]
_HEAD = np.dtype("<i4")
_NUMBERS = 4  # columns and rows of the part, column and row of its corner


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """Columns left to right and rows top to bottom of a picture, all included; none if right is less than left."""

    left: int
    right: int
    top: int
    bottom: int

    @classmethod
    def around(cls, boxes: Sequence["Box"]) -> "Box":
        """The smallest that holds some boxes; an empty one for none."""
        if not boxes:
            return cls(left=0, right=-1, top=0, bottom=-1)
        return cls(
            left=min(b.left for b in boxes),
            right=max(b.right for b in boxes),
            top=min(b.top for b in boxes),
            bottom=max(b.bottom for b in boxes),
        )


@dataclass(frozen=True, slots=True)
class Part:
    """A rectangle of a picture.

    Attributes:
        pixels: uint8 (rows, columns, 3), red first.
        corner: column and row of its first pixel in the picture.
    """

    pixels: Bytes
    corner: tuple[int, int]

    def cut(self, box: Box) -> Bytes:
        """A box of the picture that lies in the part."""
        left, top = self.corner
        return self.pixels[box.top - top : box.bottom - top + 1, box.left - left : box.right - left + 1]


@dataclass(frozen=True, slots=True)
class PictureParts:
    """Parts of the pictures of a run, one file each; what cannot be written is decoded again.

    Any number of processes may use a store at the same time, as long as one at a time keeps a picture. A file that a
    killed process left unfinished counts as none.

    Attributes:
        folder: where the files are; an existing folder.
        most_bytes: larger parts are not kept.
    """

    folder: Path
    most_bytes: int

    @classmethod
    def create(cls, folder: Path, pictures: int) -> "PictureParts | None":
        """A store for so many pictures, with what an earlier run left in the folder; None if it cannot be made."""
        try:
            folder.mkdir(exist_ok=True)
        except OSError:
            return None
        return cls(folder, int(active().raster.picture_parts_mb * 1e6 / max(1, pictures)))

    def get(self, path: Path, needs: Box) -> Part | None:
        """What was kept of a picture; None if nothing was, or not all that is needed."""
        try:
            with self._file(path).open("rb", buffering=0) as file:
                columns, rows, left, top = np.fromfile(file, _HEAD, _NUMBERS).tolist()
                if needs.left < left or needs.right >= left + columns:
                    return None
                if needs.top < top or needs.bottom >= top + rows:
                    return None
                pixels = np.fromfile(file, np.uint8, rows * columns * 3).reshape(rows, columns, 3)
        except (OSError, ValueError):
            return None
        return Part(pixels, (left, top))

    def keep(self, path: Path, picture: Bytes, drawn: Box) -> None:
        """Keep what was drawn of a picture and `part_margin` around it, unless some of it is kept already.

        Args:
            path: its file. picture: uint8 (rows, columns, 3), all of it. drawn: lies in it.
        """
        file = self._file(path)
        margin = round(active().raster.part_margin * max(picture.shape))
        left, top = max(drawn.left - margin, 0), max(drawn.top - margin, 0)
        part = picture[top : drawn.bottom + margin + 1, left : drawn.right + margin + 1]
        if drawn.right < drawn.left or part.size > self.most_bytes or file.exists():
            return
        data = np.empty(_NUMBERS * _HEAD.itemsize + part.size, np.uint8)
        data[: -part.size] = np.array([part.shape[1], part.shape[0], left, top], _HEAD).view(np.uint8)
        data[-part.size :].reshape(part.shape)[...] = part
        try:
            with file.open("wb", buffering=0) as out:
                data.tofile(out)
        except OSError:  # the disk is full: what is needed more is written there next
            with contextlib.suppress(OSError):
                file.unlink()

    def _file(self, path: Path) -> Path:
        return self.folder / blake2b(os.fsencode(path), digest_size=16).hexdigest()
