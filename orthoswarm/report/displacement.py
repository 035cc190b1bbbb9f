"""How far the orthoimage lies from the map, block by block, as a user would measure it by flickering the two."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.geo import GroundGrid

Array = NDArray[np.float64]
Gray = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_BLOCK_PX = 72
_SEARCH_PX = 14
_MOST_BLOCKS = 700
_LEAST_PEAK = 0.35
_LEAST_LEAD = 1.25


@dataclass(frozen=True, slots=True)
class Displacements:
    """Where blocks of the orthoimage are found on the map.

    Attributes:
        at: float64 (K, 2), middles of the blocks on the ground. shift: float64 (K, 2), map minus orthoimage, metres.
        blocks: how many blocks were tried.
    """

    at: Array
    shift: Array
    blocks: int

    @property
    def size_m(self) -> Array:
        """Lengths of the shifts, metres."""
        return np.asarray(np.hypot(self.shift[:, 0], self.shift[:, 1]))


def displacements(ortho: Bytes, seen: Mask, basemap: Bytes, valid: Mask, grid: GroundGrid) -> Displacements:
    """Match blocks of an orthoimage to a map of the same grid by their gradients.

    Only clear matches count: the peak of the correlation is high and no other is near it. What changed between the two
    (debris, other seasons) therefore gives no arrow, rather than a wrong one.

    Args:
        ortho: grey orthoimage (rows, columns).
        seen: where it is drawn.
        basemap: grey map on the same grid.
        valid: where the map means something.
        grid: of both.
    """
    import cv2

    a, b = _gradient(ortho), _gradient(basemap)
    at, shift, tried = [], [], 0
    step = _BLOCK_PX
    # Blocks side by side, or with gaps where there are more than are worth the time.
    apart = step * max(1, round((grid.height * grid.width / step**2 / _MOST_BLOCKS) ** 0.5))
    for r in range(_SEARCH_PX, grid.height - step - _SEARCH_PX, apart):
        for c in range(_SEARCH_PX, grid.width - step - _SEARCH_PX, apart):
            block = (slice(r, r + step), slice(c, c + step))
            wide = (
                slice(r - _SEARCH_PX, r + step + _SEARCH_PX),
                slice(c - _SEARCH_PX, c + step + _SEARCH_PX),
            )
            if seen[block].mean() < 0.95 or valid[wide].mean() < 0.95:
                continue
            tried += 1
            scores = cv2.matchTemplate(b[wide], a[block], cv2.TM_CCOEFF_NORMED)
            found = _clear_peak(np.asarray(scores))
            if found is not None:
                at.append((c + 0.5 * step - 0.5, r + 0.5 * step - 0.5))
                shift.append((found[0] - _SEARCH_PX, _SEARCH_PX - found[1]))
    middles = grid.to_ground(np.array(at).reshape(-1, 2))
    return Displacements(middles, np.array(shift, float).reshape(-1, 2) * grid.gsd_m, tried)


def _gradient(gray: Bytes) -> Gray:
    """Gradient size, compressed so that strong edges do not outvote all others."""
    import cv2

    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)
    size = cv2.magnitude(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    return np.asarray(cv2.sqrt(size), np.float32)


def _clear_peak(scores: NDArray[np.float32]) -> tuple[float, float] | None:
    """Column and row of the best score, to a fraction; None unless it stands out and lies inside."""
    r, c = np.unravel_index(int(scores.argmax()), scores.shape)
    best = float(scores[r, c])
    if best < _LEAST_PEAK or not (0 < r < scores.shape[0] - 1 and 0 < c < scores.shape[1] - 1):
        return None
    rest = scores.copy()
    rest[max(0, r - 4) : r + 5, max(0, c - 4) : c + 5] = -1
    if best < _LEAST_LEAD * max(float(rest.max()), 0.1):
        return None
    return c + _vertex(scores[r, c - 1 : c + 2]), r + _vertex(scores[r - 1 : r + 2, c])


def _vertex(three: NDArray[np.float32]) -> float:
    low, mid, high = (float(v) for v in three)
    bend = low - 2 * mid + high
    return 0.5 * (low - high) / bend if bend < 0 else 0.0
