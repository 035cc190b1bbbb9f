"""The pre-disaster map on a block of ground: its small local offsets, and what leaning buildings hide on it."""

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.change.structure import blurred
from orthoswarm.model.arrays import Flags, Floats

_TILE_PX: Final = 64  # side of the parts whose offset is measured
_FARTHEST_PX: Final = 4  # offsets: a map's own distortion is up to 3 m
_CLEAR: Final = 6.0  # a peak so many sigmas above the others' is believed
_HIDES_M: Final = 2.0  # what is higher than the line of sight by this hides


def local_offsets(before: Floats, now: Floats) -> Floats:
    """How far a map's structure lies from the pictures', float32 (rows, columns, 2): columns and rows, in pixels.

    Parts of _TILE_PX are correlated; what is not clear is taken from its neighbours, 0 where there is none.

    Args:
        before, now: structure of map and pictures, float32 (rows, columns, 2 or more), gradients first.
    """
    rows, columns = (max(1, side // _TILE_PX) for side in before.shape[:2])
    found = np.zeros((rows, columns, 3), np.float32)
    taper = np.outer(*[np.hanning(_TILE_PX + 2)[1:-1]] * 2).astype(np.float32)
    for r in range(rows):
        for c in range(columns):
            part = np.s_[r * _TILE_PX : (r + 1) * _TILE_PX, c * _TILE_PX : (c + 1) * _TILE_PX]
            a, b = (np.ascontiguousarray(f[part][..., :2]).view(np.complex64)[..., 0] for f in (before, now))
            if a.shape == taper.shape:
                found[r, c] = _peak(a * taper, b * taper)
    weight = found[..., 2].copy()
    near = blurred(weight, 0.8)
    smooth = np.dstack([blurred(found[..., k] * weight, 0.8) for k in range(2)]) / np.maximum(near, 1e-6)[..., None]
    smooth[near < 1e-3] = 0.0
    size = (before.shape[1], before.shape[0])
    return np.asarray(cv2.resize(smooth.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))


def _peak(before: NDArray[Any], now: NDArray[Any]) -> tuple[float, float, float]:
    """Offset of one part, columns and rows, and its weight, 0 where it is not clear; complex gradients."""
    both = np.fft.ifft2(np.fft.fft2(before) * np.conj(np.fft.fft2(now))).real
    spread = float(both.std())
    n = _FARTHEST_PX
    near = np.roll(both, (n, n), (0, 1))[: 2 * n + 1, : 2 * n + 1]
    row, column = np.unravel_index(int(near.argmax()), near.shape)
    clear = float(near[row, column]) / max(spread, 1e-9)
    if clear < _CLEAR or row in (0, 2 * n) or column in (0, 2 * n):
        return 0.0, 0.0, 0.0

    def between(low: float, middle: float, high: float) -> float:
        bend = low - 2 * middle + high
        return 0.5 * (low - high) / bend if bend < 0 else 0.0

    dy = between(*near[row - 1 : row + 2, column])
    dx = between(*near[row, column - 1 : column + 2])
    return column - n + dx, row - n + dy, clear


def shifted(values: Floats, offset: Floats) -> Floats:
    """Values taken at each pixel plus an offset (columns, rows), float32 (rows, columns, 2)."""
    row, column = (a.astype(np.float32) for a in np.indices(values.shape[:2]))
    return np.asarray(
        cv2.remap(
            values, column + offset[..., 0], row + offset[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
    )


def hidden_on_map(height: Floats, lean: tuple[float, float], gsd_m: float) -> Flags:
    """Where the map shows what stands before the ground, bool (rows, columns).

    Args:
        height: above the bare ground, float32, metres. lean: shift on the map a metre of height, (east, north).
        gsd_m: of the pixels.
    """
    slope, top = float(np.hypot(*lean)), float(height.max())
    hidden = np.zeros(height.shape, bool)
    if slope < 1e-3 or top < _HIDES_M:
        return hidden
    # Ground at p is hidden by what stands at p - lean * h, as that is shown at p.
    for k in range(1, int(np.ceil(top * slope / gsd_m)) + 1):
        away = k * gsd_m / slope
        dx, dy = round(-lean[0] / slope * k), round(lean[1] / slope * k)
        hidden |= (
            cv2.warpAffine(height, np.array([[1, 0, -dx], [0, 1, -dy]], np.float32), height.shape[::-1])
            > away + _HIDES_M
        )
    return hidden
