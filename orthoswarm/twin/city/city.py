"""A procedural city: streets, blocks and surface detail that never repeats (the twin's default ground)."""

import numpy as np

from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.geo import GroundGrid
from orthoswarm.twin.city import scene as kinds
from orthoswarm.twin.city.builder import CARS, Area, Builder, Color, ParkingPlace, pick, rect
from orthoswarm.twin.city.procedural_noise import add_detail, noise_field
from orthoswarm.twin.city.quarters import fill_block
from orthoswarm.twin.city.scene import CELL_M, TEXEL_M, Scene
from orthoswarm.twin.city.stamps import stamp_car

# Amplitudes in grey values of five octaves (0.25, 0.7, 2.3, 9, 45 m) for each kind, and the tint of coarse octaves.
_DETAIL: dict[int, tuple[tuple[float, float, float, float, float], Color]] = {
    kinds.GRASS: ((11, 13, 13, 15, 14), (1.1, 0.8, 0.5)),
    kinds.ASPHALT: ((7, 5, 6, 8, 8), (1, 1, 1)),
    kinds.CONCRETE: ((7, 5, 7, 8, 6), (1, 0.97, 0.9)),
    kinds.SOIL: ((10, 12, 16, 18, 14), (1, 0.9, 0.7)),
    kinds.FIELD: ((10, 12, 10, 10, 12), (0.9, 0.9, 0.5)),
    kinds.WATER: ((1, 0, 0, 1, 2), (1, 1, 1)),
    kinds.ROOF: ((4, 3, 4, 4, 0), (1, 0.95, 0.9)),
    kinds.TREE: ((6, 5, 4, 6, 8), (1.1, 0.9, 0.5)),
    kinds.CAR: ((2, 0, 0, 0, 0), (1, 1, 1)),
    kinds.MARK: ((9, 8, 8, 4, 0), (1, 1, 1)),
    kinds.RUBBLE: ((18, 20, 18, 16, 14), (1, 0.92, 0.8)),
    kinds.PHOTO: ((0, 0, 0, 0, 0), (1, 1, 1)),
}


def build_city(grid: GroundGrid, seed: int, *, relief_m: float = 0.0) -> tuple[Scene, list[ParkingPlace]]:
    """A city on a texture grid, without cars, and its parking places.

    Args:
        grid: from `scene_grid`.
        seed: of the random city.
        relief_m: smooth ground relief of about +-relief_m around height 0.
    """
    rng = np.random.default_rng([seed, 11])
    scene = Scene.blank(grid, float(rng.uniform(-0.6, 0.6)))
    if relief_m:
        scene.dtm[:] = smooth_relief(scene.dtm.shape, relief_m, seed)
        scene.dsm[:] = scene.dtm
    scene.albedo[:] = (98, 98, 100)
    scene.kind[:] = kinds.ASPHALT
    bend = (rng.uniform(0, 6.28, 4), rng.uniform(0.4, 1.0, 4) * np.array([9.0, 3.0, 9.0, 3.0]))
    builder = Builder(scene, rng, bend)
    radius = 0.5 * TEXEL_M * float(np.hypot(grid.width, grid.height)) + 30.0
    for block in _split(builder, (-radius, -radius, radius, radius), 0):
        if _near(builder, block):
            fill_block(builder, block)
    _asphalt_patches(builder, radius)
    amplitude = np.zeros((kinds.KINDS, 5), np.float32)
    tint = np.ones((kinds.KINDS, 3), np.float32)
    for kind, (levels, hue) in _DETAIL.items():
        amplitude[kind], tint[kind] = levels, hue
    add_detail(scene.albedo, scene.kind, amplitude, tint, seed * 977 + 5)
    return scene, builder.slots


def smooth_relief(shape: tuple[int, ...], relief_m: float, seed: int) -> Floats:
    """Rolling ground of about +-relief_m: features of 600 m down to 150 m, float32 of `shape` on cells."""
    import cv2

    coarse = noise_field((shape[0] // 16 + 2, shape[1] // 16 + 2), CELL_M * 16, 560.0, 3, seed * 31 + 7)
    coarse -= float(np.mean(coarse))
    coarse *= relief_m / float(np.percentile(np.abs(coarse), 98))
    return np.asarray(cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC), np.float32)


def place_cars(scene: Scene, slots: list[ParkingPlace], seed: int, share: float = 0.55) -> None:
    """Put cars on a random share of the parking places, in place; another seed gives other cars."""
    rng = np.random.default_rng([seed, 23])
    for slot in slots:
        if rng.random() > share:
            continue
        color = np.asarray(pick(rng, CARS), float)
        along, across, turn = rng.normal(0, 0.5), rng.normal(0, 0.2), rng.normal(0, 0.03)
        ca, sa = np.cos(slot.angle), np.sin(slot.angle)
        stamp_car(
            scene.albedo, scene.kind, scene.dsm, scene.dtm, scene.wall, scene.facade,
            slot.x + along * ca - across * sa, slot.y + along * sa + across * ca,
            slot.angle + turn, rng.uniform(4.0, 5.0), color,
        )  # fmt: skip


def _near(b: Builder, block: Area) -> bool:
    """Whether a block touches the grid."""
    xy = b.place(rect(*block))
    g = b.scene.grid
    return bool(
        (xy[:, 0].max() > -20) and (xy[:, 1].max() > -20)
        and (xy[:, 0].min() < g.width * TEXEL_M + 20) and (xy[:, 1].min() < g.height * TEXEL_M + 20)
    )  # fmt: skip


def _split(b: Builder, area: Area, depth: int) -> list[Area]:
    """Divide an area by streets until the pieces are blocks; paints the streets' markings."""
    u0, v0, u1, v1 = area
    wide, high = u1 - u0, v1 - v0
    if max(wide, high) < 150.0 or (max(wide, high) < 200.0 and b.rng.random() < 0.3) or min(wide, high) < 60.0:
        return [area]
    road = (24.0, 24.0, 18.0, 18.0, 14.0, 12.0, 10.0, 9.0, 8.0)[min(depth, 8)]
    cut = b.rng.uniform(0.36, 0.64)
    if wide >= high:
        m = u0 + cut * wide
        _street(b, np.array([[m, v0], [m, v1]]), road)
        first, second = (u0, v0, m - road / 2, v1), (m + road / 2, v0, u1, v1)
    else:
        m = v0 + cut * high
        _street(b, np.array([[u0, m], [u1, m]]), road)
        first, second = (u0, v0, u1, m - road / 2), (u0, m + road / 2, u1, v1)
    return _split(b, first, depth + 1) + _split(b, second, depth + 1)


def _street(b: Builder, ends: Array, width: float) -> None:
    """Markings, slots for cars and trees along one street."""
    length = float(np.hypot(*(ends[1] - ends[0])))
    along = (ends[1] - ends[0]) / length
    across = np.array([-along[1], along[0]])
    if width < 9.5 and b.rng.random() < 0.5:
        return
    center = 0.0 if width < 17 else 0.15
    for offset, on, off in [(0.0, 3.0, 4.0 if width < 17 else 0.0)] + (
        [(s * width * 0.24, 3.0, 6.0) for s in (-1, 1)] if width > 17 else []
    ):
        for t in np.arange(0.0, length, max(on + off, 20.0 if off == 0 else 1.0)):
            stop = min(length, t + (on if off else 20.0))
            p = ends[0] + across * offset + along * np.array([[t], [stop]])
            b.line(p, 0.25 + center, (205, 205, 200) if offset else (206, 190, 120), kinds.MARK)
    for side in (-1, 1):
        for t in np.arange(6.0, length - 6.0, 7.0):
            p = ends[0] + along * t + across * side * (width / 2 - (1.6 if b.rng.random() < 0.75 else 3.5))
            turn = 0.0 if abs(along[0]) > 0.5 else np.pi / 2
            b.slot(float(p[0]), float(p[1]), turn + (np.pi if side > 0 else 0.0))
    for t in np.arange(b.rng.uniform(20, 60), length, b.rng.uniform(90, 160)):
        for k in np.arange(-width / 2 + 0.8, width / 2 - 0.5, 1.2):  # a crossing for people
            p = ends[0] + along * np.array([[t], [t + 3.0]]) + across * k
            b.line(p, 0.5, (214, 214, 210), kinds.MARK)


def _asphalt_patches(b: Builder, radius: float) -> None:
    """Road repairs and manholes: texture on streets, which would otherwise have none."""
    import cv2

    s, rng = b.scene, b.rng
    area = s.grid.width * s.grid.height * TEXEL_M**2
    for _ in range(int(area / 500.0)):
        x, y = rng.uniform(0, s.grid.width), rng.uniform(0, s.grid.height)
        if s.kind[int(y), int(x)] not in (kinds.ASPHALT, kinds.CONCRETE):
            continue
        grey = float(rng.normal(96, 22))
        if rng.random() < 0.4:
            cv2.circle(s.albedo, (int(x), int(y)), int(rng.integers(1, 3)), (grey - 30,) * 3, -1)
            continue
        size = (rng.uniform(3, 14), rng.uniform(6, 50))
        box = cv2.boxPoints(((x, y), size, float(np.degrees(-s.angle_rad)) + 90.0 * rng.integers(2)))
        corners = np.round(box * 16).astype(np.int32)
        low, high = np.maximum(box.min(0).astype(int) - 1, 0), box.max(0).astype(int) + 2
        window = s.kind[low[1] : high[1], low[0] : high[0]]
        if window.size and np.isin(window, (kinds.ASPHALT, kinds.CONCRETE)).all():
            cv2.fillConvexPoly(s.albedo, corners, (grey, grey, grey), cv2.LINE_AA, 4)
