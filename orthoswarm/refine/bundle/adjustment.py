"""The adjustment: one small robust least-squares problem over cameras, lenses, biases, drift and points.

Beyond the paper (RECIPE.md steps 2 and 8): instead of a line a leg and a homography a leg, all errors that a swarm's
records have are unknowns with priors, held together by tracks, ground heights and ties to the map.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray
from scipy.linalg import lapack, solve_triangular
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from orthoswarm.model.errors import AdjustmentError
from orthoswarm.refine.bundle import normal_equations
from orthoswarm.refine.bundle.block_arrays import CX, CY, K1, K2, K3, CameraBlock, F, Ints, Tracks
from orthoswarm.refine.bundle.priors import Layout, Priors

Array = NDArray[np.float64]
_BLOCK, _WIDE = 64, 600
_LENS_COLUMNS = [F, K1, K2, K3, CX, CY]


@dataclass(frozen=True, slots=True)
class MapTies:
    """Points of which the map says where they lie.

    What was compared is ground, which a map shows where it is, however much its roofs lean.

    Attributes:
        point: int32 (Q,), at most one tie a point. xy: float64 (Q, 2). sigma_m: float64 (Q,).
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
    """What is believed of the points' heights.

    Attributes:
        height: float64 (P,) expected Z. sigma: robust sigma; soft_sigma: a weak one that is not robust, metres.
        c: robust scale of `sigma`.
    """

    height: Array
    sigma: float
    soft_sigma: float
    c: float = 4.0


@dataclass(slots=True)
class Adjustment:
    """State of an adjustment; `step` improves it in place.

    Attributes:
        cameras: cameras now. points: float64 (P, 3). common: float64 (layout.size,) values of the common unknowns (the
            lens columns hold differences to the prior's start). tracks: observations sorted by point.
        obs_weight: float64 (M,) robust weights of the last step. point_inverse: float64 (P, 3, 3), inverse of each
            point's own block (its covariance with the cameras held).
        tie_residual: float64 (Q, 2) of the last step. information: float64 (layout.size, layout.size), inverse
            covariance of the common unknowns at the last step (empty before it).
    """

    cameras: CameraBlock
    tracks: Tracks
    priors: Priors
    points: Array
    free: NDArray[np.bool_]
    layout: Layout
    common: Array
    start: NDArray[np.int64]
    slot: Ints
    bandwidth: int
    obs_weight: Array
    point_inverse: Array
    tie_residual: Array = field(default_factory=lambda: np.zeros((0, 2)))
    cost: float = 0.0
    gps_weight: Array = field(default_factory=lambda: np.zeros(0))
    information: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def begin(
        cls, cameras: CameraBlock, tracks: Tracks, priors: Priors, points: Array, free: NDArray[np.bool_] | None = None
    ) -> "Adjustment":
        """Set up; observations are sorted by point, cameras are ordered for a narrow band."""
        order = np.lexsort((tracks.camera, tracks.point))
        tracks = Tracks(tracks.camera[order], tracks.point[order], tracks.uv[order], tracks.sigma_px[order])
        start = np.searchsorted(tracks.point, np.arange(len(points) + 1))
        free = np.ones(len(cameras), bool) if free is None else free
        slot, width = _order(tracks, len(points), len(cameras), free)
        layout = Layout.of(priors)
        return cls(
            replace(
                cameras, position=cameras.position.copy(), rotation=cameras.rotation.copy(), lens=cameras.lens.copy()
            ),
            tracks,
            priors,
            np.array(points, float),
            free,
            layout,
            np.zeros(layout.size),
            start,
            slot,
            width,
            np.zeros(len(tracks.point)),
            np.zeros((len(points), 3, 3)),
        )

    def step(
        self, c: float, ground: HeightPrior, ties: MapTies | None = None, tie_c: float = 9.0, damping: float = 1e-6
    ) -> float:
        """One Gauss-Newton step with robust scale c (squared sigmas); returns the largest camera move in metres.

        Raises:
            AdjustmentError: if the system is singular even with its priors (NaN in the input).
        """
        system = self._assemble(c, ground, MapTies.none() if ties is None else ties, tie_c)
        system.band[0] *= 1.0 + damping
        step_camera, step_common, self.information = _solve(system)
        self._move(step_camera, step_common)
        normal_equations.back_substitute(
            self.points,
            self.start,
            self.tracks.camera,
            self.slot,
            system.w_obs,
            system.w_lens,
            self.point_inverse,
            system.b_point,
            step_camera,
            step_common[: self.layout.lens_columns],
            50.0,
        )
        return float(np.abs(step_camera.reshape(-1, 6)[:, :3]).max()) if len(step_camera) else 0.0

    def covariance(
        self,
        chosen: NDArray[np.integer],
        c: float,
        ground: HeightPrior,
        ties: MapTies | None = None,
        tie_c: float = 9.0,
    ) -> tuple[Array, Array]:
        """Covariances at the present state; the points are eliminated, not held.

        Args:
            chosen: (K,) free cameras. c, ground, ties, tie_c: as for `step`.

        Returns:
            float64 (K, 6, 6) of position and rotation about the camera's axes, and (size, size) of the common unknowns.
        """
        system = self._assemble(c, ground, MapTies.none() if ties is None else ties, tie_c)
        factor = _factor(system.band)
        y = _back(factor, system.side)
        inverse = np.linalg.inv(system.corner - system.side.T @ y)
        rows = (6 * self.slot[chosen][:, None] + np.arange(6)).ravel()
        unit = np.zeros((system.band.shape[1], len(rows)), order="F")
        unit[rows, np.arange(len(rows))] = 1.0
        solved = _back(factor, unit)
        out = np.empty((len(chosen), 6, 6))
        for k in range(len(chosen)):
            own = rows[6 * k : 6 * k + 6]
            out[k] = solved[own, 6 * k : 6 * k + 6] + y[own] @ inverse @ y[own].T
        return out, np.asarray(inverse, np.float64)

    def _assemble(self, c: float, ground: HeightPrior, ties: MapTies, tie_c: float) -> "_System":
        n, size, lenses = int(self.free.sum()), self.layout.size, len(self.cameras.lens)
        k, points = 6 * lenses, len(self.points)
        system = _System.empty(n, size, lenses, points, len(self.tracks.point), self.bandwidth)
        lens_side, lens_corner, rhs_lens = np.zeros((6 * n, k)), np.zeros((k, k)), np.zeros(k)
        tie_of_point = np.full(points, -1, np.int32)
        tie_of_point[ties.point] = np.arange(len(ties.point), dtype=np.int32)
        self.tie_residual = np.zeros((len(ties.point), 2))
        self.cost, _ = normal_equations.build(
            self.cameras.position,
            self.cameras.rotation,
            self.cameras.lens_id,
            self.cameras.lens,
            self.points,
            self.start,
            self.tracks.camera,
            self.tracks.uv,
            1.0 / self.tracks.sigma_px.astype(float) ** 2,
            self.slot,
            c,
            ground.height,
            np.full(points, 1.0 / ground.sigma**2),
            ground.c,
            1.0 / ground.soft_sigma**2,
            tie_of_point,
            ties.xy,
            1.0 / ties.sigma_m**2,
            tie_c,
            system.band,
            lens_side,
            lens_corner,
            system.rhs,
            rhs_lens,
            system.w_obs,
            system.w_lens,
            self.point_inverse,
            system.b_point,
            self.obs_weight,
            self.tie_residual,
        )
        system.side[:, :k], system.corner[:k, :k], system.rhs_common[:k] = lens_side, lens_corner, rhs_lens
        self._add_priors(system.band, system.side, system.corner, system.rhs, system.rhs_common)
        return system

    def residuals(self) -> Array:
        """Reprojection residuals (M, 2) in pixels now."""
        out = np.empty((len(self.tracks.point), 2))
        normal_equations.residuals(
            self.cameras.position,
            self.cameras.rotation,
            self.cameras.lens_id,
            self.cameras.lens,
            self.points,
            self.tracks.point,
            self.tracks.camera,
            self.tracks.uv,
            out,
        )
        return out

    def group_values(self, group: int) -> tuple[Array, float, float]:
        """Attitude bias (3,) in radians, height offset in metres and lag in seconds of a group."""
        at = self.layout.offset[group]
        return self.common[at : at + 3].copy(), float(self.common[at + 3]), float(self.common[at + 4])

    def position_residuals(self) -> Array:
        """Cameras minus records, drift, lag and height offset taken off, metres (N, 3)."""
        p, lay = self.priors, self.layout
        base = np.asarray(lay.offset)[p.group]
        out = self.cameras.position - p.position
        out[:, :2] -= lay.drift(self.common, p.group) + self.common[base + 4][:, None] * p.velocity
        out[:, 2] -= self.common[base + 3]
        return np.asarray(out)

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

    def _add_priors(self, band: Array, side: Array, corner: Array, rhs: Array, rhs_common: Array) -> None:
        p, lay = self.priors, self.layout
        lens_weight = np.where(p.lens_sigma > 0, 1.0 / np.maximum(p.lens_sigma, 1e-12) ** 2, 1e18).ravel()
        diagonal = np.arange(lay.lens_columns)
        corner[diagonal, diagonal] += lens_weight
        rhs_common[: lay.lens_columns] -= lens_weight * self.common[: lay.lens_columns]
        i = np.flatnonzero(self.free)
        at = 6 * self.slot[i]
        group = p.group[i]
        base = np.asarray(lay.offset)[group]
        # attitude: log(R_recorded^T R) - bias
        bias = self.common[base[:, None] + np.arange(3)]
        r = log_rotation(np.swapaxes(p.rotation[i], 1, 2) @ self.cameras.rotation[i]) - bias
        w = _weights(p.rotation_sigma[i])
        e2 = (r * r * w).sum(1)
        w = w * (1.0 / (1.0 + e2 / 25.0) ** 2)[:, None]
        for a in range(3):
            band[0, at + 3 + a] += w[:, a]
            rhs[at + 3 + a] -= w[:, a] * r[:, a]
            side[at + 3 + a, base + a] -= w[:, a]
            np.add.at(corner, (base + a, base + a), w[:, a])
            np.add.at(rhs_common, base + a, w[:, a] * r[:, a])
        self._add_position_priors(band, side, corner, rhs, rhs_common)
        for g, model in enumerate(p.models):
            o, k = lay.offset[g], lay.knots[g]
            sigma = np.array([*model.bias_sigma, model.height_sigma, model.lag_sigma])
            weight = np.where(sigma > 0, 1.0 / np.maximum(sigma, 1e-9) ** 2, 1e18)
            d = np.arange(o, o + 5)
            corner[d, d] += weight
            rhs_common[d] -= weight * self.common[d]
            if k:
                _add_drift_prior(corner, rhs_common, self.common, o + 5, k, model.drift_sigma, model.drift_bend)

    def _add_position_priors(self, band: Array, side: Array, corner: Array, rhs: Array, rhs_common: Array) -> None:
        p, lay = self.priors, self.layout
        i = np.flatnonzero(self.free)
        at = 6 * self.slot[i]
        base = np.asarray(lay.offset)[p.group[i]]
        knots = np.asarray(lay.knots)[p.group[i]]
        residual = self.position_residuals()[i]
        xy, rz = residual[:, :2], residual[:, 2]
        w = _weights(p.position_sigma[i])
        e2 = (xy * xy * w[:, :2]).sum(1)
        robust = 1.0 / (1.0 + e2 / p.position_c) ** 2
        self.gps_weight = np.ones(len(self.cameras))
        self.gps_weight[i] = robust
        w[:, :2] *= robust[:, None]
        left = lay.knot_left[i]
        fraction = lay.knot_fraction[i]
        for a in range(2):
            wa, ra = w[:, a], xy[:, a]
            columns = [base + 4]
            factors = [-p.velocity[i, a]]
            has = knots > 0
            columns += [base + 5 + 2 * left + a, base + 5 + 2 * (left + 1) + a]
            factors += [np.where(has, fraction - 1.0, 0.0), np.where(has, -fraction, 0.0)]
            columns = [np.where(has, c, base + 4) if n else c for n, c in enumerate(columns)]
            band[0, at + a] += wa
            rhs[at + a] -= wa * ra
            for c, f in zip(columns, factors):
                side[at + a, c] += wa * f
                np.add.at(rhs_common, c, -wa * f * ra)
                for c2, f2 in zip(columns, factors):
                    np.add.at(corner, (c, c2), wa * f * f2)
        wz = w[:, 2]
        band[0, at + 2] += wz
        rhs[at + 2] -= wz * rz
        side[at + 2, base + 3] -= wz
        np.add.at(corner, (base + 3, base + 3), wz)
        np.add.at(rhs_common, base + 3, wz * rz)


def _weights(sigma: Array) -> Array:
    return np.where(np.isfinite(sigma), 1.0 / np.maximum(sigma, 1e-9) ** 2, 0.0)


def _add_drift_prior(corner: Array, rhs: Array, common: Array, at: int, knots: int, sigma: float, bend: float) -> None:
    """Knots are small (sigma) and bend little (second differences, sigma `bend`)."""
    precision = np.eye(knots) / sigma**2
    if knots > 2:
        second = np.diff(np.eye(knots), 2, axis=0)
        precision += second.T @ second / bend**2
    for a in range(2):
        c = at + 2 * np.arange(knots) + a
        corner[np.ix_(c, c)] += precision
        rhs[c] -= precision @ common[c]


@dataclass(frozen=True, slots=True)
class _System:
    """Reduced normal equations: banded cameras, a border of common unknowns, and what gives the points back."""

    band: Array
    side: Array
    corner: Array
    rhs: Array
    rhs_common: Array
    w_obs: Array
    w_lens: Array
    b_point: Array

    @classmethod
    def empty(cls, free: int, common: int, lenses: int, points: int, observations: int, bandwidth: int) -> "_System":
        return cls(
            np.zeros((6 * (bandwidth + 1), 6 * free), order="F"),
            np.zeros((6 * free, common)),
            np.zeros((common, common)),
            np.zeros(6 * free),
            np.zeros(common),
            np.zeros((observations, 6, 3)),
            np.zeros((points, lenses, 6, 3)),
            np.zeros((points, 3)),
        )


def _factor(band: Array) -> Array:
    factor, info = lapack.dpbtrf(band, lower=1, overwrite_ab=1)
    if info != 0:
        raise AdjustmentError("the adjustment is singular; check the records for NaN or repeated pictures")
    return np.asarray(factor)


def _back(factor: Array, right: Array) -> Array:
    """Solve with a banded Cholesky factor and many right sides (N, K).

    LAPACK's own routine reads the whole factor once for each of them; in blocks of columns it is read once.
    """
    above, n = factor.shape
    if above <= _WIDE:
        return np.asarray(lapack.dpbtrs(factor, right, lower=1)[0])
    x = np.array(right, float)
    blocks = [(a, min(a + _BLOCK, n), min(a + _BLOCK - 1 + above, n)) for a in range(0, n, _BLOCK)]
    for a, b, end in blocks:
        own, below = _blocks_of(factor, a, b, end)
        x[a:b] = solve_triangular(own, x[a:b], lower=True, check_finite=False)
        x[b:end] -= below @ x[a:b]
    for a, b, end in reversed(blocks):
        own, below = _blocks_of(factor, a, b, end)
        x[a:b] = solve_triangular(own, x[a:b] - below.T @ x[b:end], lower=True, trans="T", check_finite=False)
    return x


def _blocks_of(factor: Array, a: int, b: int, end: int) -> tuple[Array, Array]:
    """Of the factor's columns a to b: the triangle on the diagonal, and the rows below it down to `end`."""
    above = len(factor)
    # entry (i, j) of the factor lies at [i - j, j]: a step of one row and a step of one column are both strides
    down, across = factor.strides[0], factor.strides[1] - factor.strides[0]
    whole = np.array(as_strided(factor[:, a:], (end - a, b - a), (down, across)), order="F")
    beyond = whole[above:]  # outside the band the view shows other columns
    beyond[np.tril_indices(len(beyond), 0, b - a)] = 0.0
    return whole[: b - a], whole[b - a :]


def _solve(system: _System) -> tuple[Array, Array, Array]:
    """Solve the bordered banded system: the cameras' steps, the common ones and their inverse covariance."""
    if not system.band.shape[1]:
        return np.zeros(0), np.asarray(np.linalg.solve(system.corner, system.rhs_common)), system.corner
    both = _back(_factor(system.band), np.column_stack([system.side, system.rhs]))
    y, x = both[:, :-1], both[:, -1]
    information = system.corner - system.side.T @ y
    common = np.linalg.solve(information, system.rhs_common - system.side.T @ x)
    return np.asarray(x - y @ common), np.asarray(common), np.asarray(information)


def _order(tracks: Tracks, points: int, count: int, free: NDArray[np.bool_]) -> tuple[Ints, int]:
    """Place of each free camera in the band (-1 if held) and the band's width in cameras, as narrow as it goes."""
    index = np.flatnonzero(free)
    if len(index) == 0:
        return np.full(count, -1, np.int32), 0
    local = np.full(count, -1, np.int64)
    local[index] = np.arange(len(index))
    use = free[tracks.camera]
    cam, pt = local[tracks.camera[use]], tracks.point[use]
    sights = csr_matrix((np.ones(len(cam), np.float32), (cam, pt)), shape=(len(index), points))
    graph = (sights @ sights.T).tocoo()
    best: tuple[int, NDArray[np.int64]] = (len(index), np.arange(len(index)))
    for permutation in (np.arange(len(index)), reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True)):
        place = np.empty(len(index), np.int64)
        place[permutation] = np.arange(len(index))
        width = int(np.abs(place[graph.row] - place[graph.col]).max()) if graph.nnz else 0
        if width < best[0]:
            best = (width, place)
    slot = np.full(count, -1, np.int32)
    slot[index] = best[1]
    return slot, min(best[0], max(len(index) - 1, 0))


def exp_rotation(vector: Array) -> Array:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3), Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=1)
    a = np.where(angle < 1e-8, 1.0, np.sin(angle) / np.maximum(angle, 1e-12))[:, None, None]
    b = np.where(angle < 1e-4, 0.5, (1.0 - np.cos(angle)) / np.maximum(angle, 1e-12) ** 2)[:, None, None]
    k = np.zeros((len(vector), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -vector[:, 2], vector[:, 1], -vector[:, 0]
    k -= np.swapaxes(k, 1, 2)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def log_rotation(rotation: Array) -> Array:
    """Rotation vectors (N, 3) of rotation matrices (N, 3, 3)."""
    cosine = np.clip((np.trace(rotation, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    angle = np.arccos(cosine)
    vector = np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=1,
    )
    scale = np.where(angle < 1e-6, 0.5, angle / np.maximum(2.0 * np.sin(angle), 1e-9))
    return np.asarray(vector * scale[:, None])
