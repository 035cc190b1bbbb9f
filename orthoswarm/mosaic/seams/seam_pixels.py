"""The pixels near a tile's seams as the other picture shows them: few, so that they have a small file of their own."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Floats, Ints

_COLUMNS = 4


@dataclass(frozen=True, slots=True)
class SeamPixels:
    """Pixels of a tile, by the label of the picture that is mixed into them.

    Attributes:
        index: int32 (N,), their numbers in the tile. label: int32 (N,), ascending.
        share: float32 (N,), of that picture.
        colors: uint32 (1, N), its colours, R, G, B, A in memory order, 0 where it was not drawn.
    """

    index: Ints
    label: Ints
    share: Floats
    colors: NDArray[np.uint32]

    @classmethod
    def create(cls, path: Path, other: Ints, share: Floats) -> "SeamPixels | None":
        """Those of a tile (T, T), see `feather.transition`, in a new file; None if there are none.

        Raises:
            OSError: if it cannot be written.
        """
        index = np.flatnonzero(other)
        if not len(index):
            return None
        index = index[np.argsort(other.ravel()[index], kind="stable")].astype(np.int32)
        empty = np.zeros(len(index), np.int32)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.stack([index, other.ravel()[index], share.ravel()[index].view(np.int32), empty]).tofile(path)
        return cls.open(path)

    @classmethod
    def open(cls, path: Path) -> "SeamPixels | None":
        """Those of a file, which changes with them; None if there is none. Processes may share it."""
        if not path.exists():
            return None
        rows = np.asarray(np.memmap(path, np.int32, "r+")).reshape(_COLUMNS, -1)
        return cls(rows[0], rows[1], rows[2].view(np.float32), rows[3:].view(np.uint32))

    def of(self, label: int) -> slice:
        """Where the pixels of a picture are."""
        return slice(*np.searchsorted(self.label, [label, label + 1]).tolist())

    def counts(self) -> list[tuple[int, int]]:
        """The labels, and how many pixels each has."""
        labels, counts = np.unique(self.label, return_counts=True)
        return list(zip(labels.tolist(), counts.tolist(), strict=True))
