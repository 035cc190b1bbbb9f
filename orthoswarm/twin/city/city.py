"""A procedural city, the twin's default ground: streets, blocks of houses, halls, towers, parks and fields."""

import itertools

import numpy as np

from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.geo import GroundGrid
from orthoswarm.twin.city import scene as kinds
from orthoswarm.twin.city.builder import CARS, FLAT_ROOFS, LAWNS, ROOFS, Area, Builder, Color, ParkingPlace, pick, rect
from orthoswarm.twin.city.procedural_noise import add_detail, noise_field
from orthoswarm.twin.city.scene import CELL_M, TEXEL_M, Scene
from orthoswarm.twin.city.stamps import DOME, FLAT, GABLE, HIP, stamp_car

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
        grid: from `scene_grid`. seed: of the random city.
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


def fill_block(b: Builder, block: Area) -> None:
    """Pave a block and fill it, inside a pavement of 2 m, with one kind of quarter."""
    u0, v0, u1, v1 = block
    b.polygon(rect(*block), (158, 156, 150), kinds.CONCRETE)
    inner = (u0 + 2.0, v0 + 2.0, u1 - 2.0, v1 - 2.0)
    roll = b.rng.random()
    if roll < 0.58:
        _houses(b, inner)
    elif roll < 0.72:
        _halls(b, inner)
    elif roll < 0.82:
        _towers(b, inner)
    elif roll < 0.92:
        _park(b, inner)
    else:
        _field(b, inner)


def _houses(b: Builder, area: Area) -> None:
    """Rows of lots with a house, a lawn, a drive, sheds, pools and trees."""
    u0, v0, u1, v1 = area
    rng = b.rng
    depth = float(rng.uniform(24, 34))
    rows = max(1, round((v1 - v0) / depth))
    edges = np.linspace(v0, v1, rows + 1)
    for j in range(rows):
        u, lo, hi = u0, float(edges[j]), float(edges[j + 1])
        front = -1.0 if j % 2 == 0 else 1.0
        while u < u1 - 8.0:
            width = min(float(rng.uniform(14, 23)), u1 - u)
            if u1 - u - width < 8.0:
                width = u1 - u
            _lot(b, (u, lo, u + width, hi), front)
            u += width


def _lot(b: Builder, area: Area, front: float) -> None:
    u0, v0, u1, v1 = area
    rng = b.rng
    width, depth = u1 - u0, v1 - v0
    soil = rng.random() < 0.12
    b.polygon(rect(*area), pick(rng, LAWNS) if not soil else (142, 122, 96), kinds.SOIL if soil else kinds.GRASS)
    b.line(rect(*area), 0.25, (130, 116, 96), kinds.CONCRETE)
    if width < 9 or depth < 14:
        return
    hu, hv = min(0.5 * width - 1.5, rng.uniform(4.5, 7.5)), rng.uniform(4.0, 5.8)
    u = 0.5 * (u0 + u1) + rng.uniform(-1, 1)
    v = (v0 + 5.5 + hv if front < 0 else v1 - 5.5 - hv) - front * rng.uniform(-1.0, 3.0)
    street = v0 if front < 0 else v1
    drive = u + rng.choice([-1.0, 1.0]) * (hu - 1.7)
    b.polygon(rect(drive - 1.6, min(street, v), drive + 1.6, max(street, v)), (168, 164, 156), kinds.CONCRETE)
    b.slot(drive, 0.5 * (street + v) - front * -1.0, np.pi / 2)
    for _ in range(int(rng.integers(1, 4))):  # beds, terraces, paths
        w, h = rng.uniform(1.5, 6.0), rng.uniform(1.0, 4.0)
        p, q = rng.uniform(u0 + 1, u1 - 1 - w), rng.uniform(v0 + 1, v1 - 1 - h)
        b.polygon(rect(p, q, p + w, q + h), pick(rng, [(120, 96, 70), (176, 160, 138), (100, 112, 70)]), kinds.SOIL)
    shape = int(rng.choice([GABLE, GABLE, HIP, FLAT]))
    eave = float(rng.uniform(3.2, 6.8))
    rise = 0.0 if shape == FLAT else float(rng.uniform(1.6, 3.6))
    turn = float(rng.normal(0, 0.03)) + (np.pi / 2 if rng.random() < 0.3 else 0.0)
    color = pick(rng, ROOFS)
    b.building(u, v, hu, hv, eave=eave, rise=rise, shape=shape, color=color, turn=turn)
    if rng.random() < 0.4:  # a wing
        at = u + rng.uniform(-2, 2), v - front * hv
        b.building(*at, 3.0, 3.5, eave=eave * 0.7, rise=rise * 0.6, shape=shape, color=color, turn=turn)
    if rng.random() < 0.5:
        at = u + rng.uniform(-hu, hu) * 0.5, v + rng.uniform(-1, 1)
        b.building(*at, 0.5, 0.5, eave=eave + rise + 0.8, rise=0, shape=FLAT, color=(110, 84, 74))
    back = v1 if front < 0 else v0
    if rng.random() < 0.5:
        at = rng.uniform(u0 + 3, u1 - 3), back + front * 3.5
        b.building(*at, 2.2, 1.8, eave=2.4, rise=0.5, shape=GABLE, color=pick(rng, ROOFS), windows=False)
    if rng.random() < 0.12 and b.is_free(u, back + front * 9.0, 3.5):  # a pool
        b.polygon(rect(u - 3, back + front * 9 - 2, u + 3, back + front * 9 + 2), (92, 168, 190), kinds.CONCRETE)
    for _ in range(int(rng.integers(0, 4))):
        r = float(rng.uniform(1.2, 3.6))
        b.tree(rng.uniform(u0 + 1, u1 - 1), back + front * rng.uniform(1.0, 0.4 * depth), r, r * rng.uniform(1.6, 2.6))


def _parking(b: Builder, area: Area) -> None:
    """A car park with stalls."""
    u0, v0, u1, v1 = area
    g = float(b.rng.normal(104, 10))
    b.polygon(rect(*area), (g, g, g + 2), kinds.ASPHALT)
    for v in np.arange(v0 + 1.0, v1 - 5.5, 16.5):
        for stall in np.arange(u0 + 1.0, u1 - 2.5, 2.7):
            b.line(np.array([[stall, v], [stall, v + 5.0]]), 0.25, (205, 205, 205), kinds.MARK)
            b.slot(stall + 1.35, v + 2.5, np.pi / 2)


def _halls(b: Builder, area: Area) -> None:
    """Large flat roofs with machines on them, and car parks."""
    u0, v0, u1, v1 = area
    rng = b.rng
    b.polygon(rect(*area), (132, 130, 126), kinds.CONCRETE)
    u = u0 + 4.0
    while u < u1 - 22.0:
        width = min(float(rng.uniform(24, 52)), u1 - 4.0 - u)
        split = v0 + (v1 - v0) * float(rng.uniform(0.4, 0.65))
        park, hall = (v0 + 2, split - 3), (split, v1 - 3)
        if rng.random() < 0.5:
            park, hall = (split + 3, v1 - 2), (v0 + 3, split)
        _parking(b, (u, park[0], u + width - 3, park[1]))
        hu, hv = 0.5 * (width - 5), 0.5 * (hall[1] - hall[0])
        cu, cv = u + 0.5 * width, 0.5 * (hall[0] + hall[1])
        if hu > 4 and hv > 4:
            eave = float(rng.uniform(5, 12))
            b.building(cu, cv, hu, hv, eave=eave, rise=0.0, shape=FLAT, color=pick(rng, FLAT_ROOFS))
            for _ in range(int(hu * hv / 35)):
                _machine(b, cu + rng.uniform(-0.8, 0.8) * hu, cv + rng.uniform(-0.8, 0.8) * hv, eave)
        u += width + 3.0


def _machine(b: Builder, u: float, v: float, lift: float) -> None:
    """An air conditioner or skylight on a flat roof."""
    rng = b.rng
    size = rng.uniform(0.5, 2.0, 2)
    tall, color = float(rng.uniform(0.4, 1.8)), pick(rng, FLAT_ROOFS)
    b.building(
        u, v, float(size[0]), float(size[1]), eave=tall, rise=0.0, shape=FLAT, color=color, lift=lift, windows=False
    )


def _towers(b: Builder, area: Area) -> None:
    """Tower blocks on lawns."""
    u0, v0, u1, v1 = area
    rng = b.rng
    b.polygon(rect(*area), pick(rng, LAWNS), kinds.GRASS)
    for u in np.arange(u0 + 18, u1 - 16, 44):
        b.line(np.array([[u + 20, v0], [u + 20, v1]]), 2.0, (170, 164, 154), kinds.CONCRETE)
        for v in np.arange(v0 + 18, v1 - 16, 42):
            hu, hv = float(rng.uniform(7, 13)), float(rng.uniform(7, 11))
            height = float(rng.uniform(14, 40))
            color = pick(rng, FLAT_ROOFS)
            b.building(u, v, hu, hv, eave=height, rise=0.0, shape=FLAT, color=color)
            for _ in range(5):
                _machine(b, u + rng.uniform(-0.75, 0.75) * hu, v + rng.uniform(-0.75, 0.75) * hv, height)
            b.building(u + 2, v, 2.5, 2.5, eave=height + 2.8, rise=0, shape=FLAT, color=color, windows=False)
            for _ in range(5):
                r = float(rng.uniform(1.5, 3.5))
                b.tree(u + rng.uniform(-19, 19), v + rng.choice([-1, 1]) * rng.uniform(14, 19), r, r * 2.2)


def _park(b: Builder, area: Area) -> None:
    """Lawn, paths, many trees, sometimes a pond."""
    u0, v0, u1, v1 = area
    rng = b.rng
    b.polygon(rect(*area), pick(rng, LAWNS), kinds.GRASS)
    for _ in range(4):
        knots = rng.uniform((u0, v0), (u1, v1), (4, 2))
        t = np.linspace(0, 1, 24)[:, None]
        curve = (
            (1 - t) ** 3 * knots[0] + 3 * t * (1 - t) ** 2 * knots[1] + 3 * t**2 * (1 - t) * knots[2] + t**3 * knots[3]
        )
        for a, c in itertools.pairwise(curve):
            b.line(np.stack([a, c]), 2.0, (182, 168, 140), kinds.SOIL)
    if rng.random() < 0.4 and min(u1 - u0, v1 - v0) > 50:
        turn = np.linspace(0, 2 * np.pi, 40)[:-1]
        reach = rng.uniform(9, 16) * (1 + 0.2 * np.sin(3 * turn + rng.uniform(0, 6)))
        center = np.array([rng.uniform(u0 + 20, u1 - 20), rng.uniform(v0 + 20, v1 - 20)])
        rim = center + reach[:, None] * np.stack([np.cos(turn) * 1.4, np.sin(turn)], -1)
        b.polygon(rim, (150, 136, 104), kinds.SOIL)
        b.polygon(center + 0.92 * (rim - center), (62, 78, 72), kinds.WATER)
    for _ in range(int((u1 - u0) * (v1 - v0) / 130)):
        r = float(rng.uniform(1.5, 4.8))
        b.tree(rng.uniform(u0 + 2, u1 - 2), rng.uniform(v0 + 2, v1 - 2), r, r * rng.uniform(1.6, 2.6))


def _field(b: Builder, area: Area) -> None:
    """A ploughed or planted field with rows, and a hut."""
    u0, v0, u1, v1 = area
    rng = b.rng
    base = np.asarray(pick(rng, [(128, 108, 80), (112, 122, 66), (154, 140, 90), (120, 100, 76)]))
    b.polygon(rect(*area), (float(base[0]), float(base[1]), float(base[2])), kinds.FIELD)
    for v in np.arange(v0 + 1, v1 - 1, float(rng.uniform(1.2, 2.6))):
        red, green, blue = (float(x) for x in np.clip(base + rng.normal(-18, 9), 0, 255))
        start, stop = u0 + rng.uniform(0.5, 4), u1 - rng.uniform(0.5, 4)
        b.line(np.array([[start, v], [stop, v]]), 0.5, (red, green, blue), kinds.FIELD)
    b.building(u0 + 9, v0 + 8, 5, 4, eave=3.5, rise=1.8, shape=GABLE, color=pick(rng, ROOFS))
    if rng.random() < 0.4:
        b.building(u0 + 24, v0 + 10, 4, 4, eave=8.0, rise=2.5, shape=DOME, color=(190, 190, 192), windows=False)
    for _ in range(6):
        r = float(rng.uniform(2, 4.5))
        b.tree(rng.uniform(u0 + 2, u1 - 2), v1 - 3, r, r * 2)
