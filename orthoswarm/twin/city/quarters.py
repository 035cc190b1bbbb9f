"""The contents of city blocks: houses, halls, towers, parks and fields."""

import itertools

import numpy as np

from orthoswarm.twin.city import scene as kinds
from orthoswarm.twin.city.builder import FLAT_ROOFS, LAWNS, ROOFS, Area, Builder, pick, rect
from orthoswarm.twin.city.stamps import DOME, FLAT, GABLE, HIP


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
