"""Stated errors: the adjustment's covariance propagated to the ground, plus systematic errors outside its model."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.model.camera import fov_rad, ground_jacobian
from orthoswarm.model.robust import mad_sigma
from orthoswarm.refine.bundle.adjustment import Adjustment, HeightPrior, MapTies
from orthoswarm.refine.bundle.block_arrays import WIDTH, F

Array = NDArray[np.float64]

_MEDIAN_SIGMA = 1.25
"""Sigma of the median of n Gaussian values, times sqrt(n): sqrt(pi / 2)."""


@dataclass(frozen=True, slots=True)
class StatedErrors:
    """Errors of N pictures as the adjustment states them.

    Attributes:
        sigma_m: float64 (N,), of the ground point at each picture's centre, `stated_sigma_factor` times the sigma of an
            axis, metres.
        fov_sigma_deg: one sigma of the field of view, degrees.
        pose: float32 (N, 6, 6), covariance of position (metres) and rotation about the camera's axes (radians), without
            the error that is common to all pictures.
    """

    sigma_m: Array
    fov_sigma_deg: float
    pose: NDArray[np.float32]


def stated_errors(
    adjustment: Adjustment, c: float, heights: HeightPrior, *, ties: MapTies | None, tie_c: float, floor_m: float
) -> StatedErrors:
    """Errors of pictures and lens: the adjustment's covariance, and what it does not contain.

    Args:
        adjustment: after its last step. c, heights, ties, tie_c: as for Adjustment.step.
        floor_m: error common to all pictures, which the covariance does not contain; one sigma per axis.

    """
    config = active().bundle
    n = len(adjustment.cameras)
    free = np.flatnonzero(adjustment.free)
    chosen = np.unique(np.r_[free[:: config.covariance_every_photos], free[-1]])
    covariance, common = adjustment.covariance(chosen, c, heights, ties, tie_c)
    variance = np.array([_ground_variance(adjustment, int(i), q) for i, q in zip(chosen, covariance)])
    share = 1.0 if ties is None else config.tied_covariance_share
    sigma = np.hypot(share * np.sqrt(np.interp(np.arange(n), chosen, variance)), floor_m)
    lens = adjustment.cameras.lens[0]
    spread = float(np.sqrt(max(common[0, 0], 0.0)))
    f, width = float(lens[F]), int(lens[WIDTH])
    fov_sigma = abs(fov_rad(f * (1 + spread), width) - fov_rad(f * (1 - spread), width)) / 2
    pose = share**2 * _between(chosen, covariance, n)
    return StatedErrors(config.stated_sigma_factor * sigma, float(np.degrees(fov_sigma)), pose.astype(np.float32))


def _between(chosen: NDArray[np.integer], covariance: Array, n: int) -> Array:
    """Covariances (n, 6, 6) of all pictures, interpolated between those of the chosen ones (ascending)."""
    after = np.searchsorted(chosen, np.arange(n)).clip(1, max(len(chosen) - 1, 1))
    if len(chosen) == 1:
        return np.repeat(covariance, n, axis=0)
    share = ((np.arange(n) - chosen[after - 1]) / (chosen[after] - chosen[after - 1])).clip(0.0, 1.0)[:, None, None]
    return np.asarray((1.0 - share) * covariance[after - 1] + share * covariance[after])


def common_map_sigma(residual: Array, sigma_m: Array, gsd_m: float) -> float:
    """Error common to all map ties of a picture, one sigma per axis, metres.

    A poor map (old, coarse, blurred) makes ties scatter and also shifts them together: the common shift
    grew with the scatter when maps of simulated cities were blurred and made noisy.

    Args:
        residual: float64 (Q, 2) of the ties after the adjustment. sigma_m: float64 (Q,), their prior sigmas.
        gsd_m: ground sampling distance of the map.
    """
    config = active().bundle
    floor = config.map_floor_px * gsd_m
    if len(residual) == 0:
        return floor
    scatter = mad_sigma(residual)
    # so few ties do not resist the adjustment: their residuals are too small
    if len(residual) < config.scatter_least_ties:
        scatter = max(scatter, float(np.median(sigma_m)))
    return float(np.hypot(floor, config.tie_scatter_share * scatter))


def systematic_tie_offset(leg: NDArray[np.int32], camera: NDArray[np.integer], residual: Array) -> Array:
    """Offset of the map around each picture, where its ties agree on one that the adjustment did not remove.

    A few deviating ties are wrong matches, or changed ground; if most of the ties around a picture are
    off by the same vector, the picture or the map is.

    Args:
        leg: int32 (N,), -1 in turns. camera: (Q,), picture of each tie. residual: float64 (Q, 2), metres.

    Returns:
        float64 (N,), metres, 0 where ties are few, do not agree, or agree with the adjustment.
    """
    config = active().bundle
    near = config.systematic_reach_photos
    out = np.zeros(len(leg))
    order = np.argsort(camera, kind="stable")
    camera, residual = camera[order], residual[order]
    first, last = (
        np.searchsorted(camera, np.arange(len(leg)) - near),
        np.searchsorted(camera, np.arange(len(leg)) + near, side="right"),
    )
    for i, (a, b) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        mine = residual[a:b][leg[camera[a:b]] == leg[i]]
        if len(mine) < config.systematic_least_ties:
            continue
        middle = np.median(mine, axis=0)
        spread = mad_sigma(mine - middle)
        out[i] = max(
            0.0, float(np.hypot(*middle)) - config.systematic_sigmas * _MEDIAN_SIGMA * spread / np.sqrt(len(mine))
        )
    return out


def map_distortion_variance(place: Array, residual: Array, height_m: float) -> float:
    """Variance per axis of the map's displacement under one picture, from place to place, metres squared.

    Matching noise is independent from tie to tie, a distortion of the map is similar for neighbours: so the
    semivariogram of the residuals rises with distance by the distortion's variance. The part that varies within a
    picture averages out over its ties: the variance of a picture's mean is the semivariogram at large distance minus
    that at the usual distance within it (Cressie 1993, Statistics for Spatial Data, chapter 2). Medians instead of
    means of the squared differences are used, as ties may be wrong (for two Gaussian axes the median is ln 2 of the
    mean). The residuals lack the share that the adjustment absorbed (`distortion_followed`).

    Args:
        place: float64 (Q, 2), positions of the ties, metres. residual: float64 (Q, 2), their residuals, metres.
        height_m: flying height.

    Returns:
        The variance; 0 where there are too few close or distant pairs of ties to estimate it.
    """
    config = active().bundle
    step = max(1, -(-len(place) // config.variogram_most_ties))
    place, residual = place[::step], residual[::step]
    i, j = np.triu_indices(len(place), 1)
    apart = np.hypot(*(place[i] - place[j]).T)
    half = ((residual[i] - residual[j]) ** 2).sum(1) / 4.0
    inner, outer = config.variogram_near_heights
    near = half[(apart > inner * height_m) & (apart < outer * height_m)]
    far = half[apart > config.variogram_far_heights * height_m]
    if min(len(near), len(far)) < config.variogram_least_pairs:
        return 0.0
    left = float(np.median(far) - np.median(near)) / float(np.log(2.0))
    return max(0.0, config.distortion_followed * left)


def _ground_variance(adjustment: Adjustment, i: int, covariance: Array) -> float:
    """Variance per axis (mean of both) of the point where the picture's optical axis meets the ground at height 0."""
    height = max(float(adjustment.cameras.position[i, 2]), 1.0)
    j = ground_jacobian(adjustment.cameras.rotation[i], height, active().bundle.oblique_axis_down)
    return height**2 if j is None else float(np.trace(j @ covariance @ j.T)) / 2
