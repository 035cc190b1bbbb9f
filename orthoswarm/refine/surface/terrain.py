"""The ground under the pictures: a smooth surface fitted below the points, and its significance against a plane.

Points of a reconstruction lie on the ground and on objects above it, so the surface is fitted from
below: points far above it lose their weight first. Heights and nodes are in the cameras' datum.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from orthoswarm.compute.robust_kernel import robust_weights
from orthoswarm.model.arrays import Array, Flags
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.placement import Terrain
from orthoswarm.model.robust import MEDIAN_LENGTH_SIGMAS
from orthoswarm.mosaic.extent import FLAT_RELIEF_M
from orthoswarm.refine.surface.smooth_surface import FitSettings, fit_nodes

_GROUND_MODE_KERNEL_M: Final = 0.15  # Gaussian kernel of the density of heights in which the ground's level is sought
_GROUND_MODE_WINDOW_M: Final = 15.0  # heights farther than this from the median do not count for the ground's level
_GROUND_MODE_BIN_M: Final = 0.05  # bin of that density: a third of its kernel (exactness)
_GROUND_MODE_SHARE: Final = 0.4  # the lowest peak of at least this share of the highest one's density is the ground
_POINTS_CENTRE_SCALE_M: Final = 2.0  # robust scale of the points' centre over the ground


@dataclass(frozen=True, slots=True, kw_only=True)
class TerrainFit:
    """A fitted surface, with the height prior for the adjustment and the ground for rendering.

    Attributes:
        terrain: the surface T as fitted (not shrunk).
        kappa: smoothness, sigma of the second difference between nodes 30 m apart, metres.
        sd_m: standard deviation of T over nodes with data; median_m: its median there.
        ground_m: level of the ground in the points' datum: median_m where there is relief, else the lower flank of
            the mode of the heights (rubble, cars and bushes only raise points).
        points_above_m: height of the points' robust centre above that ground; with a height prior around
            level + points_above_m the ground itself is at the level.
        support: bool (rows, columns), nodes with data in an adjacent cell. settings: of the fit.
    """

    terrain: Terrain
    kappa: float
    sd_m: float
    median_m: float
    ground_m: float
    points_above_m: float
    support: Flags
    settings: FitSettings = field(default_factory=FitSettings)

    @property
    def shrink(self) -> float:
        """Share of the relief that enters the height prior, 0 to 1; 0 where it cannot be distinguished from noise."""
        return _shrink(self.sd_m, FLAT_RELIEF_M)

    def prior(self, z0_m: float) -> Terrain:
        """The surface around which point heights are held: shrink (T - median T) + z0, a plane at z0 where flat.

        With z0 = level + points_above_m the ground itself is at the level, not the centre of all points.
        """
        return _about(self.terrain, self.median_m, self.shrink, z0_m)

    def rendering(self) -> Terrain:
        """T shrunk about its own median for rectifying pictures (never about zero)."""
        s = _shrink(self.sd_m, self.settings.render_flat_sd_m)
        return _about(self.terrain, self.median_m, s, self.median_m)


def fit_terrain(
    points: Array,
    sigma_z: Array,
    bounds: BoundingBox,
    *,
    kappa: float | None = None,
    settings: FitSettings | None = None,
) -> TerrainFit:
    """Fit the ground under points that lie on it and on things above it, see `smooth_surface`.

    Args:
        points: float64 (P, 3), east, north, up in metres. sigma_z: float64 (P,), one sigma of each height.
        bounds: that the nodes must cover (points outside are not used). kappa: smoothness; None finds it by hold-out.

    Raises:
        OrthoSwarmError: if no point lies within the bounds.
    """
    s = settings or FitSettings()
    points, sigma_z = np.asarray(points, float).reshape(-1, 3), np.asarray(sigma_z, float)
    nodes = fit_nodes(points, sigma_z, bounds, kappa, s)
    if nodes is None:
        raise OrthoSwarmError("no adjusted point lies on the area, so no terrain can be fitted; give one by --dem")
    terrain = Terrain(nodes.west, nodes.south, s.step_m, nodes.z.astype(np.float32))
    rows, columns = nodes.z.shape
    c, r = (points[:, 0] - nodes.west) / s.step_m, (points[:, 1] - nodes.south) / s.step_m
    used = (c >= 0) & (r >= 0) & (c < columns - 1) & (r < rows - 1) & np.isfinite(points[:, 2]) & (sigma_z > 0)
    above = points[used, 2] - terrain.height(points[used, :2])
    sd, median = float(nodes.z[nodes.support].std()), float(np.median(nodes.z[nodes.support]))
    flat = _shrink(sd, FLAT_RELIEF_M) == 0.0
    ground = lower_flank(points[used, 2], sigma_z[used]) if flat else median
    pull = robust_centre(points[used, 2] - ground if flat else above)
    return TerrainFit(
        terrain=terrain,
        kappa=nodes.kappa,
        sd_m=sd,
        median_m=median,
        ground_m=ground,
        points_above_m=pull,
        support=nodes.support,
        settings=s,
    )


def lower_flank(height: Array, sigma: Array | None = None) -> float:
    """Level of the ground from heights of points that lie mostly on it and partly above it.

    The half-maximum point on the lower side of the mode, moved up by the half width that a peak of the heights' own
    noise would have: a symmetric peak returns its mode, one skewed upwards its lower edge. Of several peaks the lowest
    one of sufficient density is used, as many corners lie on car roofs.
    """
    window_m, bin_m, kernel_m = _GROUND_MODE_WINDOW_M, _GROUND_MODE_BIN_M, _GROUND_MODE_KERNEL_M
    z = np.asarray(height, float)
    if len(z) == 0:
        return 0.0
    centre = float(np.median(z))
    z = z[np.abs(z - centre) < window_m]
    edges = np.arange(-window_m - 0.5, window_m + 0.5 + bin_m, bin_m)
    counts = np.histogram(z - centre, edges)[0].astype(float)
    bins = int(5 * kernel_m / bin_m)
    reach = np.arange(-bins, bins + 1) * bin_m
    density = np.convolve(counts, np.exp(-0.5 * (reach / kernel_m) ** 2), mode="same")
    peak = np.r_[False, (density[1:-1] >= density[:-2]) & (density[1:-1] > density[2:]), False]
    peak &= density >= _GROUND_MODE_SHARE * density.max()
    top = int(np.flatnonzero(peak)[0]) if peak.any() else int(density.argmax())
    below = np.flatnonzero(density[:top] < 0.5 * density[top])
    if len(below) == 0:
        return centre + float(edges[top]) + bin_m / 2
    i = int(below[-1])
    part = (0.5 * density[top] - density[i]) / max(density[i + 1] - density[i], 1e-12)
    flank = edges[i] + bin_m / 2 + bin_m * part
    mode = edges[top] + bin_m / 2
    noise = kernel_m
    if sigma is not None and len(sigma):
        noise = float(np.hypot(kernel_m, np.median(sigma)))
    return centre + float(min(flank + MEDIAN_LENGTH_SIGMAS * noise, mode))


def robust_centre(x: Array) -> float:
    """Robust centre of values, started at their median."""
    if len(x) == 0:
        return 0.0
    c = float(np.median(x))
    for _ in range(20):
        w = robust_weights(((x - c) / _POINTS_CENTRE_SCALE_M) ** 2, 1.0)
        c = float((w * x).sum() / w.sum())
    return c


def _shrink(sd: float, noise: float) -> float:
    return max(0.0, 1.0 - (noise / max(sd, 1e-9)) ** 2)


def _about(terrain: Terrain, median: float, share: float, level: float) -> Terrain:
    z = share * (terrain.z.astype(np.float64) - median) + level
    return Terrain(terrain.west, terrain.south, terrain.step_m, z.astype(np.float32))
