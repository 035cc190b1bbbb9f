"""Tracking of corners through one vehicle's pictures, spread by cells and predicted from the records.

Optical flow between consecutive pictures, started from the recorded attitude and the flown step; each window is
rotated and scaled as predicted, so that tracks survive the turns of the flight.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import kernel
from orthoswarm.config import active
from orthoswarm.refine.bundle.block_arrays import Tracks
from orthoswarm.refine.features import klt
from orthoswarm.refine.features.corners import strongest
from orthoswarm.refine.features.pair_homography import measured_homography, shifted_prediction

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


@dataclass(frozen=True, slots=True)
class _Flow:
    """Flow of K tracks: which are good, where they are now (K, 2), how many are good, how many stay in the picture."""

    good: NDArray[np.bool_]
    found: NDArray[np.float32]
    kept: int
    expected: int


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
    _chain: Array = field(default_factory=lambda: np.tile(np.eye(3), (active().features.anchor_photos, 1, 1)))
    _count: int = 0
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
        self._count += 1
        if predicted is None or self._gray is None or self._gray.shape != gray.shape:
            self._live = _Live()
            self._go_on(None)
        else:
            self._go_on(predicted)
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

    def _go_on(self, homography: Array | None) -> None:
        """Set the present picture's place in the chain of homographies from the first one; None begins another."""
        photos = len(self._chain)
        now = np.eye(3) if homography is None else homography @ self._chain[(self._count - 2) % photos]
        self._chain[(self._count - 1) % photos] = now / now[2, 2]

    def _follow(self, gray: Gray, half: Gray, predicted: Array) -> float:
        config = active().features
        before, live = len(self._live.ident), self._live
        flow = self._flow(gray, half, predicted)
        if flow.kept < max(config.shift_below_corners, config.shift_below_share * flow.expected):
            shifted = shifted_prediction(self._gray, gray, predicted)
            if shifted is not None:
                flow, predicted = self._better(gray, half, shifted, flow, predicted)
        if flow.kept < config.homography_below_share * flow.expected:
            measured = measured_homography(self._gray, gray, live.uv, predicted)
            if measured is not None:
                flow, predicted = self._better(gray, half, measured, flow, predicted)
                self._go_on(predicted)
        followed = live.take(flow.good)
        followed.uv, followed.age = flow.found[flow.good], followed.age + 1
        self._correct_drift(followed, gray)
        self._live = followed.take(
            _oldest_per_cell(followed.uv, followed.age, followed.ident, gray.shape[1], self.cell_px)
        )
        return flow.kept / max(before, 1)

    def _better(self, gray: Gray, half: Gray, other: Array, now: "_Flow", predicted: Array) -> tuple["_Flow", Array]:
        """The present flow or, if it keeps more tracks, that from another prediction; with the prediction used."""
        flow = self._flow(gray, half, other)
        return (flow, other) if flow.kept > now.kept else (now, predicted)

    def _correct_drift(self, live: _Live, gray: Gray) -> None:
        """Compare each window with its first observation; where that no longer matches, the present one replaces it."""
        if self._stack is None or not len(live.uv):
            return
        config = active().features
        photos, now, ok = len(self._stack), self._count - 1, np.zeros(len(live.uv), bool)
        klt.anchor(
            stack=self._stack,
            chain=self._chain,
            slot=live.anchor % photos,
            points=live.anchor_uv,
            after=gray,
            here=np.linalg.inv(self._chain[now % photos]),
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
        self._stack[(self._count - 1) % len(self._stack)] = gray

    def _flow(self, gray: Gray, half: Gray, predicted: Array) -> "_Flow":
        """Flow of the live tracks from the predicted positions, without outliers."""
        config, count = active().features, len(self._live.uv)
        guess, found, good = np.empty((count, 2), np.float32), np.empty((count, 2), np.float32), np.zeros(count, bool)
        klt.track(
            before=self._gray,
            before_half=self._half,
            after=gray,
            after_half=half,
            points=self._live.uv,
            homography=predicted,
            back=np.linalg.inv(predicted),
            rounds=config.klt_rounds[:2],
            texture=config.klt_least_texture,
            step=config.klt_step_px,
            mismatch=config.klt_mismatch,
            noise=config.klt_noise_variance,
            guess=guess,
            found=found,
            ok=good,
        )
        kept, expected = _gate(
            guess, found, good, *gray.shape, config.flow_inside_px, config.flow_least, config.flow_median_limit_px,
            config.flow_gate_px, config.flow_chance_share,
        )  # fmt: skip
        return _Flow(good, found, kept, expected)

    def _start(self, gray: Gray) -> None:
        """New corners: the strongest of each empty cell."""
        size = self.cell_px
        rows, cols = gray.shape[0] // size, gray.shape[1] // size
        if rows == 0 or cols == 0:
            return
        top, left = (gray.shape[0] - rows * size) // 2, (gray.shape[1] - cols * size) // 2
        empty = np.ones((rows, cols), bool)
        r = ((self._live.uv[:, 1] - top) // size).astype(int).clip(0, rows - 1)
        c = ((self._live.uv[:, 0] - left) // size).astype(int).clip(0, cols - 1)
        empty[r, c] = False
        config, uv = active().features, np.empty((rows * cols, 2), np.float32)
        uv = uv[
            : strongest(
                gray, empty, size, top, left, config.corner_window_px, config.border_px, config.corner_floor, uv
            )
        ]
        if len(uv):
            ident = np.arange(self._next, self._next + len(uv))
            self._next += len(uv)
            self._live = _Live(
                np.concatenate([self._live.uv, uv]),
                np.concatenate([self._live.ident, ident]),
                np.concatenate([self._live.age, np.zeros(len(uv), np.int64)]),
                np.concatenate([self._live.anchor, np.full(len(uv), self._count - 1)]),
                np.concatenate([self._live.anchor_uv, uv]),
            )


@kernel
def _gate(guess, found, ok, rows, cols, margin, least, limit, gate, chance):  # type: ignore[no-untyped-def]
    """Keep flow close to the median residual, which must itself be close to the prediction, in ok, in place.

    None is kept where no more agree than corners on different ground would by chance (binomial, 3 sigma).

    Returns:
        How many are kept, and how many were expected inside the picture.
    """
    expected = 0
    for k in range(len(ok)):
        u, v = guess[k, 0], guess[k, 1]
        expected += u >= 0 and v >= 0 and u <= cols - 1 and v <= rows - 1
        u, v = found[k, 0], found[k, 1]
        ok[k] = ok[k] and u >= margin and v >= margin and u <= cols - 1 - margin and v <= rows - 1 - margin
    kept = 0
    if ok.sum() >= least:
        residual = (found - guess)[ok]
        u, v = np.median(residual[:, 0]), np.median(residual[:, 1])
        if np.hypot(u, v) <= limit:
            for k in range(len(ok)):
                ok[k] = ok[k] and np.hypot(found[k, 0] - guess[k, 0] - u, found[k, 1] - guess[k, 1] - v) < gate
                kept += ok[k]
    if kept <= chance * expected + 3.0 * np.sqrt(chance * (1.0 - chance) * expected):
        ok[:], kept = False, 0
    return kept, expected


@kernel
def _oldest_per_cell(uv, age, ident, cols, size):  # type: ignore[no-untyped-def]
    """The track of each cell that has been followed for longest, bool (K,)."""
    across = cols // size + 1
    keep = np.zeros(len(uv), np.bool_)
    if not len(uv):
        return keep
    cell = np.empty(len(uv), np.int64)
    for k in range(len(uv)):
        cell[k] = np.int64(uv[k, 1] // size) * across + np.int64(uv[k, 0] // size)
    best = np.full(cell.max() + 1, -1)
    for k in range(len(uv)):
        b = best[cell[k]]
        if b < 0 or age[k] > age[b] or (age[k] == age[b] and ident[k] < ident[b]):
            best[cell[k]] = k
    for b in best:
        if b >= 0:
            keep[b] = True
    return keep


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
