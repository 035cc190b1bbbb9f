"""Disasters between the map and the flight: debris flow, waterlogging, haze (paper IV.A), collapsed buildings."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Flags, Floats
from orthoswarm.twin.city import scene as kinds
from orthoswarm.twin.city.procedural_noise import hash01, lattice, noise_field
from orthoswarm.twin.city.scene import CELL_M, TEXEL_M, Scene
from orthoswarm.twin.ray_marching import HAZE_CELL_M

SIZES_M = {"debris": (400.0, 880.0), "water": (330.0, 320.0), "haze": (440.0, 190.0)}
"""Extent of each disaster across and along, metres (paper IV.A)."""

_GONE: Final = 0.16  # share of the houses that are gone
_TORN: Final = 0.1  # share whose roofs are torn open
_FALLS_M: Final = 14.0  # higher buildings stand
_FALLS_M2: Final = (30.0, 700.0)


@dataclass(frozen=True, slots=True)
class DamagedGround:
    """An irregular patch of ground."""

    east: float  # easting of its centre
    north: float  # northing
    across_m: float  # its extent at right angles to its axis
    along_m: float  # along it
    angle_rad: float  # direction of its axis, anticlockwise from east


def zone_depth(scene: Scene, zone: DamagedGround, step: int, seed: int) -> Floats:
    """Signed distance of each cell from a zone's ragged edge, metres, positive inside; float32 (rows, columns).

    Args:
        scene: gives the grid. zone: the patch of ground. step: side of a cell of the result, in texels.
        seed: of the ragged edge.
    """
    rows, cols = scene.grid.height // step, scene.grid.width // step
    cell = TEXEL_M * step
    east = scene.grid.west + (np.arange(cols, dtype=np.float32) + 0.5) * cell - zone.east
    north = scene.grid.north - (np.arange(rows, dtype=np.float32) + 0.5) * cell - zone.north
    ca, sa = np.cos(zone.angle_rad), np.sin(zone.angle_rad)
    along = np.abs(east[None, :] * ca + north[:, None] * sa) / (0.5 * zone.along_m)
    across = np.abs(north[:, None] * ca - east[None, :] * sa) / (0.5 * zone.across_m)
    # a rounded rectangle: the fourth-power norm fills the stated extent and has no corners
    norm = (along**4 + across**4) ** 0.25
    ragged = noise_field((rows, cols), cell, 0.3 * min(zone.across_m, zone.along_m), 4, seed)
    return np.asarray((1.0 - norm) * 0.5 * min(zone.across_m, zone.along_m) + 14.0 * ragged, np.float32)


@in_place_kernel
def _wreckage(x, y, seed, piece):  # type: ignore[no-untyped-def]
    """Wreckage on the mud at x, y: piece[0] its height, piece[1:4] its colour; False where there is only mud.

    Boards, fragments of roofs and boulders, one candidate in each cell of 4 m, any direction.
    """
    size = 4.0
    ci, cj = int(np.floor(x / size)), int(np.floor(y / size))
    piece[0] = 0.0
    for i in range(ci - 1, ci + 2):
        for j in range(cj - 1, cj + 2):
            kind = hash01(i, j, seed)
            if kind > 0.72:
                continue
            dx = x - (i + hash01(i, j, seed + 1)) * size
            dy = y - (j + hash01(i, j, seed + 2)) * size
            big, tone = hash01(i, j, seed + 3), hash01(i, j, seed + 4)
            if kind < 0.2:  # a boulder
                radius = 0.35 + 1.5 * big * big
                d = (dx * dx + dy * dy) / (radius * radius)
                h = 1.1 * radius * np.sqrt(max(0.0, 1.0 - d))
                if d < 1.0 and h > piece[0]:
                    grey = 88.0 + 80.0 * tone + 20.0 * lattice(x / 0.6, y / 0.6, seed + 9)
                    piece[0], piece[1], piece[2], piece[3] = h, grey, 0.97 * grey, 0.92 * grey
                continue
            turn = 3.1416 * hash01(i, j, seed + 5)
            u, v = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
            long, wide = 0.6 + 2.6 * big, 0.12 + 0.25 * tone
            if kind >= 0.5:
                long, wide = 0.4 + 2.0 * big * big, 0.3 + 1.4 * tone * big
            if abs(u) > long or abs(v) > wide or 0.25 + 0.5 * big < piece[0]:
                continue
            piece[0] = 0.25 + 0.5 * big
            paint = hash01(i, j, seed + 6)
            if kind < 0.5:  # timber
                piece[1], piece[2], piece[3] = 120.0 + 90.0 * paint, 104.0 + 84.0 * paint, 84.0 + 76.0 * paint
            elif paint < 0.4:
                piece[1], piece[2], piece[3] = 150.0, 84.0, 66.0
            elif paint < 0.6:
                piece[1], piece[2], piece[3] = 86.0, 98.0, 118.0
            else:
                piece[1], piece[2], piece[3] = 190.0 * paint + 30.0, 188.0 * paint + 28.0, 184.0 * paint + 24.0
    return piece[0] > 0.0


@kernel
def _bury(albedo, kind, dsm, dtm, wall, facade, depth, flow_x, flow_y, seed):  # type: ignore[no-untyped-def]
    """Rubble and mud on every cell of positive depth: heights 0 to 3 m, streaks along the flow."""
    rows, cols = dsm.shape
    piece = np.zeros(4)
    for r in range(rows):
        for c in range(cols):
            if depth[r, c] <= 0.0:
                continue
            top = 0.0
            for k in range(4):
                rr, cc = 2 * r + (k >> 1), 2 * c + (k & 1)
                x, y = cc * TEXEL_M, rr * TEXEL_M
                # distort the coordinates, so that the pattern does not line up with the grid
                x += 4.0 * lattice(x / 21.0, y / 21.0, seed + 11)
                y += 4.0 * lattice(x / 21.0 + 7.3, y / 21.0, seed + 12)
                u, v = x * flow_x + y * flow_y, y * flow_x - x * flow_y
                p, q = 0.83 * x + 0.56 * y, 0.83 * y - 0.56 * x
                swell = 0.5 + 0.5 * lattice(u / 46.0, v / 15.0, seed)
                rough = lattice(p / 5.5, q / 5.5, seed + 1)
                h = 1.3 * swell + 0.5 * rough + 0.25 * lattice(q / 1.9, p / 1.9, seed + 2)
                tone = 104.0 + 30.0 * (swell - 0.5) + 18.0 * rough + 22.0 * lattice(u / 30.0, v / 2.4, seed + 3)
                tone += 12.0 * (2.0 * hash01(cc, rr, seed) - 1.0) + 17.0 * lattice(p / 0.9, q / 0.9, seed + 4)
                tone += 16.0 * lattice(q / 2.7, p / 2.7, seed + 5)
                wet = max(0.0, lattice(p / 33.0, q / 33.0, seed + 6) - 0.3)
                red, green, blue = tone * (1.05 - 0.5 * wet), tone * (0.93 - 0.4 * wet), tone * (0.79 - 0.3 * wet)
                if _wreckage(x, y, seed + 20, piece):
                    h += piece[0]
                    mud = 0.35 * (tone - 104.0)
                    red, green, blue = piece[1] + mud, piece[2] + mud, piece[3] + mud
                kind[rr, cc] = kinds.RUBBLE
                albedo[rr, cc, 0] = min(max(red, 0.0), 255.0)
                albedo[rr, cc, 1] = min(max(green, 0.0), 255.0)
                albedo[rr, cc, 2] = min(max(blue, 0.0), 255.0)
                top = max(top, h)
            top = min(3.0, max(0.0, top)) * min(1.0, depth[r, c] / 9.0)
            dsm[r, c] = dtm[r, c] + top
            facade[r, c] = 0
            for i in range(3):
                wall[r, c, i] = 0.7 * albedo[2 * r, 2 * c, i]


def debris_flow(scene: Scene, zone: DamagedGround, seed: int) -> None:
    """Bury a zone under 0 to 3 m of rubble, in place; buildings inside it disappear."""
    depth = zone_depth(scene, zone, 2, seed * 13 + 1)
    _bury(
        scene.albedo, scene.kind, scene.dsm, scene.dtm, scene.wall, scene.facade, depth,
        float(np.cos(zone.angle_rad)), float(-np.sin(zone.angle_rad)), seed * 17 + 3,
    )  # fmt: skip


def collapse(scene: Scene, seed: int) -> None:
    """Make buildings all over the scene rubble, in place: some are gone, of others a part of the roof is torn open.

    What is hit is of kind RUBBLE afterwards; houses only, since towers and halls rarely fall (_FALLS_M, _FALLS_M2).
    """
    import cv2

    above = scene.above_ground()
    roof = (scene.kind[::2, ::2] == kinds.ROOF) & (above > 2.0)
    count, house, stats, _ = cv2.connectedComponentsWithStats(roof.astype(np.uint8), connectivity=4)
    rng = np.random.default_rng([seed, 37])
    depth, floor = np.full(roof.shape, -1.0, np.float32), scene.dtm.copy()
    ragged = noise_field(roof.shape, CELL_M, 3.0, 2, seed * 13 + 5)
    for k in range(1, count):
        chance, turn, cut = rng.random(), rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.1, 0.45)
        left, top, width, height, cells = (int(v) for v in stats[k])
        window = np.s_[max(top - 4, 0) : top + height + 4, max(left - 4, 0) : left + width + 4]
        own = house[window] == k
        tall = float(above[window][own].max())
        if not _FALLS_M2[0] <= cells * CELL_M**2 <= _FALLS_M2[1] or tall > _FALLS_M or chance > _GONE + _TORN:
            continue
        if chance < _GONE:  # rubble lies up to two metres around the walls
            beside = cv2.distanceTransform((~own).astype(np.uint8), cv2.DIST_L2, 3) * CELL_M
            hit = (beside < 1.2 + 0.8 * ragged[window]) & (own | (above[window] < 1.0))
            depth[window][hit] = 9.0
            continue
        rows, columns = np.indices(own.shape)
        side = columns * np.cos(turn) + rows * np.sin(turn) + 3.0 * ragged[window]
        hit = own & (side > np.quantile(side[own], cut))
        depth[window][hit] = 9.0
        floor[window][hit] += 0.45 * tall
    _bury(scene.albedo, scene.kind, scene.dsm, floor, scene.wall, scene.facade, depth, 1.0, 0.0, seed * 17 + 7)


def flood(scene: Scene, zone: DamagedGround, seed: int) -> None:
    """Flood a zone with muddy water, whose only texture is moving glints, in place; the water is at ground level."""
    depth = zone_depth(scene, zone, 2, seed * 13 + 2)
    wet = depth > 0.0
    scene.dsm[wet] = scene.dtm[wet]
    scene.facade[wet] = 0
    scene.wall[wet] = (104, 92, 72)
    fine = np.repeat(np.repeat(wet, 2, axis=0), 2, axis=1)
    scene.kind[fine] = kinds.WATER
    scene.albedo[fine] = (104, 94, 74)


def haze_opacity(scene: Scene, zone: DamagedGround, seed: int) -> Floats:
    """Opacity of white haze over a zone, float32 on HAZE_CELL_M cells, 0 outside, about 0.65 inside."""
    depth = zone_depth(scene, zone, int(HAZE_CELL_M / TEXEL_M), seed * 13 + 3)
    return np.asarray(0.66 * np.clip((depth + 6.0) / 26.0, 0.0, 1.0), np.float32)


def zone_mask(scene: Scene, zone: DamagedGround, disaster: str, seed: int) -> Flags:
    """Cells of the height fields that a disaster (of SIZES_M, or "collapse") has struck, bool."""
    if disaster == "collapse":
        return np.asarray(scene.kind[::2, ::2] == kinds.RUBBLE)
    salt = {"debris": 1, "water": 2, "haze": 3}[disaster]
    return np.asarray(zone_depth(scene, zone, 2, seed * 13 + salt) > 0.0)
