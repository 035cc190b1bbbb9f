"""Where in the tiles each frame of a map won: a few numbers each, since a large map has millions of them."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise

import numpy as np

from orthoswarm.model.arrays import Ints
from orthoswarm.mosaic.render_passes import Window

_NUMBERS = 8
"""Frame, row and column of the tile, rows and columns of the window (4), pixels."""


class FrameWindows(Mapping[int, list[Window]]):
    """Windows by frame, frames and tiles in order.

    Args:
        results: of tasks, pairs of a frame and its window in a tile.
    """

    def __init__(self, results: Iterable[Iterable[tuple[int, Window]]] = ()) -> None:
        tables = [_table(result) for result in results]
        table = np.concatenate([np.empty((0, _NUMBERS), np.int32), *tables])
        self._table = table[np.lexsort((table[:, 2], table[:, 1], table[:, 0]))]
        frames, first = np.unique(self._table[:, 0], return_index=True)
        ends = [*first.tolist(), len(self._table)]
        self._row = {frame: slice(*both) for frame, both in zip(frames.tolist(), pairwise(ends), strict=True)}

    def __getitem__(self, frame: int) -> list[Window]:
        own = self._table[self._row[frame]]
        return [
            Window(key=(r, c), row0=row0, row1=row1, col0=col0, col1=col1, pixels=pixels)
            for _, r, c, row0, row1, col0, col1, pixels in own.tolist()
        ]

    def __iter__(self) -> Iterator[int]:
        return iter(self._row)

    def __len__(self) -> int:
        return len(self._row)


def _table(result: Iterable[tuple[int, Window]]) -> Ints:
    rows = [(i, *w.key, w.row0, w.row1, w.col0, w.col1, w.pixels) for i, w in result]
    return np.array(rows, np.int32).reshape(-1, _NUMBERS)
