"""What happens to a city after the map was made: debris flow, waterlogging, haze (the paper's IV.A)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.kernels import kernel
from orthoswarm.twin import scene as kinds
from orthoswarm.twin.grain import hash01, lattice, noise_field
from orthoswarm.twin.render import HAZE_CELL_M
from orthoswarm.twin.scene import CELL_M, TEXEL_M, Scene

Floats = NDArray[np.float32]

SIZES_M = {"debris": (400.0, 880.0), "water": (330.0, 320.0), "haze": (440.0, 190.0)}
"""Extent of each disaster across and along, metres (paper IV.A)."""


@dataclass(frozen=True, slots=True)
class Zone:
    """An irregular patch of ground.

    Attributes:
        east: easting of its centre; north: northing.
        across_m: its extent at right angles to its axis; along_m: along it.
        angle_rad: direction of its axis, anticlockwise from east.
    """

    east: float
    north: float
    across_m: float
    along_m: float
    angle_rad: float


def zone_depth(scene: Scene, zone: Zone, step: int, seed: int) -> Floats:
    """How deep inside a zone each place lies, in metres (negative outside), edges ragged.

    Args:
        scene: gives the grid.
        zone: where.
        step: texels along the side of a cell of the result.
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


@kernel
def _bury(albedo, kind, dsm, dtm, wall, facade, depth, flow_x, flow_y, seed):  # type: ignore[no-untyped-def]
    """Rubble and mud on every cell of positive depth: heights 0 to 3 m, streaks along the flow."""
    rows, cols = dsm.shape
    for r in range(rows):
        for c in range(cols):
            if depth[r, c] <= 0.0:
                continue
            x, y = c * CELL_M, r * CELL_M
            u, v = x * flow_x + y * flow_y, y * flow_x - x * flow_y
            swell = 0.5 + 0.5 * lattice(u / 38.0, v / 17.0, seed)
            rough = lattice(x / 5.5, y / 5.5, seed + 1)
            block = lattice(x / 1.6, y / 1.6, seed + 2)
            h = 1.5 * swell + 0.55 * rough + (0.9 * (block - 0.45) if block > 0.45 else 0.0)
            h = min(3.0, max(0.0, h)) * min(1.0, depth[r, c] / 9.0)
            dsm[r, c] = dtm[r, c] + h
            facade[r, c] = 0
            tone = 108.0 + 26.0 * (swell - 0.5) + 20.0 * rough + 26.0 * lattice(u / 24.0, v / 2.6, seed + 3)
            for i in range(3):
                wall[r, c, i] = min(max(tone * (1.0 - 0.13 * i), 0.0), 255.0)
            for k in range(4):
                rr, cc = 2 * r + (k >> 1), 2 * c + (k & 1)
                xx, yy = cc * TEXEL_M, rr * TEXEL_M
                fine = 17.0 * (2.0 * hash01(cc, rr, seed) - 1.0) + 24.0 * lattice(xx / 0.8, yy / 0.8, seed + 4)
                fine += 22.0 * lattice(xx / 2.7, yy / 2.7, seed + 5)
                plank = lattice(xx / 3.1, yy / 0.7, seed + 6)  # wreckage: pale and dark slivers
                if abs(plank) > 0.72:
                    fine += 60.0 * np.sign(plank)
                kind[rr, cc] = kinds.RUBBLE
                for i in range(3):
                    albedo[rr, cc, i] = min(max((tone + fine) * (1.05 - 0.13 * i), 0.0), 255.0)


def debris_flow(scene: Scene, zone: Zone, seed: int) -> None:
    """Bury a zone under 0 to 3 m of rubble, in place; houses within it are gone."""
    depth = zone_depth(scene, zone, 2, seed * 13 + 1)
    _bury(
        scene.albedo, scene.kind, scene.dsm, scene.dtm, scene.wall, scene.facade, depth,
        float(np.cos(zone.angle_rad)), float(-np.sin(zone.angle_rad)), seed * 17 + 3,
    )  # fmt: skip


def flood(scene: Scene, zone: Zone, seed: int) -> None:
    """Put a zone under muddy water that has no texture but moving glints, in place; the ground level is kept."""
    depth = zone_depth(scene, zone, 2, seed * 13 + 2)
    wet = depth > 0.0
    scene.dsm[wet] = scene.dtm[wet]
    scene.facade[wet] = 0
    scene.wall[wet] = (104, 92, 72)
    fine = np.repeat(np.repeat(wet, 2, axis=0), 2, axis=1)
    scene.kind[fine] = kinds.WATER
    scene.albedo[fine] = (104, 94, 74)


def haze_opacity(scene: Scene, zone: Zone, seed: int) -> Floats:
    """Opacity of a white veil over a zone, float32 on HAZE_CELL_M cells, 0 outside, about 0.65 within."""
    depth = zone_depth(scene, zone, int(HAZE_CELL_M / TEXEL_M), seed * 13 + 3)
    return np.asarray(0.66 * np.clip((depth + 6.0) / 26.0, 0.0, 1.0), np.float32)


def zone_mask(scene: Scene, zone: Zone, disaster: str, seed: int) -> NDArray[np.bool_]:
    """The zone on the height fields' cells, as the disaster of that name uses it."""
    salt = {"debris": 1, "water": 2, "haze": 3}[disaster]
    return np.asarray(zone_depth(scene, zone, 2, seed * 13 + salt) > 0.0)
