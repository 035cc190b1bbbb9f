"""Banded Cholesky solver of the cameras' normal equations, and the camera order that makes the band narrow."""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided
from scipy.linalg import lapack, solve_triangular
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from orthoswarm.model.arrays import Array, Flags, Indices, Ints
from orthoswarm.model.errors import AdjustmentError
from orthoswarm.refine.bundle.block_arrays import Tracks

_BLOCK_COLUMNS, _NARROW_ROWS = 64, 600
"""Sizes for the processor's cache; they change the speed, not the result."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BandedSystem:
    """Reduced normal equations: banded cameras, a border of common unknowns, and the blocks for the back substitution.

    Attributes (n free cameras, s common unknowns, L lenses, P points, M observations):
        band: float64 (6 (bandwidth + 1), 6 n), lower band of the cameras' part. side: (6 n, s). corner: (s, s).
        rhs: (6 n,). rhs_common: (s,).
        w_obs: (M, 6, 3), w_lens: (P, L, 6, 3), b_point: (P, 3): see normal_equations.build.
    """

    band: Array
    side: Array
    corner: Array
    rhs: Array
    rhs_common: Array
    w_obs: Array
    w_lens: Array
    b_point: Array

    def solve(self) -> tuple[Array, Array, Array]:
        """Steps of the cameras (6 n,) and of the common unknowns (s,), and the latter's inverse covariance (s, s)."""
        if not self.band.shape[1]:
            return np.zeros(0), np.asarray(np.linalg.solve(self.corner, self.rhs_common)), self.corner
        both = solve_factored(factorise(self.band), np.column_stack([self.side, self.rhs]))
        y, x = both[:, :-1], both[:, -1]
        information = self.corner - self.side.T @ y
        common = np.linalg.solve(information, self.rhs_common - self.side.T @ x)
        return np.asarray(x - y @ common), np.asarray(common), np.asarray(information)


def factorise(band: Array) -> Array:
    """Cholesky factor of a symmetric matrix as LAPACK's lower band, in place; it must be positive definite."""
    factor, info = lapack.dpbtrf(band, lower=1, overwrite_ab=1)
    if info != 0:
        raise AdjustmentError("the adjustment is singular; check the records for NaN or repeated pictures")
    return np.asarray(factor)


def solve_factored(factor: Array, right: Array) -> Array:
    """Solve with a banded Cholesky factor and many right-hand sides (N, K).

    LAPACK reads the complete factor once for each right-hand side; working in blocks of columns reads it only once.
    """
    above, n = factor.shape
    if above <= _NARROW_ROWS:
        return np.asarray(lapack.dpbtrs(factor, right, lower=1)[0])
    x = np.array(right, float)
    starts = range(0, n, _BLOCK_COLUMNS)
    blocks = [(a, min(a + _BLOCK_COLUMNS, n), min(a + _BLOCK_COLUMNS - 1 + above, n)) for a in starts]
    for a, b, end in blocks:
        own, below = _blocks_of(factor, a, b, end)
        x[a:b] = solve_triangular(own, x[a:b], lower=True, check_finite=False)
        x[b:end] -= below @ x[a:b]
    for a, b, end in reversed(blocks):
        own, below = _blocks_of(factor, a, b, end)
        x[a:b] = solve_triangular(own, x[a:b] - below.T @ x[b:end], lower=True, trans="T", check_finite=False)
    return x


def _blocks_of(factor: Array, a: int, b: int, end: int) -> tuple[Array, Array]:
    """Two blocks of the factor's columns a to b: the triangle on the diagonal, and the rows below it down to `end`."""
    above = len(factor)
    # entry (i, j) of the factor is stored at [i - j, j], so the block is a strided view
    down, across = factor.strides[0], factor.strides[1] - factor.strides[0]
    columns = np.array(as_strided(factor[:, a:], (end - a, b - a), (down, across)), order="F")
    beyond = columns[above:]  # outside the band the strided view holds entries of other columns
    beyond[np.tril_indices(len(beyond), 0, b - a)] = 0.0
    return columns[: b - a], columns[b - a :]


def camera_order(tracks: Tracks, position: Array, points: int, free: Flags) -> tuple[Ints, int]:
    """Slot of each free camera in the band (-1 if held), int32 (N,), and the band's width in cameras.

    Cameras that observe a common point must lie within the band. Takes the best of the input order, that of Cuthill and
    McKee (1969), and that along the longer side of the flown area, which is a seventh narrower for parallel legs: it
    advances in all of them together.

    tracks: observations. position: float64 (N, 3) of the cameras, metres. points: how many there are. free: bool (N,),
    False for cameras that are held.
    """
    count = len(free)
    index = np.flatnonzero(free)
    if len(index) == 0:
        return np.full(count, -1, np.int32), 0
    local = np.full(count, -1, np.int64)
    local[index] = np.arange(len(index))
    use = free[tracks.camera]
    cam, pt = local[tracks.camera[use]], tracks.point[use]
    observes = csr_matrix((np.ones(len(cam), np.float32), (cam, pt)), shape=(len(index), points))
    graph = (observes @ observes.T).tocoo()
    extent = np.nan_to_num(position[index, :2] - position[index, :2].mean(0))
    orders = (
        np.arange(len(index)),
        reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True),
        np.argsort(extent @ np.linalg.eigh(extent.T @ extent)[1][:, -1], kind="stable"),  # along the longer side
    )
    best: tuple[int, Indices] = (len(index), np.arange(len(index)))
    for permutation in orders:
        place = np.empty(len(index), np.int64)
        place[permutation] = np.arange(len(index))
        width = int(np.abs(place[graph.row] - place[graph.col]).max()) if graph.nnz else 0
        if width < best[0]:
            best = (width, place)
    slot = np.full(count, -1, np.int32)
    slot[index] = best[1]
    return slot, min(best[0], max(len(index) - 1, 0))
