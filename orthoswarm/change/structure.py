"""Structure of a grey picture: gradients divided by the contrast around them, which light, season and sensor leave.

A gradient keeps its sign where a thing keeps its colours; doubled in angle it keeps its direction only, so that an edge
whose sides have changed places in brightness is the same edge.
"""

from typing import Final, NamedTuple

import cv2
import numpy as np

from orthoswarm.model.arrays import Floats

AROUND_M: Final = 3.0  # sigma of the surroundings whose contrast counts
_LEAST_AROUND_PX: Final = 2.5
NOISE_GRAY: Final = 1.5  # contrast of noise and compression, grey values a pixel of the working grid
_SMOOTH_PX: Final = 0.7  # pictures are made as soft as the map
_MOST: Final = 2.0  # of a gradient in contrasts around it: edges of shadows do not outweigh all else


class Structure(NamedTuple):
    """Structure of each pixel."""

    field: Floats  # float32 (rows, columns, 4): gradient along columns and rows, and both doubled in angle
    contrast: Floats  # float32 (rows, columns), of the surroundings, grey values a pixel

    @property
    def power(self) -> Floats:
        """Square of the gradients, float32 (rows, columns)."""
        return np.asarray(self.field[..., 0] ** 2 + self.field[..., 1] ** 2)


def structure(gray: Floats, gsd_m: float) -> Structure:
    """Structure of a grey picture, float32 (rows, columns), 0 to 255, with pixels of `gsd_m`."""
    soft = cv2.GaussianBlur(gray, (0, 0), _SMOOTH_PX)
    dx = cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=0.125)
    dy = cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=0.125)
    energy = dx * dx + dy * dy
    around = np.sqrt(blurred(energy, max(AROUND_M / gsd_m, _LEAST_AROUND_PX)))
    scale = 1.0 / (around + np.float32(NOISE_GRAY))
    length = np.sqrt(energy) * scale
    scale *= np.minimum(length, np.float32(_MOST)) / np.maximum(length, 1e-6)
    out = np.empty((*gray.shape, 4), np.float32)
    x, y = out[..., 0], out[..., 1]
    np.multiply(dx, scale, out=x)
    np.multiply(dy, scale, out=y)
    size = np.maximum(np.hypot(x, y), 1e-6)
    out[..., 2] = (x * x - y * y) / size
    out[..., 3] = 2.0 * x * y / size
    return Structure(out, around)


def blurred(values: Floats, sigma_px: float) -> Floats:
    """Values, float32 (rows, columns) or with channels, averaged with a Gaussian of a sigma in pixels."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT))
