"""Procedural noise from hashed lattices: detailed texture that never repeats and depends only on the seed."""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Floats


@in_place_kernel
def hash01(x, y, seed):  # type: ignore[no-untyped-def]
    """A number in [0, 1) that looks random but depends only on two integers and a seed."""
    h = (x * 374761393 + y * 668265263 + seed * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 2246822519) & 0xFFFFFFFF
    h ^= h >> 16
    return h * 2.3283064365386963e-10


@in_place_kernel
def lattice(x, y, seed):  # type: ignore[no-untyped-def]
    """Smooth value noise in [-1, 1] with a feature size of one unit."""
    xi, yi = np.int64(np.floor(x)), np.int64(np.floor(y))
    fx, fy = x - xi, y - yi
    fx, fy = fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy)
    a, b = hash01(xi, yi, seed), hash01(xi + 1, yi, seed)
    c, d = hash01(xi, yi + 1, seed), hash01(xi + 1, yi + 1, seed)
    top, low = a + (b - a) * fx, c + (d - c) * fx
    return 2.0 * (top + (low - top) * fy) - 1.0


@in_place_kernel
def _fill(out, step, scale, octaves, seed):  # type: ignore[no-untyped-def]
    rows, cols = out.shape
    for r in range(rows):
        for c in range(cols):
            total, weight, s, norm = 0.0, 1.0, scale, 0.0
            for k in range(octaves):
                total += weight * lattice(c * step / s, r * step / s, seed + k)
                norm += weight
                weight *= 0.55
                s *= 0.47
            out[r, c] = total / norm


def noise_field(shape: tuple[int, int], step_m: float, scale_m: float, octaves: int, seed: int) -> Floats:
    """Fractal noise, float32 of `shape`, about -1 to 1.

    Args:
        shape: rows, columns. step_m: side of a cell.
        scale_m: size of the largest features; each further octave is about half of it. octaves: how many.
        seed: of the noise.
    """
    out = np.empty(shape, np.float32)
    _fill(out, step_m, scale_m, octaves, seed)
    return out


@in_place_kernel
def add_detail(albedo, kind, amplitude, tint, seed):  # type: ignore[no-untyped-def]
    """Add fine texture to colours in place: five octaves (0.25, 0.7, 2.3, 9, 45 m) with amplitudes per kind.

    albedo uint8 (R, C, 3), kind uint8 (R, C), amplitude float32 (kinds, 5) in grey values, tint float32 (kinds, 3):
    factor of the two coarsest octaves for each colour band.
    """
    rows, cols = kind.shape
    for r in range(rows):
        for c in range(cols):
            k = kind[r, c]
            x, y = c * 0.25, r * 0.25
            fine = amplitude[k, 0] * (2.0 * hash01(c, r, seed) - 1.0)
            if amplitude[k, 1] > 0.0:
                fine += amplitude[k, 1] * lattice(x / 0.7, y / 0.7, seed + 1)
            if amplitude[k, 2] > 0.0:
                fine += amplitude[k, 2] * lattice(x / 2.3, y / 2.3, seed + 2)
            coarse = 0.0
            if amplitude[k, 3] > 0.0:
                coarse += amplitude[k, 3] * lattice(x / 9.0, y / 9.0, seed + 3)
            if amplitude[k, 4] > 0.0:
                coarse += amplitude[k, 4] * lattice(x / 45.0, y / 45.0, seed + 4)
            for b in range(3):
                v = albedo[r, c, b] + fine + coarse * tint[k, b]
                albedo[r, c, b] = min(max(v, 0.0), 255.0)
