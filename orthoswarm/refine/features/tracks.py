"""Tracking of corners through one vehicle's pictures, spread by cells and predicted from the records.

Optical flow between consecutive pictures, started from the recorded attitude and the flown step; each window is
rotated and scaled as predicted, so that tracks survive the turns of the flight.

Corners are the strongest of each cell that holds none, by the minimum-eigenvalue measure: Shi and Tomasi 1994, with
Sobel gradients and a square window as in OpenCV's cornerMinEigenVal; only wanted cells are computed, in whole numbers
that float32 holds exactly.
"""

from dataclasses import dataclass, field
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Array, Flags, Floats, Gray, Indices
from orthoswarm.refine.bundle.block_arrays import Tracks
from orthoswarm.refine.features import klt
from orthoswarm.refine.features.flow_calibration import phase_shift

_BORDER_PX: Final = 9  # corners nearer to the picture's border are not begun: the window of the flow would leave it
_CORNER_WINDOW_PX: Final = 5  # window of the minimum-eigenvalue corner measure (Shi and Tomasi 1994)
_CORNER_FLOOR: Final = 1e-4  # least corner measure, as of OpenCV's cornerMinEigenVal: below it there is no texture
FLOW_SIGMA_PX: Final = 0.35
"""Sigma of a followed corner in working pixels: 0.05 of noise and a drift along the track (measured together on
simulated flights; it gave the best adjustments)."""
_TRACK_LEAST_OBSERVATIONS: Final = 3  # shorter tracks are dropped: two rays cannot be checked
_FLOW_INSIDE_PX: Final = 3.0  # flow that ends nearer to the border is dropped
_FLOW_MEDIAN_LIMIT_PX: Final = 12.0  # where the median flow is farther from the prediction, all is dropped
_FLOW_GATE_PX: Final = 5.0  # flow that is farther from the median of its picture is dropped
_FLOW_LEAST: Final = 3  # fewer corners that agree are not a consensus
_SHIFT_BELOW_SHARE: Final = 0.3  # with fewer followed corners the shift is measured on the whole picture
_SHIFT_BELOW_CORNERS: Final = 6  # ... or fewer corners than this
_HOMOGRAPHY_BELOW_SHARE: Final = 0.6
"""Where a smaller share is followed, the recorded angles are not what the pictures show (3 degrees are 17 pixels), and
the homography is measured."""
_ANCHOR_PHOTOS: Final = 48  # photos that are held so that corners are compared with their first observation
_ANCHOR_LIMIT_PX: Final = 1.5  # largest correction by that comparison; beyond it the track begins anew there
_KLT_LEAST_TEXTURE: Final = 2.0  # least eigenvalue of a window's gradient matrix a pixel, grey values squared
_KLT_STEP_PX: Final = 0.01  # a smaller step ends the iterations
_KLT_ROUNDS: Final = (8, 10, 8)  # most iterations: at half size, at full size, against the first observation
_KLT_MISMATCH: Final = 0.75  # largest mean square error of a window from picture to picture, as a share of its variance
_KLT_ANCHOR_MISMATCH: Final = 0.4  # the same against the first observation: stricter, or tracks would creep
_KLT_NOISE_VARIANCE: Final = 4.0  # noise of the picture that is added to both, grey values squared
_HOMOGRAPHY_PX: Final = 3.0  # flow within this distance agrees with a homography (RANSAC; chosen; not measured)
_HOMOGRAPHY_SHARE: Final = 0.4  # least share of the flow that must agree
_HOMOGRAPHY_LEAST: Final = 12  # fewest corners that must agree
_PYRAMID_WINDOW_PX: Final = 21  # window of the flow over several octaves (OpenCV's default)
CELL_PX: Final = 80
"""One corner is followed in each cell of this size, working pixels: about 48 in a picture of 640 x 480. Spread matters
more than strength: the strongest corners sit on glints (over water such flights failed by 11 m)."""
_FLOW_CHANCE_SHARE: Final = 0.1
"""Share of the corners that agree where pictures show different ground (textures of noise: 0.09 in the middle; past
holes of flights in simulation 0.10 at most, where the ground is the same 0.25 or more, usually 0.6)."""
_PYRAMID_OCTAVES: Final = 4  # octaves below the full picture of that flow: it reaches some 16 windows
_ORB_CORNERS: Final = 1000  # ORB corners (Rublee et al. 2011) of a turn that nobody recorded
_ORB_LEAST: Final = 30  # fewest ORB matches that must agree
_ORB_SHARE: Final = 0.25  # least share of the ORB matches that must agree
_PHASE_REDUCTION: Final = 4  # phase correlation for a prediction's missing shift works on pictures reduced by this
_PHASE_RESPONSE: Final = 0.05  # least response of that phase correlation


@dataclass(slots=True)
class _Live:
    """Tracks visible in the last picture: pixel, id, age in pictures, first observation (picture number and pixel)."""

    uv: Floats = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    ident: Indices = field(default_factory=lambda: np.zeros(0, np.int64))
    age: Indices = field(default_factory=lambda: np.zeros(0, np.int64))
    anchor: Indices = field(default_factory=lambda: np.zeros(0, np.int64))
    anchor_uv: Floats = field(default_factory=lambda: np.zeros((0, 2), np.float32))

    def take(self, keep: NDArray[Any]) -> "_Live":
        """A subset of the tracks."""
        return _Live(self.uv[keep], self.ident[keep], self.age[keep], self.anchor[keep], self.anchor_uv[keep])


@dataclass(frozen=True, slots=True)
class _Flow:
    """Flow of K tracks: which are good, where they are now (K, 2), how many are good, how many stay in the picture."""

    good: Flags
    found: Floats
    kept: int
    expected: int


@dataclass(slots=True, kw_only=True)
class Tracker:
    """Tracks corners, at most one a cell of `cell_px` working pixels: `add` pictures in order, then read `tracks`."""

    cell_px: int = CELL_PX
    _live: _Live = field(default_factory=_Live)
    _gray: Gray | None = None
    _half: Gray | None = None
    _stack: Gray | None = None
    _chain: Array = field(default_factory=lambda: np.tile(np.eye(3), (_ANCHOR_PHOTOS, 1, 1)))
    _count: int = 0
    _next: int = 0
    _log: list[tuple[int, Indices, Floats]] = field(default_factory=list)

    def add(self, index: int, gray: Gray, predicted: Array | None) -> float:
        """Track all live corners into the next picture and start new ones in empty cells.

        Args:
            index: of the picture (the camera of the observations). gray: uint8 (rows, columns).
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
                survived = self._follow(self._gray, gray, half, predicted)
        if self._stack is None or self._stack.shape[1:] != gray.shape:
            self._stack = np.zeros((_ANCHOR_PHOTOS, *gray.shape), np.uint8)
        self._stack[(self._count - 1) % len(self._stack)] = gray
        self._start(gray)
        self._log.append((index, self._live.ident.copy(), self._live.uv.copy()))
        self._gray, self._half = gray, half
        return survived

    def latest(self) -> tuple[Indices, Floats]:
        """Ids and pixels (K, 2) of the last picture's tracks; what is known of all pictures so far is forgotten."""
        self._log.clear()
        return self._live.ident.copy(), self._live.uv.copy()

    def tracks(self) -> Tracks:
        """Observations of all tracks that are long enough, in working pixels."""
        if not self._log:
            return Tracks(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2)), np.zeros(0, np.float32))
        camera = np.concatenate([np.full(len(ident), i, np.int32) for i, ident, _ in self._log])
        ident = np.concatenate([ident for _, ident, _ in self._log])
        uv = np.concatenate([uv for _, _, uv in self._log]).astype(np.float64)
        keep = np.bincount(ident, minlength=self._next)[ident] >= _TRACK_LEAST_OBSERVATIONS
        sigma = np.full(len(ident), FLOW_SIGMA_PX, np.float32)
        return Tracks(camera, ident.astype(np.int32), uv, sigma).take(keep).renumbered()

    def _go_on(self, homography: Array | None) -> None:
        """Set the present picture's place in the chain of homographies from the first one; None begins another."""
        photos = len(self._chain)
        now = np.eye(3) if homography is None else homography @ self._chain[(self._count - 2) % photos]
        self._chain[(self._count - 1) % photos] = now / now[2, 2]

    def _follow(self, before: Gray, gray: Gray, half: Gray, predicted: Array) -> float:
        live = self._live
        flow = self._flow(gray, half, predicted)
        if flow.kept < max(_SHIFT_BELOW_CORNERS, _SHIFT_BELOW_SHARE * flow.expected):
            shifted = shifted_prediction(before, gray, predicted)
            if shifted is not None:
                flow, predicted = self._better(gray, half, shifted, flow, predicted)
        if flow.kept < _HOMOGRAPHY_BELOW_SHARE * flow.expected:
            measured = measured_homography(before, gray, live.uv, predicted)
            if measured is not None:
                flow, predicted = self._better(gray, half, measured, flow, predicted)
                self._go_on(predicted)
        followed = live.take(flow.good)
        followed.uv, followed.age = flow.found[flow.good], followed.age + 1
        self._correct_drift(followed, gray)
        self._live = followed.take(
            _oldest_per_cell(followed.uv, followed.age, followed.ident, gray.shape[1], self.cell_px)
        )
        return flow.kept / len(live.ident)

    def _better(self, gray: Gray, half: Gray, other: Array, now: _Flow, predicted: Array) -> tuple[_Flow, Array]:
        """The present flow or, if it keeps more tracks, that from another prediction; with the prediction used."""
        flow = self._flow(gray, half, other)
        return (flow, other) if flow.kept > now.kept else (now, predicted)

    def _correct_drift(self, live: _Live, gray: Gray) -> None:
        """Compare each window with its first observation; where that no longer matches, the present one replaces it."""
        if self._stack is None or not len(live.uv):
            return
        photos, now, ok = len(self._stack), self._count - 1, np.zeros(len(live.uv), bool)
        here = np.linalg.inv(self._chain[now % photos])
        limits = _KLT_ROUNDS[2], _KLT_LEAST_TEXTURE, _KLT_STEP_PX, _KLT_ANCHOR_MISMATCH, _KLT_NOISE_VARIANCE
        klt.anchor(
            self._stack, self._chain, live.anchor % photos, live.anchor_uv, gray, here, _ANCHOR_LIMIT_PX, limits,
            live.uv, ok,
        )  # fmt: skip
        lost = ~ok | (now + 1 - live.anchor >= photos)
        live.anchor[lost], live.anchor_uv[lost] = now, live.uv[lost]

    def _flow(self, gray: Gray, half: Gray, predicted: Array) -> _Flow:
        """Flow of the live tracks from the predicted positions, without outliers."""
        count = len(self._live.uv)
        guess, found, good = np.empty((count, 2), np.float32), np.empty((count, 2), np.float32), np.zeros(count, bool)
        limits = _KLT_ROUNDS[:2], _KLT_LEAST_TEXTURE, _KLT_STEP_PX, _KLT_MISMATCH, _KLT_NOISE_VARIANCE
        klt.track(
            self._gray, self._half, gray, half, self._live.uv, predicted, np.linalg.inv(predicted), limits, guess,
            found, good,
        )  # fmt: skip
        kept, expected = _gate(guess, found, good, gray.shape)
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
        uv = np.empty((rows * cols, 2), np.float32)
        uv = uv[: strongest(gray, empty, size, top, left, uv)]
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


def _gate(guess: Floats, found: Floats, ok: Flags, shape: tuple[int, ...]) -> tuple[int, int]:
    """Keep flow close to the median residual, which must itself be close to the prediction, in ok, in place.

    None is kept where no more agree than corners on different ground would by chance (binomial, 3 sigma). Returns how
    many are kept, and how many were expected inside the picture.
    """
    last, margin, chance = np.array(shape[1::-1]) - 1, _FLOW_INSIDE_PX, _FLOW_CHANCE_SHARE
    expected = int(((guess >= 0) & (guess <= last)).all(1).sum())
    ok &= ((found >= margin) & (found <= last - margin)).all(1)
    kept = 0
    if ok.sum() >= _FLOW_LEAST:
        residual = found - guess
        middle = np.median(residual[ok], axis=0)
        if np.hypot(*middle) <= _FLOW_MEDIAN_LIMIT_PX:
            ok &= np.hypot(*(residual - middle).T) < _FLOW_GATE_PX
            kept = int(ok.sum())
    if kept <= chance * expected + 3.0 * np.sqrt(chance * (1.0 - chance) * expected):
        ok[:], kept = False, 0
    return kept, expected


def _oldest_per_cell(uv: Floats, age: Indices, ident: Indices, cols: int, size: int) -> Flags:
    """The track of each cell that has been followed for longest, bool (K,)."""
    cell = (uv[:, 1] // size).astype(np.int64) * (cols // size + 1) + (uv[:, 0] // size).astype(np.int64)
    order = np.lexsort((ident, -age, cell))
    keep = np.zeros(len(uv), bool)
    keep[order[np.unique(cell[order], return_index=True)[1]]] = True
    return keep


def measured_homography(previous: Gray, gray: Gray, uv: Floats, predicted: Array) -> Array | None:
    """The homography that most of a flow over several octaves agrees on; None without agreement.

    For a swaying camera whose angles are degrees off or not recorded. From the prediction and, without a consensus (a
    heading more than ten degrees off), from no motion; after that from ORB corners.

    uv: float32 (K, 2), corners of the previous picture. predicted: 3x3 homography from its pixels.
    """
    if len(uv) < _HOMOGRAPHY_LEAST:
        return None
    for start in (predicted, np.eye(3)):
        aligned = shifted_prediction(previous, gray, start)
        measured = _flow_homography(previous, gray, uv, start if aligned is None else aligned)
        if measured is not None:
            return measured
    return _turned_homography(previous, gray)


def _flow_homography(previous: Gray, gray: Gray, uv: Floats, start: Array) -> Array | None:
    """The homography that most of the flow from a given start agrees on, None without agreement."""
    p = uv.astype(float) @ start[:, :2].T + start[:, 2]
    guess = np.ascontiguousarray(p[:, :2] / p[:, 2:], dtype=np.float32)
    warped = cv2.warpPerspective(previous, start, gray.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    window = (_PYRAMID_WINDOW_PX, _PYRAMID_WINDOW_PX)
    found, status, _ = cv2.calcOpticalFlowPyrLK(warped, gray, guess, None, winSize=window, maxLevel=_PYRAMID_OCTAVES)
    ok = is_inside(guess, gray.shape) & (status.ravel() == 1) & is_inside(found, gray.shape)
    if ok.sum() < _HOMOGRAPHY_LEAST:
        return None
    return _agreed(uv[ok], found[ok], max(_HOMOGRAPHY_LEAST, _HOMOGRAPHY_SHARE * ok.sum()))


def _turned_homography(previous: Gray, gray: Gray) -> Array | None:
    """The homography that rotation-invariant corners (ORB) agree on, for turns without recorded headings, or None."""
    orb = cv2.ORB.create(nfeatures=_ORB_CORNERS)
    (before, ours), (after, theirs) = (orb.detectAndCompute(picture, None) for picture in (previous, gray))
    if ours is None or theirs is None:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(ours, theirs)
    if len(pairs) < _ORB_LEAST:
        return None
    a = np.array([before[m.queryIdx].pt for m in pairs], np.float32)
    b = np.array([after[m.trainIdx].pt for m in pairs], np.float32)
    return _agreed(a, b, max(_ORB_LEAST, _ORB_SHARE * len(pairs)))


def _agreed(a: Floats, b: Floats, fewest: float) -> Array | None:
    """The homography by RANSAC over pairs of pixels (K, 2), None with too few inliers."""
    homography, inlier = cv2.findHomography(a, b, cv2.RANSAC, _HOMOGRAPHY_PX)
    if homography is None or inlier.sum() < fewest:
        return None
    return np.asarray(homography, np.float64)


def shifted_prediction(previous: Gray, gray: Gray, predicted: Array) -> Array | None:
    """The prediction corrected by a shift from phase correlation of reduced pictures, None if that is unclear."""
    warped = cv2.warpPerspective(previous, predicted, gray.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    dx, dy, response = phase_shift(warped, gray, 1.0 / _PHASE_REDUCTION)
    if response <= _PHASE_RESPONSE:
        return None
    return np.array([[1.0, 0, _PHASE_REDUCTION * dx], [0, 1.0, _PHASE_REDUCTION * dy], [0, 0, 1.0]]) @ predicted


def is_inside(uv: Floats, shape: tuple[int, ...]) -> Flags:
    """Which pixels (K, 2) lie in a picture of this shape."""
    h, w = shape[:2]
    return (uv[:, 0] >= 0) & (uv[:, 1] >= 0) & (uv[:, 0] <= w - 1) & (uv[:, 1] <= h - 1)


def predicted_homography(before: Array, after: Array, height_m: float, step: Array, matrix: Array) -> Array:
    """The homography of flat ground from one picture's pixels to the next one's, predicted from their records.

    before, after: (3, 3) rotations, camera to ground. height_m: of the earlier camera above the ground. step: (3,) its
    movement in metres, east, north, up. matrix: 3x3 calibration matrix.
    """
    upward = before[2]  # the ground's normal in the earlier camera's axes
    relative = after.T @ before + np.outer(after.T @ step, upward) / height_m
    return np.asarray(matrix @ relative @ np.linalg.inv(matrix))


@kernel
def strongest(gray, empty, size, top, left, uv):  # type: ignore[no-untyped-def]
    """The strongest corner of each wanted cell, into uv float32 (K, 2), column and row; returns how many.

    gray: uint8 (rows, columns). empty: bool, which cells are wanted. size: of a cell; top, left: of the first one.
    """
    cells, cols = empty.shape[1], gray.shape[1]
    best, where, score = np.empty(cells, np.float32), np.empty((cells, 2), np.int64), np.empty(cols, np.float32)
    sums = np.zeros((_CORNER_WINDOW_PX + 3, 3, cols), np.float32)
    return _search(gray, empty, size, top, left, uv, best, where, score, sums)


@in_place_kernel
def _search(gray, empty, size, top, left, uv, best, where, score, sums):  # type: ignore[no-untyped-def]
    """What `strongest` does.

    Args:
        best, where: (cells of a row,), (.., 2) room for the highest measure of each cell, and its pixel.
        score: float32 (columns,) room for the measures of a row.
        sums: float32 (window + 3, 3, columns) room for the products of as many rows, their total, those of a new row,
            and their sums over columns.
    """
    rows, cols = gray.shape
    window = _CORNER_WINDOW_PX
    reach = window // 2
    margin = max(_BORDER_PX, reach + 1)
    scale = 1.0 / (4.0 * window * 255.0) ** 2
    found = 0
    lines, total, product, across = sums[:window], sums[window], sums[window + 1], sums[window + 2]
    for row in range(empty.shape[0]):
        y0, y1 = max(top + row * size, margin), min(top + (row + 1) * size, rows - margin)
        first = 0
        while first < empty.shape[1]:
            if not empty[row, first]:
                first += 1
                continue
            last = first
            while last < empty.shape[1] and empty[row, last]:
                last += 1
            x0, x1 = max(left + first * size, margin), min(left + last * size, cols - margin)
            best[first:last] = -1.0
            if x1 > x0 and y1 > y0:
                n = x1 - x0 + 2 * reach
                lines[:] = 0.0
                total[:] = 0.0
                for y in range(y0 - reach, y1 + reach):
                    _products(gray, y, x0 - reach, n, product)
                    old = lines[(y - y0 + reach) % window]
                    for k in range(3):
                        _exchange(product[k, :n], old[k, :n], total[k, :n])
                    if y >= y0 + reach:
                        _measure(total, x1 - x0, window, across, score)
                        _highest(score, x1 - x0, x0, y - reach, left, size, best, where)
            for cell in range(first, last):
                if best[cell] * scale > _CORNER_FLOOR:
                    uv[found, 0], uv[found, 1] = where[cell, 0], where[cell, 1]
                    found += 1
            first = last
    return found


@in_place_kernel
def _products(gray, y, x, n, product):  # type: ignore[no-untyped-def]
    """Products of the Sobel gradients (xx, xy, yy) of n pixels of a row from a column on; slices vectorise."""
    nw, north, ne = gray[y - 1, x - 1 : x - 1 + n], gray[y - 1, x : x + n], gray[y - 1, x + 1 : x + 1 + n]
    west, east = gray[y, x - 1 : x - 1 + n], gray[y, x + 1 : x + 1 + n]
    sw, south, se = gray[y + 1, x - 1 : x - 1 + n], gray[y + 1, x : x + n], gray[y + 1, x + 1 : x + 1 + n]
    xx, xy, yy = product[0, :n], product[1, :n], product[2, :n]
    two = np.float32(2.0)
    for c in range(n):
        a, b, d, e = np.float32(nw[c]), np.float32(ne[c]), np.float32(sw[c]), np.float32(se[c])
        gx = b - a + e - d + two * (np.float32(east[c]) - np.float32(west[c]))
        gy = d - a + e - b + two * (np.float32(south[c]) - np.float32(north[c]))
        xx[c], xy[c], yy[c] = gx * gx, gx * gy, gy * gy


@in_place_kernel
def _exchange(new, old, total):  # type: ignore[no-untyped-def]
    """Take an old row from the total, add a new one, and keep it in the old one's place."""
    for c in range(len(total)):
        total[c] += new[c] - old[c]
        old[c] = new[c]


@in_place_kernel
def _measure(total, n, window, across, score):  # type: ignore[no-untyped-def]
    """Smaller eigenvalue of the gradient matrix about n pixels, whose sums over rows are known for each column."""
    xx, xy, yy = across[0, :n], across[1, :n], across[2, :n]
    xx[:] = 0.0
    xy[:] = 0.0
    yy[:] = 0.0
    for k in range(window):
        a, b, d = total[0, k : k + n], total[1, k : k + n], total[2, k : k + n]
        for c in range(n):
            xx[c] += a[c]
            xy[c] += b[c]
            yy[c] += d[c]
    half, to = np.float32(0.5), score[:n]
    for c in range(n):
        difference = half * (xx[c] - yy[c])
        to[c] = half * (xx[c] + yy[c]) - np.sqrt(difference * difference + xy[c] * xy[c])


@in_place_kernel
def _highest(score, n, x, y, left, size, best, where):  # type: ignore[no-untyped-def]
    """Compare the scores of a row with the best of their cells so far."""
    c = 0
    while c < n:
        cell = (x + c - left) // size
        end = min(n, left + (cell + 1) * size - x)
        top = best[cell]
        for k in range(c, end):
            if score[k] > top:
                top = score[k]
                where[cell, 0], where[cell, 1] = x + k, y
        best[cell] = top
        c = end
