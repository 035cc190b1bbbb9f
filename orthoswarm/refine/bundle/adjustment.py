"""Bundle adjustment: one robust least-squares problem over cameras, lenses, biases, drift and tie points.

Beyond the paper: instead of one line and one homography for each leg, the errors of the records are unknowns
with priors (Förstner and Wrobel 2016, chapter 15). Tie points, ground heights and map ties constrain them.
"""

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.model.arrays import Array, Flags, Indices, Ints
from orthoswarm.refine.bundle import normal_equations
from orthoswarm.refine.bundle.banded_solver import BandedSystem, camera_order, factorise, solve_factored
from orthoswarm.refine.bundle.block_arrays import CX, CY, K1, K2, K3, CameraBlock, F, Tracks, exp_rotation
from orthoswarm.refine.bundle.priors import Layout, Priors, add_priors, position_residuals

_LENS_COLUMNS = [F, K1, K2, K3, CX, CY]

TRACK_ROBUST_C: Final = 9.0  # robust scale of image observations near the minimum, squared sigmas: 3 sigmas
TIE_ROBUST_C: Final = 9.0  # robust scale of ties to the map, squared sigmas, where a step names no other
POINT_STEP_LIMIT_M: Final = 50.0  # longest move of a point in one step; near-parallel rays would throw it far
_HEIGHT_ROBUST_C: Final = 4.0  # robust scale of the points' height prior, squared sigmas, where it names no other
_DAMPING_SHARE: Final = 1e-6  # added to the diagonal of the cameras' equations, as a share (Levenberg 1944)


@dataclass(frozen=True, slots=True)
class MapTies:
    """Horizontal control points on the ground, found by matching pictures with the map, which displaces roofs.

    point: int32 (Q,), tie point, each at most once. xy: float64 (Q, 2), its place on the map, local frame. sigma_m:
    float64 (Q,).
    """

    point: Ints
    xy: Array
    sigma_m: Array

    @classmethod
    def none(cls) -> "MapTies":
        """No ties."""
        return cls(np.zeros(0, np.int32), np.zeros((0, 2)), np.zeros(0))


@dataclass(frozen=True, slots=True)
class HeightPrior:
    """Prior on the points' heights.

    height: float64 (P,) expected Z, metres. sigma: robust sigma, metres; soft_sigma: sigma of a second, weak prior that
    is not robust, metres. c: robust scale of `sigma`, squared sigmas.
    """

    height: Array
    sigma: float
    soft_sigma: float
    c: float = _HEIGHT_ROBUST_C


@dataclass(slots=True, kw_only=True)
class Adjustment:
    """State of a bundle adjustment; `step` improves it in place.

    Attributes:
        cameras: present exterior and interior orientation. tracks: observations, sorted by point. priors: see there.
        points: float64 (P, 3), tie points. free: bool (N,), False for cameras that are held fixed.
        layout: of the common unknowns. common: float64 (layout.size,), their values (the lens columns hold differences
            to the prior's start).
        start: int64 (P + 1,), first observation of each point. slot: int32 (N,), place of each camera in the band, -1
            if held. bandwidth: of the band, in cameras.
        obs_weight: float64 (M,), robust weights of the observations at the last step.
        point_inverse: float64 (P, 3, 3), inverse of each point's own block (its covariance with the cameras held).
        tie_residual: float64 (Q, 2), metres, at the last step.
        information: float64 (layout.size, layout.size), inverse covariance of the common unknowns at the last step
            (empty before it).
    """

    cameras: CameraBlock
    tracks: Tracks
    priors: Priors
    points: Array
    free: Flags
    layout: Layout
    common: Array
    start: Indices
    slot: Ints
    bandwidth: int
    obs_weight: Array
    point_inverse: Array
    tie_residual: Array = field(default_factory=lambda: np.zeros((0, 2)))
    information: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def begin(
        cls, cameras: CameraBlock, tracks: Tracks, priors: Priors, points: Array, free: Flags | None = None
    ) -> "Adjustment":
        """Set up the state: observations sorted by point, cameras ordered for a narrow band."""
        tracks = tracks.take(np.lexsort((tracks.camera, tracks.point)))
        free = np.ones(len(cameras), bool) if free is None else free
        slot, bandwidth = camera_order(tracks, cameras.position, len(points), free)
        layout = Layout.of(priors)
        return cls(
            cameras=cameras.copy(),
            tracks=tracks,
            priors=priors,
            points=np.array(points, float),
            free=free,
            layout=layout,
            common=np.zeros(layout.size),
            start=np.searchsorted(tracks.point, np.arange(len(points) + 1)),
            slot=slot,
            bandwidth=bandwidth,
            obs_weight=np.zeros(len(tracks.point)),
            point_inverse=np.zeros((len(points), 3, 3)),
        )

    def copy(self) -> "Adjustment":
        """An independent copy, to return to if further steps make the solution worse."""
        return replace(
            self,
            cameras=self.cameras.copy(),
            points=self.points.copy(),
            common=self.common.copy(),
            obs_weight=self.obs_weight.copy(),
            point_inverse=self.point_inverse.copy(),
        )

    def step(
        self, c: float, heights: HeightPrior, ties: MapTies | None = None, tie_c: float = TIE_ROBUST_C,
        damping: float = _DAMPING_SHARE,
    ) -> float:  # fmt: skip
        """One Gauss-Newton step, iteratively reweighted; returns the largest change of a camera position, metres.

        Args:
            c: robust scale of the reprojection residuals, squared sigmas. heights: prior of the points' heights.
            ties: map ties. tie_c: their robust scale. damping: share added to the diagonal of the cameras' part.

        Raises:
            AdjustmentError: if the system is singular even with its priors (NaN in the input).
        """
        system = self._assemble(c, heights, ties or MapTies.none(), tie_c)
        system.band[0] *= 1.0 + damping
        step_camera, step_common, self.information = system.solve()
        self._move(step_camera, step_common)
        normal_equations.back_substitute(
            self.points, (self.start, self.tracks.camera, self.slot),
            (system.w_obs, system.w_lens, self.point_inverse, system.b_point),
            step_camera, step_common[: self.layout.lens_columns], POINT_STEP_LIMIT_M,
        )  # fmt: skip
        return float(np.abs(step_camera.reshape(-1, 6)[:, :3]).max()) if len(step_camera) else 0.0

    def covariance(
        self, chosen: NDArray[np.integer], c: float, heights: HeightPrior, ties: MapTies | None = None,
        tie_c: float = TIE_ROBUST_C,
    ) -> tuple[Array, Array, Array]:  # fmt: skip
        """Covariances of free cameras (K,) at the present state, with the points eliminated, not held; see `step`.

        Returns:
            float64 (K, 6, 6) of position and rotation about the camera's axes, (size, size) of the common unknowns, and
            (K, 6, size) between both.
        """
        system = self._assemble(c, heights, ties or MapTies.none(), tie_c)
        factor = factorise(system.band)
        y = solve_factored(factor, system.side)
        inverse = np.linalg.inv(system.corner - system.side.T @ y)
        rows = (6 * self.slot[chosen][:, None] + np.arange(6)).ravel()
        unit = np.zeros((system.band.shape[1], len(rows)), order="F")
        unit[rows, np.arange(len(rows))] = 1.0
        solved = solve_factored(factor, unit)
        out, between = np.empty((len(chosen), 6, 6)), np.empty((len(chosen), 6, len(inverse)))
        for k in range(len(chosen)):
            own = rows[6 * k : 6 * k + 6]
            between[k] = -y[own] @ inverse
            out[k] = solved[own, 6 * k : 6 * k + 6] - between[k] @ y[own].T
        return out, np.asarray(inverse, np.float64), between

    def _assemble(self, c: float, heights: HeightPrior, ties: MapTies, tie_c: float) -> BandedSystem:
        """Build the reduced normal equations at the present state."""
        lenses, points, size = len(self.cameras.lens), len(self.points), self.layout.size
        n, k = 6 * int(self.free.sum()), 6 * lenses
        system = BandedSystem(
            band=np.zeros((6 * (self.bandwidth + 1), n), order="F"),
            side=np.zeros((n, size)),
            corner=np.zeros((size, size)),
            rhs=np.zeros(n),
            rhs_common=np.zeros(size),
            w_obs=np.zeros((len(self.tracks.point), 6, 3)),
            w_lens=np.zeros((points, lenses, 6, 3)),
            b_point=np.zeros((points, 3)),
        )
        lens_side, lens_corner, rhs_lens = np.zeros((n, k)), np.zeros((k, k)), np.zeros(k)
        tie_of_point = np.full(points, -1, np.int32)
        tie_of_point[ties.point] = np.arange(len(ties.point), dtype=np.int32)
        self.tie_residual = np.zeros((len(ties.point), 2))
        normal_equations.build(
            self.cameras.arrays,
            self.points,
            (self.start, self.tracks.camera, self.tracks.uv, 1.0 / self.tracks.sigma_px.astype(float) ** 2),
            self.slot,
            c,
            (heights.height, 1.0 / heights.sigma**2, heights.c, 1.0 / heights.soft_sigma**2),
            (tie_of_point, ties.xy, 1.0 / ties.sigma_m**2, tie_c),
            (system.band, lens_side, lens_corner, system.rhs, rhs_lens),
            (system.w_obs, system.w_lens, self.point_inverse, system.b_point),
            self.obs_weight,
            self.tie_residual,
            normal_equations.room_of_a_point(),
        )
        system.side[:, :k], system.corner[:k, :k], system.rhs_common[:k] = lens_side, lens_corner, rhs_lens
        add_priors(system, self.cameras, self.priors, self.layout, common=self.common, free=self.free, slot=self.slot)
        return system

    @property
    def ground_m(self) -> float:
        """Median height of the points, metres; 0 without any."""
        return float(np.median(self.points[:, 2])) if len(self.points) else 0.0

    def residuals(self) -> Array:
        """Present reprojection residuals (M, 2), pixels."""
        out = np.empty((len(self.tracks.point), 2))
        normal_equations.residuals(
            self.cameras.arrays, self.points, self.tracks.point, self.tracks.camera, self.tracks.uv, out
        )
        return out

    def group_values(self, group: int) -> tuple[Array, float, float]:
        """Attitude bias (3,) in radians, height offset in metres and lag in seconds of a group."""
        at = self.layout.offset[group]
        return self.common[at : at + 3].copy(), float(self.common[at + 3]), float(self.common[at + 4])

    def position_residuals(self) -> Array:
        """Positions minus records, with drift, lag and height offset taken off, metres (N, 3)."""
        return position_residuals(self.cameras, self.priors, self.layout, self.common)

    def _move(self, step_camera: Array, step_common: Array) -> None:
        moves = np.zeros((len(self.cameras), 6))
        index = np.flatnonzero(self.free)
        moves[index] = step_camera.reshape(-1, 6)[self.slot[index]]
        self.cameras.position[:] += moves[:, :3]
        self.cameras.rotation[index] = self.cameras.rotation[index] @ exp_rotation(moves[index, 3:])
        self.common += step_common
        lens = self.priors.lens + self.common[: self.layout.lens_columns].reshape(-1, 6)
        self.cameras.lens[:, F] = np.exp(lens[:, 0])
        self.cameras.lens[:, _LENS_COLUMNS[1:]] = lens[:, 1:]
