"""A made-up flight over rolling ground, seen by a pinhole: matches without pictures, with exact truth."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from orthoswarm.model.camera import rotation_from_angles
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.features.pair_matching import Pair
from orthoswarm.refine.features.sift_features import SiftFeatures

GRID = LocalGrid(32632)
ORIGIN = np.array([500000.0, 5200000.0])


@dataclass
class World:
    """Photos, their true cameras, and matches between them."""

    frames: list[Frame]
    cameras: CameraBlock
    features: list[SiftFeatures]
    pairs: list[Pair]


def lawnmower(legs: int, photos: int, step: float, spacing: float, along_north: bool) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 2) and courses (N,) of a lawnmower flight centred on 0."""
    xy, course = [], []
    for leg in range(legs):
        s = (np.arange(photos) - (photos - 1) / 2) * step
        s = s if leg % 2 == 0 else -s
        c = np.full(photos, (leg - (legs - 1) / 2) * spacing)
        xy.append(np.stack([c, s] if along_north else [s, c], 1))
        heading = 0.0 if along_north else np.pi / 2
        course.append(np.full(photos, heading + (0.0 if leg % 2 == 0 else np.pi)))
    return np.concatenate(xy), np.concatenate(course)


def make_world(
    xy: np.ndarray,
    yaw: np.ndarray,
    *,
    height: float | np.ndarray = 60.0,
    fov_deg: float = 80.0,
    tilt_deg: float = 0.0,
    k1: float = 0.0,
    relief: float = 1.0,
    gps_sigma: float = 1.0,
    noise_px: float = 0.4,
    seed: int = 0,
    size: tuple[int, int] = (800, 600),
) -> World:
    """Frames that record position, height, yaw and a nadir pitch; matches of every overlapping pair."""
    rng = np.random.default_rng(seed)
    n = len(xy)
    w, h = size
    f = 0.5 * w / np.tan(np.radians(fov_deg) / 2)
    attitude = np.radians(0.5)
    rotation = rotation_from_angles(
        yaw + rng.normal(0, attitude, n),
        np.radians(tilt_deg) - np.pi / 2 + rng.normal(0, attitude, n),
        rng.normal(0, attitude, n),
    )
    z = height + rng.normal(0, 0.3, n)
    high_up = float(np.max(height))
    lens = np.array([[f, k1, 0, 0, 0, 0, w, h]], float)
    cameras = CameraBlock(np.column_stack([xy, z]), rotation, np.zeros(n, np.int32), lens)
    reach = 1.2 * high_up
    low, high = xy.min(0) - reach, xy.max(0) + reach
    count = int(np.prod(high - low) / (high_up / 12) ** 2)
    ground = rng.uniform(low, high, (count, 2))
    bumps = relief * np.sin(ground[:, 0] / 9.0) * np.cos(ground[:, 1] / 7.0)
    points = np.column_stack([ground, bumps])
    features, seen = [], []
    for i in range(n):
        uv = cameras.project(np.full(count, i), points)
        ok = np.isfinite(uv).all(1) & (uv > 3).all(1) & (uv < np.array([w - 4, h - 4])).all(1)
        index = np.flatnonzero(ok)
        noisy = (uv[index] + rng.normal(0, noise_px, (len(index), 2))).astype(np.float32)
        nothing = np.zeros((len(index), 128), np.uint8)
        features.append(
            SiftFeatures(
                uv=noisy,
                descriptor=nothing,
                sigma_px=np.full(len(index), 0.5, np.float32),
                width=w,
                height=h,
                step_px=w / 480,
            )
        )
        seen.append(index)
    pairs = []
    for i in range(n):
        for j in range(i + 1, n):
            _, a, b = np.intersect1d(seen[i], seen[j], return_indices=True)
            if len(a) >= 15:
                keep = rng.permutation(len(a))[:80]
                pairs.append(Pair(i, j, np.stack([a[keep], b[keep]], 1).astype(np.int32)))
    frames = _frames(xy + rng.normal(0, gps_sigma, xy.shape), z, yaw, size)
    return World(frames, cameras, features, pairs)


def _frames(xy: np.ndarray, z: np.ndarray, yaw: np.ndarray, size: tuple[int, int]) -> list[Frame]:
    ll = GRID.to_geographic(xy + ORIGIN)
    convergence = GRID.convergence_rad(ll[:, 0], ll[:, 1])
    frames = []
    for k in range(len(xy)):
        fix = Fix(
            float(ll[k, 0]),
            float(ll[k, 1]),
            height_m=float(z[k]),
            yaw_rad=float(yaw[k] + convergence[k]),
            pitch_rad=-np.pi / 2,
            roll_rad=0.0,
        )
        frames.append(
            Frame(
                image=f"p{k:03d}.jpg",
                path=Path(f"p{k:03d}.jpg"),
                vehicle="v",
                time_s=5.0 * k,
                fix=fix,
                width=size[0],
                height=size[1],
            )
        )
    return frames


def without(frame: Frame, *names: str) -> Frame:
    """A frame that did not record some fields of its fix."""
    return replace(frame, fix=replace(frame.fix, **dict.fromkeys(names)))


def texture(seed: int, rows: int = 700, columns: int = 900) -> np.ndarray:
    """A random picture with structure at all scales, uint8."""
    import cv2

    rng = np.random.default_rng(seed)
    out = np.zeros((rows, columns), np.float32)
    for k in range(6):
        shape = (max(2, rows >> (7 - k)), max(2, columns >> (7 - k)))
        layer = rng.normal(size=shape).astype(np.float32)
        out += cv2.resize(layer, (columns, rows), interpolation=cv2.INTER_CUBIC) * 0.8 ** (k)
    out = (out - out.min()) / (out.max() - out.min())
    return (255 * out).astype(np.uint8)
