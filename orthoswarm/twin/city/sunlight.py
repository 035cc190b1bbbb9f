"""Lighting of a scene: sun, cast shadows, season; gives the colours that are rendered."""

from dataclasses import dataclass

import numpy as np

from orthoswarm.compute.jit import in_place_kernel
from orthoswarm.model.arrays import Bytes
from orthoswarm.twin.city import scene as kinds
from orthoswarm.twin.city.procedural_noise import add_detail
from orthoswarm.twin.city.scene import CELL_M, Scene


@dataclass(frozen=True, slots=True)
class Sun:
    """Direction of the sun and share of ambient light."""

    azimuth_rad: float  # clockwise from grid north
    elevation_rad: float  # above the horizon
    ambient: float = 0.42  # share of the light that reaches a shadow

    def direction(self) -> tuple[float, float, float]:
        """Unit vector towards the sun: columns (east), rows (south), up."""
        c = np.cos(self.elevation_rad)
        east, south = np.sin(self.azimuth_rad) * c, -np.cos(self.azimuth_rad) * c
        return float(east), float(south), float(np.sin(self.elevation_rad))


@in_place_kernel
def _shade(dsm, top, sun, ambient, cell, out):  # type: ignore[no-untyped-def]
    """Light on each cell (128 for level ground in the sun): Lambertian reflection by slope, and cast shadows."""
    rows, cols = dsm.shape
    sx, sy, sz = sun
    step = 1.0 / max(abs(sx), abs(sy))
    rise = sz * step * cell
    for r in range(rows):
        for c in range(cols):
            z = dsm[r, c]
            gx = dsm[r, min(c + 1, cols - 1)] - z
            if abs(gx) > 0.5:
                gx = z - dsm[r, max(c - 1, 0)]
                if abs(gx) > 0.5:
                    gx = 0.0
            gy = dsm[min(r + 1, rows - 1), c] - z
            if abs(gy) > 0.5:
                gy = z - dsm[max(r - 1, 0), c]
                if abs(gy) > 0.5:
                    gy = 0.0
            nx, ny = -gx / cell, -gy / cell
            lambert = (nx * sx + ny * sy + sz) / np.sqrt(nx * nx + ny * ny + 1.0)
            light = max(lambert, 0.0) / sz
            height, k = z + 0.3, 1
            while light > 0.0:
                height += rise
                if height > top:
                    break
                rr, cc = int(r + 0.5 + k * step * sy), int(c + 0.5 + k * step * sx)
                if rr < 0 or cc < 0 or rr >= rows or cc >= cols:
                    break
                if dsm[rr, cc] > height:
                    light = 0.0
                k += 1
            out[r, c] = min(255.0, 128.0 * (ambient + (1.0 - ambient) * min(light, 1.35)))


def light_map(scene: Scene, sun: Sun) -> Bytes:
    """Light on each cell of the height field, uint8, 128 for level ground in the sun."""
    out = np.empty(scene.dsm.shape, np.uint8)
    _shade(scene.dsm, float(scene.dsm.max()), np.array(sun.direction()), sun.ambient, CELL_M, out)
    return out


@in_place_kernel
def _lit(albedo, light, out):  # type: ignore[no-untyped-def]
    """Colour = albedo * light / 128; light lies on cells of two texels, bilinear between their centres."""
    rows, cols = albedo.shape[:2]
    high, wide = light.shape
    for r in range(rows):
        y = (r - 0.5) * 0.5
        r0 = min(max(int(np.floor(y)), 0), high - 1)
        r1 = min(r0 + 1, high - 1)
        fy = 0.25 if r & 1 else 0.75
        for c in range(cols):
            x = (c - 0.5) * 0.5
            c0 = min(max(int(np.floor(x)), 0), wide - 1)
            c1 = min(c0 + 1, wide - 1)
            fx = 0.25 if c & 1 else 0.75
            s = (light[r0, c0] * (1 - fx) + light[r0, c1] * fx) * (1 - fy)
            s += (light[r1, c0] * (1 - fx) + light[r1, c1] * fx) * fy
            s /= 128.0
            for b in range(3):
                # shadows are lit by the sky: bluer
                v = albedo[r, c, b] * (s + (0.05 if b == 2 else 0.0) * max(0.0, 1.0 - s))
                out[r, c, b] = min(v, 255.0)


def lit_texture(scene: Scene, sun: Sun) -> Bytes:
    """The scene's colours under the sun, uint8 (rows, columns, 3).

    A scene made from a photograph carries its own shadows; light it with `ambient` near 1.
    """
    out = np.empty_like(scene.albedo)
    _lit(scene.albedo, light_map(scene, sun), out)
    return out


@in_place_kernel
def _tone(image, kind, matrix, offset, contrast):  # type: ignore[no-untyped-def]
    rows, cols = kind.shape
    for r in range(rows):
        for c in range(cols):
            k = kind[r, c]
            a, g, b = float(image[r, c, 0]), float(image[r, c, 1]), float(image[r, c, 2])
            for i in range(3):
                v = matrix[k, i, 0] * a + matrix[k, i, 1] * g + matrix[k, i, 2] * b + offset[k, i]
                v = 110.0 + (v - 110.0) * contrast
                image[r, c, i] = min(max(v, 0.0), 255.0)


def change_season(scene: Scene, seed: int) -> None:
    """Another season: change the colours of plants and soil, and the contrast of everything, in place."""
    rng = np.random.default_rng([seed, 31])
    matrix = np.tile(np.eye(3), (kinds.KINDS, 1, 1))
    offset = np.zeros((kinds.KINDS, 3))
    for kind in (kinds.GRASS, kinds.TREE, kinds.FIELD):
        dry = rng.uniform(0.15, 0.5)
        matrix[kind] = (1 - dry) * np.eye(3) + dry * np.array([[0.2, 0.95, 0.1], [0.35, 0.6, 0.1], [0.3, 0.3, 0.4]])
        offset[kind] = rng.uniform(-12, 12)
    offset[kinds.SOIL] = offset[kinds.FIELD] + rng.uniform(-10, 10)
    offset[kinds.ASPHALT] = rng.uniform(-10, 14)
    offset[kinds.PHOTO] = rng.uniform(-14, 14, 3)
    _tone(scene.albedo, scene.kind, matrix, offset, 1.0 + float(rng.uniform(-0.12, 0.08)))
    amplitude = np.zeros((kinds.KINDS, 5), np.float32)
    # soil and plants also change locally between two dates: weeds, wear, wet spots
    amplitude[[kinds.PHOTO, kinds.TREE]] = (5, 6, 7, 8, 10)
    amplitude[[kinds.GRASS, kinds.SOIL, kinds.FIELD]] = (3, 4, 5, 6, 8)
    add_detail(scene.albedo, scene.kind, amplitude, np.ones((kinds.KINDS, 3), np.float32), seed * 613 + 9)
