"""How far colours are apart for people who lack one kind of cones."""

from itertools import combinations

import numpy as np

# Linear RGB as seen with normal vision, and without red, green and blue cones: Machado, Oliveira and Fernandes (2009),
# "A physiologically-based model for simulation of color vision deficiency", severity 1.0.
SEEN = {
    "normal": np.eye(3),
    "without red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "without green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "without blue": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}
XYZ = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
WHITE = [0.95047, 1.0, 1.08883]


def rgb_of(text):
    """The values 0 to 255 of "#rrggbb"."""
    return tuple(int(text[k : k + 2], 16) for k in (1, 3, 5))


def lab(rgb, seen):
    """CIE L*a*b* (D65) of a colour, values 0 to 255, as it is seen."""
    values = np.array(rgb) / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    x = np.array(XYZ) @ np.clip(np.array(seen) @ linear, 0.0, 1.0) / WHITE
    f = np.where(x > 0.008856, np.cbrt(x), 7.787 * x + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def least_difference(colours):
    """The least difference (CIE 1976) of two of these colours in any vision."""
    seen = [[lab(rgb, matrix) for rgb in colours] for matrix in SEEN.values()]
    return min(float(np.linalg.norm(a - b)) for labs in seen for a, b in combinations(labs, 2))
