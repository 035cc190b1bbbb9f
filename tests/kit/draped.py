"""Pictures of legs over a surface of known shape with a texture draped over it."""

import cv2
import numpy as np

from orthoswarm.model.camera import rotation_from_angles
from orthoswarm.refine.bundle.block_arrays import CameraBlock

WIDTH, HEIGHT, FOCAL = 400, 300, 190.0
TEXTURE_M = 0.4


def texture(seed=0, size=1100):
    rng = np.random.default_rng(seed)
    t = sum(a * cv2.GaussianBlur(rng.normal(0, 1, (size, size)), (0, 0), s) * s for s, a in ((1.2, 22), (4, 25)))
    return np.clip(120 + t, 0, 255).astype(np.float32)


def rig_of(legs=2, *, per_leg=12, spacing=18.0, tilt_deg=3.0, k1=0.0, seed=0, height=100.0):
    """Legs 60 m apart, the second one flown back, with the wobble of a real flight."""
    rng = np.random.default_rng(seed)
    position, rotation, leg = [], [], []
    for number in range(legs):
        for i in range(per_leg):
            along = i * spacing if number % 2 == 0 else (per_leg - 1 - i) * spacing
            position.append(
                [60.0 * number + rng.normal(0, 0.5), along + rng.normal(0, 0.5), height + rng.normal(0, 0.3)]
            )
            yaw = np.pi * (number % 2) + 0.2 + rng.normal(0, 0.01)
            tilt = np.radians(tilt_deg) * rng.normal(0, 1, 2) / 2
            rotation.append(rotation_from_angles(yaw, -np.pi / 2 + tilt[0], tilt[1]))
            leg.append(number)
    lens = np.array([[FOCAL, k1, 0, 0, 0, 0, WIDTH, HEIGHT]])
    cameras = CameraBlock(np.array(position), np.array(rotation), np.zeros(len(leg), np.int32), lens)
    return cameras, np.array(leg)


def render(cameras, i, surface, picture, noise=1.5):
    """What camera i sees of a gentle surface with a texture draped over it (origin 200 m south-west of zero)."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    uv = np.c_[columns.ravel(), rows.ravel()]
    index = np.full(len(uv), i)
    z = np.zeros(len(uv))
    for _ in range(6):
        xy = cameras.to_ground(index, uv, z)
        z = surface(xy)
    at = ((xy + 200.0) / TEXTURE_M).reshape(HEIGHT, WIDTH, 2).astype(np.float32)
    out = cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    gain = 1 + 0.1 * np.sin(i)
    out = out * gain + np.random.default_rng(i).normal(0, noise, out.shape)
    return np.clip(out, 0, 255).astype(np.uint8)


class Pictures:
    def __init__(self, cameras, surface, picture=None):
        self.made = [
            render(cameras, i, surface, texture() if picture is None else picture) for i in range(len(cameras))
        ]
        self.read = []

    def __call__(self, i):
        self.read.append(i)
        return self.made[i]
