"""How cells look in one picture of the ground: colour, roughness, and whether edges lie along two directions."""

from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoswarm.change.structure import blurred
from orthoswarm.model.arrays import Bytes, Flags, Floats

FINE: Final = 4  # pixels along the side of a cell
_DARK: Final = 12.0  # grey values that noise and haze add: dark colours have no hue


class CellLooks(NamedTuple):
    """Looks of cells, all float32 (rows, columns) but `color` (rows, columns, 3) and `order`."""

    color: Floats  # mean red, green, blue, 0 to 255
    edges: Floats  # mean gradient, grey values a pixel
    spots: Floats  # mean of how much a pixel differs from those around it
    order: Floats  # (rows, columns, 3), gradients with their angles times four, and their lengths


def on_cells(values: NDArray[Any], per_cell: int) -> Floats:
    """Means over the cells of per_cell x per_cell pixels; rows and columns must be multiples of it."""
    if per_cell == 1:
        return values
    size = (values.shape[1] // per_cell, values.shape[0] // per_cell)
    return np.asarray(cv2.resize(np.ascontiguousarray(values), size, interpolation=cv2.INTER_AREA))


def cell_looks(picture: Bytes) -> CellLooks:
    """Looks of the cells of FINE x FINE pixels of a picture, uint8 (rows, columns, 3)."""
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    dx = cv2.Sobel(gray, cv2.CV_32F, 1, 0, scale=0.125)
    dy = cv2.Sobel(gray, cv2.CV_32F, 0, 1, scale=0.125)
    length = np.sqrt(dx * dx + dy * dy) + np.float32(1e-3)
    spots = np.abs(cv2.Laplacian(gray, cv2.CV_32F))
    real, imaginary = dx * dx - dy * dy, 2 * dx * dy
    cube = 1.0 / (length * length * length)
    order = [(real * real - imaginary * imaginary) * cube, 2 * real * imaginary * cube, length]
    color = on_cells(picture, FINE).astype(np.float32)
    return CellLooks(
        color, on_cells(length, FINE), on_cells(spots, FINE), np.dstack([on_cells(o, FINE) for o in order])
    )


def order_of(order: Floats) -> Floats:
    """Share of the gradients that lie along two directions at right angles, float32 (...,), of sums (..., 3)."""
    return np.asarray(np.hypot(order[..., 0], order[..., 1]) / (order[..., 2] + 0.5))


def hue(color: Floats) -> Floats:
    """Brightness and two differences of colours (..., 3), float32, logarithmic: light multiplies them all."""
    log = np.log(color + np.float32(_DARK))
    mean = log.mean(-1)
    return np.asarray(np.stack([mean, log[..., 0] - mean, log[..., 2] - mean], -1), np.float32)


class ToneModel(NamedTuple):
    """What colours of the map have become in the pictures, where the ground is the same: season, light and sensor.

    A linear map of all, and for each of some classes of colours what its ground differs from that, and how much it
    varies; found by robust means, as most of the ground is unchanged.
    """

    linear: Floats  # (4, 3)
    classes: Floats  # (K, 3), hues of the map
    shift: Floats  # (K, 3)
    spread: Floats  # (K, 3)

    @classmethod
    def of(cls, before: Floats, now: Floats, both: Flags) -> "ToneModel":
        """The model of a scene: colours (rows, columns, 3), and where both are known."""
        b, a = hue(before[both]), hue(now[both])
        step = max(1, len(b) // _SAMPLES)
        b, a = b[::step], a[::step]
        if len(b) < _FEWEST:
            nothing = np.zeros((1, 3), np.float32)
            return cls(np.zeros((4, 3), np.float32), nothing, nothing, nothing + np.float32(np.inf))
        design, weight = np.c_[np.ones(len(b)), b], np.ones(len(b))
        for _ in range(8):
            linear = np.linalg.lstsq(design * weight[:, None], a * weight[:, None], rcond=None)[0]
            rest = a - design @ linear
            spread = 1.48 * np.median(np.abs(rest), 0) + 0.01
            weight = 1.0 / (1.0 + ((rest / spread / 2.0) ** 2).sum(1))
        cv2.setRNGSeed(1)
        ends = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 1e-3)
        _, label, classes = cv2.kmeans(b * _HUE_WEIGHT, _CLASSES, None, ends, 1, cv2.KMEANS_PP_CENTERS)
        shift, spreads = np.zeros((len(classes), 3)), np.tile(spread, (len(classes), 1))
        for k in range(len(classes)):
            own = rest[label[:, 0] == k]
            if len(own) > _FEWEST // 4:
                shift[k] = np.median(own, 0)
                spreads[k] = 1.48 * np.median(np.abs(own - shift[k]), 0)
        return cls(linear.astype(np.float32), classes, shift.astype(np.float32), np.maximum(spreads, 0.02))

    def differs(self, before: Floats, now: Floats) -> tuple[Floats, Floats]:
        """How far colours (rows, columns, 3) are from what they should have become.

        Returns in spreads, squared, at most _MOST, and as a difference of hues; float32 (rows, columns).
        """
        b, a = hue(before), hue(now)
        nearest, least = np.zeros(b.shape[:2], np.intp), np.full(b.shape[:2], np.inf, np.float32)
        weighted = b * _HUE_WEIGHT
        for k, middle in enumerate(self.classes):
            away = ((weighted - middle) ** 2).sum(-1)
            closer = away < least
            nearest[closer], least[closer] = k, away[closer]
        wanted = self.linear[0] + b @ self.linear[1:] + self.shift[nearest]
        rest = (a - wanted)[..., 1:]
        far = ((rest / self.spread[nearest][..., 1:]) ** 2).sum(-1)
        return np.asarray(np.minimum(far, _MOST), np.float32), np.asarray(
            np.hypot(rest[..., 0], rest[..., 1]), np.float32
        )


_SAMPLES: Final = 20_000
_FEWEST: Final = 200
_CLASSES: Final = 24
_HUE_WEIGHT: Final = np.array([1.0, 2.0, 2.0], np.float32)
_MOST: Final = 25.0


def mean_around(values: Floats, sigma_cells: float, both: Floats) -> Floats:
    """Means (rows, columns, ...) over the surroundings of cells, of those that count."""
    weight = blurred(both, sigma_cells)
    counted = values * (both if values.ndim == 2 else both[..., None])
    mean = blurred(np.ascontiguousarray(counted), sigma_cells)
    return np.asarray(mean / np.maximum(weight if values.ndim == 2 else weight[..., None], 1e-3))
