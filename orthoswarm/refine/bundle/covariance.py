"""Stated errors: the adjustment's covariance propagated to the ground, plus systematic errors outside its model."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.export.product_files import OBLIQUE_AXIS_DOWN
from orthoswarm.model.arrays import Array, Floats, Ints
from orthoswarm.model.camera import fov_rad, ground_jacobian
from orthoswarm.model.robust import MEDIAN_SIGMA, mad_sigma
from orthoswarm.refine.bundle.adjustment import Adjustment, HeightPrior, MapTies
from orthoswarm.refine.bundle.block_arrays import WIDTH, F
from orthoswarm.refine.bundle.priors import Priors

_LENS_CX = 4
"""Column of the principal point's cx among a lens's unknowns, cy is the next (see priors.Priors)."""

RECEIVER_COMMON_SIGMA_M: Final = 1.5
"""The part of the error that all receivers at a place and time share, an axis: ionosphere and orbits. The GPS standard
(SPS PS 2020) commits to 8 m (95 %) horizontally on average; 3 to 4 m are usual, most of it shared."""
_COVARIANCE_EVERY_PHOTOS: Final = 24  # covariances are computed for every so many-th photo and interpolated between
_SCATTER_LEAST_TIES: Final = 40  # with fewer ties the adjustment follows them, and their residuals are too small
_SYSTEMATIC_LEAST_TIES: Final = 4  # with fewer ties about a photo a systematic offset of the map there is not estimated
_SYSTEMATIC_REACH_PHOTOS: Final = 4  # ... which uses the ties of so many photos before and after, of the same leg
_SYSTEMATIC_SIGMAS: Final = 2.0  # sigmas of the ties' median taken off before it counts as systematic


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
    pose: Floats


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
    if ties is None:
        adjustment = replace(adjustment, priors=with_seen_drift(adjustment))
    free = np.flatnonzero(adjustment.free)
    chosen = np.unique(np.r_[free[::_COVARIANCE_EVERY_PHOTOS], free[-1]])
    covariance, common, between = adjustment.covariance(chosen, c, heights, ties, tie_c)
    variance = np.array(
        [_ground_variance(adjustment, int(i), q, common, b) for i, q, b in zip(chosen, covariance, between)]
    )
    share = 1.0 if ties is None else config.tied_covariance_share
    sigma = np.hypot(share * np.sqrt(np.interp(np.arange(n), chosen, variance)), floor_m)
    lens = adjustment.cameras.lens[0]
    spread = float(np.sqrt(max(common[0, 0], 0.0)))
    f, width = float(lens[F]), int(lens[WIDTH])
    fov_sigma = abs(fov_rad(f * (1 + spread), width) - fov_rad(f * (1 - spread), width)) / 2
    pose = share**2 * _between(chosen, covariance, n)
    return StatedErrors(config.stated_sigma_factor * sigma, float(np.degrees(fov_sigma)), pose.astype(np.float32))


def with_seen_drift(adjustment: Adjustment) -> Priors:
    """Priors whose receivers drift as much as this flight shows, instead of as much as any may.

    Pictures show how a drift changes, not what it has in common over the flight. That is the receiver's bias, its own
    and what all have in common, and the mean of what it drifted by since it was right: of a drift that grows evenly the
    mean square is three times the variance about its mean.

    Args:
        adjustment: without a map, after its last step.
    """
    p, layout, config = adjustment.priors, adjustment.layout, active()
    bias2 = config.registration.receiver_bias_sigma_m**2 + RECEIVER_COMMON_SIGMA_M**2
    drift = layout.drift(adjustment.common, p.group)
    models = list(p.models)
    for g, (model, knots) in enumerate(zip(p.models, layout.knots, strict=True)):
        if knots:
            seen = float(drift[p.group == g].var(axis=0).mean())
            size = min(float(np.sqrt(bias2 + config.bundle.drift_mean_share * seen)), model.drift_sigma)
            models[g] = replace(model, drift_sigma=size * float(np.sqrt(knots)))  # the knots' mean has that sigma
    return replace(p, models=tuple(models))


def receiver_sigma(adjustment: Adjustment) -> Array:
    """Sigma (2,) of a flight's place by its own receiver, east and north, metres: its bias, and its drift's mean.

    A receiver that drifts to the east may be right in the north. What all receivers have in common is none of it.

    Args:
        adjustment: without a map, after its last step.
    """
    p, config = adjustment.priors, active()
    drift = adjustment.layout.drift(adjustment.common, p.group)
    groups = [drift[p.group == g] for g in range(len(p.models)) if (p.group == g).any()]
    seen = np.average([own.var(axis=0) for own in groups], axis=0, weights=[len(own) for own in groups])
    return np.asarray(np.sqrt(config.registration.receiver_bias_sigma_m**2 + config.bundle.drift_mean_share * seen))


def _between(chosen: NDArray[np.integer], covariance: Array, n: int) -> Array:
    """Covariances (n, 6, 6) of all pictures, interpolated between those of the chosen ones (ascending)."""
    after = np.searchsorted(chosen, np.arange(n)).clip(1, max(len(chosen) - 1, 1))
    if len(chosen) == 1:
        return np.repeat(covariance, n, axis=0)
    share = ((np.arange(n) - chosen[after - 1]) / (chosen[after] - chosen[after - 1])).clip(0.0, 1.0)[:, None, None]
    return np.asarray((1.0 - share) * covariance[after - 1] + share * covariance[after])


def with_distance_errors(pose: Floats, rotation: Array, distance_sigma_m: Array) -> Floats:
    """Covariances of cameras whose distance from the ground is wrong by what their focal length makes up for.

    Over level ground pictures show the ratio of both only. A camera with a wrong focal length then lies on its optical
    axis, so that the ground in its middle stays where it is.

    Args:
        pose: float32 (N, 6, 6) as in StatedErrors. rotation: float64 (N, 3, 3), camera to ground.
        distance_sigma_m: float64 (N,), one sigma along the axis.
    """
    out = pose.copy()
    axis = rotation[:, :, 2] * distance_sigma_m[:, None]
    out[:, :3, :3] += axis[:, :, None] * axis[:, None, :]
    return out


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
    if len(residual) < _SCATTER_LEAST_TIES:
        scatter = max(scatter, float(np.median(sigma_m)))
    return float(np.hypot(floor, config.tie_scatter_share * scatter))


def systematic_tie_offset(leg: Ints, camera: NDArray[np.integer], residual: Array) -> Array:
    """Offset of the map around each picture, where its ties agree on one that the adjustment did not remove.

    A few deviating ties are wrong matches, or changed ground; if most of the ties around a picture are
    off by the same vector, the picture or the map is.

    Args:
        leg: int32 (N,), -1 in turns. camera: (Q,), picture of each tie. residual: float64 (Q, 2), metres.

    Returns:
        float64 (N,), metres, 0 where ties are few, do not agree, or agree with the adjustment.
    """
    near = _SYSTEMATIC_REACH_PHOTOS
    out = np.zeros(len(leg))
    order = np.argsort(camera, kind="stable")
    camera, residual = camera[order], residual[order]
    first, last = (
        np.searchsorted(camera, np.arange(len(leg)) - near),
        np.searchsorted(camera, np.arange(len(leg)) + near, side="right"),
    )
    for i, (a, b) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        mine = residual[a:b][leg[camera[a:b]] == leg[i]]
        if len(mine) < _SYSTEMATIC_LEAST_TIES:
            continue
        middle = np.median(mine, axis=0)
        spread = mad_sigma(mine - middle)
        out[i] = max(0.0, float(np.hypot(*middle)) - _SYSTEMATIC_SIGMAS * MEDIAN_SIGMA * spread / np.sqrt(len(mine)))
    return out


def _ground_variance(adjustment: Adjustment, i: int, covariance: Array, common: Array, between: Array) -> float:
    """Variance per axis (mean of both) of the ground at height 0 that a picture's central pixel shows.

    A principal point that is solved with the pictures is known far worse than the line of sight of that pixel: an error
    of it is one of the rotation, which makes up for it.

    Args:
        adjustment: after its last step. i: camera. covariance: float64 (6, 6), its own. common: float64 (size, size),
            of the common unknowns. between: float64 (6, size).
    """
    cameras = adjustment.cameras
    height = max(float(cameras.position[i, 2]), 1.0)
    j = ground_jacobian(cameras.rotation[i], height, OBLIQUE_AXIS_DOWN)
    if j is None:
        return height**2
    lens = int(cameras.lens_id[i])
    columns = [6 * lens + _LENS_CX, 6 * lens + _LENS_CX + 1]
    # a pixel's ray turns about the camera's y against cx, about its x with cy
    by_centre = np.column_stack([-j[:, 4], j[:, 3]]) / cameras.lens[lens, F]
    mixed = j @ between[:, columns] @ by_centre.T
    own = j @ covariance @ j.T + by_centre @ common[np.ix_(columns, columns)] @ by_centre.T
    return float(np.trace(own + mixed + mixed.T)) / 2
