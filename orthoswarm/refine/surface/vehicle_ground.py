"""The ground under one vehicle during its adjustment: fitted to the points, used as their height prior.

And the level of the mapped ground: the height of the plane on which homographies are stated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from orthoswarm.model.arrays import Array
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.extent import FLAT_RELIEF_M
from orthoswarm.refine.bundle.adjustment import Adjustment, HeightPrior
from orthoswarm.refine.surface.dem_surface import DemFit, LocalDem, fit_over_dem
from orthoswarm.refine.surface.terrain import TerrainFit, fit_terrain, lower_flank

_GROUND_POINT_OBSERVATIONS: Final = 4  # least observations of a point that the terrain is fitted to
_GROUND_POINT_WEIGHT: Final = 0.6  # least mean robust weight of such a point's observations
_GROUND_POINT_SIGMA_M: Final = 1.5  # largest sigma of such a point's height
_TERRAIN_REACH_HEIGHTS: Final = 1.08  # how far beyond the outermost cameras the terrain reaches, in flying heights
_HEIGHT_PRIOR_SIGMA_M: Final = 2.0  # sigma of the robust height prior of points about the terrain
_HEIGHT_PRIOR_SOFT_SIGMA_M: Final = 20.0  # sigma of the weak height prior that is not robust
_HEIGHT_PRIOR_ROBUST_C: Final = 1.0  # scale c of the robust height prior's kernel, squared sigmas
TERRAIN_POINTS: Final = 60  # with fewer points no terrain is fitted; the ground stays level, or as it was
_LEVEL_SPACING_M: Final = 7.5  # nodes nearer to each other are thinned for the level of the mapped ground
_LEVEL_REACH_HEIGHTS: Final = 0.5
"""Ground within so many flying heights of a camera counts for the level of the mapped ground: what lies farther out is
seen obliquely, and its height is known less well (on flat ground 0 to 1 agree within 0.05 m)."""


@dataclass(frozen=True, slots=True)
class GroundModel:
    """The present estimate of the ground.

    Attributes:
        fit: the fitted terrain, None until there are enough points (then the ground is level at `level_m`, or has
            the shape of the height model).
        level_m: height of the ground's median (0: the takeoff level). dem: given height model, None to find the ground.
        contradicted_m: median difference from a height model that was dropped because it contradicts the points.
    """

    fit: TerrainFit | DemFit | None = None
    level_m: float = 0.0
    dem: LocalDem | None = None
    contradicted_m: float = 0.0

    def height(self, xy: Array) -> Array:
        """Ground height (M,) at positions (M, 2)."""
        if self.fit is None:
            return self._initial_height(xy)
        return np.asarray(self.terrain().height(xy))

    def terrain(self) -> Terrain:
        """The ground for rectifying pictures."""
        return Terrain.flat(self.level_m) if self.fit is None else self.fit.rendering()

    def height_prior(
        self, points: Array, sigma_m: float = _HEIGHT_PRIOR_SIGMA_M, robust_c: float = _HEIGHT_PRIOR_ROBUST_C
    ) -> HeightPrior:
        """The height prior of points (P, 3)."""
        if self.fit is None:
            expected = self._initial_height(points[:, :2])
        else:
            expected = self.fit.prior(self.level_m).height(points[:, :2]) + self.fit.points_above_m
        return HeightPrior(expected, sigma_m, _HEIGHT_PRIOR_SOFT_SIGMA_M, robust_c)

    def _initial_height(self, xy: Array) -> Array:
        level = np.full(len(xy), self.level_m)
        return level if self.dem is None else level + self.dem.height(xy)


def ground_points(adjustment: Adjustment) -> tuple[Array, Array]:
    """Points suitable for the terrain, float64 (K, 3), and one sigma of their heights (K,)."""
    n = len(adjustment.points)
    point = adjustment.tracks.point
    total = np.maximum(np.bincount(point, minlength=n), 1)
    weight = np.bincount(point, adjustment.obs_weight, minlength=n) / total
    sigma = np.sqrt(np.maximum(adjustment.point_inverse[:, 2, 2], 0.0))
    good = (total >= _GROUND_POINT_OBSERVATIONS) & (weight > _GROUND_POINT_WEIGHT)
    good &= (sigma < _GROUND_POINT_SIGMA_M) & (sigma > 0)
    return adjustment.points[good], sigma[good]


def fit_surface(
    adjustment: Adjustment, before: GroundModel, *, kappa: float | None = None, extra: tuple[Array, Array] | None = None
) -> GroundModel:
    """Fit the ground to an adjustment's points (and to extra ones with their sigmas); see `fit_ground`."""
    points, sigma = ground_points(adjustment)
    if extra is not None:
        points, sigma = np.concatenate([points, extra[0]]), np.concatenate([sigma, extra[1]])
    return fit_ground(points, sigma, adjustment.cameras.position, before, kappa=kappa)


def fit_ground(
    points: Array, sigma: Array, camera_position: Array, before: GroundModel, *, kappa: float | None = None
) -> GroundModel:
    """Fit the ground below cameras (N, 3) to points (P, 3) with sigmas (P,); with too few points it stays unchanged.

    A height model that contradicts the points is dropped for good.
    """
    if len(points) < TERRAIN_POINTS:
        return before
    reach = _TERRAIN_REACH_HEIGHTS * float(np.median(camera_position[:, 2]))
    bounds = BoundingBox.around_points(camera_position[:, :2], reach)
    if before.dem is not None:
        fit, off = fit_over_dem(before.dem, points, sigma, bounds, kappa=kappa)
        if fit is not None:
            return replace(before, fit=fit)
        before = replace(before, dem=None, contradicted_m=off)
    return replace(before, fit=fit_terrain(points, sigma, bounds, kappa=kappa))


def mapped_ground_level(terrain: Terrain | None, camera_position: Array, dense: Sequence[Array]) -> float:
    """Median height of the mapped ground, metres, in the datum of the cameras (N, 3); 0 without a terrain.

    Rubble, hedges and cars only raise points: so the open ground is at the lower flank of their heights. On level
    ground these are heights above zero, else above the terrain, whose median below and around the cameras is added.
    dense: ground points (K, 3) at free positions (not at corners), one array per vehicle.
    """
    if terrain is None or not len(camera_position):
        return 0.0
    ground = terrain.bare_ground()
    position = np.asarray(camera_position, float)
    below = ground.height(position[:, :2])
    height = float(np.median(position[:, 2] - below))
    stride = max(1, int(_LEVEL_SPACING_M / ground.step_m))
    z, nodes = ground.z[::stride, ::stride], ground.nodes()[::stride, ::stride].reshape(-1, 2)
    near = cKDTree(position[:, :2]).query(nodes, distance_upper_bound=_LEVEL_REACH_HEIGHTS * height)[0]
    mapped = np.isfinite(near)
    heights = z.ravel()[mapped] if mapped.any() else below
    level = float(np.median(heights))
    points = np.concatenate([np.zeros((0, 3)), *dense])
    if len(points) < TERRAIN_POINTS:
        return level
    if float(np.std(heights)) <= FLAT_RELIEF_M:
        return lower_flank(points[:, 2])
    return level + lower_flank(points[:, 2] - ground.height(points[:, :2]))
