"""Pictures made ready for sampling: reduced where the map is coarser, packed into one word per pixel."""

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]


def reduction(gsd_m: float, picture_gsd_m: float) -> int:
    """How many picture pixels per side to average into one, so that a coarser map does not alias fine texture.

    Args:
        gsd_m: the map's ground pixel.
        picture_gsd_m: the picture's ground pixel at nadir.
    """
    return max(1, int(gsd_m / picture_gsd_m + 0.25))


def reduced(picture: Bytes, factor: int) -> tuple[Bytes, int]:
    """A picture (H, W, C) averaged over blocks of factor x factor, and the factor used (less for tiny pictures).

    Column u of the picture becomes (u + 0.5) / factor - 0.5.
    """
    import cv2

    while factor > 1 and min(picture.shape[:2]) // factor < 8:
        factor //= 2
    if factor <= 1:
        return picture, 1
    height, width = picture.shape[0] // factor, picture.shape[1] // factor
    cropped = picture[: height * factor, : width * factor]
    return np.asarray(cv2.resize(cropped, (width, height), interpolation=cv2.INTER_AREA)), factor


def pack(picture: Bytes, factor: int = 1) -> tuple[NDArray[np.uint32], int]:
    """A picture as one uint32 per pixel (R, G, B, 255 in memory order), reduced, and the factor used.

    Args:
        picture: uint8 (H, W, 3), or (H, W, 4) with alpha 255.
        factor: see `reduced`.
    """
    import cv2

    picture, factor = reduced(picture, factor)
    if picture.shape[2] == 3:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2RGBA))
    return np.ascontiguousarray(picture).view(np.uint32)[..., 0], factor
