"""The network of photos in the plane: positions, ground scale, nadir offset and lag in one sparse robust adjustment.

Given the headings everything is linear: P(second) - P(first) = m R (z - o) of the first minus the same of the second,
for the centre of a pair's matches, together with recorded positions. A wrong pair disagrees with the network, and so
does a wrong position; as photos have several neighbours, the two can be distinguished.

Thresholds without another source were chosen on four real flights.
"""

from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

from orthoswarm.compute.robust_kernel import robust_widening
from orthoswarm.model.arrays import Array, Complex, Flags, Indices, Ints
from orthoswarm.refine.bundle.priors import LAG_SIGMA_S
from orthoswarm.refine.initial.planar_similarity import PairGraph, PhotoRecords

_NETWORK_SCHEDULE: Final = (400.0, 400.0, 36.0, 9.0, 9.0)  # robust schedule of pairs and recorded positions
NETWORK_GATE_SIGMAS: Final = 5.0  # pairs and recorded positions farther off the network are wrong
_PAIR_SIGMA_M: Final = 0.6  # sigma of a pair's vector
_PAIR_SIGMA_SHARE: Final = 0.05  # ... and this share of the distance of its matches from the nadirs
LAG_SPREAD_S: Final = 0.3  # scatter of the delay of recorded positions along the way
_NETWORK_STILL_M_S: Final = 0.1  # a slower vehicle has no direction along the way
_LENS_SCALE_SIGMA: Final = 0.5  # relative sigma of a lens's ground scale


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkPriors:
    """Priors of the common unknowns of the network (S segments, N photos).

    Attributes:
        metres: float64 (S,), metres per pixel. relief: float64 (N,), factor on it for each photo (the photo's height
            over its segment's).
        link: float64 (S,), metres per pixel of a segment over its lens's; link_sigma: float64 (S,), relative sigma.
        offset_sigma: float64 (S,), pixels, of the nadir's offset from 0.
        lens: int32 (S,), lens of each segment.
    """

    metres: Array
    relief: Array
    link: Array
    link_sigma: Array
    offset_sigma: Array
    lens: Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """Result of the network.

    position: complex (N,). metres: float64 (S,). offset: complex (S,), nadir pixel. offset_sigma: float64 (S,). lag:
    float64 (V,) seconds. pair_ok: bool (E,). gps_ok: bool (N,). gps_residual: complex (N,), recorded position minus the
    network's, lag removed.
    """

    position: Complex
    metres: Array
    offset: Complex
    offset_sigma: Array
    lag: Array
    pair_ok: Flags
    gps_ok: Flags
    gps_residual: Complex


class _NetworkColumns(NamedTuple):
    """First columns of the unknowns east (N), north (N), m (S), m o real (S), imaginary (S), m of lenses (L), lag (V).

    And their numbers: N, S, L, V; size: all columns.
    """

    photos: int
    segments: int
    lenses: int
    vehicles: int
    metres: int
    offset: int
    lens: int
    lag: int
    size: int


@dataclass(slots=True)
class SparseRows:
    """Linear equations of `size` unknowns in units of one sigma, real or complex, collected by blocks."""

    size: int
    count: int = 0
    parts: list[tuple[Indices, NDArray[Any], NDArray[Any]]] = field(default_factory=list)
    sides: list[NDArray[Any]] = field(default_factory=list)

    def add(self, right: NDArray[Any], *terms: tuple[ArrayLike, ArrayLike]) -> None:
        """Add a row for each element of `right`: each term is (columns, values), with one of both for each row."""
        row = self.count + np.arange(len(right))
        for column, value in terms:
            self.parts.append((row, np.broadcast_to(column, row.shape), np.broadcast_to(value, row.shape)))
        self.sides.append(right)
        self.count += len(right)

    def matrix(self) -> coo_matrix:
        """The matrix (rows, size)."""
        row, column, value = (np.concatenate([p[k] for p in self.parts]) for k in range(3))
        return coo_matrix((value, (row, column)), shape=(self.count, self.size))

    def right(self) -> NDArray[Any]:
        """The right-hand side (rows,)."""
        return np.concatenate(self.sides)


def solve_network(graph: PairGraph, records: PhotoRecords, yaw: Array, beliefs: NetworkPriors) -> Network:
    """Solve positions, scale, nadir offset and lag of N photos; yaw: float64 (N,), their headings."""
    n, s, lenses, v = len(records), len(beliefs.metres), int(beliefs.lens.max()) + 1, int(records.vehicle.max()) + 1
    at = _NetworkColumns(n, s, lenses, v, *np.cumsum([2 * n, s, 2 * s, lenses, v]).tolist())
    rows = SparseRows(at.size)
    _pair_rows(rows, at, graph, records=records, unit=np.exp(-1j * yaw), b=beliefs)
    velocity = _gps_rows(rows, at, records)
    _prior_rows(rows, at, beliefs)
    matrix, rhs = rows.matrix().tocsr(), rows.right()
    x = np.zeros(at.size)
    x[: 2 * at.photos] = np.r_[records.position.real, records.position.imag]
    x[at.metres : at.offset] = beliefs.metres
    pairs, photos = len(graph), at.photos
    for c in _NETWORK_SCHEDULE:
        residual = (rhs - matrix @ x)[: 2 * (pairs + photos)]
        weight = np.ones(len(rhs))
        weight[: 2 * pairs] = _robust(residual[: 2 * pairs], c)
        weight[2 * pairs : 2 * (pairs + photos)] = _robust(residual[2 * pairs :], c)
        weighted = diags(weight) @ matrix
        factor = splu((matrix.T @ weighted).tocsc())
        x = factor.solve(weighted.T @ rhs)
    residual = rhs - matrix @ x
    metres = x[at.metres : at.offset]
    q = x[at.offset : at.lens].reshape(2, -1)
    lag = x[at.lag :]
    position = x[:photos] + 1j * x[photos : 2 * photos]
    picks = np.zeros((at.size, 2 * at.segments))
    picks[at.offset + np.arange(2 * at.segments), np.arange(2 * at.segments)] = 1.0
    variance = np.einsum("ij,ij->j", picks, factor.solve(picks))  # of m o
    return Network(
        position=position,
        metres=metres,
        offset=(q[0] + 1j * q[1]) / metres,
        offset_sigma=np.sqrt(np.maximum(variance, 0.0)).reshape(2, -1).max(0) / metres,
        lag=lag,
        pair_ok=_norm(residual[: 2 * pairs]) < NETWORK_GATE_SIGMAS,
        gps_ok=_norm(residual[2 * pairs : 2 * (pairs + photos)]) < NETWORK_GATE_SIGMAS,
        gps_residual=records.position + lag[records.vehicle] * velocity - position,
    )


def _norm(residual: Array) -> Array:
    """Lengths of residual vectors stacked as all first, then all second components."""
    return np.asarray(np.hypot(*residual.reshape(2, -1)))


def _robust(residual: Array, c: float) -> Array:
    """Weights of both rows of stacked residual vectors."""
    return np.tile(robust_widening(_norm(residual) ** 2, c) ** -2, 2)


def _pair_rows(
    rows: SparseRows, at: _NetworkColumns, graph: PairGraph, *, records: PhotoRecords, unit: Complex, b: NetworkPriors
) -> None:
    """East, then north rows of all pairs."""
    i, j = graph.first, graph.second
    si, sj = records.segment[i], records.segment[j]
    ui, uj = unit[i] * b.relief[i], unit[j] * b.relief[j]
    reach = np.abs(b.metres[si] * graph.centre_first) + np.abs(b.metres[sj] * graph.centre_second)
    sigma = np.asarray(_PAIR_SIGMA_M + _PAIR_SIGMA_SHARE * reach)
    for part, axis in ((0, 1.0 + 0j), (1, -1j)):  # the real part of axis * value: east, then north
        east = part * at.photos
        rows.add(
            np.zeros(len(graph)),
            (j + east, 1.0 / sigma),
            (i + east, -1.0 / sigma),
            (at.metres + si, -(axis * ui * graph.centre_first).real / sigma),
            (at.metres + sj, (axis * uj * graph.centre_second).real / sigma),
            (at.offset + si, (axis * ui).real / sigma),
            (at.offset + sj, -(axis * uj).real / sigma),
            (at.offset + at.segments + si, (axis * ui * 1j).real / sigma),
            (at.offset + at.segments + sj, -(axis * uj * 1j).real / sigma),
        )


def _gps_rows(rows: SparseRows, at: _NetworkColumns, records: PhotoRecords) -> Complex:
    """Rows of recorded positions along and across the course: P - lag v = recorded; returns v (N,)."""
    velocity = records.velocity()
    speed = np.abs(velocity)
    ahead = np.where(speed > _NETWORK_STILL_M_S, velocity / np.maximum(speed, 1e-9), 1.0)
    across = records.gps_sigma()
    photo = np.arange(at.photos)
    for axis, sigma in ((ahead, np.hypot(across, LAG_SPREAD_S * speed)), (1j * ahead, across)):
        rows.add(
            (records.position * np.conj(axis)).real / sigma,
            (photo, axis.real / sigma),
            (photo + at.photos, axis.imag / sigma),
            (at.lag + records.vehicle, -(velocity * np.conj(axis)).real / sigma),
        )
    return velocity


def _prior_rows(rows: SparseRows, at: _NetworkColumns, b: NetworkPriors) -> None:
    segment, lens, vehicle = np.arange(at.segments), np.arange(at.lenses), np.arange(at.vehicles)
    link = b.link_sigma * b.metres
    rows.add(np.zeros(at.segments), (at.metres + segment, 1.0 / link), (at.lens + b.lens, -b.link / link))
    for part in (0, at.segments):
        rows.add(np.zeros(at.segments), (at.offset + part + segment, 1.0 / (b.offset_sigma * b.metres)))
    expected = np.array([np.median((b.metres / b.link)[b.lens == k]) for k in range(at.lenses)])
    rows.add(np.full(at.lenses, 1.0 / _LENS_SCALE_SIGMA), (at.lens + lens, 1.0 / (_LENS_SCALE_SIGMA * expected)))
    rows.add(np.zeros(at.vehicles), (at.lag + vehicle, 1.0 / LAG_SIGMA_S))
