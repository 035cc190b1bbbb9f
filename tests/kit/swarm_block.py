"""A synthetic flight of legs over scattered points, with known truth, for tests of the adjustment."""

from dataclasses import dataclass

import numpy as np

from orthoswarm.model.camera import rotation_from_angles
from orthoswarm.refine.bundle.block_arrays import CameraBlock, Tracks, exp_rotation
from orthoswarm.refine.bundle.priors import GroupPriors, Priors


@dataclass(kw_only=True)
class Block:
    true: CameraBlock
    points: np.ndarray
    tracks: Tracks
    start: CameraBlock
    priors: Priors
    bias: np.ndarray


def make_block(
    seed=0, *, per_leg=30, legs=3, k1=-0.05, k2=0.01, noise_px=0.3, lag_s=0.0, focal_start=330.0, lean_deg=0.0
) -> Block:
    """Pictures over flat ground; `lean_deg`: how far the airframe leans at most, and its fixed camera with it."""
    rng = np.random.default_rng(seed)
    n, speed = per_leg * legs, 8.75
    along = np.arange(per_leg) * speed
    xy = np.concatenate([np.c_[np.full(per_leg, 90.0 * k), along if k % 2 == 0 else along[::-1]] for k in range(legs)])
    heading = np.repeat([0.0 if k % 2 == 0 else np.pi for k in range(legs)], per_leg)
    position = np.c_[xy + rng.normal(0, 0.2, (n, 2)), 150 + rng.normal(0, 0.1, n)]
    lean = np.radians(lean_deg) * np.sin(np.pi * np.tile(np.arange(per_leg) / per_leg, legs))
    rotation = rotation_from_angles(
        heading + 0.1 + rng.normal(0, 0.01, n),
        -np.pi / 2 + 0.03 + lean + rng.normal(0, 0.01, n),
        rng.normal(0, 0.01, n),
    )
    zero = np.zeros(n, np.int32)
    true = CameraBlock(position, rotation, zero, np.array([[300.0, k1, k2, 0, 0, 0, 640, 480]]))
    points = np.c_[
        rng.uniform(-110, 90 * legs + 20, 900), rng.uniform(-110, along[-1] + 110, 900), rng.normal(0, 0.4, 900)
    ]
    camera, point, uv = [], [], []
    for i in range(n):
        seen = true.project(np.full(len(points), i), points)
        inside = np.flatnonzero((seen > 4).all(1) & (seen[:, 0] < 635) & (seen[:, 1] < 475))
        chosen = rng.permutation(inside)[:45]
        camera += [i] * len(chosen)
        point += list(chosen)
        uv += list(seen[chosen] + rng.normal(0, noise_px, (len(chosen), 2)))
    used, point = np.unique(point, return_inverse=True)
    tracks = Tracks(
        np.array(camera, np.int32), point.astype(np.int32), np.array(uv), np.full(len(camera), noise_px, np.float32)
    )
    bias = np.radians([0.8, -0.6, 2.0])
    recorded = rotation @ exp_rotation(np.tile(-bias, (n, 1)))
    velocity = np.gradient(xy, axis=0)
    velocity[per_leg - 1 :: per_leg] = 0
    velocity[::per_leg] = 0
    fixes = position + np.c_[rng.normal(0, 0.6, (n, 2)), np.zeros(n)] - lag_s * np.c_[velocity, np.zeros(n)]
    fixes[:, :2] += np.outer(np.arange(n), [0.05, -0.03])
    priors = Priors(
        position=fixes,
        position_sigma=np.tile([1.0, 1.0, 0.1], (n, 1)),
        rotation=recorded,
        rotation_sigma=np.full((n, 3), np.radians(0.1)),
        velocity=velocity,
        group=zero,
        models=(GroupPriors(height_sigma=0.3),),
        lens=np.array([[np.log(focal_start), 0, 0, 0, 0, 0]]),
        lens_sigma=np.array([[0.3, 0.1, 0.03, 0, 0, 0]]),
    )
    start = CameraBlock(fixes.copy(), recorded.copy(), zero, np.array([[focal_start, 0, 0, 0, 0, 0, 640.0, 480.0]]))
    return Block(true=true, points=points[used], tracks=tracks, start=start, priors=priors, bias=bias)
