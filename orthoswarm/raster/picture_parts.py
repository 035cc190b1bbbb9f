"""Parts of pictures on disk, so that a picture of which a part is drawn again need not be decoded again."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from orthoswarm.model.arrays import Bytes
from orthoswarm.raster.packed_records import records

_HEAD = np.dtype("<i4")
_NUMBERS = 4  # columns and rows of the part, column and row of its corner

_PART_MARGIN: Final = 0.1
"""What the real-time map shows of a picture is kept for the refined maps with a border of this share of the picture's
longer side; what they need beyond it is decoded again (measured on 1,017 photos: 6 % are)."""


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

    pixels: uint8 (rows, columns, 3), red first. corner: column and row of its first pixel in the picture.
    """

    pixels: Bytes
    corner: tuple[int, int]

    def cut(self, box: Box) -> Bytes:
        """A box of the picture that lies in the part."""
        left, top = self.corner
        return self.pixels[box.top - top : box.bottom - top + 1, box.left - left : box.right - left + 1]


@dataclass(frozen=True, slots=True)
class PictureParts:
    """Parts of the pictures of a run; what cannot be written is decoded again.

    Any number of processes may use a store at the same time, as long as one at a time keeps a picture.

    folder: where the files are; an existing folder. most_bytes: larger parts are not kept.
    """

    folder: Path
    most_bytes: int

    @classmethod
    def create(cls, folder: Path, pictures: int, most_mb: float) -> "PictureParts | None":
        """A store for so many pictures, with what an earlier run left in the folder; None if it cannot be made.

        most_mb: megabytes that all parts may take together.
        """
        try:
            folder.mkdir(exist_ok=True)
        except OSError:
            return None
        return cls(folder, int(most_mb * 1e6 / max(1, pictures)))

    def get(self, path: Path, needs: Box) -> Part | None:
        """What was kept of a picture; None if nothing was, or not all that is needed."""
        record = records(self.folder).get(path)
        if record is None:
            return None
        head = _NUMBERS * _HEAD.itemsize
        columns, rows, left, top = record[:head].view(_HEAD).tolist()
        if needs.left < left or needs.right >= left + columns or needs.top < top or needs.bottom >= top + rows:
            return None
        return Part(record[head:].reshape(rows, columns, 3), (left, top))

    def keep(self, path: Path, picture: Bytes, drawn: Box) -> None:
        """Keep what was drawn of a picture and `_PART_MARGIN` around it, unless some of it is kept already.

        path: its file. picture: uint8 (rows, columns, 3), all of it. drawn: lies in it.
        """
        margin = round(_PART_MARGIN * max(picture.shape))
        left, top = max(drawn.left - margin, 0), max(drawn.top - margin, 0)
        part = picture[top : drawn.bottom + margin + 1, left : drawn.right + margin + 1]
        if drawn.right < drawn.left or part.size > self.most_bytes or path in records(self.folder):
            return
        head = np.array([part.shape[1], part.shape[0], left, top], _HEAD).view(np.uint8)
        records(self.folder).put(path, head, np.ascontiguousarray(part))
