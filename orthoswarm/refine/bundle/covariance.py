"""Stated errors: the adjustment's covariance propagated to the ground, plus systematic errors outside its model.

One of these is a map that is displaced from place to place. Matching noise is independent from tie to tie, a
displacement of the map is alike for neighbours: so the semivariogram of the residuals rises with distance (Cressie
1993, Statistics for Spatial Data, chapter 2). A nearly rigid block follows a displaced map by a shift, a turn and a
scale, and leaves the rest in the residuals. What it followed is its error.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.export.product_files import OBLIQUE_AXIS_DOWN
from orthoswarm.model.arrays import Array, Floats, Ints
from orthoswarm.model.camera import fov_rad, ground_jacobian
from orthoswarm.model.placement import STATED_SIGMA_FACTOR
from orthoswarm.model.robust import MEDIAN_SIGMA, mad_sigma
from orthoswarm.refine.bundle.adjustment import Adjustment, HeightPrior, MapTies
from orthoswarm.refine.bundle.block_arrays import WIDTH, F
from orthoswarm.refine.bundle.priors import Priors

_LENS_CX = 4  # column of the principal point's cx among a lens's unknowns, cy is the next (see priors.Priors)

RECEIVER_COMMON_SIGMA_M: Final = 1.5
"""The part of the error that all receivers at a place and time share, an axis: ionosphere and orbits. The GPS standard
(SPS PS 2020) commits to 8 m (95 %) horizontally on average; 3 to 4 m are usual, most of it shared."""
RECEIVER_BIAS_SIGMA_M: Final = 1.5
"""Bias of a receiver without corrections over a flight, an axis: multipath, satellites of its own (good receivers under
open sky differ by 1 to 2 m)."""
DRIFT_MEAN_SHARE: Final = 3.0
"""Mean square of a drift for its variance about its mean, in the stated error without a map: a drift that grows evenly
from 0 to d has a mean of d / 2 and a variance of d^2 / 12."""
TIE_SCATTER_SHARE: Final = 0.4
"""Share of the map ties' scatter that the ties of a photo have in common (terrain, lens, what the map shows): no number
of ties averages it away. Fitted together with the two below to 30 simulated sets of 15 to 339 photos a vehicle: heights
of 80 to 250 m, lenses, noise, maps of 0.2 to 2 m, blurred and noisy ones."""
MAP_FLOOR_PX: Final = 0.058  # error that no residual shows, in pixels of the compared map (fitted as above)
TIED_COVARIANCE_SHARE: Final = 0.8
"""Factor of the covariance where map ties determine a photo: corners are tracked better than their sigma (0.05 and not
0.35 px, with a drift between; fitted as above)."""
_COVARIANCE_EVERY_PHOTOS: Final = 24  # covariances are computed for every so many-th photo and interpolated between
_SCATTER_LEAST_TIES: Final = 40  # with fewer ties the adjustment follows them, and their residuals are too small
_SYSTEMATIC_LEAST_TIES: Final = 4  # with fewer ties about a photo a systematic offset of the map there is not estimated
_SYSTEMATIC_REACH_PHOTOS: Final = 4  # ... which uses the ties of so many photos before and after, of the same leg
_SYSTEMATIC_SIGMAS: Final = 2.0  # sigmas of the ties' median taken off before it counts as systematic
_LN2 = float(np.log(2.0))  # median of the squared length of a Gaussian vector of two axes, for one of its mean

_VARIOGRAM_MOST_TIES: Final = 200  # of more ties every so many-th is used: pairs grow with their square (its cost)
_VARIOGRAM_CLASSES: Final = 9  # classes of distance between ties; the first ends at ....
_VARIOGRAM_NEAR_HEIGHTS: Final = 0.1  # ... so many flying heights ...
_VARIOGRAM_FAR_SHARE: Final = 0.85  # ... the last at this share of the largest distance: few pairs are farther apart
_VARIOGRAM_LEAST_PAIRS: Final = 30  # a class with fewer pairs is left out
_VARIOGRAM_LEAST_CLASSES: Final = 3  # fewer classes do not tell the map's distortion
_VARIOGRAM_FLAT_SHARE: Final = 0.1  # classes weigh by their value, those below this share of the largest alike
_CORRELATION_LENGTHS: Final = 8  # correlation lengths that are tried, from ... (its cost)
_CORRELATION_HEIGHTS: Final = 0.2  # ... so many flying heights to ...
_CORRELATION_RADII: Final = 1.5  # ... so many radii (root mean square) of the vehicle's ties


@dataclass(frozen=True, slots=True)
class StatedErrors:
    """Errors of N pictures as the adjustment states them.

    sigma_m: float64 (N,), of the ground point at each picture's centre, `stated_sigma_factor` times the sigma of an
    axis, metres. fov_sigma_deg: one sigma of the field of view. pose: float32 (N, 6, 6), covariance of position
    (metres) and rotation about the camera's axes (radians), without the error that is common to all pictures.
    """

    sigma_m: Array
    fov_sigma_deg: float
    pose: Floats


def stated_errors(
    adjustment: Adjustment, c: float, heights: HeightPrior, *, ties: MapTies | None, tie_c: float, floor_m: float
) -> StatedErrors:
    """Errors of pictures and lens: the adjustment's covariance, and what it does not contain.

    adjustment: after its last step. c, heights, ties, tie_c: as for Adjustment.step. floor_m: error common to all
    pictures, one sigma per axis.
    """
    n = len(adjustment.cameras)
    if ties is None:
        adjustment = replace(adjustment, priors=with_seen_drift(adjustment))
    free = np.flatnonzero(adjustment.free)
    chosen = np.unique(np.r_[free[::_COVARIANCE_EVERY_PHOTOS], free[-1]])
    covariance, common, between = adjustment.covariance(chosen, c, heights, ties, tie_c)
    variance = np.array(
        [_ground_variance(adjustment, int(i), q, common, b) for i, q, b in zip(chosen, covariance, between)]
    )
    share = 1.0 if ties is None else TIED_COVARIANCE_SHARE
    sigma = np.hypot(share * np.sqrt(np.interp(np.arange(n), chosen, variance)), floor_m)
    lens = adjustment.cameras.lens[0]
    spread = float(np.sqrt(max(common[0, 0], 0.0)))
    f, width = float(lens[F]), int(lens[WIDTH])
    fov_sigma = abs(fov_rad(f * (1 + spread), width) - fov_rad(f * (1 - spread), width)) / 2
    pose = share**2 * _between(chosen, covariance, n)
    return StatedErrors(STATED_SIGMA_FACTOR * sigma, float(np.degrees(fov_sigma)), pose.astype(np.float32))


def with_seen_drift(adjustment: Adjustment) -> Priors:
    """Priors of an adjustment without a map whose receivers drift as much as this flight shows, not as much as any may.

    Pictures show how a drift changes, not what it has in common over the flight: the receiver's bias, its own and what
    all have in common, and the mean of what it drifted by since it was right (see `DRIFT_MEAN_SHARE`).
    """
    p, layout = adjustment.priors, adjustment.layout
    bias2 = RECEIVER_BIAS_SIGMA_M**2 + RECEIVER_COMMON_SIGMA_M**2
    drift = layout.drift(adjustment.common, p.group)
    models = list(p.models)
    for g, (model, knots) in enumerate(zip(p.models, layout.knots, strict=True)):
        if knots:
            seen = float(drift[p.group == g].var(axis=0).mean())
            size = min(float(np.sqrt(bias2 + DRIFT_MEAN_SHARE * seen)), model.drift_sigma)
            models[g] = replace(model, drift_sigma=size * float(np.sqrt(knots)))  # the knots' mean has that sigma
    return replace(p, models=tuple(models))


def receiver_sigma(adjustment: Adjustment) -> Array:
    """Sigma (2,), east and north, metres, of a flight's place by its own receiver: its bias, and its drift's mean.

    A receiver that drifts to the east may be right in the north. What all receivers have in common is none of it.
    """
    p = adjustment.priors
    drift = adjustment.layout.drift(adjustment.common, p.group)
    groups = [drift[p.group == g] for g in range(len(p.models)) if (p.group == g).any()]
    seen = np.average([own.var(axis=0) for own in groups], axis=0, weights=[len(own) for own in groups])
    return np.asarray(np.sqrt(RECEIVER_BIAS_SIGMA_M**2 + DRIFT_MEAN_SHARE * seen))


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

    pose: float32 (N, 6, 6) as in StatedErrors. rotation: float64 (N, 3, 3), camera to ground. distance_sigma_m: float64
    (N,), one sigma along the axis.
    """
    out = pose.copy()
    axis = rotation[:, :, 2] * distance_sigma_m[:, None]
    out[:, :3, :3] += axis[:, :, None] * axis[:, None, :]
    return out


def common_map_sigma(residual: Array, sigma_m: Array, gsd_m: float) -> float:
    """Error common to all map ties of a picture, one sigma per axis, metres.

    A poor map (old, coarse, blurred) makes ties scatter and also shifts them together: the common shift grew with the
    scatter when maps of simulated cities were blurred and made noisy.

    residual: float64 (Q, 2), of the ties, adjusted. sigma_m: float64 (Q,), prior. gsd_m: the map's pixel.
    """
    floor = MAP_FLOOR_PX * gsd_m
    if len(residual) == 0:
        return floor
    scatter = mad_sigma(residual)
    if len(residual) < _SCATTER_LEAST_TIES:
        scatter = max(scatter, float(np.median(sigma_m)))
    return float(np.hypot(floor, TIE_SCATTER_SHARE * scatter))


def systematic_tie_offset(leg: Ints, camera: NDArray[np.integer], residual: Array) -> Array:
    """Offset of the map around each picture (N,), metres, where its ties agree on one that the adjustment left; else 0.

    A few deviating ties are wrong matches or changed ground; if most are off by the same vector, picture or map is.

    leg: int32 (N,), -1 in turns. camera: (Q,), picture of each tie. residual: float64 (Q, 2), metres.
    """
    out, near = np.zeros(len(leg)), _SYSTEMATIC_REACH_PHOTOS
    order = np.argsort(camera, kind="stable")
    camera, residual = camera[order], residual[order]
    first = np.searchsorted(camera, np.arange(len(leg)) - near)
    last = np.searchsorted(camera, np.arange(len(leg)) + near, side="right")
    for i, (a, b) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        mine = residual[a:b][leg[camera[a:b]] == leg[i]]
        if len(mine) < _SYSTEMATIC_LEAST_TIES:
            continue
        middle = np.median(mine, axis=0)
        spread = mad_sigma(mine - middle)
        out[i] = max(0.0, float(np.hypot(*middle)) - _SYSTEMATIC_SIGMAS * MEDIAN_SIGMA * spread / np.sqrt(len(mine)))
    return out


def _ground_variance(adjustment: Adjustment, i: int, covariance: Array, common: Array, between: Array) -> float:
    """Variance per axis (mean of both) of the ground at height 0 that the central pixel of picture i shows.

    A principal point that is solved with the pictures is known far worse than the line of sight of that pixel: an error
    of it is one of the rotation, which makes up for it.

    covariance: float64 (6, 6), the camera's. common: (size, size), of the common unknowns. between: (6, size).
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


def map_distortion_variance(place: Array, residual: Array, height_m: float) -> float:
    """Variance per axis of what a block is displaced by on a map displaced from place to place, m^2; 0 with few ties.

    Noise and a displacement with a Gaussian correlation are fitted to the semivariogram of the residuals: variances by
    least squares, the correlation's length by trial, of which it is known what a similarity fitted to the ties follows,
    and what semivariogram the rest has. By medians of the squared differences, as ties may be wrong.

    place: float64 (Q, 2), positions of the ties, metres. residual: float64 (Q, 2), theirs. height_m: flying height.
    """
    step = max(1, -(-len(place) // _VARIOGRAM_MOST_TIES))
    place, residual = place[::step], residual[::step]
    i, j = np.triu_indices(len(place), 1)
    apart = np.hypot(*(place[i] - place[j]).T)
    if len(i) < _VARIOGRAM_LEAST_PAIRS or not apart.max() > 0.0:
        return 0.0
    half = ((residual[i] - residual[j]) ** 2).sum(1) / 4.0
    near, far = _VARIOGRAM_NEAR_HEIGHTS * height_m, _VARIOGRAM_FAR_SHARE * float(apart.max())
    edges = np.r_[0.0, np.geomspace(min(near, far), far, _VARIOGRAM_CLASSES)]
    number = np.digitize(apart, edges) - 1
    classes = [np.flatnonzero(number == k) for k in range(_VARIOGRAM_CLASSES)]
    classes = [pairs for pairs in classes if len(pairs) >= _VARIOGRAM_LEAST_PAIRS]
    if len(classes) < _VARIOGRAM_LEAST_CLASSES:
        return 0.0
    found = np.array([np.median(half[pairs]) / _LN2 for pairs in classes])
    radius = float(np.sqrt(((place - place.mean(axis=0)) ** 2).sum(axis=1).mean()))
    shortest, longest = _CORRELATION_HEIGHTS * height_m, _CORRELATION_RADII * radius
    best = (np.inf, 0.0)
    for length_m in np.geomspace(min(shortest, longest), longest, _CORRELATION_LENGTHS):
        left, followed = _followed(place, length_m)
        level = np.diag(left)
        expected = 0.5 * (level[i] + level[j]) - left[i, j]
        variance, misfit = _fit(found, np.array([expected[pairs].mean() for pairs in classes]))
        best = min(best, (misfit, variance * followed))
    return best[1]


def _followed(place: Array, length_m: float) -> tuple[Array, float]:
    """Of a map displaced by unit variance: what a similarity that is fitted to ties leaves, and what it follows.

    Covariance (Q, Q) of the residuals of an axis; variance of an axis of the fitted values, mean over the ties.
    """
    n = len(place)
    apart2 = ((place[:, None] - place[None]) ** 2).sum(axis=2)
    covariance = np.exp(-0.5 * apart2 / length_m**2)
    x, y = (place - place.mean(axis=0)).T
    radius = max(float(np.sqrt((x**2 + y**2).sum())), 1e-9)
    one, zero = np.full(n, 1.0 / np.sqrt(n)), np.zeros(n)
    east = np.column_stack([one, zero, x / radius, -y / radius])  # orthonormal together with north
    north = np.column_stack([zero, one, y / radius, x / radius])
    inner = east.T @ covariance @ east + north.T @ covariance @ north
    left = covariance.copy()
    for axis in (east, north):
        cross = (covariance @ axis) @ axis.T
        left += 0.5 * (axis @ inner @ axis.T - cross - cross.T)
    return left, float(np.trace(inner)) / (2 * n)


def _fit(found: Array, expected: Array) -> tuple[float, float]:
    """Variance of the displacement and misfit of found = noise + variance x expected, both at least 0."""
    weight = 1.0 / np.maximum(found, _VARIOGRAM_FLAT_SHARE * found.max() + 1e-12)
    one, shape, value = weight, weight * expected, weight * found
    a, b, c = one @ one, one @ shape, shape @ shape
    p, q = one @ value, shape @ value
    determinant = a * c - b * b
    noise, variance = (
        ((c * p - b * q) / determinant, (a * q - b * p) / determinant) if determinant > 0 else (p / a, 0.0)
    )
    if variance < 0.0:
        noise, variance = p / a, 0.0
    elif noise < 0.0:
        noise, variance = 0.0, q / c
    return float(variance), float(np.sum((value - noise * one - variance * shape) ** 2))
