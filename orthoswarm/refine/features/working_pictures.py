"""The grey pictures of one vehicle at working scale, read when needed and cached within a memory bound."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, Final

import cv2
import numpy as np

from orthoswarm.model.arrays import Gray
from orthoswarm.model.frame import Frame
from orthoswarm.raster.grey_pictures import WORK_WIDTH_PX
from orthoswarm.raster.picture_file import PictureError

ReadGray = Callable[[Frame], Gray]
"""Returns a photo's grey values, uint8 (rows, columns), at any size; may raise PictureError."""

_CACHE_MB: Final = 160.0  # memory that a vehicle's refinement keeps of its pictures at working scale
_SMALL_WIDTH_PX: Final = 160  # columns of the reduced pictures that stay in memory


class Pictures:
    """Grey pictures by index; the most recently read ones stay in memory, reduced ones always do.

    scale: full-resolution pixels per working pixel. size: (width, height) at working scale. damaged: index -> reason
    why that picture cannot be used.
    """

    def __init__(
        self, frames: Sequence[Frame], read: ReadGray, work_width: int = WORK_WIDTH_PX, cache_mb: float = _CACHE_MB
    ) -> None:
        self._frames, self._read = frames, read
        width, height = frames[0].width, frames[0].height
        self.scale = max(1.0, max(width, height) / work_width)
        self.size = (round(width / self.scale), round(height / self.scale))
        self._limit = max(8, int(cache_mb * 1e6 / max(self.size[0] * self.size[1], 1)))
        self._cache: OrderedDict[int, Gray] = OrderedDict()
        self._small: dict[int, Gray] = {}
        self.damaged: dict[int, str] = {}

    def gray(self, i: int) -> Gray:
        """Picture i; uniform grey if it cannot be decoded (see `damaged`) or lost parts in transmission."""
        cached = self._cache.get(i)
        if cached is not None:
            self._cache.move_to_end(i)
            return cached
        picture = self.once(i)
        self._cache[i] = picture
        if len(self._cache) > self._limit:
            self._cache.popitem(last=False)
        if i not in self._small:
            width = min(_SMALL_WIDTH_PX, self.size[0])
            size = (width, max(1, round(width * self.size[1] / self.size[0])))
            self._small[i] = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        return picture

    def small(self, i: int) -> Gray:
        """Picture i reduced to `_SMALL_WIDTH_PX` columns."""
        if i not in self._small:
            self.gray(i)
        return self._small[i]

    def reduced(self) -> dict[int, Gray]:
        """The reduced pictures so far, by index."""
        return dict(self._small)

    def restore(self, reduced: dict[int, Gray], damaged: dict[int, str]) -> None:
        """Take over what an earlier reading of the same pictures found: see `reduced` and `damaged`."""
        self._small.update(reduced)
        self.damaged.update(damaged)

    def only(self, i: int) -> "Pictures":
        """Picture i by itself, as number 0, read in the same way."""
        alone = copy(self)
        alone._frames, alone._cache, alone._small, alone.damaged = [self._frames[i]], OrderedDict(), {}, {}
        return alone

    def drop(self) -> None:
        """Free the memory of the working-scale pictures (the reduced ones stay)."""
        self._cache.clear()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_cache": OrderedDict(), "_small": {}}

    def once(self, i: int) -> Gray:
        """As `gray`, of a picture that is asked for once: nothing of it is kept."""
        frame, unusable = self._frames[i], np.full(self.size[::-1], 127, np.uint8)
        if frame.damaged:  # parts of it may show another moment: its record is used, its content is not
            return unusable
        try:
            picture = self._read(frame)
        except PictureError as error:
            self.damaged[i] = error.reason
            return unusable
        factor = max(1, round(frame.width / picture.shape[1]))
        rows, columns = (side * factor for side in picture.shape)
        if (rows, columns) != (frame.height, frame.width):
            self.damaged[i] = f"{frame.image} is {columns}x{rows}, not as its header says; left out"
            return unusable
        if picture.shape[::-1] == self.size:
            return picture
        return np.asarray(cv2.resize(picture, self.size, interpolation=cv2.INTER_AREA), np.uint8)


def shrunk(picture: Gray, factor: int) -> Gray:
    """A picture reduced by a whole factor; rows and columns that are left over are cut off."""
    if factor == 1:
        return picture
    rows, columns = picture.shape[0] // factor, picture.shape[1] // factor
    cut = picture[: rows * factor, : columns * factor]
    return np.asarray(cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8)
