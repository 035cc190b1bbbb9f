"""Ground shaped by the user's height model (DEM), corrected where the pictures contradict it.

The model's vertical datum differs from heights above takeoff, and it may be old, coarse, or not cover the area. So a
smooth surface is fitted to the points' heights above the model. Where that is level, it is one vertical shift and the
model's shape is used; elsewhere the pictures are used. A model that explains none of the relief is ignored.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from orthoswarm.model.arrays import Array, Flags, Floats
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.placement import Terrain
from orthoswarm.raster.height_model import HeightModel, KnownGround
from orthoswarm.refine.surface.smooth_surface import FitSettings
from orthoswarm.refine.surface.terrain import fit_terrain, robust_centre

_DEM_BLOCK_M: Final = 64.0  # windows of a height model lie on multiples, so that a path that moves reads none again
_DEM_NODES: Final = 150_000  # nodes of the height model in memory for one vehicle (memory)
_DEM_ROUGHER_M: Final = 0.3  # a model contradicts the pictures if heights over it vary by so much more than the ground
_DEM_NOISE_M: Final = 0.4  # differences from a model of this size are errors of the points' own surface
_DEM_NOISE_LEAST_SHARE: Final = 0.25  # a model that seldom agrees is kept only below this share of `_DEM_NOISE_M`
_DEM_NOISE_NODES: Final = 2.0  # differences are averaged over a Gaussian of this sigma, nodes
_DEM_TRUSTED_M: Final = 0.15  # median difference up to which a model is better than the points' own surface
_DEM_DOUBTED_M: Final = 0.3  # median difference from which it is not
_DEM_LEVEL_KERNEL_M: Final = 0.2  # Gaussian kernel of the mode by which the model's level is found
_DEM_LEAST_POINTS: Final = 60  # with fewer points on a model its level is a guess, and it is left out
_DEM_SEAM_M: Final = 90.0  # over this distance the ground beyond a model is led to its level at the border


@dataclass(frozen=True, slots=True)
class LocalDem:
    """A height model in a local frame, whose origin is east and north of it."""

    model: HeightModel
    origin: tuple[float, float]

    def window(self, bounds: BoundingBox, most_nodes: int = _DEM_NODES) -> KnownGround:
        """Heights above the model's zero within bounds; both in the local frame."""
        low = [float(np.floor((v + o) / _DEM_BLOCK_M) * _DEM_BLOCK_M) for v, o in zip(bounds[:2], self.origin)]
        high = [float(np.ceil((v + o) / _DEM_BLOCK_M) * _DEM_BLOCK_M) for v, o in zip(bounds[2:], self.origin)]
        ground = self.model.window(BoundingBox(*low, *high), most_nodes)
        t = ground.terrain
        return replace(ground, terrain=replace(t, west=t.west - self.origin[0], south=t.south - self.origin[1]))

    def height(self, xy: Array) -> Array:
        """Heights (M,) above the model's zero at positions (M, 2)."""
        ok: Flags = np.asarray(np.isfinite(xy).all(axis=1))
        if not ok.any():
            return np.zeros(len(xy))
        low, high = np.quantile(xy[ok], [0.01, 0.99], axis=0)
        ground = self.window(BoundingBox.around_points([low, high]))
        return ground.terrain.height(np.where(ok[:, None], xy, low))


@dataclass(frozen=True, slots=True)
class SurfaceSum:
    """Ground as the sum of two surfaces."""

    lower: Terrain
    upper: Terrain

    def height(self, east_north: Array) -> Array:
        """Heights (...,) at ground points (..., 2)."""
        return self.lower.height(east_north) + self.upper.height(east_north)


@dataclass(frozen=True, kw_only=True)
class DemFit:
    """A height model shifted to the points' level; used in place of a TerrainFit.

    Attributes:
        bounds: of the nodes, local frame. most_nodes: most nodes read from the model. shift_m: added to its heights.
        rest: difference of the ground from the shifted model. beyond: ground above the model's zero where it has none.
        points_above_m: how far the robust centre of the points lies over the ground (see TerrainFit).
        sd_m: standard deviation of the ground over nodes with data.
    """

    dem: LocalDem
    bounds: BoundingBox
    most_nodes: int
    shift_m: float
    rest: Terrain
    points_above_m: float
    sd_m: float
    beyond: Terrain | None = None
    _made: dict[str, Terrain] = field(default_factory=dict, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without the nodes, which are read again from the file."""
        return {**self.__dict__, "_made": {}}

    def prior(self, z0_m: float) -> SurfaceSum:
        """The surface around which point heights are held, the model's zero at z0."""
        return SurfaceSum(self._shape(), _shifted(self.rest, z0_m))

    def rendering(self) -> Terrain:
        """The ground for rectifying pictures."""
        if "drawn" not in self._made:
            shape = self._shape()
            z = shape.z + self.rest.height(shape.nodes()) + self.shift_m
            self._made["drawn"] = replace(shape, z=z.astype(np.float32))
        return self._made["drawn"]

    def _shape(self) -> Terrain:
        if "shape" not in self._made:
            self._made["shape"] = _completed(self.dem.window(self.bounds, self.most_nodes), self.beyond)
        return self._made["shape"]


def fit_over_dem(
    dem: LocalDem,
    points: Array,
    sigma_z: Array,
    bounds: BoundingBox,
    *,
    kappa: float | None = None,
    settings: FitSettings | None = None,
    most_nodes: int = _DEM_NODES,
) -> tuple[DemFit | None, float]:
    """Fit the ground under points over a height model (see `fit_terrain` for the other arguments).

    Args:
        points: float64 (P, 3), local frame. bounds: that it must cover. most_nodes: most nodes read from the model.

    Returns:
        The fit, None if the model contradicts the points (or has no heights there); and how far the ground differs
        from the model, the median over nodes with data.
    """
    ground = dem.window(bounds, most_nodes)
    if not ground.known.any():
        return None, 0.0
    beyond = None
    if not ground.known.all():
        found = fit_terrain(points, sigma_z, bounds, kappa=kappa, settings=settings)
        on = ground.knows(points[:, :2])
        if int(on.sum()) < _DEM_LEAST_POINTS:
            return None, 0.0
        above = points[on, 2] - ground.terrain.height(points[on, :2])
        beyond = _shifted(found.rendering(), -kernel_mode(above))
    shape = _completed(ground, beyond)
    over = points.copy()
    over[:, 2] -= shape.height(points[:, :2])
    left = fit_terrain(over, sigma_z, bounds, kappa=kappa, settings=settings)
    nodes, known = left.terrain, left.support & ground.knows(left.terrain.nodes())
    if not known.any():
        return None, 0.0
    sd = float((nodes.z + shape.height(nodes.nodes()))[known].std())
    shift = kernel_mode(nodes.z[known].astype(np.float64))
    difference = nodes.z - np.float32(shift)
    off = float(np.median(np.abs(difference[known])))
    if float(difference[known].std()) > sd + _DEM_ROUGHER_M:
        return None, off
    rest = replace(nodes, z=difference * _difference_share(difference, left.support, off))
    good = np.isfinite(over).all(1) & (sigma_z > 0)
    pull = robust_centre(over[good, 2] - rest.height(over[good, :2]) - shift)
    return DemFit(
        dem=dem,
        bounds=bounds,
        most_nodes=most_nodes,
        shift_m=shift,
        rest=rest,
        points_above_m=pull,
        sd_m=sd,
        beyond=beyond,
    ), off


def _difference_share(difference: Floats, known: Flags, usual_m: float) -> Floats:
    """Share (rows, columns) of the difference from the model to apply: none where it is small around a node.

    A surface through points errs by decimetres, most at its border; a model that agrees with it nearly everywhere is
    more accurate. A model that seldom agrees is not.
    """
    from scipy.ndimage import gaussian_filter

    doubt = (_DEM_DOUBTED_M - usual_m) / (_DEM_DOUBTED_M - _DEM_TRUSTED_M)
    noise = _DEM_NOISE_M * float(np.clip(doubt, _DEM_NOISE_LEAST_SHARE, 1.0))
    weight = known.astype(np.float64)
    power = gaussian_filter(weight * difference**2, _DEM_NOISE_NODES)
    power /= np.maximum(gaussian_filter(weight, _DEM_NOISE_NODES), 1e-3)
    return np.asarray(np.maximum(0.0, 1.0 - noise**2 / np.maximum(power, 1e-9)), np.float32)


def _shifted(terrain: Terrain, by_m: float) -> Terrain:
    return replace(terrain, z=terrain.z + np.float32(by_m))


def _completed(ground: KnownGround, beyond: Terrain | None) -> Terrain:
    """The model's heights, filled with other ground where it has none, shifted to the model's level at the border."""
    t, known = ground.terrain, ground.known
    if beyond is None or known.all():
        return t
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    other = beyond.height(t.nodes())
    blur = _DEM_SEAM_M / 3.0 / t.step_m
    gap = gaussian_filter(np.where(known, t.z - other, 0.0), blur, mode="nearest")
    gap /= np.maximum(gaussian_filter(known.astype(np.float64), blur, mode="nearest"), 1e-6)
    away = distance_transform_edt(~known) * t.step_m
    other += gap * np.clip(1.0 - away / _DEM_SEAM_M, 0.0, 1.0)
    return replace(t, z=np.where(known, t.z, other).astype(np.float32))


def kernel_mode(values: Array) -> float:
    """Most frequent value: mean shift with a Gaussian kernel from the best of many starts."""
    starts = np.quantile(values, np.linspace(0.02, 0.98, 49))
    near = np.exp(-0.5 * ((values[None, :] - starts[:, None]) / _DEM_LEVEL_KERNEL_M) ** 2)
    at = float(starts[near.sum(1).argmax()])
    for _ in range(20):
        w = np.exp(-0.5 * ((values - at) / _DEM_LEVEL_KERNEL_M) ** 2)
        at = float((w * values).sum() / w.sum())
    return at
