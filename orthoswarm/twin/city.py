"""A procedural city: streets, blocks, houses, towers, lawns, fields, ponds and trees (the twin's usual ground)."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from orthoswarm.geo import GroundGrid
from orthoswarm.twin import scene as kinds
from orthoswarm.twin.grain import add_detail, noise_field
from orthoswarm.twin.scene import CELL_M, TEXEL_M, Scene
from orthoswarm.twin.stamps import DOME, FLAT, GABLE, HIP, stamp_building, stamp_car, stamp_tree

Array = NDArray[np.float64]
Color = tuple[float, float, float]

LAWNS: list[Color] = [(96, 118, 62), (110, 128, 72), (84, 104, 58), (128, 130, 84), (140, 130, 92)]
ROOFS: list[Color] = [
    (150, 82, 62), (128, 70, 56), (168, 108, 82), (96, 92, 92), (122, 118, 114), (78, 74, 78), (150, 134, 112), (92, 104, 118),
]  # fmt: skip
FLAT_ROOFS: list[Color] = [(176, 174, 168), (150, 150, 148), (198, 194, 186), (120, 120, 122), (160, 146, 128)]
WALLS: list[Color] = [(206, 196, 176), (188, 170, 148), (170, 160, 156), (214, 206, 196), (160, 120, 100)]
TREES: list[Color] = [(62, 86, 44), (74, 98, 48), (54, 76, 46), (88, 104, 54), (98, 92, 48)]
CARS: list[Color] = [(225, 225, 225), (60, 60, 64), (150, 152, 156), (150, 40, 36), (44, 62, 112), (24, 24, 26)]

# Grey values of five octaves (0.25, 0.7, 2.3, 9, 45 m) for each kind, and how coarse octaves turn the hue.
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


@dataclass(frozen=True, slots=True)
class Slot:
    """A place where a car may stand: X, Y (metres from the grid's upper left) and direction."""

    x: float
    y: float
    angle: float


@dataclass(slots=True)
class _Builder:
    """The scene under construction, and the city's own frame (u along the streets, v across; metres)."""

    scene: Scene
    rng: np.random.Generator
    bend: tuple[Array, Array]
    slots: list[Slot] = field(default_factory=list)

    def place(self, uv: Array) -> Array:
        """X, Y in metres from the upper left of city coordinates (..., 2); streets bend gently."""
        a = self.scene.angle_rad
        u, v = uv[..., 0], uv[..., 1]
        phase, size = self.bend
        bu = u + size[0] * np.sin(v / 310.0 + phase[0]) + size[1] * np.sin(v / 131.0 + u / 700.0 + phase[1])
        bv = v + size[2] * np.sin(u / 270.0 + phase[2]) + size[3] * np.sin(u / 117.0 - v / 600.0 + phase[3])
        g = self.scene.grid
        east = bu * np.cos(a) - bv * np.sin(a) + 0.5 * g.width * TEXEL_M
        north = bu * np.sin(a) + bv * np.cos(a) - 0.5 * g.height * TEXEL_M
        return np.stack([east, -north], -1)

    def local(self, u: float, v: float) -> tuple[float, float, float]:
        """X, Y of a city position and the local direction of u there (angle from X towards Y)."""
        p = self.place(np.array([[u, v], [u + 1.0, v]]))
        return float(p[0, 0]), float(p[0, 1]), float(np.arctan2(p[1, 1] - p[0, 1], p[1, 0] - p[0, 0]))

    def polygon(self, uv: Array, color: Color, kind: int, *, dense: bool = True) -> None:
        """Fill a polygon given in city coordinates."""
        self.polygon_xy(self.place(_densify(uv) if dense else uv), color, kind)

    def polygon_xy(self, xy: Array, color: Color, kind: int) -> None:
        """Fill a polygon given in X, Y."""
        import cv2

        points = np.round((xy / TEXEL_M - 0.5) * 16).astype(np.int32)
        cv2.fillPoly(self.scene.albedo, [points], color, cv2.LINE_AA, 4)
        cv2.fillPoly(self.scene.kind, [points], float(kind), cv2.LINE_8, 4)

    def line(self, uv: Array, width_m: float, color: Color, kind: int) -> None:
        """A stroke along city coordinates, at least one texel wide."""
        import cv2

        points = np.round((self.place(_densify(uv)) / TEXEL_M - 0.5) * 16).astype(np.int32)
        thick = max(1, round(width_m / TEXEL_M))
        cv2.polylines(self.scene.albedo, [points], False, color, thick, cv2.LINE_AA, 4)
        cv2.polylines(self.scene.kind, [points], False, float(kind), thick, cv2.LINE_8, 4)

    def building(
        self, u: float, v: float, hu: float, hv: float, eave: float, rise: float, shape: int, color: Color,
        wall: Color | None = None, *, turn: float = 0.0, lift: float = 0.0, windows: bool = True,
    ) -> None:  # fmt: skip
        """A building at a city position; its floor is the lowest ground near its centre."""
        x, y, angle = self.local(u, v)
        base = self.ground(x, y) + lift
        wall = wall or _pick(self.rng, WALLS)
        s = self.scene
        stamp_building(
            s.albedo, s.kind, s.dsm, s.wall, s.facade, x, y, angle + turn, hu, hv, base, eave, rise, shape,
            np.asarray(color, float), np.asarray(wall, float), int(windows), int(self.rng.integers(1 << 30)),
        )  # fmt: skip

    def tree(self, u: float, v: float, radius: float, height: float) -> None:
        """A tree at a city position."""
        x, y, _ = self.local(u, v)
        self.tree_xy(x, y, radius, height)

    def tree_xy(self, x: float, y: float, radius: float, height: float) -> None:
        """A tree at X, Y."""
        s = self.scene
        color = np.asarray(_pick(self.rng, TREES), float) + self.rng.uniform(-10, 10, 3)
        seed = int(self.rng.integers(1 << 30))
        stamp_tree(s.albedo, s.kind, s.dsm, s.dtm, s.wall, s.facade, x, y, radius, height, color, seed)

    def ground(self, x: float, y: float) -> float:
        """Height of the bare ground at X, Y."""
        rows, cols = self.scene.dtm.shape
        r, c = min(max(int(y / CELL_M), 0), rows - 1), min(max(int(x / CELL_M), 0), cols - 1)
        return float(self.scene.dtm[r, c])

    def slot(self, u: float, v: float, turn: float) -> None:
        """Remember a place for a car."""
        x, y, angle = self.local(u, v)
        self.slots.append(Slot(x, y, angle + turn))


def _pick(rng: np.random.Generator, colors: list[Color]) -> Color:
    base = np.asarray(colors[int(rng.integers(len(colors)))], float) + rng.normal(0, 6, 3)
    r, g, b = np.clip(base, 5, 250)
    return (float(r), float(g), float(b))


def _densify(uv: Array, step: float = 25.0) -> Array:
    """More vertices along a closed or open line, so that bends of the streets are followed."""
    pieces = []
    for a, b in zip(uv, np.roll(uv, -1, axis=0), strict=True):
        n = max(1, int(np.hypot(*(b - a)) / step))
        pieces.append(a + (b - a) * np.arange(n)[:, None] / n)
    out: Array = np.concatenate(pieces)
    return out


def _rect(u0: float, v0: float, u1: float, v1: float) -> Array:
    return np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]], float)


def build_city(grid: GroundGrid, seed: int, *, relief_m: float = 0.0) -> tuple[Scene, list[Slot]]:
    """A city on a texture grid, without cars, and the places where cars may stand.

    Args:
        grid: from `scene_grid`.
        seed: which city.
        relief_m: smooth ground relief of about +-relief_m about height 0.
    """
    rng = np.random.default_rng([seed, 11])
    scene = Scene.blank(grid, float(rng.uniform(-0.6, 0.6)))
    if relief_m:
        scene.dtm[:] = smooth_relief(scene.dtm.shape, relief_m, seed)
        scene.dsm[:] = scene.dtm
    scene.albedo[:] = (98, 98, 100)
    scene.kind[:] = kinds.ASPHALT
    bend = (rng.uniform(0, 6.28, 4), rng.uniform(0.4, 1.0, 4) * np.array([9.0, 3.0, 9.0, 3.0]))
    builder = _Builder(scene, rng, bend)
    radius = 0.5 * TEXEL_M * float(np.hypot(grid.width, grid.height)) + 30.0
    for block in _split(builder, (-radius, -radius, radius, radius), 0):
        if _near(builder, block):
            _fill_block(builder, block)
    _asphalt_patches(builder, radius)
    amplitude = np.zeros((kinds.KINDS, 5), np.float32)
    tint = np.ones((kinds.KINDS, 3), np.float32)
    for kind, (levels, hue) in _DETAIL.items():
        amplitude[kind], tint[kind] = levels, hue
    add_detail(scene.albedo, scene.kind, amplitude, tint, seed * 977 + 5)
    return scene, builder.slots


def smooth_relief(shape: tuple[int, ...], relief_m: float, seed: int) -> NDArray[np.float32]:
    """Rolling ground of about +-relief_m: features of 600 m down to 150 m, float32 of `shape` on cells."""
    import cv2

    coarse = noise_field((shape[0] // 16 + 2, shape[1] // 16 + 2), CELL_M * 16, 560.0, 3, seed * 31 + 7)
    coarse -= float(np.mean(coarse))
    coarse *= relief_m / float(np.percentile(np.abs(coarse), 98))
    return np.asarray(cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC), np.float32)


def place_cars(scene: Scene, slots: list[Slot], seed: int, share: float = 0.55) -> None:
    """Put cars on a random share of the slots, in place (another seed, other cars elsewhere)."""
    rng = np.random.default_rng([seed, 23])
    for slot in slots:
        if rng.random() > share:
            continue
        color = np.asarray(_pick(rng, CARS), float)
        along, across, turn = rng.normal(0, 0.5), rng.normal(0, 0.2), rng.normal(0, 0.03)
        ca, sa = np.cos(slot.angle), np.sin(slot.angle)
        stamp_car(
            scene.albedo, scene.kind, scene.dsm, scene.dtm, scene.wall, scene.facade,
            slot.x + along * ca - across * sa, slot.y + along * sa + across * ca,
            slot.angle + turn, rng.uniform(4.0, 5.0), color,
        )  # fmt: skip


def _near(b: _Builder, block: tuple[float, float, float, float]) -> bool:
    """Whether a block touches the grid."""
    xy = b.place(_rect(*block))
    g = b.scene.grid
    return bool(
        (xy[:, 0].max() > -20) and (xy[:, 1].max() > -20)
        and (xy[:, 0].min() < g.width * TEXEL_M + 20) and (xy[:, 1].min() < g.height * TEXEL_M + 20)
    )  # fmt: skip


def _split(b: _Builder, area: tuple[float, float, float, float], depth: int) -> list[tuple[float, float, float, float]]:
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


def _street(b: _Builder, ends: Array, width: float) -> None:
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


def _asphalt_patches(b: _Builder, radius: float) -> None:
    """Repairs and manholes: texture on streets that would else be even."""
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
        patch = np.zeros((1,), np.uint8)
        del patch
        corners = np.round(box * 16).astype(np.int32)
        low, high = np.maximum(box.min(0).astype(int) - 1, 0), box.max(0).astype(int) + 2
        window = s.kind[low[1] : high[1], low[0] : high[0]]
        if window.size and np.isin(window, (kinds.ASPHALT, kinds.CONCRETE)).all():
            cv2.fillConvexPoly(s.albedo, corners, (grey, grey, grey), cv2.LINE_AA, 4)


def _fill_block(b: _Builder, block: tuple[float, float, float, float]) -> None:
    """Pave a block's rim and put one kind of quarter on it."""
    u0, v0, u1, v1 = block
    b.polygon(_rect(*block), (158, 156, 150), kinds.CONCRETE)
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


def _houses(b: _Builder, area: tuple[float, float, float, float]) -> None:
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


def _lot(b: _Builder, area: tuple[float, float, float, float], front: float) -> None:
    u0, v0, u1, v1 = area
    rng = b.rng
    width, depth = u1 - u0, v1 - v0
    soil = rng.random() < 0.12
    b.polygon(_rect(*area), _pick(rng, LAWNS) if not soil else (142, 122, 96), kinds.SOIL if soil else kinds.GRASS)
    b.line(_rect(*area), 0.25, (130, 116, 96), kinds.CONCRETE)
    if width < 9 or depth < 14:
        return
    hu, hv = min(0.5 * width - 1.5, rng.uniform(4.5, 7.5)), rng.uniform(4.0, 5.8)
    u = 0.5 * (u0 + u1) + rng.uniform(-1, 1)
    v = (v0 + 5.5 + hv if front < 0 else v1 - 5.5 - hv) - front * rng.uniform(-1.0, 3.0)
    street = v0 if front < 0 else v1
    drive = u + rng.choice([-1.0, 1.0]) * (hu - 1.7)
    b.polygon(_rect(drive - 1.6, min(street, v), drive + 1.6, max(street, v)), (168, 164, 156), kinds.CONCRETE)
    b.slot(drive, 0.5 * (street + v) - front * -1.0, np.pi / 2)
    for _ in range(int(rng.integers(1, 4))):  # beds, terraces, paths
        w, h = rng.uniform(1.5, 6.0), rng.uniform(1.0, 4.0)
        p, q = rng.uniform(u0 + 1, u1 - 1 - w), rng.uniform(v0 + 1, v1 - 1 - h)
        b.polygon(_rect(p, q, p + w, q + h), _pick(rng, [(120, 96, 70), (176, 160, 138), (100, 112, 70)]), kinds.SOIL)
    shape = int(rng.choice([GABLE, GABLE, HIP, FLAT]))
    eave = float(rng.uniform(3.2, 6.8))
    rise = 0.0 if shape == FLAT else float(rng.uniform(1.6, 3.6))
    turn = float(rng.normal(0, 0.03)) + (np.pi / 2 if rng.random() < 0.3 else 0.0)
    color = _pick(rng, ROOFS)
    b.building(u, v, hu, hv, eave, rise, shape, color, turn=turn)
    if rng.random() < 0.4:  # a wing
        b.building(u + rng.uniform(-2, 2), v - front * hv, 3.0, 3.5, eave * 0.7, rise * 0.6, shape, color, turn=turn)
    if rng.random() < 0.5:
        b.building(
            u + rng.uniform(-hu, hu) * 0.5, v + rng.uniform(-1, 1), 0.5, 0.5, eave + rise + 0.8, 0, FLAT, (110, 84, 74)
        )
    back = v1 if front < 0 else v0
    if rng.random() < 0.5:
        b.building(
            rng.uniform(u0 + 3, u1 - 3), back + front * 3.5, 2.2, 1.8, 2.4, 0.5, GABLE, _pick(rng, ROOFS), windows=False
        )
    if rng.random() < 0.12:
        b.polygon(_rect(u - 3, back + front * 9 - 2, u + 3, back + front * 9 + 2), (92, 168, 190), kinds.CONCRETE)
    for _ in range(int(rng.integers(0, 4))):
        r = float(rng.uniform(1.2, 3.6))
        b.tree(rng.uniform(u0 + 1, u1 - 1), back + front * rng.uniform(1.0, 0.4 * depth), r, r * rng.uniform(1.6, 2.6))


def _parking(b: _Builder, area: tuple[float, float, float, float]) -> None:
    """A car park with stalls."""
    u0, v0, u1, v1 = area
    g = float(b.rng.normal(104, 10))
    b.polygon(_rect(*area), (g, g, g + 2), kinds.ASPHALT)
    for v in np.arange(v0 + 1.0, v1 - 5.5, 16.5):
        for stall in np.arange(u0 + 1.0, u1 - 2.5, 2.7):
            b.line(np.array([[stall, v], [stall, v + 5.0]]), 0.25, (205, 205, 205), kinds.MARK)
            b.slot(stall + 1.35, v + 2.5, np.pi / 2)


def _halls(b: _Builder, area: tuple[float, float, float, float]) -> None:
    """Large flat roofs with machines on them, and car parks."""
    u0, v0, u1, v1 = area
    rng = b.rng
    b.polygon(_rect(*area), (132, 130, 126), kinds.CONCRETE)
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
            b.building(cu, cv, hu, hv, eave, 0.0, FLAT, _pick(rng, FLAT_ROOFS))
            for _ in range(int(hu * hv / 35)):
                _machine(b, cu + rng.uniform(-0.8, 0.8) * hu, cv + rng.uniform(-0.8, 0.8) * hv, eave)
        u += width + 3.0


def _machine(b: _Builder, u: float, v: float, lift: float) -> None:
    """An air conditioner or skylight on a flat roof."""
    rng = b.rng
    size = rng.uniform(0.5, 2.0, 2)
    b.building(u, v, float(size[0]), float(size[1]), float(rng.uniform(0.4, 1.8)), 0.0, FLAT, _pick(rng, FLAT_ROOFS), lift=lift, windows=False)  # fmt: skip


def _towers(b: _Builder, area: tuple[float, float, float, float]) -> None:
    """High houses in lawns."""
    u0, v0, u1, v1 = area
    rng = b.rng
    b.polygon(_rect(*area), _pick(rng, LAWNS), kinds.GRASS)
    for u in np.arange(u0 + 18, u1 - 16, 44):
        b.line(np.array([[u + 20, v0], [u + 20, v1]]), 2.0, (170, 164, 154), kinds.CONCRETE)
        for v in np.arange(v0 + 18, v1 - 16, 42):
            hu, hv = float(rng.uniform(7, 13)), float(rng.uniform(7, 11))
            height = float(rng.uniform(14, 40))
            color = _pick(rng, FLAT_ROOFS)
            b.building(u, v, hu, hv, height, 0.0, FLAT, color)
            for _ in range(5):
                _machine(b, u + rng.uniform(-0.75, 0.75) * hu, v + rng.uniform(-0.75, 0.75) * hv, height)
            b.building(u + 2, v, 2.5, 2.5, height + 2.8, 0, FLAT, color, windows=False)
            for _ in range(5):
                r = float(rng.uniform(1.5, 3.5))
                b.tree(u + rng.uniform(-19, 19), v + rng.choice([-1, 1]) * rng.uniform(14, 19), r, r * 2.2)


def _park(b: _Builder, area: tuple[float, float, float, float]) -> None:
    """Lawn, paths, many trees, sometimes a pond."""
    u0, v0, u1, v1 = area
    rng = b.rng
    b.polygon(_rect(*area), _pick(rng, LAWNS), kinds.GRASS)
    for _ in range(4):
        p = rng.uniform((u0, v0), (u1, v1), (4, 2))
        t = np.linspace(0, 1, 24)[:, None]
        curve = (1 - t) ** 3 * p[0] + 3 * t * (1 - t) ** 2 * p[1] + 3 * t**2 * (1 - t) * p[2] + t**3 * p[3]
        for a, c in zip(curve[:-1], curve[1:], strict=True):
            b.line(np.stack([a, c]), 2.0, (182, 168, 140), kinds.SOIL)
    if rng.random() < 0.4 and min(u1 - u0, v1 - v0) > 50:
        turn = np.linspace(0, 2 * np.pi, 40)[:-1]
        r = rng.uniform(9, 16) * (1 + 0.2 * np.sin(3 * turn + rng.uniform(0, 6)))
        center = np.array([rng.uniform(u0 + 20, u1 - 20), rng.uniform(v0 + 20, v1 - 20)])
        rim = center + r[:, None] * np.stack([np.cos(turn) * 1.4, np.sin(turn)], -1)
        b.polygon(rim, (150, 136, 104), kinds.SOIL)
        b.polygon(center + 0.92 * (rim - center), (62, 78, 72), kinds.WATER)
    for _ in range(int((u1 - u0) * (v1 - v0) / 130)):
        r = float(rng.uniform(1.5, 4.8))
        b.tree(rng.uniform(u0 + 2, u1 - 2), rng.uniform(v0 + 2, v1 - 2), r, r * rng.uniform(1.6, 2.6))


def _field(b: _Builder, area: tuple[float, float, float, float]) -> None:
    """A ploughed or grown field with rows, and a hut."""
    u0, v0, u1, v1 = area
    rng = b.rng
    base = np.asarray(_pick(rng, [(128, 108, 80), (112, 122, 66), (154, 140, 90), (120, 100, 76)]))
    b.polygon(_rect(*area), tuple(base), kinds.FIELD)
    for v in np.arange(v0 + 1, v1 - 1, float(rng.uniform(1.2, 2.6))):
        shade = tuple(float(x) for x in np.clip(base + rng.normal(-18, 9), 0, 255))
        start, stop = u0 + rng.uniform(0.5, 4), u1 - rng.uniform(0.5, 4)
        b.line(np.array([[start, v], [stop, v]]), 0.5, shade, kinds.FIELD)
    b.building(u0 + 9, v0 + 8, 5, 4, 3.5, 1.8, GABLE, _pick(rng, ROOFS))
    if rng.random() < 0.4:
        b.building(u0 + 24, v0 + 10, 4, 4, 8.0, 2.5, DOME, (190, 190, 192), windows=False)
    for _ in range(6):
        r = float(rng.uniform(2, 4.5))
        b.tree(rng.uniform(u0 + 2, u1 - 2), v1 - 3, r, r * 2)
