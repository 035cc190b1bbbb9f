"""A made-up flat ground, photos of it with a drone's tags or parts of them, and a map of it; all in milliseconds."""

from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from orthoswarm.model.camera import Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.model.geo import GroundGrid, LocalGrid, utm_epsg
from orthoswarm.twin.drone_photo import PhotoTags, with_tags

GSD = 0.5
SIDE = 640.0
FOV = 82.0
WIDTH, HEIGHT = 320, 240


@dataclass(frozen=True)
class Shot:
    """One photo: where it is (metres from the scene's middle), how it looks (degrees), and which tags it has."""

    east: float
    north: float
    _: KW_ONLY
    height: float = 80.0
    yaw: float = 0.0
    pitch: float = -90.0
    roll: float = 0.0
    time_s: float = 1_700_000_000.0
    fov: float = FOV
    size: tuple[int, int] = (WIDTH, HEIGHT)
    tags: str = "all"  # all, position, none
    recorded: tuple[float, float] = (0.0, 0.0)  # error of the recorded position


class Scene:
    """The ground around a position, and what is made of it."""

    def __init__(self, lat: float = 47.4, lon: float = 8.5, seed: int = 3):
        self.grid = LocalGrid(utm_epsg(lat, lon))
        self.lat, self.lon = lat, lon
        self.middle = np.round(self.grid.to_grid(lat, lon))
        n = int(SIDE / GSD)
        self.ground = GroundGrid(
            epsg=self.grid.epsg,
            west=self.middle[0] - SIDE / 2,
            north=self.middle[1] + SIDE / 2,
            gsd_m=GSD,
            width=n,
            height=n,
        )
        self.rgb = scene_texture(n, seed)

    def camera(self, shot: Shot) -> Camera:
        yaw = np.radians(shot.yaw) - self.grid.convergence_rad(self.lat, self.lon)
        rotation = rotation_from_angles(yaw, np.radians(shot.pitch), np.radians(shot.roll))
        lens = Lens(*shot.size, focal_px(np.radians(shot.fov), max(shot.size)))
        return Camera(np.array([*np.add(self.middle, (shot.east, shot.north)), shot.height]), rotation, lens)

    def picture(self, shot: Shot):
        """What the camera sees, RGB."""
        to_ground = self.camera(shot).homography()
        to_raster = self.ground.homography_from_ground() @ to_ground
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        return cv2.warpPerspective(self.rgb, to_raster, shot.size, flags=flags, borderMode=cv2.BORDER_REFLECT)

    def write(self, path: Path, shot: Shot) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        bgr = self.picture(shot)[..., ::-1]
        jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()
        here = np.add(self.middle, (shot.east + shot.recorded[0], shot.north + shot.recorded[1]))
        lat, lon = self.grid.to_geographic(here)
        if shot.tags == "all":
            angles = (shot.yaw, shot.pitch, shot.roll)
            tags = PhotoTags(
                time_s=shot.time_s,
                lat_deg=lat,
                lon_deg=lon,
                altitude_m=500 + shot.height,
                height_m=shot.height,
                gimbal_deg=angles,
                flight_deg=(shot.yaw, 0.0, 0.0),
            )
            path.write_bytes(with_tags(jpeg, tags))
        elif shot.tags == "position":
            path.write_bytes(jpeg)
            exif = Image.Exif()
            gps = exif.get_ifd(0x8825)
            gps[1], gps[2] = ("N" if lat >= 0 else "S"), _dms(abs(lat))
            gps[3], gps[4] = ("E" if lon >= 0 else "W"), _dms(abs(lon))
            with Image.open(path) as image:
                image.save(path, exif=exif, quality=95)
        else:
            path.write_bytes(jpeg)
        return path

    def fly(self, folder: Path, shots, suffix: str = "JPG") -> list[Path]:
        return [self.write(folder / f"DJI_{i:04d}.{suffix}", shot) for i, shot in enumerate(shots)]

    def basemap(self, path: Path) -> Path:
        import rasterio

        with rasterio.open(
            path, "w", driver="GTiff", width=self.ground.width, height=self.ground.height, count=3, dtype="uint8",
            crs=f"EPSG:{self.ground.epsg}", transform=self.ground.affine(), tiled=True,
        ) as out:  # fmt: skip
            out.write(self.rgb.transpose(2, 0, 1))
        return path

    def error_m(self, row: dict, shot: Shot) -> float:
        """How far a line of frames.jsonl puts the picture's middle and corners from where they are, at worst."""
        w, h = shot.size
        pixels = np.array([[w / 2, h / 2], [0, 0], [w - 1, 0], [w - 1, h - 1], [0, h - 1]])
        at = np.c_[pixels, np.ones(5)] @ np.array(row["homography"]).T
        truth = self.camera(shot).to_ground(pixels)
        return float(np.hypot(*(at[:, :2] / at[:, 2:] - truth).T).max())


def legs(count: int = 3, photos: int = 8, step: float = 22.0, apart: float = 45.0, noise: float = 1.0, **fixed):
    """Shots of a boustrophedon flight, east and back, with noise on the recorded positions."""
    rng = np.random.default_rng(7)
    out = []
    for leg in range(count):
        for i in range(photos):
            along = (i - (photos - 1) / 2) * step * (1 if leg % 2 == 0 else -1)
            across = (leg - (count - 1) / 2) * apart
            yaw = 90.0 if leg % 2 == 0 else -90.0
            recorded = tuple(rng.uniform(-noise, noise, 2))
            shot = Shot(along, across, yaw=yaw, time_s=1_700_000_000.0 + 4.0 * len(out), recorded=recorded)
            out.append(replace(shot, **fixed))
    return out


def scene_texture(n: int, seed: int):
    """Blotches of several sizes, and blocks with sharp edges, as roofs and fields have them."""
    rng = np.random.default_rng(seed)
    rgb = np.zeros((n, n, 3), np.float32)
    for scale, weight in ((160, 50), (40, 35), (10, 25), (3, 22)):
        small = rng.standard_normal((n // scale + 2, n // scale + 2, 3)).astype(np.float32)
        rgb += weight * cv2.resize(small, (n, n), interpolation=cv2.INTER_CUBIC)
    rgb = 128 + 0.6 * rgb
    for _ in range(500):
        x, y = rng.integers(0, n, 2)
        a, b = rng.integers(6, 40, 2)
        box = cv2.boxPoints(((float(x), float(y)), (float(a), float(b)), float(rng.uniform(0, 90))))
        cv2.fillPoly(rgb, [box.astype(np.int32)], [float(v) for v in rng.uniform(30, 230, 3)])
    return np.clip(rgb, 0, 255).astype(np.uint8)


def _dms(value: float):
    degrees = int(value)
    minutes = int((value - degrees) * 60)
    return (degrees, minutes, round(((value - degrees) * 60 - minutes) * 60, 7))
