"""The kernel that enters one picture's footprint into a grid of cells."""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel

UNSEEN = 255  # value of `best` in a cell that no picture sees
_EDGE, _OBLIQUE, _COARSE = 1, 2, 64


@in_place_kernel
def _count(flaws):  # type: ignore[no-untyped-def]
    """Number of set bits."""
    number = 0
    while flaws > 0:
        number += flaws & 1
        flaws >>= 1
    return number


@in_place_kernel
def paint(best, good, height, level, box, edges, camera, position, lens, quality):  # type: ignore[no-untyped-def]
    """Enter a view into the cells of a box; returns how many cells it sees well.

    Args:
        best: uint8 (rows, columns), flaws of the best view so far, UNSEEN where there is none; changed.
        good: uint16 (rows, columns), number of views without a flaw; changed.
        height: float32, ground at the cells from `box[4]`, `box[5]` on; (1, 1) for level ground.
        level: the ground's height if it is level.
        box: first row, row behind the last, first column, column behind the last, of the cells; row and column of the
            cell to which the first element of `height` belongs. edges: west, north of the grid, side of a cell, metres.
        camera: float64 (3, 3), View.to_camera. position: float64 (3,).
        lens: focal length in pixels, k1, k2, k3, principal point (2), columns, rows, largest undistorted radius.
        quality: two sigma in metres, two sigma of the focal length (relative), flaws of the picture, coarsest ground
            pixel allowed in metres (0: any), least descent of a ray that is not oblique, and of one that sees at all.
    """
    focal, k1, k2, k3, cu, cv, columns, rows, reach = lens
    sigma, focal_sigma, picture_flaws, coarsest, cos_oblique, cos_flattest = quality
    seen = 0
    flat = height.shape[0] == 1 and height.shape[1] == 1
    for r in range(box[0], box[1]):
        north = edges[1] - (r + 0.5) * edges[2] - position[1]
        for c in range(box[2], box[3]):
            east = edges[0] + (c + 0.5) * edges[2] - position[0]
            up = (level if flat else height[r - box[4], c - box[5]]) - position[2]
            depth = camera[2, 0] * east + camera[2, 1] * north + camera[2, 2] * up
            if depth <= 0.0 or up >= 0.0:
                continue
            x = (camera[0, 0] * east + camera[0, 1] * north + camera[0, 2] * up) / depth
            y = (camera[1, 0] * east + camera[1, 1] * north + camera[1, 2] * up) / depth
            r2 = x * x + y * y
            if r2 > reach * reach:
                continue
            stretch = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            u, v = focal * x * stretch, focal * y * stretch
            inside = min(min(cu + u + 0.5, columns - 0.5 - cu - u), min(cv + v + 0.5, rows - 0.5 - cv - v))
            if inside < 0.0:
                continue
            descent = -up / np.sqrt(east * east + north * north + up * up)
            if descent < cos_flattest:
                continue
            flaws = int(picture_flaws)
            along = focal_sigma * np.sqrt(u * u + v * v)
            place = (sigma + 0.5 * edges[2]) * focal / depth
            if inside * inside < along * along + place * place:
                flaws |= _EDGE
            if descent < cos_oblique:
                flaws |= _OBLIQUE
            if coarsest > 0.0 and depth > coarsest * focal:
                flaws |= _COARSE
            if flaws == 0:
                good[r, c] = min(65535, good[r, c] + 1)
                best[r, c] = 0
                seen += 1
            elif best[r, c] == UNSEEN or (best[r, c] > 0 and _count(flaws) < _count(np.int64(best[r, c]))):
                best[r, c] = flaws
    return seen
