"""A flight over level ground with a wide hall, in memory: its frames, and what each picture shows, walls included."""

from pathlib import Path

import cv2
import numpy as np

from orthoswarm.model.camera import focal_px, rotation_from_angles
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from tests.kit.draped import TEXTURE_M, texture

GRID = LocalGrid(32631)
ORIGIN = np.array([500_000.0, 5_000_000.0])
ROOF_M, HEIGHT_M = 14.0, 100.0
MIDDLE, HALF = np.array([60.0, 100.0]), np.array([32.0, 24.0])
"""The hall's middle and half its sides, metres from ORIGIN."""
FOV, SIZE = np.radians(80.0), (320, 240)


def away(xy: np.ndarray, half: np.ndarray = HALF) -> np.ndarray:
    """Distance from the walls of the hall, or of another round its middle, negative inside it."""
    return (np.abs(xy - MIDDLE) - half).max(-1)


class HallFlight:
    """Legs over the hall, 40 m apart, pictures 18 m apart.

    Attributes:
        frames: with exact records. cameras: the true ones, about ORIGIN.
    """

    def __init__(self, roof_m: float = ROOF_M, half: np.ndarray = HALF) -> None:
        self.roof_m, self.half = roof_m, half
        position, rotation = [], []
        for leg in range(4):
            for k in range(12):
                along = 18.0 * k if leg % 2 == 0 else 18.0 * (11 - k)
                position.append([40.0 * leg, along, HEIGHT_M])
                rotation.append(rotation_from_angles(np.pi * (leg % 2), -np.pi / 2, 0.0))
        lens = np.array([[focal_px(FOV, SIZE[0]), 0, 0, 0, 0, 0, *SIZE]])
        self.cameras = CameraBlock(np.array(position), np.array(rotation), np.zeros(len(position), np.int32), lens)
        self._ground, self._roof = texture(1), texture(2)
        self.frames = [self._frame(i) for i in range(len(position))]
        self._shown = [self._show(i) for i in range(len(position))]

    def read(self, frame: Frame) -> np.ndarray:
        """What a frame shows, uint8 (rows, columns)."""
        return self._shown[int(Path(frame.image).stem)]

    def _show(self, i: int) -> np.ndarray:
        rows, columns = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(float)
        uv, index = np.stack([columns, rows], -1).reshape(-1, 2), np.full(rows.size, i)
        roof, ground = (self.cameras.to_ground(index, uv, np.full(len(uv), z)) for z in (self.roof_m, 0.0))
        on_roof = away(roof, self.half) < 0.0
        between = np.array([away(roof + s * (ground - roof), self.half) < 0.0 for s in np.linspace(0.0, 1.0, 9)]).any(0)
        shown = np.where(on_roof, laid(self._roof, roof), np.where(between, 60.0, laid(self._ground, ground)))
        noise = np.random.default_rng(i).normal(0.0, 1.5, len(uv))
        return np.clip(shown + noise, 0.0, 255.0).reshape(rows.shape).astype(np.uint8)

    def _frame(self, i: int) -> Frame:
        height = float(self.cameras.position[i, 2])
        lat, lon = (float(v) for v in GRID.to_geographic(ORIGIN + self.cameras.position[i, :2]))
        yaw = np.pi * (i // 12 % 2) + GRID.convergence_rad(lat, lon)
        fix = Fix(lat, lon, height, yaw_rad=yaw, pitch_rad=-np.pi / 2, roll_rad=0.0)
        return Frame(
            image=f"{i}.jpg", path=Path(f"{i}.jpg"), vehicle="a", time_s=1.75e9 + 3.0 * i, fix=fix, width=SIZE[0],
            height=SIZE[1], fov_hint_rad=FOV,
        )  # fmt: skip


def laid(picture: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Grey values at places (N, 2) of a picture's pixels on a texture that begins 200 m south-west."""
    at = ((xy + 200.0) / TEXTURE_M).astype(np.float32).reshape(SIZE[1], SIZE[0], 2)
    return cv2.remap(picture, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT).ravel()
