"""Objects stamped into a scene's arrays: buildings, trees, cars.

Positions in metres: X = easting - west, Y = north - northing (rows grow downwards); angles turn X towards Y.
"""

import numpy as np

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.twin.city.procedural_noise import hash01, lattice
from orthoswarm.twin.city.scene import CAR, CELL_M, ROOF, TEXEL_M, TREE

FLAT, GABLE, HIP, DOME = range(4)


@in_place_kernel
def _roof_rise(shape, lu, lv, hu, hv):  # type: ignore[no-untyped-def]
    """Height of a roof over its eaves, 0 to 1, at a local position."""
    if shape == GABLE:
        return 1.0 - abs(lv) / hv
    if shape == HIP:
        return max(0.0, min(1.0 - abs(lv) / hv, (hu - abs(lu)) / hv))
    if shape == DOME:
        return np.sqrt(max(0.0, 1.0 - (lu / hu) ** 2 * 0.9))
    return 0.0


@in_place_kernel
def stamp_building(  # type: ignore[no-untyped-def]
    albedo, kind, dsm, wall, facade, x, y, angle, hu, hv, base, eave, rise, shape, color, wall_color, windows, seed
):
    """A rectangular building: half sides hu (along the ridge) and hv, walls up to base + eave, then the roof."""
    ca, sa = np.cos(angle), np.sin(angle)
    reach = np.sqrt(hu * hu + hv * hv) + 1.0
    rows, cols = kind.shape
    for r in range(max(0, int((y - reach) / TEXEL_M)), min(rows, int((y + reach) / TEXEL_M) + 1)):
        for c in range(max(0, int((x - reach) / TEXEL_M)), min(cols, int((x + reach) / TEXEL_M) + 1)):
            dx, dy = (c + 0.5) * TEXEL_M - x, (r + 0.5) * TEXEL_M - y
            lu, lv = dx * ca + dy * sa, dy * ca - dx * sa
            if abs(lu) > hu or abs(lv) > hv:
                continue
            kind[r, c] = ROOF
            if shape == FLAT:
                edge = min(hu - abs(lu), hv - abs(lv))
                shade = 14.0 * lattice(lu / 3.5, lv / 3.5, seed) + 9.0 * (
                    2.0 * hash01(int(lu / 4.0), int(lv / 4.0), seed) - 1
                )
                if edge < 0.5:
                    shade += 28.0
                elif edge < 0.9:
                    shade -= 30.0
            else:
                course = int(np.floor(lv / 0.45)) * 31 + int(np.floor(lu / 0.9)) * 17
                shade = 13.0 * (2.0 * hash01(course, seed, 7) - 1.0) + 12.0 * lattice(lu / 2.0, lv / 2.0, seed)
                if shape == GABLE and abs(lv) < 0.3:
                    shade += 22.0
            shade += 8.0 * (2.0 * hash01(r, c, seed) - 1.0)
            for b in range(3):
                albedo[r, c, b] = min(max(color[b] + shade, 0.0), 255.0)
    rows, cols = dsm.shape
    for r in range(max(0, int((y - reach) / CELL_M)), min(rows, int((y + reach) / CELL_M) + 1)):
        for c in range(max(0, int((x - reach) / CELL_M)), min(cols, int((x + reach) / CELL_M) + 1)):
            dx, dy = (c + 0.5) * CELL_M - x, (r + 0.5) * CELL_M - y
            lu, lv = dx * ca + dy * sa, dy * ca - dx * sa
            if abs(lu) > hu or abs(lv) > hv:
                continue
            z = base + eave + rise * _roof_rise(shape, lu, lv, hu, hv)
            if z > dsm[r, c]:
                dsm[r, c] = z
                facade[r, c] = windows
                for b in range(3):
                    wall[r, c, b] = wall_color[b]


@in_place_kernel
def _crown(dx, dy, radius, height, seed):  # type: ignore[no-untyped-def]
    """Height of a ragged tree crown over the ground at an offset from the trunk; negative outside."""
    ragged = radius * (1.0 + 0.18 * lattice(dx / (0.5 * radius) + 31.0, dy / (0.5 * radius), seed))
    d2 = (dx * dx + dy * dy) / (ragged * ragged)
    if d2 >= 1.0:
        return -1.0
    return height * (0.45 + 0.55 * np.sqrt(1.0 - d2)) * (1.0 + 0.10 * lattice(dx / 0.9, dy / 0.9, seed + 5))


@in_place_kernel
def stamp_tree(albedo, kind, dsm, dtm, wall, facade, x, y, radius, height, color, seed):  # type: ignore[no-untyped-def]
    """A tree: a ragged dome of leaves with clumps, over the ground at its foot."""
    rows, cols = dsm.shape
    base = dtm[min(max(int(y / CELL_M), 0), rows - 1), min(max(int(x / CELL_M), 0), cols - 1)]
    reach = radius * 1.2
    for r in range(max(0, int((y - reach) / TEXEL_M)), min(kind.shape[0], int((y + reach) / TEXEL_M) + 1)):
        for c in range(max(0, int((x - reach) / TEXEL_M)), min(kind.shape[1], int((x + reach) / TEXEL_M) + 1)):
            dx, dy = (c + 0.5) * TEXEL_M - x, (r + 0.5) * TEXEL_M - y
            h = _crown(dx, dy, radius, height, seed)
            if h < 0.0 or base + h < dsm[r // 2, c // 2]:
                continue
            kind[r, c] = TREE
            shade = 22.0 * lattice(dx / 0.8, dy / 0.8, seed + 1) + 16.0 * (2.0 * hash01(r, c, seed) - 1.0)
            shade -= 22.0 * (1.0 - h / height)
            for b in range(3):
                albedo[r, c, b] = min(max(color[b] + shade * (0.7 if b == 2 else 1.0), 0.0), 255.0)
    for r in range(max(0, int((y - reach) / CELL_M)), min(rows, int((y + reach) / CELL_M) + 1)):
        for c in range(max(0, int((x - reach) / CELL_M)), min(cols, int((x + reach) / CELL_M) + 1)):
            h = _crown((c + 0.5) * CELL_M - x, (r + 0.5) * CELL_M - y, radius, height, seed)
            if h > 0.0 and base + h > dsm[r, c]:
                dsm[r, c] = base + h
                facade[r, c] = 0
                for b in range(3):
                    wall[r, c, b] = color[b] * 0.55


@in_place_kernel
def stamp_car(albedo, kind, dsm, dtm, wall, facade, x, y, angle, length, color):  # type: ignore[no-untyped-def]
    """A car: a box of 1.5 m with dark windows; nothing is drawn where something already stands."""
    ca, sa = np.cos(angle), np.sin(angle)
    rows, cols = dsm.shape
    row, col = min(max(int(y / CELL_M), 0), rows - 1), min(max(int(x / CELL_M), 0), cols - 1)
    base = dtm[row, col]
    if dsm[row, col] > base + 0.5:
        return
    hu, hv, reach = 0.5 * length, 0.95, 0.5 * length + 1.0
    for r in range(max(0, int((y - reach) / TEXEL_M)), min(kind.shape[0], int((y + reach) / TEXEL_M) + 1)):
        for c in range(max(0, int((x - reach) / TEXEL_M)), min(kind.shape[1], int((x + reach) / TEXEL_M) + 1)):
            dx, dy = (c + 0.5) * TEXEL_M - x, (r + 0.5) * TEXEL_M - y
            lu, lv = (dx * ca + dy * sa) / hu, (dy * ca - dx * sa) / hv
            if abs(lu) > 1.0 or abs(lv) > 1.0:
                continue
            kind[r, c] = CAR
            glass = 0.22 < lu < 0.48 or -0.8 < lu < -0.58
            for b in range(3):
                albedo[r, c, b] = 35 if glass else color[b]
    for r in range(max(0, int((y - reach) / CELL_M)), min(rows, int((y + reach) / CELL_M) + 1)):
        for c in range(max(0, int((x - reach) / CELL_M)), min(cols, int((x + reach) / CELL_M) + 1)):
            dx, dy = (c + 0.5) * CELL_M - x, (r + 0.5) * CELL_M - y
            lu, lv = dx * ca + dy * sa, dy * ca - dx * sa
            if abs(lu) <= hu and abs(lv) <= hv and dsm[r, c] < base + 1.0:
                dsm[r, c] = base + (1.5 if -0.7 * hu < lu < 0.45 * hu else 1.0)
                facade[r, c] = 0
                for b in range(3):
                    wall[r, c, b] = color[b] * 0.6
