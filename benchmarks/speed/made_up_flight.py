"""A made-up survey flight with JPEG pictures on disk, for the mosaic benchmarks: three vehicles, straight legs."""

from pathlib import Path

import cv2
import numpy as np

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import PlacedFrame

EAST, NORTH = 327000.0, 3383000.0
HEIGHT_M, SPACING_M, LEG_SPACING_M = 150.0, 8.75, 95.0
WIDTH, HEIGHT = 640, 480
TEXTURE_M = 0.5


def texture(size: int, seed: int = 0) -> np.ndarray:
    """A ground of patches, edges and grain at all scales, so that JPEGs are as large as those of a town."""
    rng = np.random.default_rng(seed)
    image = np.full((size, size, 3), 120.0, np.float32)
    for scale, strength in ((128, 25), (32, 30), (8, 18), (2, 5)):
        small = rng.normal(0, strength, (size // scale + 2, size // scale + 2, 3)).astype(np.float32)
        blow = cv2.INTER_NEAREST if scale in (8, 32) else cv2.INTER_LINEAR
        image += cv2.resize(small, None, fx=scale, fy=scale, interpolation=blow)[:size, :size]
    return np.clip(image, 0, 255).astype(np.uint8)


def fly(folder: Path, count: int, quality: int = 90) -> list[PlacedFrame]:
    """Take about `count` pictures over a square area, in the order in which three vehicles take them at once."""
    rng = np.random.default_rng(1)
    per_leg = max(4, round(np.sqrt(count * LEG_SPACING_M / SPACING_M)))
    legs = max(3, round(count / per_leg / 3) * 3)
    side = max(per_leg * SPACING_M, legs * LEG_SPACING_M) + 500.0
    ground = texture(int(side / TEXTURE_M))
    lens = Lens(WIDTH, HEIGHT, focal_px(float(np.radians(90.0)), WIDTH))
    to_texture = np.array([[1 / TEXTURE_M, 0, 250 / TEXTURE_M], [0, 1 / TEXTURE_M, 250 / TEXTURE_M], [0, 0, 1]])
    frames = []
    for step in range(legs // 3 * per_leg):
        for vehicle in range(3):
            leg, along = divmod(step, per_leg)
            leg += vehicle * (legs // 3)
            forward = along if leg % 2 == 0 else per_leg - 1 - along
            x, y = leg * LEG_SPACING_M + rng.normal(0, 1), forward * SPACING_M + rng.normal(0, 0.5)
            angles = np.radians(
                [180.0 * (leg % 2) + 20.0 + rng.normal(0, 1), -91.5 + rng.normal(0, 1), rng.normal(0, 1)]
            )
            camera = Camera(np.array([x, y, HEIGHT_M + rng.normal(0, 0.3)]), rotation_from_angles(*angles), lens)
            picture = cv2.warpPerspective(
                ground, to_texture @ camera.homography(), (WIDTH, HEIGHT), flags=cv2.WARP_INVERSE_MAP
            )
            name = f"uav{vehicle + 1}_{step:04d}.jpg"
            cv2.imwrite(str(folder / name), picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
            placed = Camera(camera.position + np.array([EAST, NORTH, 0.0]), camera.rotation, lens)
            frame = Frame(
                image=name,
                path=folder / name,
                vehicle=f"uav{vehicle + 1}",
                time_s=float(step),
                fix=Fix(0.0, 0.0),
                width=WIDTH,
                height=HEIGHT,
            )
            frames.append(PlacedFrame(frame, placed, "realtime", 1.0))
    return frames


def area(frames: list[PlacedFrame]) -> GroundGrid:
    """The grid of all that the frames see, at the default ground pixel."""
    from orthoswarm.mosaic.footprint import default_gsd, footprint_boxes

    cameras = [f.camera for f in frames]
    boxes = footprint_boxes(cameras, 0.0, 0.0)
    west, south = (float(v) for v in boxes[:, :2].min(0))
    east, north = (float(v) for v in boxes[:, 2:].max(0))
    return GroundGrid.around(32648, BoundingBox(west, south, east, north), default_gsd(cameras))
