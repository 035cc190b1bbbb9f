"""Following corners through one vehicle's pictures (RECIPE.md step 1): spread by cells, predicted by the records.

Optical flow between consecutive pictures, started from the recorded attitude and the flown step; each window is
turned and scaled as the prediction says, so that chains survive corners.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.refine.bundle.block_arrays import Tracks
from orthoswarm.refine.features import klt
from orthoswarm.refine.features.pair_homography import (
    apply_homography,
    is_inside,
    measured_homography,
    shifted_prediction,
)

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

CELL_PX = 80
BORDER_PX = 9
FLOW_SIGMA_PX = 0.35
HELD = 48
"""Pictures that are held for comparison with first sights."""
ANCHOR_PX = 1.5
MISSED = 0.6
"""Where fewer tracks are followed, the recorded angles are not what the pictures show (3 degrees are 17 pixels)."""


@dataclass(slots=True)
class _Live:
    """Tracks alive in the last picture: pixel, id, age in pictures, first sight (picture number and pixel)."""

    uv: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    ident: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    age: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    anchor: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    anchor_uv: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), np.float32))

    def take(self, keep: NDArray[Any]) -> "_Live":
        """Some of the tracks."""
        return _Live(self.uv[keep], self.ident[keep], self.age[keep], self.anchor[keep], self.anchor_uv[keep])


@dataclass(slots=True)
class Tracker:
    """Follows corners picture by picture; feed it in order, then take the tracks.

    Attributes:
        scale: full-resolution pixels per pixel of the pictures that are fed.
        cell_px: one track is kept in each cell of this size.
    """

    scale: float = 1.0
    cell_px: int = CELL_PX
    _live: _Live = field(default_factory=_Live)
    _gray: Gray | None = None
    _half: Gray | None = None
    _stack: NDArray[np.uint8] | None = None
    _chain: list[Array] = field(default_factory=list)
    _next: int = 0
    _log: list[tuple[int, NDArray[np.int64], NDArray[np.float32]]] = field(default_factory=list)

    def add(self, index: int, gray: Gray, predicted: Array | None) -> float:
        """Follow all live tracks into the next picture and start new ones in empty cells.

        Args:
            index: of the picture (the camera of the observations).
            gray: uint8 (rows, columns).
            predicted: 3x3 homography from the last picture's pixels to this one's, None to start afresh.

        Returns:
            Share of the live tracks that survived (1 if there were none).
        """
        half = np.asarray(cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        survived = 1.0
        if predicted is None or self._gray is None or self._gray.shape != gray.shape:
            self._live = _Live()
            self._chain.append(np.eye(3))
        else:
            self._chain.append(predicted @ self._chain[-1])
            self._chain[-1] /= self._chain[-1][2, 2]
            if len(self._live.ident):
                survived = self._follow(gray, half, predicted)
        self._hold(gray)
        self._start(gray)
        self._log.append((index, self._live.ident.copy(), self._live.uv.copy()))
        self._gray, self._half = gray, half
        return survived

    def tracks(self, min_observations: int = 3) -> Tracks:
        """All tracks with enough observations, as observations in full-resolution pixels."""
        if not self._log:
            return Tracks(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2)), np.zeros(0, np.float32))
        camera = np.concatenate([np.full(len(ident), i, np.int32) for i, ident, _ in self._log])
        ident = np.concatenate([ident for _, ident, _ in self._log])
        uv = np.concatenate([uv for _, _, uv in self._log]).astype(np.float64)
        keep = np.bincount(ident, minlength=self._next)[ident] >= min_observations
        _, point = np.unique(ident[keep], return_inverse=True)
        uv = (uv[keep] + 0.5) * self.scale - 0.5
        sigma = np.full(len(point), FLOW_SIGMA_PX * self.scale, np.float32)
        return Tracks(camera[keep], point.astype(np.int32), uv, sigma)

    def _follow(self, gray: Gray, half: Gray, predicted: Array) -> float:
        before, live = len(self._live.ident), self._live
        guess = apply_homography(predicted, live.uv)
        good, found = self._flow(gray, half, predicted, guess)
        inside = is_inside(guess, gray.shape, 0.0)
        if good.sum() < max(6, 0.3 * inside.sum()):
            shifted = shifted_prediction(self._gray, gray, predicted)
            if shifted is not None:
                good, found, predicted = self._better(gray, half, shifted, (good, found, predicted))
        if good.sum() < MISSED * inside.sum():
            seen = measured_homography(self._gray, gray, live.uv, predicted)
            if seen is not None:
                good, found, predicted = self._better(gray, half, seen, (good, found, predicted))
                self._chain[-1] = predicted @ self._chain[-2]
                self._chain[-1] /= self._chain[-1][2, 2]
        kept = live.take(good)
        kept.uv, kept.age = found[good], kept.age + 1
        self._to_first_sight(kept, gray)
        self._live = _oldest_per_cell(kept, gray.shape, self.cell_px)
        return float(good.sum()) / max(before, 1)

    def _better(
        self, gray: Gray, half: Gray, other: Array, now: tuple[NDArray[np.bool_], NDArray[np.float32], Array]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32], Array]:
        """Flow as it is now or, where that keeps more tracks, from another prediction; with its prediction."""
        good, found = self._flow(gray, half, other, apply_homography(other, self._live.uv))
        return (good, found, other) if good.sum() > now[0].sum() else now

    def _to_first_sight(self, live: _Live, gray: Gray) -> None:
        """Compare with the first sight; where it is no longer recognised, the present sight becomes the first."""
        if self._stack is None or not len(live.uv):
            return
        now = len(self._chain) - 1
        anchors, which = np.unique(live.anchor, return_inverse=True)
        back = np.stack([self._chain[a] for a in anchors]) @ np.linalg.inv(self._chain[now])
        affine = _derivative(back[which], live.uv)
        ok = np.zeros(len(live.uv), bool)
        klt.anchor(self._stack, live.anchor % HELD, live.anchor_uv, gray, affine, ANCHOR_PX, live.uv, ok)
        lost = ~ok | (now + 1 - live.anchor >= HELD)
        live.anchor[lost], live.anchor_uv[lost] = now, live.uv[lost]

    def _hold(self, gray: Gray) -> None:
        if self._stack is None or self._stack.shape[1:] != gray.shape:
            self._stack = np.zeros((HELD, *gray.shape), np.uint8)
        self._stack[(len(self._chain) - 1) % HELD] = gray

    def _flow(
        self, gray: Gray, half: Gray, predicted: Array, guess: NDArray[np.float32]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """Flow of the live tracks from the guess, gated."""
        found, ok = np.empty_like(guess), np.zeros(len(guess), bool)
        klt.track(self._gray, self._half, gray, half, self._live.uv, guess, _backward(predicted, guess), found, ok)
        return _gate(guess, found, ok, gray.shape), found

    def _start(self, gray: Gray) -> None:
        """New corners: the strongest of each empty cell."""
        size = self.cell_px
        rows, cols = gray.shape[0] // size, gray.shape[1] // size
        if rows == 0 or cols == 0:
            return
        top, left = (gray.shape[0] - rows * size) // 2, (gray.shape[1] - cols * size) // 2
        taken = np.zeros((rows, cols), bool)
        r = ((self._live.uv[:, 1] - top) // size).astype(int).clip(0, rows - 1)
        c = ((self._live.uv[:, 0] - left) // size).astype(int).clip(0, cols - 1)
        taken[r, c] = True
        uv = corners(gray, ~taken, size, top, left)
        if len(uv):
            ident = np.arange(self._next, self._next + len(uv))
            self._next += len(uv)
            self._live = _Live(
                np.concatenate([self._live.uv, uv]),
                np.concatenate([self._live.ident, ident]),
                np.concatenate([self._live.age, np.zeros(len(uv), np.int64)]),
                np.concatenate([self._live.anchor, np.full(len(uv), len(self._chain) - 1)]),
                np.concatenate([self._live.anchor_uv, uv]),
            )


def corners(
    gray: Gray, empty: NDArray[np.bool_], size: int = CELL_PX, top: int = 0, left: int = 0
) -> NDArray[np.float32]:
    """The strongest corner (minimum eigenvalue) of each wanted cell: float32 (K, 2), column and row.

    Cells without texture give none. Only the rows of cells that are wanted are computed.
    """
    found: list[tuple[float, float]] = []
    floor = 1e-4
    for row in np.flatnonzero(empty.any(1)):
        y0 = top + int(row) * size
        a, b = max(y0 - 3, 0), min(y0 + size + 3, gray.shape[0])
        for first, last in _runs(empty[row]):
            x0, x1 = left + first * size, left + last * size
            c, d = max(x0 - 3, 0), min(x1 + 3, gray.shape[1])
            score = cv2.cornerMinEigenVal(gray[a:b, c:d], 5, ksize=3)[y0 - a : y0 - a + size, x0 - c : x1 - c]
            _mask_border(score, y0, x0, gray.shape)
            cells = score.reshape(size, last - first, size).transpose(1, 0, 2).reshape(last - first, -1)
            best = cells.argmax(1)
            for n, k in enumerate(best):
                if cells[n, k] > floor:
                    found.append((x0 + n * size + int(k) % size, y0 + int(k) // size))
    return np.array(found, np.float32).reshape(-1, 2)


def _runs(flags: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist())


def _mask_border(score: NDArray[np.float32], y0: int, x0: int, shape: tuple[int, ...]) -> None:
    b = BORDER_PX
    score[: max(0, b - y0)] = 0
    score[:, : max(0, b - x0)] = 0
    below, right = y0 + score.shape[0] - (shape[0] - b), x0 + score.shape[1] - (shape[1] - b)
    if below > 0:
        score[-below:] = 0
    if right > 0:
        score[:, -right:] = 0


def _backward(homography: Array, uv: NDArray[np.float32]) -> Array:
    """Derivatives (K, 2, 2) of the inverse homography at pixels (K, 2) of the later picture."""
    return _derivative(np.asarray(np.linalg.inv(homography), np.float64), uv)


def _derivative(homography: Array, uv: NDArray[np.float32]) -> Array:
    """Derivatives (K, 2, 2) of one homography (3, 3), or of one for each pixel (K, 3, 3), at pixels (K, 2)."""
    x, y = uv[:, 0:1].astype(float), uv[:, 1:2].astype(float)
    p = homography[..., 0] * x + homography[..., 1] * y + homography[..., 2]
    q = p[:, :2] / p[:, 2:]
    out = homography[..., :2, :2] - q[:, :, None] * homography[..., 2:, :2]
    return np.asarray(out / p[:, 2:, None])


def _gate(
    guess: NDArray[np.float32], found: NDArray[np.float32], ok: NDArray[np.bool_], shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Keep flows that agree with the others: 5 px from the median residual, which is 12 px from the guess at most."""
    good = ok & is_inside(found, shape, 3.0)
    if good.sum() < 3:
        return np.zeros_like(good)
    residual = found - guess
    centre = np.median(residual[good], axis=0)
    if np.hypot(*centre) > 12.0:
        return np.zeros_like(good)
    return np.asarray(good & (np.hypot(*(residual - centre).T) < 5.0))


def _oldest_per_cell(live: _Live, shape: tuple[int, ...], size: int) -> _Live:
    """One track a cell, the one followed longest: spread matters more than strength."""
    cols = shape[1] // size + 1
    cell = (live.uv[:, 1] // size).astype(np.int64) * cols + (live.uv[:, 0] // size).astype(np.int64)
    order = np.lexsort((live.ident, -live.age))
    _, first = np.unique(cell[order], return_index=True)
    keep = np.sort(order[first])
    return live.take(keep)


def predicted_homography(before: Array, after: Array, height_m: float, step: Array, matrix: Array) -> Array:
    """The homography of flat ground from one picture's pixels to the next one's, from their records.

    Args:
        before: (3, 3) rotation of the earlier camera, camera to ground; after: of the later one.
        height_m: height of the earlier camera above the ground.
        step: (3,) its movement in metres, east, north, up.
        matrix: 3x3 calibration matrix.
    """
    upward = before[2]  # the ground's normal in the earlier camera's axes
    relative = after.T @ before + np.outer(after.T @ step, upward) / height_m
    return np.asarray(matrix @ relative @ np.linalg.inv(matrix))


def follow(
    count: int,
    read: Callable[[int], Gray],
    prediction: Callable[[int], Array | None],
    scale: float = 1.0,
    cell_px: int = CELL_PX,
) -> tuple[Tracks, NDArray[np.float64]]:
    """Track through pictures 0..count-1; returns the tracks and the share that survived into each picture."""
    tracker = Tracker(scale, cell_px)
    survived = np.ones(count)
    for i in range(count):
        survived[i] = tracker.add(i, read(i), prediction(i))
    return tracker.tracks(), survived
