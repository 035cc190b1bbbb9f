"""A made-up ground whose colour is known everywhere, and exact pictures of it: what mosaics are tested against."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import PlacedFrame, Terrain

EAST, NORTH = 327000.0, 3383000.0
_WAVES = np.array(
    [
        [0.31, 0.12, 0.3],
        [-0.11, 0.29, 1.1],
        [0.23, 0.27, 2.0],
        [0.05, -0.07, 0.4],
        [-0.35, 0.17, 1.7],
        [0.02, 0.015, 2.2],
    ]
)


def colour(east_north):
    """Red, green, blue (..., 3) of the ground: sums of waves some 16 m long and longer, 20 to 235."""
    p = np.asarray(east_north) - (EAST, NORTH)
    waves = np.sin(p @ _WAVES[:, :2].T + _WAVES[:, 2])
    mix = np.array([[1, 0.5, 0], [0, 1, 0.4], [0.6, 0, 1], [1, 1, 1], [0, -1, 0.5], [1, 1, 1]])
    return 128.0 + 30.0 * (waves @ mix)


def hills(east_north):
    """Heights of smooth hills, +-8 m."""
    p = np.asarray(east_north) - (EAST, NORTH)
    return 8.0 * np.sin(p[..., 0] / 60.0) * np.cos(p[..., 1] / 75.0)


def level(east_north):
    return np.zeros(np.shape(east_north)[:-1])


def terrain_of(height: Callable, step_m: float = 30.0, reach_m: float = 600.0) -> Terrain:
    n = int(2 * reach_m / step_m) + 1
    west, south = EAST - reach_m, NORTH - reach_m
    nodes = np.stack(np.meshgrid(west + step_m * np.arange(n), south + step_m * np.arange(n)), -1)
    return Terrain(west, south, step_m, height(nodes).astype(np.float32))


def picture_of(camera: Camera, height: Callable = level, gain=1.0):
    """The picture that a camera takes, uint8 (H, W, 3)."""
    lens = camera.lens
    pixels = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), -1).astype(float)
    z = np.zeros(pixels.shape[:2])
    for _ in range(12):
        ground = camera.to_ground(pixels, z)
        z = height(np.nan_to_num(ground, nan=EAST))
    return np.clip(np.rint(colour(np.nan_to_num(ground)) * gain), 0, 255).astype(np.uint8)


def camera(
    east=0.0, north=0.0, height=100.0, *, yaw_deg=0.0, pitch_deg=-90.0, roll_deg=0.0, lens: Lens | None = None
) -> Camera:
    angles = np.radians([yaw_deg, pitch_deg, roll_deg])
    return Camera(np.array([EAST + east, NORTH + north, height]), rotation_from_angles(*angles), lens or small_lens())


def small_lens(**terms: float) -> Lens:
    return Lens(160, 120, 90.0, **terms)


def grid(size_m=200.0, gsd_m=1.0, east=0.0, north=0.0) -> GroundGrid:
    half = size_m / 2
    bounds = BoundingBox(EAST + east - half, NORTH + north - half, EAST + east + half, NORTH + north + half)
    return GroundGrid.around(32648, bounds, gsd_m)


@dataclass
class Flight:
    """Frames and their pictures in memory; `read` takes the place of reading files."""

    frames: list[PlacedFrame] = field(default_factory=list)
    pictures: dict[str, np.ndarray] = field(default_factory=dict)

    def take(self, camera: Camera, height: Callable = level, *, vehicle="uav1", weak=False, gain=1.0) -> "Flight":
        name = f"{vehicle}_{len(self.frames):04d}.jpg"
        frame = Frame(
            image=name,
            path=Path(name),
            vehicle=vehicle,
            time_s=None,
            fix=Fix(0, 0),
            width=camera.lens.width,
            height=camera.lens.height,
        )
        self.frames.append(PlacedFrame(frame, camera, "fine", 0.1, weak))
        self.pictures[name] = picture_of(camera, height, gain)
        return self

    def read(self, path: Path, longest: int = 0) -> np.ndarray:
        return self.pictures[path.name]

    @property
    def cameras(self) -> list[Camera]:
        return [f.camera for f in self.frames]


def survey(seed=0, height: Callable = level, lens: Lens | None = None, tilt_deg=6.0, count=12) -> Flight:
    """Two legs of a dozen frames with every heading and some tilt."""
    rng = np.random.default_rng(seed)
    flight = Flight()
    for k in range(count):
        leg, along = divmod(k, (count + 1) // 2)
        flight.take(
            camera(
                east=-45 + 90 * leg + rng.normal(0, 3),
                north=-60 + 120 * along / max(1, (count + 1) // 2 - 1) + rng.normal(0, 3),
                height=100 + rng.normal(0, 2),
                yaw_deg=rng.uniform(0, 360),
                pitch_deg=-90 + rng.normal(0, tilt_deg),
                roll_deg=rng.normal(0, tilt_deg),
                lens=lens,
            ),
            height,
            vehicle=f"uav{leg + 1}",
        )
    return flight


def pixel_centres(grid: GroundGrid):
    columns, rows = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    return grid.to_ground(np.stack([columns, rows], -1))


def seen(camera: Camera, grid: GroundGrid, height: Callable = level, margin=0.0):
    """Where a camera sees a grid's pixel centres, bool (rows, columns); and squared distances to its nadir point."""
    ground = pixel_centres(grid)
    z = height(ground)
    uv = camera.project(np.concatenate([ground, z[..., None]], -1))
    size = (camera.lens.width - 1.0 - margin, camera.lens.height - 1.0 - margin)
    inside = ((uv >= margin) & (uv <= size)).all(-1) & unfolded(camera, ground, z)
    d2 = ((ground - camera.nadir) ** 2).sum(-1)
    rise = camera.position[2] - z
    return inside & (rise > 0) & (d2 <= (np.tan(np.radians(75.0)) * rise) ** 2), d2


def unfolded(camera: Camera, ground, z):
    """Where radial distortion grows with the angle; beyond, Camera.project folds the ground back into the picture."""
    d = (np.concatenate([ground, z[..., None]], -1) - camera.position) @ camera.rotation
    r2 = ((d[..., :2] / np.maximum(d[..., 2:], 1e-3)) ** 2).sum(-1)
    lens = camera.lens
    return 1.0 + r2 * (3 * lens.k1 + r2 * (5 * lens.k2 + r2 * 7 * lens.k3)) >= 0.2


def shift_of(image, truth, valid):
    """Least-squares shift (columns, rows) in pixels between a picture and its truth (H, W), by gradients."""
    gy, gx = np.gradient(truth)
    a = np.stack([gx[valid], gy[valid]], 1)
    return np.linalg.lstsq(a, (image - truth)[valid], rcond=None)[0]
