"""Pictures made ready for sampling: reduced where the map is coarser, packed into one word per pixel."""

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Bytes


def reduction(gsd_m: float, picture_gsd_m: float) -> int:
    """How many picture pixels per side to average into one, so that a coarser map does not alias fine texture.

    gsd_m: the map's ground pixel. picture_gsd_m: the picture's ground pixel at nadir.
    """
    return max(1, int(gsd_m / picture_gsd_m + 0.25))


def reduced(picture: Bytes, factor: int) -> tuple[Bytes, int]:
    """A picture (H, W, C) averaged over blocks of factor x factor, and the factor used (less for tiny pictures).

    Column u of the picture becomes (u + 0.5) / factor - 0.5.
    """
    factor = bearable(factor, min(picture.shape[:2]))
    height, width = picture.shape[0] // factor, picture.shape[1] // factor
    return reduced_exactly(picture[: height * factor, : width * factor], factor), factor


def bearable(factor: int, side: int) -> int:
    """A factor by which a picture is to be reduced, or less where its shorter side is too short for it."""
    while factor > 1 and side // factor < 8:
        factor //= 2
    return max(factor, 1)


def reduced_exactly(pixels: Bytes, factor: int) -> Bytes:
    """Pixels (H, W, C) averaged over blocks of factor x factor, which divides H and W."""
    import cv2

    if factor == 1:
        return pixels
    size = (pixels.shape[1] // factor, pixels.shape[0] // factor)
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))


def pack(picture: Bytes, factor: int = 1) -> tuple[NDArray[np.uint32], int]:
    """A picture as one uint32 per pixel (R, G, B, 255 in memory order), reduced, and the factor used.

    picture: uint8 (H, W, 3), or (H, W, 4) with alpha 255. factor: see `reduced`.
    """
    import cv2

    picture, factor = reduced(picture, factor)
    if picture.shape[2] == 3:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA))
    return np.ascontiguousarray(picture).view(np.uint32)[..., 0], factor
