"""Honest error estimates: the adjustment's covariance carried to the ground, inflated by what it cannot know."""

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.camera import fov_rad
from orthoswarm.refine.bundle.adjustment import Adjustment, HeightPrior, MapTies
from orthoswarm.refine.bundle.block_arrays import WIDTH, F

Array = NDArray[np.float64]

EVERY = 24
FEWEST_TIES = 4
ENOUGH_TIES = 40
RADIAL = 1.25
"""Stated is this times the sigma of an axis, to stand between both meanings of "the error" of a point on the ground.

Of Gaussian errors 79 and 98.8 % of each axis lie within one and two of it, and 54 and 95.6 % of their lengths.
"""
TIE_SHARE = 0.4
"""Part of the ties' scatter that a picture's ties have in common (terrain, lens, what the map shows): no number of
ties takes it away. Fitted with the two below to 30 simulated sets of 15 to 339 pictures a vehicle: heights of 80 to
250 m, lenses, noise, maps of 0.2 to 2 m, blurred and noisy ones."""
MAP_FLOOR_PX = 0.058
"""What no residual tells, in pixels of the compared map."""
HELD_SHARE = 0.8
"""Corners are followed better than the adjustment is told (0.05 and not 0.35 px, with a drift in between)."""


def frame_sigmas(
    adjustment: Adjustment, c: float, ground: HeightPrior, ties: MapTies | None, tie_c: float, floor_m: float
) -> tuple[Array, float]:
    """Ground error of each picture's centre (N,), metres (see RADIAL), and the sigma of the FoV in degrees."""
    n = len(adjustment.cameras)
    free = np.flatnonzero(adjustment.free)
    chosen = np.unique(np.r_[free[::EVERY], free[-1]])
    covariance, common = adjustment.covariance(chosen, c, ground, ties, tie_c)
    variance = np.array([_ground_variance(adjustment, int(i), q) for i, q in zip(chosen, covariance)])
    share = 1.0 if ties is None else HELD_SHARE
    sigma = np.hypot(share * np.sqrt(np.interp(np.arange(n), chosen, variance)), floor_m)
    lens = adjustment.cameras.lens[0]
    spread = float(np.sqrt(max(common[0, 0], 0.0)))
    f, width = float(lens[F]), int(lens[WIDTH])
    fov_sigma = abs(fov_rad(f * (1 + spread), width) - fov_rad(f * (1 - spread), width)) / 2
    return RADIAL * sigma, float(np.degrees(fov_sigma))


def common_map_sigma(residual: Array, sigma_m: Array, gsd_m: float) -> float:
    """How far a whole picture may be off by what its ties have in common, one sigma of an axis, metres.

    A map that suits the pictures badly (old, coarse, blurred) scatters ties and displaces all of them: the shift that
    they had in common grew with their scatter where maps of simulated cities were blurred and made noisy.

    Args:
        residual: float64 (Q, 2) of the ties after the adjustment. sigma_m: float64 (Q,), what they were given.
        gsd_m: pixel of the compared map.
    """
    floor = MAP_FLOOR_PX * gsd_m
    if len(residual) == 0:
        return floor
    scatter = 1.4826 * float(np.median(np.abs(residual)))
    if len(residual) < ENOUGH_TIES:  # so few are followed: what is left tells little
        scatter = max(scatter, float(np.median(sigma_m)))
    return float(np.hypot(floor, TIE_SHARE * scatter))


def systematic_tie_offset(leg: NDArray[np.int32], camera: NDArray[np.integer], residual: Array, near: int = 4) -> Array:
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
    rotation, height = adjustment.cameras.rotation[i], max(float(adjustment.cameras.position[i, 2]), 1.0)
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
