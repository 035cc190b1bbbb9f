"""Shift, turn and scale in the plane by control points, as a least-squares adjustment with priors.

Four unknowns: shift (2), turn and scale about the middle of the photos. Priors on turn and scale let one or two points
shift the block, and more of them turn and scale it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from orthoswarm.control.control_observations import ControlObservation
from orthoswarm.evaluation.misread_points import FARTHEST_M
from orthoswarm.evaluation.point_rays import MISTAKE_PROBABILITY
from orthoswarm.model.arrays import Array, Floats
from orthoswarm.model.camera import Camera
from orthoswarm.model.placement import Terrain
from orthoswarm.model.plane_similarity import Similarity

_HALVINGS = 20  # of a bracket of a kilometre, to a millimetre

_SCATTER_FEWEST: Final = 5  # fewest points without a stated sigma whose scatter is estimated
_SHIFT_SIGMA_M: Final = 100.0  # what is known of the shift before the control points: nothing, so that they decide it


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlFit:
    """A similarity and the residuals of the control points."""

    similarity: Similarity  # from the block to the ground
    used: list[ControlObservation]  # the observations used
    residual: Array  # float64 (n, 2), of each of them, block minus survey
    left_out: list[ControlObservation]  # observations rejected as outliers
    contradiction: bool  # True where the observations disagree, but are too few to find the outlier
    # how far points whose sigma is not stated scatter more than was assumed, one sigma of an axis
    scatter_m: float = 0.0


def fit_similarity(observations: Sequence[ControlObservation], nadirs: Array, border_m: float) -> ControlFit:
    """The similarity that moves a block onto its control points.

    Outliers are rejected, the worst first, as long as three other observations remain. Points whose survey states no
    sigma are believed as far as they agree: a handheld receiver's are metres off, and of nine such points those that
    agree by chance must not reject the others.

    observations: at least one. nadirs: float64 (N, 2), nadir points of the photos, for their centre and extent.
    border_m: prior sigma of rotation and scale, as the displacement at the photos' rms radius, metres.
    """
    middle = np.asarray(nadirs.mean(axis=0))
    radius = max(float(np.sqrt(((nadirs - middle) ** 2).sum(axis=1).mean())), 1.0)
    shift = _SHIFT_SIGMA_M
    prior_sigma = np.array([shift, shift, border_m / radius, border_m / radius])
    limit = -2.0 * np.log(MISTAKE_PROBABILITY)
    used, left_out, scatter_m = list(observations), [], np.inf
    while True:
        scatter_m = min(_scatter(used, middle, prior_sigma, scatter_m), scatter_m)
        weighed = _widened(used, scatter_m)
        chi2 = _left_out_chi2(weighed, middle, prior_sigma)
        worst = int(np.argmax(chi2))
        if chi2[worst] <= limit or len(used) <= 3:
            break
        left_out.append(used.pop(worst))
    similarity, residual = _adjusted(weighed, middle, prior_sigma)
    return ControlFit(
        similarity=similarity, used=weighed, residual=residual, left_out=left_out,
        contradiction=bool(chi2[worst] > limit), scatter_m=scatter_m,
    )  # fmt: skip


def _scatter(used: Sequence[ControlObservation], middle: Array, prior_sigma: Array, before_m: float) -> float:
    """What has to be added to unstated sigmas so that half of the points lie within their median distance, metres.

    The median of the points' squared distances from their predictions by the others, in sigmas, is 2 ln 2 (two axes).
    With too few points that of before stays; 0 where none was found.
    """
    unstated = np.array([not o.stated for o in used])
    if unstated.sum() < _SCATTER_FEWEST:
        return before_m if np.isfinite(before_m) else 0.0

    def too_small(scatter_m: float) -> bool:
        chi2 = _left_out_chi2(_widened(used, scatter_m), middle, prior_sigma)
        return bool(np.median(chi2[unstated]) > 2.0 * np.log(2.0))

    low, high = 0.0, FARTHEST_M
    if not too_small(low):
        return 0.0
    for _ in range(_HALVINGS):
        half = 0.5 * (low + high)
        low, high = (half, high) if too_small(half) else (low, half)
    return high


def _widened(used: Sequence[ControlObservation], scatter_m: float) -> list[ControlObservation]:
    """The observations, those without a stated sigma with a scatter more."""
    return [o if o.stated else replace(o, sigma_m=float(np.hypot(o.sigma_m, scatter_m))) for o in used]


def _adjusted(used: list[ControlObservation], middle: Array, prior_sigma: Array) -> tuple[Similarity, Array]:
    """The adjustment and its residuals; its covariance grows where they are larger than their sigmas (Birge ratio)."""
    similarity = _solved(used, middle, prior_sigma)
    residual = np.array([similarity.moved(o.placed) - o.surveyed for o in used])
    weight = 1.0 / np.array([o.sigma_m for o in used]) ** 2
    left = float((weight[:, None] * residual**2).sum() + ((similarity.values / prior_sigma) ** 2).sum())
    variance = left / (2 * len(used))  # four observations more, the priors, stand against four unknowns
    factor = max(1.0, variance)
    return Similarity(middle, similarity.values, np.asarray(similarity.covariance * factor, np.float64)), residual


def _solved(used: Sequence[ControlObservation], middle: Array, prior_sigma: Array) -> Similarity:
    placed, surveyed = np.array([o.placed for o in used]), np.array([o.surveyed for o in used])
    sigma_m = np.array([o.sigma_m for o in used])
    return Similarity.between(placed, surveyed, sigma_m, middle=middle, prior_sigma=prior_sigma)


def _left_out_chi2(used: Sequence[ControlObservation], middle: Array, prior_sigma: Array) -> Array:
    """Squared Mahalanobis distance (n,) of each observation from its prediction by the others (two axes)."""
    if len(used) < 2:
        return np.zeros(1)
    out = []
    for k, o in enumerate(used):
        others = _solved([*used[:k], *used[k + 1 :]], middle, prior_sigma)
        away = others.moved(o.placed) - o.surveyed
        variance = o.sigma_m**2 + float(others.sigma_m(o.placed)) ** 2
        out.append(float((away**2).sum()) / variance)
    return np.array(out)


def moved_camera(camera: Camera, similarity: Similarity, level_m: float, up_m: float = 0.0) -> Camera:
    """A camera after a similarity; heights over a level are scaled, too, so that no pixel's ray is bent.

    camera: before it. level_m: of the ground. up_m: added to its height.
    """
    height = float(similarity.moved_heights(camera.position[2], level_m)) + up_m
    position = np.array([*similarity.moved(camera.nadir), height])
    return replace(camera, position=position, rotation=similarity.about_up @ camera.rotation)


def moved_terrain(terrain: Terrain, similarity: Similarity, level_m: float) -> Terrain:
    """The ground after a similarity, on nodes as far apart as before.

    terrain: before it. level_m: heights over this level are scaled.
    """
    rows, columns = terrain.z.shape
    step = terrain.step_m
    if rows <= 2 and columns <= 2 and terrain.bare is None and float(np.ptp(terrain.z)) == 0.0:
        return terrain  # a level plane
    west, south = terrain.west, terrain.south
    east, north = west + (columns - 1) * step, south + (rows - 1) * step
    corners = similarity.moved(np.array([[west, south], [east, south], [east, north], [west, north]]))
    low = np.floor(corners.min(axis=0) / step) * step
    count = np.ceil((corners.max(axis=0) - low) / step).astype(int) + 1
    empty = Terrain(float(low[0]), float(low[1]), step, np.zeros(count[::-1], np.float32))
    before = similarity.back(empty.nodes())

    def moved(z: Floats) -> Floats:
        heights = replace(terrain, z=z).height(before)
        return np.asarray(similarity.moved_heights(heights, level_m), np.float32)

    return terrain.changed(moved, west=float(low[0]), south=float(low[1]))
