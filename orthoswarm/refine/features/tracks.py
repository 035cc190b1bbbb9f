"""Tracking of corners through one vehicle's pictures, spread by cells and predicted from the records.

Optical flow between consecutive pictures, started from the recorded attitude and the flown step; each window is
rotated and scaled as predicted, so that tracks survive the turns of the flight.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
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


@dataclass(slots=True)
class _Live:
    """Tracks visible in the last picture: pixel, id, age in pictures, first observation (picture number and pixel)."""

    uv: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    ident: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    age: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    anchor: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    anchor_uv: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), np.float32))

    def take(self, keep: NDArray[Any]) -> "_Live":
        """A subset of the tracks."""
        return _Live(self.uv[keep], self.ident[keep], self.age[keep], self.anchor[keep], self.anchor_uv[keep])


@dataclass(slots=True, kw_only=True)
class Tracker:
    """Tracks corners from picture to picture: `add` the pictures in order, then read `tracks`.

    Attributes:
        scale: full-resolution pixels per pixel of the added pictures.
        cell_px: at most one track in each cell of this size.
    """

    scale: float = 1.0
    cell_px: int = field(default_factory=lambda: active().features.cell_px)
    _live: _Live = field(default_factory=_Live)
    _gray: Gray | None = None
    _half: Gray | None = None
    _stack: NDArray[np.uint8] | None = None
    _chain: list[Array] = field(default_factory=list)
    _next: int = 0
    _log: list[tuple[int, NDArray[np.int64], NDArray[np.float32]]] = field(default_factory=list)

    def add(self, index: int, gray: Gray, predicted: Array | None) -> float:
        """Track all live corners into the next picture and start new ones in empty cells.

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

    def tracks(self) -> Tracks:
        """Observations of all tracks that are long enough, in full-resolution pixels."""
        config = active().features
        if not self._log:
            return Tracks(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2)), np.zeros(0, np.float32))
        camera = np.concatenate([np.full(len(ident), i, np.int32) for i, ident, _ in self._log])
        ident = np.concatenate([ident for _, ident, _ in self._log])
        uv = np.concatenate([uv for _, _, uv in self._log]).astype(np.float64)
        keep = np.bincount(ident, minlength=self._next)[ident] >= config.track_least_observations
        _, point = np.unique(ident[keep], return_inverse=True)
        uv = (uv[keep] + 0.5) * self.scale - 0.5
        sigma = np.full(len(point), config.flow_sigma_px * self.scale, np.float32)
        return Tracks(camera[keep], point.astype(np.int32), uv, sigma)

    def _follow(self, gray: Gray, half: Gray, predicted: Array) -> float:
        config = active().features
        before, live = len(self._live.ident), self._live
        guess = apply_homography(predicted, live.uv)
        good, found = self._flow(gray, half, predicted, guess)
        inside = is_inside(guess, gray.shape, 0.0)
        if good.sum() < max(config.shift_below_corners, config.shift_below_share * inside.sum()):
            shifted = shifted_prediction(self._gray, gray, predicted)
            if shifted is not None:
                good, found, predicted = self._better(gray, half, shifted, (good, found, predicted))
        if good.sum() < config.homography_below_share * inside.sum():
            measured = measured_homography(self._gray, gray, live.uv, predicted)
            if measured is not None:
                good, found, predicted = self._better(gray, half, measured, (good, found, predicted))
                self._chain[-1] = predicted @ self._chain[-2]
                self._chain[-1] /= self._chain[-1][2, 2]
        followed = live.take(good)
        followed.uv, followed.age = found[good], followed.age + 1
        self._correct_drift(followed, gray)
        self._live = _oldest_per_cell(followed, gray.shape, self.cell_px)
        return float(good.sum()) / max(before, 1)

    def _better(
        self, gray: Gray, half: Gray, other: Array, now: tuple[NDArray[np.bool_], NDArray[np.float32], Array]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32], Array]:
        """The present flow or, if it keeps more tracks, that from another prediction; with the prediction used."""
        good, found = self._flow(gray, half, other, apply_homography(other, self._live.uv))
        return (good, found, other) if good.sum() > now[0].sum() else now

    def _correct_drift(self, live: _Live, gray: Gray) -> None:
        """Compare each window with its first observation; where that no longer matches, the present one replaces it."""
        if self._stack is None or not len(live.uv):
            return
        config = active().features
        photos = len(self._stack)
        now = len(self._chain) - 1
        anchors, which = np.unique(live.anchor, return_inverse=True)
        back = np.stack([self._chain[a] for a in anchors]) @ np.linalg.inv(self._chain[now])
        affine = _derivative(back[which], live.uv)
        ok = np.zeros(len(live.uv), bool)
        klt.anchor(
            stack=self._stack,
            slot=live.anchor % photos,
            points=live.anchor_uv,
            after=gray,
            affine=affine,
            limit=config.anchor_limit_px,
            rounds=config.klt_rounds[2],
            texture=config.klt_least_texture,
            step=config.klt_step_px,
            mismatch=config.klt_anchor_mismatch,
            noise=config.klt_noise_variance,
            found=live.uv,
            ok=ok,
        )
        lost = ~ok | (now + 1 - live.anchor >= photos)
        live.anchor[lost], live.anchor_uv[lost] = now, live.uv[lost]

    def _hold(self, gray: Gray) -> None:
        if self._stack is None or self._stack.shape[1:] != gray.shape:
            self._stack = np.zeros((active().features.anchor_photos, *gray.shape), np.uint8)
        self._stack[(len(self._chain) - 1) % len(self._stack)] = gray

    def _flow(
        self, gray: Gray, half: Gray, predicted: Array, guess: NDArray[np.float32]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """Flow of the live tracks from the predicted positions, without outliers."""
        config = active().features
        found, ok = np.empty_like(guess), np.zeros(len(guess), bool)
        klt.track(
            before=self._gray,
            before_half=self._half,
            after=gray,
            after_half=half,
            points=self._live.uv,
            guess=guess,
            affine=_backward(predicted, guess),
            rounds=config.klt_rounds[:2],
            texture=config.klt_least_texture,
            step=config.klt_step_px,
            mismatch=config.klt_mismatch,
            noise=config.klt_noise_variance,
            found=found,
            ok=ok,
        )
        expected = int(is_inside(guess, gray.shape, 0.0).sum())
        return _gate(guess, found, ok, gray.shape, expected), found

    def _start(self, gray: Gray) -> None:
        """New corners: the strongest of each empty cell."""
        size = self.cell_px
        rows, cols = gray.shape[0] // size, gray.shape[1] // size
        if rows == 0 or cols == 0:
            return
        top, left = (gray.shape[0] - rows * size) // 2, (gray.shape[1] - cols * size) // 2
        occupied = np.zeros((rows, cols), bool)
        r = ((self._live.uv[:, 1] - top) // size).astype(int).clip(0, rows - 1)
        c = ((self._live.uv[:, 0] - left) // size).astype(int).clip(0, cols - 1)
        occupied[r, c] = True
        uv = corners(gray, ~occupied, size, top, left)
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


def corners(gray: Gray, empty: NDArray[np.bool_], size: int, top: int = 0, left: int = 0) -> NDArray[np.float32]:
    """The strongest corner (minimum eigenvalue) of each wanted cell: float32 (K, 2), column and row.

    Cells without texture give no corner. Only the rows of wanted cells are computed.
    """
    config = active().features
    window, reach = config.corner_window_px, (config.corner_window_px + 1) // 2
    found: list[tuple[float, float]] = []
    for row in np.flatnonzero(empty.any(1)):
        y0 = top + int(row) * size
        a, b = max(y0 - reach, 0), min(y0 + size + reach, gray.shape[0])
        for first, last in _runs(empty[row]):
            x0, x1 = left + first * size, left + last * size
            c, d = max(x0 - reach, 0), min(x1 + reach, gray.shape[1])
            score = cv2.cornerMinEigenVal(gray[a:b, c:d], window, ksize=3)[y0 - a : y0 - a + size, x0 - c : x1 - c]
            _mask_border(score, y0, x0, gray.shape, config.border_px)
            cells = score.reshape(size, last - first, size).transpose(1, 0, 2).reshape(last - first, -1)
            best = cells.argmax(1)
            for n, k in enumerate(best):
                if cells[n, k] > config.corner_floor:
                    found.append((x0 + n * size + int(k) % size, y0 + int(k) // size))
    return np.array(found, np.float32).reshape(-1, 2)


def _runs(flags: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist())


def _mask_border(score: NDArray[np.float32], y0: int, x0: int, shape: tuple[int, ...], b: int) -> None:
    """Suppress corners within b pixels of the border of a picture of this shape; the score's origin is (x0, y0)."""
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
    guess: NDArray[np.float32], found: NDArray[np.float32], ok: NDArray[np.bool_], shape: tuple[int, ...], expected: int
) -> NDArray[np.bool_]:
    """Keep flow close to the median residual, which must itself be close to the prediction.

    None is kept where no more agree than `expected` corners on different ground would by chance (binomial, 3 sigma).
    """
    config = active().features
    good = ok & is_inside(found, shape, config.flow_inside_px)
    if good.sum() < config.flow_least:
        return np.zeros_like(good)
    residual = found - guess
    centre = np.median(residual[good], axis=0)
    if np.hypot(*centre) > config.flow_median_limit_px:
        return np.zeros_like(good)
    agree = np.asarray(good & (np.hypot(*(residual - centre).T) < config.flow_gate_px))
    share = config.flow_chance_share
    by_chance = share * expected + 3.0 * np.sqrt(share * (1.0 - share) * expected)
    return agree if agree.sum() > by_chance else np.zeros_like(good)


def _oldest_per_cell(live: _Live, shape: tuple[int, ...], size: int) -> _Live:
    """One track per cell, the longest."""
    cols = shape[1] // size + 1
    cell = (live.uv[:, 1] // size).astype(np.int64) * cols + (live.uv[:, 0] // size).astype(np.int64)
    order = np.lexsort((live.ident, -live.age))
    _, first = np.unique(cell[order], return_index=True)
    keep = np.sort(order[first])
    return live.take(keep)


def predicted_homography(before: Array, after: Array, height_m: float, step: Array, matrix: Array) -> Array:
    """The homography of flat ground from one picture's pixels to the next one's, predicted from their records.

    Args:
        before: (3, 3) rotation of the earlier camera, camera to ground; after: the later camera's.
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
    cell_px: int | None = None,
) -> tuple[Tracks, NDArray[np.float64]]:
    """Track corners through pictures 0 .. count - 1.

    Args:
        count: number of pictures. read: returns picture i at working scale.
        prediction: 3x3 homography from picture i - 1 to i, None where tracking starts afresh.
        scale: full-resolution pixels per working pixel. cell_px: see Tracker (None: as configured).

    Returns:
        The tracks, and the share of them that survived into each picture, float64 (count,).
    """
    tracker = Tracker(scale=scale) if cell_px is None else Tracker(scale=scale, cell_px=cell_px)
    survived = np.ones(count)
    for i in range(count):
        survived[i] = tracker.add(i, read(i), prediction(i))
    return tracker.tracks(), survived
