"""Drawing a city: its street-aligned frame, and polygons, strokes, buildings and trees placed in that frame."""

from dataclasses import dataclass, field

import numpy as np

from orthoswarm.model.arrays import Array, Ints
from orthoswarm.twin.city.scene import CELL_M, TEXEL_M, Scene
from orthoswarm.twin.city.stamps import stamp_building, stamp_tree

Color = tuple[float, float, float]
Area = tuple[float, float, float, float]  # u0, v0, u1, v1 of a rectangle in the city's frame, metres

LAWNS: list[Color] = [(96, 118, 62), (110, 128, 72), (84, 104, 58), (128, 130, 84), (140, 130, 92)]
ROOFS: list[Color] = [
    (150, 82, 62), (128, 70, 56), (168, 108, 82), (96, 92, 92), (122, 118, 114), (78, 74, 78), (150, 134, 112),
    (92, 104, 118),
]  # fmt: skip
FLAT_ROOFS: list[Color] = [(176, 174, 168), (150, 150, 148), (198, 194, 186), (120, 120, 122), (160, 146, 128)]
WALLS: list[Color] = [(206, 196, 176), (188, 170, 148), (170, 160, 156), (214, 206, 196), (160, 120, 100)]
TREES: list[Color] = [(62, 86, 44), (74, 98, 48), (54, 76, 46), (88, 104, 54), (98, 92, 48)]
CARS: list[Color] = [(225, 225, 225), (60, 60, 64), (150, 152, 156), (150, 40, 36), (44, 62, 112), (24, 24, 26)]


@dataclass(frozen=True, slots=True)
class ParkingPlace:
    """A parking place for a car: X, Y (metres from the grid's upper left) and direction."""

    x: float
    y: float
    angle: float


@dataclass(slots=True)
class Builder:
    """The scene under construction, and the city's own frame (u along the streets, v across; metres)."""

    scene: Scene
    rng: np.random.Generator
    bend: tuple[Array, Array]
    slots: list[ParkingPlace] = field(default_factory=list)

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

    def polygon(self, uv: Array, color: Color, kind: int) -> None:
        """Fill a polygon given in city coordinates."""
        import cv2

        points = self._sixteenths(uv)
        cv2.fillPoly(self.scene.albedo, [points], color, cv2.LINE_AA, 4)
        cv2.fillPoly(self.scene.kind, [points], float(kind), cv2.LINE_8, 4)

    def line(self, uv: Array, width_m: float, color: Color, kind: int) -> None:
        """A stroke along city coordinates, at least one texel wide."""
        import cv2

        points = self._sixteenths(uv)
        thick = max(1, round(width_m / TEXEL_M))
        cv2.polylines(self.scene.albedo, [points], False, color, thick, cv2.LINE_AA, 4)
        cv2.polylines(self.scene.kind, [points], False, float(kind), thick, cv2.LINE_8, 4)

    def _sixteenths(self, uv: Array) -> Ints:
        """Vertices in sixteenths of a texel, as OpenCV draws them, dense enough to follow the bends of streets."""
        return np.round((self.place(_densify(uv)) / TEXEL_M - 0.5) * 16).astype(np.int32)

    def building(
        self, u: float, v: float, hu: float, hv: float, *, eave: float, rise: float, shape: int, color: Color,
        wall: Color | None = None, turn: float = 0.0, lift: float = 0.0, windows: bool = True,
    ) -> None:  # fmt: skip
        """A building at a city position; its floor is the lowest ground near its centre."""
        x, y, angle = self.local(u, v)
        base = self.ground(x, y) + lift
        wall = wall or pick(self.rng, WALLS)
        s = self.scene
        stamp_building(
            s.albedo, s.kind, s.dsm, s.wall, s.facade, x, y, angle + turn, float(hu), float(hv), base, eave,
            float(rise), shape, np.asarray(color, float), np.asarray(wall, float), int(windows),
            int(self.rng.integers(1 << 30)),
        )  # fmt: skip

    def tree(self, u: float, v: float, radius: float, height: float) -> None:
        """A tree at a city position."""
        x, y, _ = self.local(u, v)
        s = self.scene
        color = np.asarray(pick(self.rng, TREES), float) + self.rng.uniform(-10, 10, 3)
        seed = int(self.rng.integers(1 << 30))
        stamp_tree(s.albedo, s.kind, s.dsm, s.dtm, s.wall, s.facade, x, y, radius, height, color, seed)

    def ground(self, x: float, y: float) -> float:
        """Height of the bare ground at X, Y."""
        rows, cols = self.scene.dtm.shape
        r, c = min(max(int(y / CELL_M), 0), rows - 1), min(max(int(x / CELL_M), 0), cols - 1)
        return float(self.scene.dtm[r, c])

    def is_free(self, u: float, v: float, reach: float) -> bool:
        """Whether nothing stands within about `reach` metres of a city position."""
        x, y, _ = self.local(u, v)
        rows, cols = self.scene.dsm.shape
        low = (max(0, int((y - reach) / CELL_M)), max(0, int((x - reach) / CELL_M)))
        part = np.s_[low[0] : max(0, int((y + reach) / CELL_M)), low[1] : max(0, int((x + reach) / CELL_M))]
        if low[0] >= rows or low[1] >= cols:
            return True
        return not bool((self.scene.dsm[part] > self.scene.dtm[part] + 0.5).any())

    def slot(self, u: float, v: float, turn: float) -> None:
        """Add a parking place."""
        x, y, angle = self.local(u, v)
        self.slots.append(ParkingPlace(x, y, angle + turn))


def pick(rng: np.random.Generator, colors: list[Color]) -> Color:
    """One of some colours, slightly varied."""
    base = np.asarray(colors[int(rng.integers(len(colors)))], float) + rng.normal(0, 6, 3)
    r, g, b = np.clip(base, 5, 250)
    return (float(r), float(g), float(b))


def _densify(uv: Array, step: float = 25.0) -> Array:
    """More vertices along a line, closed or open."""
    pieces = []
    for a, b in zip(uv, np.roll(uv, -1, axis=0), strict=True):
        n = max(1, int(np.hypot(*(b - a)) / step))
        pieces.append(a + (b - a) * np.arange(n)[:, None] / n)
    out: Array = np.concatenate(pieces)
    return out


def rect(u0: float, v0: float, u1: float, v1: float) -> Array:
    """The corners (4, 2) of an upright rectangle."""
    return np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]], float)
