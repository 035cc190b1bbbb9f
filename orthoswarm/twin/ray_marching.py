"""Rendering of a scene in true perspective, with facades and occlusion, by marching rays through its height field.

The height field is a set of columns with tilted tops: a ray that enters a column through its side hits the wall, a
ray from above hits the top. A table of the highest point of each 8 m tile lets rays skip empty air.
"""

from dataclasses import dataclass, replace

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Array, Bytes, Floats
from orthoswarm.model.camera import Camera, Lens
from orthoswarm.model.geo import GroundGrid
from orthoswarm.twin.city.procedural_noise import noise_field
from orthoswarm.twin.city.scene import CELL_M, TEXEL_M, TILE_CELLS, WATER, Scene

NOISE_SIDE = 1024
HAZE_CELL_M = 4.0
HAZE_HEIGHT_M = 20.0
BLOCK = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class PreparedScene:
    """A scene prepared for rendering."""

    scene: Scene  # heights and kinds
    levels: tuple[Bytes, Bytes, Bytes]  # lit colours at 0.25, 0.5 and 1 m, uint8 (rows, columns, 3) each
    tiles: Floats  # float32, highest point of each tile, plus 0.3 m for tilted tops
    sun: tuple[float, float, float]  # unit vector to the sun (columns, rows, up), for walls
    ambient: float  # light in the shade
    haze: Floats  # float32 on 4 m cells, opacity of the haze, 0 to 1; shape (0, 0) without haze
    noise: Floats  # float32 (1024, 1024), read with wrap-around, for moving glints and haze


def make_stage(
    scene: Scene, lit: Bytes, sun: tuple[float, float, float], ambient: float, haze: Floats
) -> PreparedScene:
    """Prepare a scene and its lit colours for rendering; arguments as the attributes of `PreparedScene`."""
    import cv2

    half = cv2.resize(lit, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    quarter = cv2.resize(half, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    rows, cols = scene.dsm.shape
    blocks = scene.dsm.reshape(rows // TILE_CELLS, TILE_CELLS, cols // TILE_CELLS, TILE_CELLS)
    tiles = np.ascontiguousarray(blocks.max(axis=(1, 3)) + 0.3, np.float32)
    return PreparedScene(
        scene=scene, levels=(lit, np.asarray(half), np.asarray(quarter)), tiles=tiles, sun=sun, ambient=ambient,
        haze=haze, noise=noise_field((NOISE_SIDE, NOISE_SIDE), 1.0, 48.0, 5, 4711),
    )  # fmt: skip


@in_place_kernel
def _march(dsm, tiles, ax, ay, zc, bx, by, top):  # type: ignore[no-untyped-def]
    """Follow the ray (ax, ay) + (bx, by) (zc - z), in cells, downwards from height `top` to the surface.

    Returns row and column of the cell hit, the height of the hit, and 0 for a top, 1 for a face across columns, 2 for
    one across rows; row -1 where the ray leaves the field.
    """
    eps = 1e-5
    stepx, stepy = (1.0 if bx > 0 else 0.0), (1.0 if by > 0 else 0.0)
    invx = 1.0 / bx if abs(bx) > 1e-9 else 0.0
    invy = 1.0 / by if abs(by) > 1e-9 else 0.0
    z, side = top, 0
    while True:
        px, py = ax + bx * (zc - z + eps), ay + by * (zc - z + eps)
        ti, tj = int(np.floor(py / TILE_CELLS)), int(np.floor(px / TILE_CELLS))
        if ti < 0 or tj < 0 or ti >= tiles.shape[0] or tj >= tiles.shape[1]:
            return -1, -1, 0.0, 0
        highest = tiles[ti, tj]
        leave_x = zc - ((tj + stepx) * TILE_CELLS - ax) * invx if invx != 0.0 else -1e9
        leave_y = zc - ((ti + stepy) * TILE_CELLS - ay) * invy if invy != 0.0 else -1e9
        low = max(leave_x, leave_y)
        if low > highest:  # the ray stays above everything in this tile
            z, side = min(z, low) - eps, (1 if leave_x >= leave_y else 2)
            continue
        if z > highest:
            z, side = highest, 0
            px, py = ax + bx * (zc - z + eps), ay + by * (zc - z + eps)
        first_c, first_r = tj * TILE_CELLS, ti * TILE_CELLS
        c = min(max(int(np.floor(px)), first_c), first_c + TILE_CELLS - 1)
        r = min(max(int(np.floor(py)), first_r), first_r + TILE_CELLS - 1)
        while True:
            h = dsm[r, c]
            if h >= z and side > 0:
                return r, c, z, side
            zx = zc - (c + stepx - ax) * invx if invx != 0.0 else -1e9
            zy = zc - (r + stepy - ay) * invy if invy != 0.0 else -1e9
            if h >= max(zx, zy):
                return r, c, h, 0
            if zx >= zy:
                z, side = min(z, zx), 1
                c += 1 if stepx > 0.0 else -1
            else:
                z, side = min(z, zy), 2
                r += 1 if stepy > 0.0 else -1
            if c < first_c or r < first_r or c >= first_c + TILE_CELLS or r >= first_r + TILE_CELLS:
                break


@in_place_kernel
def _slope(dsm, r, c):  # type: ignore[no-untyped-def]
    """Slope of a column's top per cell, columns and rows: the smaller one-sided difference, none across a step."""
    rows, cols = dsm.shape
    z = dsm[r, c]
    left, right = z - dsm[r, max(c - 1, 0)], dsm[r, min(c + 1, cols - 1)] - z
    gx = 0.5 * (left + right) if max(abs(left), abs(right)) < 0.6 else (left if abs(left) < abs(right) else right)
    up, down = z - dsm[max(r - 1, 0), c], dsm[min(r + 1, rows - 1), c] - z
    gy = 0.5 * (up + down) if max(abs(up), abs(down)) < 0.6 else (up if abs(up) < abs(down) else down)
    return (gx if abs(gx) < 0.6 else 0.0), (gy if abs(gy) < 0.6 else 0.0)


@in_place_kernel
def _texture(texture, x, y, scale, rgb):  # type: ignore[no-untyped-def]
    """Bilinear colour at x, y (metres from the upper left) of a texture with texels of 1/scale m."""
    rows, cols = texture.shape[:2]
    u, v = x * scale - 0.5, y * scale - 0.5
    c, r = int(np.floor(u)), int(np.floor(v))
    fu, fv = u - c, v - r
    c0, r0 = min(max(c, 0), cols - 1), min(max(r, 0), rows - 1)
    c1, r1 = min(max(c + 1, 0), cols - 1), min(max(r + 1, 0), rows - 1)
    a, b = (1 - fu) * (1 - fv), fu * (1 - fv)
    d, e = (1 - fu) * fv, fu * fv
    for i in range(3):
        rgb[i] = a * texture[r0, c0, i] + b * texture[r0, c1, i] + d * texture[r1, c0, i] + e * texture[r1, c1, i]


@in_place_kernel
def _wall_color(dsm, wall, facade, r, c, side, bx, by, x, y, z, sun, ambient, ca, sa, rgb):  # type: ignore[no-untyped-def]
    """Colour of a vertical face: its paint, rows of windows, sun or shade."""
    nx = (-1.0 if bx > 0 else 1.0) if side == 1 else 0.0
    ny = (-1.0 if by > 0 else 1.0) if side == 2 else 0.0
    # the face's true direction is one of the two of the street grid; stairs of cells only approximate it
    u, v = nx * ca + ny * sa, ny * ca - nx * sa
    if abs(u) >= abs(v):
        fx, fy = (ca, sa) if u > 0 else (-ca, -sa)
        along = (y * ca - x * sa) * 1.0
    else:
        fx, fy = (-sa, ca) if v > 0 else (sa, -ca)
        along = x * ca + y * sa
    light = ambient + (1.0 - ambient) * max(0.0, fx * sun[0] + fy * sun[1])
    gain = 1.0
    if facade[r, c]:
        floor = z / 3.0 - np.floor(z / 3.0)
        bay = along / 2.6 - np.floor(along / 2.6)
        if 0.3 < floor < 0.78 and 0.22 < bay < 0.72 and dsm[r, c] - z > 0.7:
            gain = 0.42
        elif floor < 0.08:
            gain = 0.86
    for i in range(3):
        rgb[i] = min(255.0, wall[r, c, i] * light * gain)


@in_place_kernel
def _noise_at(noise, x, y):  # type: ignore[no-untyped-def]
    """Bilinear interpolation in the noise, with wrap-around."""
    xi, yi = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - xi, y - yi
    n = noise.shape[0] - 1
    a, b = noise[yi & n, xi & n], noise[yi & n, (xi + 1) & n]
    c, d = noise[(yi + 1) & n, xi & n], noise[(yi + 1) & n, (xi + 1) & n]
    return (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy


@in_place_kernel
def _water_color(noise, x, y, motion, rgb):  # type: ignore[no-untyped-def]
    """Moving water: an even colour with waves and glints that differ in every picture."""
    wave = _noise_at(noise, x * 17.0 + motion[0], y * 17.0 + motion[1])
    swell = _noise_at(noise, x * 1.3 + motion[2], y * 1.3 + motion[3])
    glint = 420.0 * max(0.0, wave + 0.7 * swell - 0.66)
    for i in range(3):
        rgb[i] = min(255.0, rgb[i] + 5.0 * wave + 4.0 * swell + glint)


@in_place_kernel
def _veil(haze, noise, x, y, motion, rgb):  # type: ignore[no-untyped-def]
    """White haze of uneven, moving opacity; the ray crosses the haze layer at x, y."""
    u, v = x / HAZE_CELL_M - 0.5, y / HAZE_CELL_M - 0.5
    c, r = int(np.floor(u)), int(np.floor(v))
    if c < 0 or r < 0 or c >= haze.shape[1] - 1 or r >= haze.shape[0] - 1:
        return
    fu, fv = u - c, v - r
    a = (haze[r, c] * (1 - fu) + haze[r, c + 1] * fu) * (1 - fv)
    a += (haze[r + 1, c] * (1 - fu) + haze[r + 1, c + 1] * fu) * fv
    if a <= 0.0:
        return
    drift = 0.6 * _noise_at(noise, x * 0.55 + motion[4], y * 0.55 + motion[5])
    drift += 0.5 * _noise_at(noise, x * 0.23 + motion[6], y * 0.23 + motion[7])
    a = min(0.93, max(0.0, a * (1.0 + 0.9 * drift)))
    for i in range(3):
        rgb[i] = rgb[i] * (1.0 - a) + (228.0 + 10.0 * drift) * a


@in_place_kernel
def _highest_below(tiles, rays, rotation, cx, cy, cz, r0, c0, r1, c1, top, floor):  # type: ignore[no-untyped-def]
    """An upper bound of the heights that the rays of a small block (corners r0, c0 to r1, c1) can hit.

    The rays stay in the box around their paths from `top` down to the lowest ground. The highest tile of that box is
    a lower top, which makes the box smaller; three rounds are enough.
    """
    for _ in range(3):
        low_x = low_y = 1e18
        high_x = high_y = -1e18
        for k in range(4):
            r, c = (r1 if k & 2 else r0), (c1 if k & 1 else c0)
            x, y = rays[r, c, 0], rays[r, c, 1]
            down = -(rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2])
            if down < 0.05:
                return top
            bx = (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]) / down
            by = -(rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]) / down
            for z in (top, floor):
                px, py = cx + bx * (cz - z), cy + by * (cz - z)
                low_x, high_x, low_y, high_y = min(low_x, px), max(high_x, px), min(low_y, py), max(high_y, py)
        side = TILE_CELLS * CELL_M
        first_r, last_r = int(low_y / side) - 1, int(high_y / side) + 1
        first_c, last_c = int(low_x / side) - 1, int(high_x / side) + 1
        if first_r < 0 or first_c < 0 or last_r >= tiles.shape[0] or last_c >= tiles.shape[1]:
            return top
        highest = floor
        for i in range(first_r, last_r + 1):
            for j in range(first_c, last_c + 1):
                highest = max(highest, tiles[i, j])
        if highest >= top - 0.5:
            return top
        top = highest
    return top


@kernel
def _shoot(  # type: ignore[no-untyped-def]
    rays, rotation, cx, cy, cz, t0, t1, t2, dsm, tiles, kind, wall, facade, sun, ambient, haze, noise, motion,
    ca, sa, top, floor, pixel, side_rays, out,
):  # fmt: skip
    """Colours of all rays of one picture: rays float32 (n R, n C, 2) normalised; averages n x n into out (R, C, 3).

    One long body on purpose: a function call for each ray with all these arrays would cost as much as the ray itself.
    """
    rows, cols = out.shape[:2]
    n = side_rays
    share = 1.0 / (n * n)
    rgb = np.empty(3)
    ax, ay = cx / CELL_M, cy / CELL_M
    for block in range(((rows + BLOCK - 1) // BLOCK) * ((cols + BLOCK - 1) // BLOCK)):
        wide = (cols + BLOCK - 1) // BLOCK
        first_r, first_c = block // wide * BLOCK, block % wide * BLOCK
        last_r, last_c = min(first_r + BLOCK, rows), min(first_c + BLOCK, cols)
        near_top = _highest_below(
            tiles, rays, rotation, cx, cy, cz, n * first_r, n * first_c, n * last_r - 1, n * last_c - 1, top, floor
        )
        for ray in range((last_r - first_r) * (last_c - first_c) * n * n):
            k, at = ray % (n * n), ray // (n * n)
            r, c = first_r + at // (last_c - first_c), first_c + at % (last_c - first_c)
            x, y = rays[n * r + k // n, n * c + k % n, 0], rays[n * r + k // n, n * c + k % n, 1]
            dx = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]
            dy = -(rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2])
            down = -(rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2])
            rgb[0] = rgb[1] = rgb[2] = 190.0
            if down > 0.05:
                bx, by = dx / down, dy / down
                hr, hc, z, side = _march(dsm, tiles, ax, ay, cz, bx / CELL_M, by / CELL_M, near_top)
                if hr < 0:
                    rgb[0] = rgb[1] = rgb[2] = 120.0
                elif side > 0 and dsm[hr, hc] - z > 0.45:
                    gx, gy = cx + bx * (cz - z), cy + by * (cz - z)
                    _wall_color(dsm, wall, facade, hr, hc, side, bx, by, gx, gy, z, sun, ambient, ca, sa, rgb)
                else:
                    h = dsm[hr, hc]
                    sx, sy = _slope(dsm, hr, hc)
                    # where the ray meets the column's tilted top
                    px, py = ax + bx * cz / CELL_M - hc - 0.5, ay + by * cz / CELL_M - hr - 0.5
                    gain = 1.0 + (sx * bx + sy * by) / CELL_M
                    if gain > 0.3:
                        z = min(max((h + sx * px + sy * py) / gain, h - 0.6), h + 0.6)
                    gx, gy = cx + bx * (cz - z), cy + by * (cz - z)
                    size = pixel * (cz - z) / down
                    if size < 0.36:
                        _texture(t0, gx, gy, 4.0, rgb)
                    elif size < 0.72:
                        _texture(t1, gx, gy, 2.0, rgb)
                    else:
                        _texture(t2, gx, gy, 1.0, rgb)
                    row, col = (
                        min(max(int(gy * 4.0), 0), kind.shape[0] - 1),
                        min(max(int(gx * 4.0), 0), kind.shape[1] - 1),
                    )
                    if kind[row, col] == WATER:
                        _water_color(noise, gx, gy, motion, rgb)
                if hr >= 0 and haze.shape[0] > 0:
                    _veil(haze, noise, cx + bx * (cz - HAZE_HEIGHT_M), cy + by * (cz - HAZE_HEIGHT_M), motion, rgb)
            if k == 0:
                out[r, c, 0], out[r, c, 1], out[r, c, 2] = share * rgb[0], share * rgb[1], share * rgb[2]
            else:
                out[r, c, 0] += share * rgb[0]
                out[r, c, 1] += share * rgb[1]
                out[r, c, 2] += share * rgb[2]


def lens_rays(lens: Lens, side: int = 2) -> Floats:
    """Normalised undistorted coordinates of side x side rays a pixel, float32 (side rows, side columns, 2)."""
    u, v = lens.principal_point
    cols = (np.arange(side * lens.width) - 0.5 * (side - 1)) / side - u
    rows = (np.arange(side * lens.height) - 0.5 * (side - 1)) / side - v
    xy = np.stack(np.meshgrid(cols, rows), -1) / lens.focal_px
    return np.ascontiguousarray(lens.undistort(xy) if not lens.is_pinhole else xy, np.float32)


def render(stage: PreparedScene, camera: Camera, rays: Floats, motion: Array) -> Floats:
    """One picture, float32 (rows, columns, 3), red first, before the sensor.

    Args:
        stage: the scene with its light. camera: in the scene's grid; heights over takeoff.
        rays: from `lens_rays` of the camera's lens. motion: float64 (8,), offsets of waves and haze at this moment.
    """
    s = stage.scene
    out = np.empty((camera.lens.height, camera.lens.width, 3), np.float32)
    side = rays.shape[0] // camera.lens.height
    x, y = camera.position[0] - s.grid.west, s.grid.north - camera.position[1]
    _shoot(
        rays, camera.rotation, float(x), float(y), float(camera.position[2]), *stage.levels, s.dsm, stage.tiles, s.kind,
        s.wall, s.facade, np.asarray(stage.sun), stage.ambient, stage.haze, stage.noise, motion,
        *s.wall_axis, min(float(stage.tiles.max()), float(camera.position[2])), float(s.dsm.min()),
        1.0 / (side * camera.lens.focal_px), side, out,
    )  # fmt: skip
    return out


@in_place_kernel
def _rise_inside(x, lean, side):  # type: ignore[no-untyped-def]
    """Height above its ground point x up to which an oblique ray stays inside the scene, which spans 0 to `side`."""
    if abs(lean) < 1e-9:
        return 1e9
    return (x / lean if lean > 0.0 else (x - side) / lean) - 1e-3


@kernel
def _satellite(texture, dsm, dtm, tiles, wall, facade, sun, ambient, ca, sa, lean_x, lean_y, top, gsd, out):  # type: ignore[no-untyped-def]
    """Parallel rays: each map pixel looks from its terrain point towards the satellite, 2x2 rays a pixel."""
    rows, cols = out.shape[:2]
    rgb = np.empty(3)
    for r in range(rows):
        for c in range(cols):
            s0 = s1 = s2 = 0.0
            for k in range(4):
                x, y = (c + 0.25 + 0.5 * (k & 1)) * gsd, (r + 0.25 + 0.5 * (k >> 1)) * gsd
                tr, tc = min(int(y / CELL_M), dtm.shape[0] - 1), min(int(x / CELL_M), dtm.shape[1] - 1)
                ground = dtm[tr, tc]
                # p(z) = x - lean (z - ground): what lies above the ground is displaced by lean * height
                hr, hc, z, side = _march(
                    dsm, tiles, x / CELL_M, y / CELL_M, float(ground), lean_x / CELL_M, lean_y / CELL_M, top
                )
                if hr < 0:  # at the height of the scene's highest point the ray is outside: start where it enters
                    wide, high = CELL_M * dsm.shape[1], CELL_M * dsm.shape[0]
                    rise = min(_rise_inside(x, lean_x, wide), _rise_inside(y, lean_y, high))
                    hr, hc, z, side = _march(
                        dsm, tiles, x / CELL_M, y / CELL_M, float(ground), lean_x / CELL_M, lean_y / CELL_M,
                        ground + rise,
                    )  # fmt: skip
                if hr < 0:
                    rgb[0] = rgb[1] = rgb[2] = 0.0
                elif side > 0 and dsm[hr, hc] - z > 0.45:
                    gx, gy = x + lean_x * (ground - z), y + lean_y * (ground - z)
                    _wall_color(dsm, wall, facade, hr, hc, side, lean_x, lean_y, gx, gy, z, sun, ambient, ca, sa, rgb)
                else:
                    if abs(dsm[hr, hc] - ground) < 0.3 and abs(dtm[hr, hc] - dsm[hr, hc]) < 0.01:
                        z = ground
                    else:
                        z = min(z, dsm[hr, hc])
                    _texture(texture, x + lean_x * (ground - z), y + lean_y * (ground - z), 4.0, rgb)
                s0 += rgb[0]
                s1 += rgb[1]
                s2 += rgb[2]
            out[r, c, 0], out[r, c, 1], out[r, c, 2] = 0.25 * s0, 0.25 * s1, 0.25 * s2


def satellite_view(stage: PreparedScene, lean: tuple[float, float], gsd_m: float) -> tuple[Floats, GroundGrid]:
    """A satellite image rectified on the bare ground: buildings lean (relief displacement) and hide what is behind.

    Args:
        stage: the scene with its light.
        lean: relief displacement in metres per metre of height above the ground, (east, north).
        gsd_m: side of a map pixel.

    Returns:
        float32 (rows, columns, 3) and its grid.
    """
    s = stage.scene
    width, height = (int(n * TEXEL_M / gsd_m) for n in (s.grid.width, s.grid.height))
    grid = replace(s.grid, gsd_m=gsd_m, width=width, height=height)
    out = np.empty((grid.height, grid.width, 3), np.float32)
    _satellite(
        stage.levels[0], s.dsm, s.dtm, stage.tiles, s.wall, s.facade, np.asarray(stage.sun), stage.ambient,
        *s.wall_axis, lean[0], -lean[1], float(stage.tiles.max()), gsd_m, out,
    )  # fmt: skip
    return out, grid
