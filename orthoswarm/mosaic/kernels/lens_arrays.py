"""Lenses as rows of numbers for the compiled kernels, with boxes of what they certainly and possibly see."""

from functools import lru_cache

import numpy as np

from orthoswarm.model.arrays import Array, Flags
from orthoswarm.model.camera import LEAST_RADIAL_SLOPE, Lens

F, K1, K2, K3, U, V, U_LOW, U_HIGH, V_LOW, V_HIGH = range(10)
OUTER, INNER = 10, 14
"""Columns of a lens row: focal length, radial terms, principal point, usable pixels, then two boxes (x low, x high,
y low, y high) of undistorted normalised coordinates: OUTER holds all the usable picture, INNER lies within it."""


def folds(lens: Lens, r2: Array) -> Flags:
    """Where (squared undistorted radius) the distortion hardly grows with the angle any more: nothing is visible."""
    return np.asarray(1.0 + r2 * (3 * lens.k1 + r2 * (5 * lens.k2 + r2 * 7 * lens.k3)) < LEAST_RADIAL_SLOPE)


@lru_cache(maxsize=256)
def lens_row(lens: Lens, margin_px: float) -> tuple[float, ...]:
    """A lens as a row of numbers, see the columns above."""
    u, v = lens.principal_point
    low, right, bottom = margin_px, lens.width - 1.0 - margin_px, lens.height - 1.0 - margin_px
    t = np.linspace(0.0, 1.0, 33)
    sides = [  # left, right, top, bottom
        np.stack([np.full(33, low), low + (bottom - low) * t], 1),
        np.stack([np.full(33, right), low + (bottom - low) * t], 1),
        np.stack([low + (right - low) * t, np.full(33, low)], 1),
        np.stack([low + (right - low) * t, np.full(33, bottom)], 1),
    ]
    flat = [(side - (u, v)) / lens.focal_px for side in sides]
    if not lens.is_pinhole:
        flat = [lens.undistort(side) for side in flat]
    x_left, x_right, y_top, y_bottom = flat[0][:, 0], flat[1][:, 0], flat[2][:, 1], flat[3][:, 1]
    every = np.concatenate(flat)
    pad = 0.0 if lens.is_pinhole else 0.5 / lens.focal_px  # the border is curved between the 33 points
    outer = (every[:, 0].min() - pad, every[:, 0].max() + pad, every[:, 1].min() - pad, every[:, 1].max() + pad)
    inner = (x_left.max() + pad, x_right.min() - pad, y_top.max() + pad, y_bottom.min() - pad)
    r2 = max(inner[0] ** 2, inner[1] ** 2) + max(inner[2] ** 2, inner[3] ** 2)
    radii = np.linspace(0.0, r2, 50)
    if folds(lens, radii).any():
        inner = (1.0, -1.0, 1.0, -1.0)  # folds inside: no box can be trusted, test every pixel
        radii = np.linspace(0.0, 16.0, 1601)
        fold = float(np.sqrt(radii[folds(lens, radii).argmax()]))
        outer = (-fold, fold, -fold, fold)
    numbers = (lens.focal_px, lens.k1, lens.k2, lens.k3, u, v, low, right, low, bottom, *outer, *inner)
    return tuple(float(x) for x in numbers)
