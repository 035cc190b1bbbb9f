"""Compiled search of patches: all ties of one picture with the map, or of one picture with others, in one call."""

import numpy as np

from orthoswarm.compute.jit import kernel
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, project_point
from orthoswarm.refine.features.patch_matching import (
    gradients,
    locate,
    locate_wanted,
    promising_blocks,
    rectify,
    template_of,
    window_of,
)
from orthoswarm.refine.features.shift_products import ROWS


@kernel
def search_map(  # type: ignore[no-untyped-def]
    position, rotation, lens, gray, place, pixel, ground, valid, gsd, half, reach, texture, floor, exclude,
    window_share, patch_share, wide, share, found,
):  # fmt: skip
    """Find the surroundings of K points of one picture on the map.

    Args:
        position, rotation, lens: of the picture, (3,), (3, 3), (8,). gray: uint8, the picture.
        place: float64 (K, 3), centre of each patch on the map's lattice, and the height on which it is rectified.
        pixel: int64 (K, 2), the same in rows and columns of the map.
        ground, valid: uint8 and bool (rows, columns), the map. gsd: its pixel, metres.
        half, reach: half the patch and the search, pixels. texture, floor: see `gradients`. exclude: see `locate`.
        window_share, patch_share: least share of the window that the map, of the patch that the picture shows.
        wide, share: searches of more than so many pixels look first at half size, see `promising_blocks`.
        found: float64 (K, 4) out, column and row of the shift, peak, second peak; peak 0 where there is none.
    """
    patch = np.empty((2 * half + 3, 2 * half + 3), np.float32)
    around = half + reach + 1
    size = 2 * around + 1
    seen = np.empty((size, size), np.float32)
    template, window = template_of(half), window_of(half, reach)
    for k in range(len(place)):
        found[k] = 0.0
        row, column = pixel[k, 0] - around, pixel[k, 1] - around
        if row < 0 or column < 0 or row + size > ground.shape[0] or column + size > ground.shape[1]:
            continue
        known = 0
        for r in range(size):
            values, counts, to = ground[row + r], valid[row + r], seen[r]
            for c in range(size):
                known += counts[column + c]
                to[c] = values[column + c] if counts[column + c] else np.nan
        if known < window_share * size * size:
            continue
        shown = rectify(position, rotation, lens, gray, place[k, 0], place[k, 1], place[k, 2], gsd, half + 1, patch)
        if shown < patch_share:
            continue
        gradients(patch, texture, floor, template, ROWS - 1)
        gradients(seen, texture, floor, window, 0)
        if reach > wide:
            wanted = promising_blocks(patch, seen, reach, texture, floor, share)
            found[k, 0], found[k, 1], found[k, 2], found[k, 3] = locate_wanted(template, window, reach, exclude, wanted)
        else:
            found[k, 0], found[k, 1], found[k, 2], found[k, 3] = locate(template, window, reach, exclude)


@kernel
def templates(position, rotation, lens, gray, points, gsd, half, floor, least, fields):  # type: ignore[no-untyped-def]
    """Gradients of the surroundings of K points (K, 3) in one picture, into fields (K, ...), see `template_of`.

    The first value of what the picture shows less of than the share `least` becomes NaN.
    """
    patch = np.empty((2 * half + 3, 2 * half + 3), np.float32)
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        shown = rectify(position, rotation, lens, gray, x, y, z, gsd, half + 1, patch)
        gradients(patch, False, floor, fields[k], ROWS - 1)
        if shown < least:
            fields[k, 0, 0, 0] = np.nan


@kernel
def search_picture(  # type: ignore[no-untyped-def]
    position, rotation, lens, gray, points, fields, field, gsd, half, reach, floor, exclude, least, found
):
    """Find K patches in one picture.

    Args:
        points: float64 (K, 3), their places. fields: of `templates`. field: int64 (K,), the one of each place.
        least: least share of the window that the picture shows. The others: as in `search_map`.
        found: float64 (K, 4) out, column and row of the shift, peak, second peak; peak 0 where there is none.
    """
    around = half + reach + 1
    seen = np.empty((2 * around + 1, 2 * around + 1), np.float32)
    window = window_of(half, reach)
    for k in range(len(points)):
        found[k] = 0.0
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        if rectify(position, rotation, lens, gray, x, y, z, gsd, around, seen) < least:
            continue
        gradients(seen, False, floor, window, 0)
        found[k, 0], found[k, 1], found[k, 2], found[k, 3] = locate(fields[field[k]], window, reach, exclude)


@kernel
def views_of_other_legs(  # type: ignore[no-untyped-def]
    position, rotation, lens_id, lens, points, own_leg, leg, legs, candidates, margin, views
):
    """For each point (K, 3) the pictures of other legs that show it best, at most views.shape[1] of them.

    Of each leg the picture whose nadir is nearest, the nearest legs first.

    Args:
        own_leg: int64 (K,), the leg of each point. leg: int64 (N,), of each camera, 0 to legs - 1.
        candidates: int64 (C,), cameras that may be taken. margin: pixels between the point and their border.
        views: int64 (K, V) out, cameras; -1 where there are no more.
    """
    nearest, which = np.empty(legs), np.empty(legs, np.int64)
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        nearest[:] = np.inf
        for i in candidates:
            away = np.sqrt((position[i, 0] - x) ** 2 + (position[i, 1] - y) ** 2)
            if leg[i] == own_leg[k] or away >= nearest[leg[i]]:
                continue
            own = lens[lens_id[i]]
            u, v = project_point(position[i], rotation[i], own, x, y, z)
            if u > margin and v > margin and u < own[WIDTH] - margin and v < own[HEIGHT] - margin:
                nearest[leg[i]], which[leg[i]] = away, i
        for n in range(views.shape[1]):
            best = int(np.argmin(nearest))
            views[k, n] = which[best] if nearest[best] < np.inf else -1
            nearest[best] = np.inf
