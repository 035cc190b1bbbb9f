"""The interfaces of matchers, and their result."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Matches:
    """Pairs of points that show the same ground."""

    a: Array  # float64 (N, 2), column and row in the first picture, pixel centres at integers
    b: Array  # in the second
    score: Array  # float64 (N,), confidence 0 to 1; comparable only within one matcher

    def __len__(self) -> int:
        return len(self.a)

    @classmethod
    def none(cls) -> "Matches":
        """No match."""
        return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))

    def take(self, index: NDArray[Any]) -> "Matches":
        """Some of them, by index or mask."""
        return Matches(self.a[index], self.b[index], self.score[index])


class PictureMatcher(Protocol):
    """Matches two pictures of about the same heading and scale (learned matchers are not invariant to rotation)."""

    def match(self, a: Gray, b: Gray) -> Matches:
        """Matches of two grey pictures, uint8 (rows, columns)."""


class MapMatcher(Protocol):
    """Finds a rectified patch in a window of the map on the same pixel grid."""

    def match(self, patch: Floats, valid: Mask, window: Floats, known: Mask, reach: int) -> Matches:
        """Matches from the patch (a) to the window (b).

        Args:
            patch: float32 (h, w), grey 0 to 255. valid: bool (h, w), where the patch has ground.
            window: float32 (h + 2 reach, w + 2 reach), the map; the prior puts patch pixel (c, r) at window pixel
                (c + reach, r + reach). known: bool, the same shape, where the map has ground.
            reach: the largest shift from the prior that is looked for, pixels.
        """


class UnavailableError(Exception):
    """A matcher cannot be used on this machine (weights or a package are missing); the message says what to do."""
