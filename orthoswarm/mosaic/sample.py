"""The compiled sampling of the renderer: colours of one picture into the pixels of a tile that it owns."""

import numpy as np

from orthoswarm.kernels import kernel
from orthoswarm.mosaic.lattice import height_at, project


@kernel
def _cubic(t):  # type: ignore[no-untyped-def]
    """Weights of cubic convolution (Keys 1981, a = -1/2) at -1, 0, 1, 2 for a fraction t."""
    return (
        t * (np.float32(-0.5) + t * (np.float32(1.0) - np.float32(0.5) * t)),
        np.float32(1.0) + t * t * (np.float32(1.5) * t - np.float32(2.5)),
        t * (np.float32(0.5) + t * (np.float32(2.0) - np.float32(1.5) * t)),
        t * t * (np.float32(0.5) * t - np.float32(0.5)),
    )


@kernel
def sample(rgba, label, mark, window, position, rotation, lens, lattice, gsd, picture, factor, gain):  # type: ignore[no-untyped-def]
    """Colour a tile's pixels of one label from a picture by bicubic interpolation; gives their number.

    Args:
        rgba: uint8 (T, T, 4), changed in place.
        label: int32 (T, T).
        mark: the label.
        window: int32 (4,), row0, row1, col0, col1 that hold the label.
        position: float64 (3,), the camera in the tile's frame, see lattice.Shots.about.
        rotation: float64 (3, 3), ground to camera.
        lens: float64 (18,), see lattice.
        lattice: float32, the tile's heights.
        gsd: ground pixel, metres.
        picture: uint8 (H, W, 3).
        factor: by which the picture was reduced.
        gain: float32 (3,), multiplies the colours.
    """
    height, width = picture.shape[0], picture.shape[1]
    shrink = 1.0 / factor
    low, top, half = np.float32(0.0), np.float32(255.0), np.float32(0.5)
    g0, g1, g2 = gain[0], gain[1], gain[2]
    count = 0
    for r in range(window[0], window[1]):
        for c in range(window[2], window[3]):
            if label[r, c] != mark:
                continue
            z = height_at(lattice, r, c)
            u, v = project(position, rotation, lens, (c + 0.5) * gsd, (r + 0.5) * gsd, z)
            u, v = (u + 0.5) * shrink - 0.5, (v + 0.5) * shrink - 0.5
            u, v = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
            i, j = min(int(v), height - 2), min(int(u), width - 2)
            weights_x, weights_y = _cubic(np.float32(u - j)), _cubic(np.float32(v - i))
            red, green, blue = low, low, low
            for a in range(4):
                y = min(max(i + a - 1, 0), height - 1)
                sub_r, sub_g, sub_b = low, low, low
                for b in range(4):
                    x = min(max(j + b - 1, 0), width - 1)
                    w = weights_x[b]
                    sub_r += w * np.float32(picture[y, x, 0])
                    sub_g += w * np.float32(picture[y, x, 1])
                    sub_b += w * np.float32(picture[y, x, 2])
                red += weights_y[a] * sub_r
                green += weights_y[a] * sub_g
                blue += weights_y[a] * sub_b
            rgba[r, c, 0] = np.uint8(min(max(red * g0, low), top) + half)
            rgba[r, c, 1] = np.uint8(min(max(green * g1, low), top) + half)
            rgba[r, c, 2] = np.uint8(min(max(blue * g2, low), top) + half)
            rgba[r, c, 3] = np.uint8(255)
            count += 1
    return count
