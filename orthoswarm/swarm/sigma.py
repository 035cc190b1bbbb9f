"""Honest error estimates: the adjustment's covariance carried to the ground, inflated by what it cannot know."""

import numpy as np
from numpy.typing import NDArray

from orthoswarm.camera import fov_rad
from orthoswarm.swarm.adjust import Adjustment, Ground, Ties
from orthoswarm.swarm.rig import WIDTH, F

Array = NDArray[np.float64]

EVERY = 24
FEWEST_TIES = 4
RADIAL = 1.25
"""A frame's ground error has two axes: this times the sigma of one holds about two thirds of the errors."""


def frame_sigmas(
    adjustment: Adjustment, c: float, ground: Ground, ties: Ties | None, tie_c: float, floor_m: float
) -> tuple[Array, float]:
    """Ground error of each picture's centre (N,), metres (radial, two thirds), and the sigma of the FoV in degrees."""
    n = len(adjustment.rig)
    free = np.flatnonzero(adjustment.free)
    chosen = np.unique(np.r_[free[::EVERY], free[-1]])
    covariance, common = adjustment.covariance(chosen, c, ground, ties, tie_c)
    variance = np.array([_ground_variance(adjustment, int(i), q) for i, q in zip(chosen, covariance)])
    sigma = np.sqrt(np.interp(np.arange(n), chosen, variance) + floor_m**2)
    lens = adjustment.rig.lens[0]
    spread = float(np.sqrt(max(common[0, 0], 0.0)))
    f, width = float(lens[F]), int(lens[WIDTH])
    fov_sigma = abs(fov_rad(f * (1 + spread), width) - fov_rad(f * (1 - spread), width)) / 2
    return RADIAL * sigma, float(np.degrees(fov_sigma))


def unexplained(leg: NDArray[np.int32], camera: NDArray[np.integer], residual: Array, near: int = 4) -> Array:
    """How far the map is from each picture where its ties agree on that and were not followed, float64 (N,), metres.

    A few ties that are off alone are wrong matches, or ground that changed; if most of those around a picture are
    off by the same, the picture is, or it cannot be told.

    Args:
        leg: int32 (N,), -1 in turns. camera: (Q,), picture of each tie. residual: float64 (Q, 2).
        near: ties of so many pictures before and after it, of the same leg, count.
    """
    out = np.zeros(len(leg))
    order = np.argsort(camera, kind="stable")
    camera, residual = camera[order], residual[order]
    first, last = (
        np.searchsorted(camera, np.arange(len(leg)) - near),
        np.searchsorted(camera, np.arange(len(leg)) + near, side="right"),
    )
    for i, (a, b) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        mine = residual[a:b][leg[camera[a:b]] == leg[i]]
        if len(mine) < FEWEST_TIES:
            continue
        middle = np.median(mine, axis=0)
        spread = 1.4826 * float(np.median(np.abs(mine - middle)))
        out[i] = max(0.0, float(np.hypot(*middle)) - 2.0 * 1.25 * spread / np.sqrt(len(mine)))
    return out


def _ground_variance(adjustment: Adjustment, i: int, covariance: Array) -> float:
    """Mean variance of one axis of where the picture's centre ray meets the ground."""
    rotation, height = adjustment.rig.rotation[i], max(float(adjustment.rig.position[i, 2]), 1.0)
    ray = rotation[:, 2]
    if ray[2] > -0.2:
        return height**2
    reach = -height / ray[2]
    moved = np.zeros((3, 6))
    moved[:, :3] = np.eye(3)
    for a in range(3):  # rotating about the camera's axis a moves the ray by R (e_a x e_z)
        moved[:, 3 + a] = reach * (rotation @ np.cross(np.eye(3)[a], [0.0, 0.0, 1.0]))
    onto = np.array([[1.0, 0.0, -ray[0] / ray[2]], [0.0, 1.0, -ray[1] / ray[2]]])
    j = onto @ moved
    return float(np.trace(j @ covariance @ j.T)) / 2
