"""Tilt, focal length and radial distortion from the shapes of matches alone: no positions, no tags.

Level pictures of flat ground are similar; tilt and radial distortion deform them in ways that no rotation, shift or
scale explains. The tilt of each segment and the lens are changed until the matches of all pairs fit similarities best:
Gauss-Newton on the residuals after each pair's own similarity is projected out (variable projection, Golub and Pereyra
1973). Relief disturbs single pairs, but not all of them in the same way.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.compute.robust_kernel import robust_weight
from orthoswarm.model.arrays import Array, Complex, Indices, Ints
from orthoswarm.refine.features.pair_matching import Pair
from orthoswarm.refine.features.sift_features import SiftFeatures
from orthoswarm.refine.initial.planar_similarity import PairGraph, PhotoRecords, centred, level_from_nadir

_SHAPE_ITERATIONS: Final = 12  # most Gauss-Newton iterations (they end earlier)
_SHAPE_SETTLED: Final = 1e-3  # a largest step below this, radians or relative, ends them
_SHAPE_MOST_MATCHES: Final = 64  # matches of a pair that are used, evenly picked (its cost)
_SHAPE_INDEPENDENT_SHARE: Final = 0.05  # share of the matches that are independent
_SHAPE_FLOOR_SHARE: Final = 1e-3  # least misfit of a pair, as a share of the picture's width
_SHAPE_TILT_STEP_RAD: Final = 0.15  # largest change of a tilt in one iteration
_SHAPE_BEND_LIMIT: Final = 0.3  # largest radial distortion at the picture's corner, as a share of the radius
_SHAPE_BEND_SIGMA: Final = 0.06  # prior sigma of that distortion
_SHAPE_ROUNDS: Final = 4  # reweightings of a pair's similarity
_SHAPE_ROBUST_SCALE: Final = 2.0  # a match's weight falls to a quarter at so many median misfits


@dataclass(frozen=True, slots=True, kw_only=True)
class PairMatches:
    """Matches of all pairs in one array: of pair e, rows start[e] to start[e + 1].

    first: int32 (E,), photo; second: int32 (E,). start: int64 (E + 1,). count: int64 (E,), all matches of a pair. p:
    complex (M,), pixels in the first about its centre, y up; q: in the second.
    """

    first: Ints
    second: Ints
    start: Indices
    count: Indices
    p: Complex
    q: Complex

    @property
    def arrays(self) -> tuple[Ints, Ints, Indices, Complex, Complex]:
        """What compiled code takes: first, second, start, p, q."""
        return self.first, self.second, self.start, self.p, self.q

    @classmethod
    def of(cls, pairs: Sequence[Pair], features: Sequence[SiftFeatures]) -> "PairMatches":
        """Collect the matches, evenly thinned where a pair has many."""
        z = [centred(f) for f in features]
        picked = [p.match[spaced(len(p.match), _SHAPE_MOST_MATCHES)] for p in pairs]
        start = np.concatenate([[0], np.cumsum([len(m) for m in picked], dtype=np.int64)])
        none = [np.zeros(0, np.complex128)]
        return cls(
            first=np.array([p.first for p in pairs], np.int32),
            second=np.array([p.second for p in pairs], np.int32),
            start=start.astype(np.int64),
            count=np.array([len(p) for p in pairs], np.int64),
            p=np.concatenate([z[p.first][m[:, 0]] for p, m in zip(pairs, picked)] or none),
            q=np.concatenate([z[p.second][m[:, 1]] for p, m in zip(pairs, picked)] or none),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class TiltAndLens:
    """Tilt and lens found from the shapes of matches.

    level: float64 (N, 3, 3), camera to level camera. tilt_sigma: float64 (S,), radians. log_focal: float64 (L,), of the
    focal length in pixels; log_focal_sigma: float64 (L,). k1: float64 (L,).
    """

    level: Array
    tilt_sigma: Array
    log_focal: Array
    log_focal_sigma: Array
    k1: Array


def spaced(count: int, most: int) -> NDArray[np.intp]:
    """At most so many of 0 to count - 1, evenly spaced."""
    if count <= most:
        return np.arange(count)
    return np.linspace(0, count - 1, most).astype(np.intp)


def solve_tilt_and_lens(
    matches: PairMatches, records: PhotoRecords, level: Array, *, log_focal: Array, log_focal_sigma: Array,
    tilt_sigma: Array,
) -> TiltAndLens:  # fmt: skip
    """Find the tilt, focal length and first radial term for which the matches of every pair fit a similarity best.

    level: float64 (N, 3, 3), camera to level camera by the tags (identity if there are none). tilt_sigma: float64 (S,),
    one sigma of the tilt about it, radians. log_focal: float64 (L,), prior, and its one sigma.
    """
    segments, lenses = int(records.segment.max()) + 1, len(log_focal)
    size = 2 * segments + 2 * lenses
    sigma = np.concatenate(
        [np.repeat(tilt_sigma, 2), np.stack([log_focal_sigma, np.full(lenses, _SHAPE_BEND_SIGMA)], 1).ravel()]
    )
    total = np.zeros(size)
    level = level.copy()
    lens = np.stack([log_focal, np.zeros(lenses), corner_radius(records) ** 2], axis=1)
    floor = _SHAPE_FLOOR_SHARE * records.width
    for _ in range(_SHAPE_ITERATIONS):
        normal, gradient = np.zeros((size, size)), np.zeros(size)
        _accumulate(matches.arrays, level, lens, records.lens, records.segment, floor, normal, gradient)
        normal = _SHAPE_INDEPENDENT_SHARE * normal + np.diag(sigma**-2)
        step = np.linalg.solve(normal, _SHAPE_INDEPENDENT_SHARE * gradient - total / sigma**2)
        step *= min(1.0, _SHAPE_TILT_STEP_RAD / float(np.abs(step[: 2 * segments]).max(initial=1e-9)))
        total += step
        for s in range(segments):
            rows = records.segment == s
            level[rows] = level_from_nadir(complex(step[2 * s], step[2 * s + 1]), 1.0) @ level[rows]
        lens[:, :2] += step[2 * segments :].reshape(-1, 2)
        lens[:, 1] = np.clip(lens[:, 1], -_SHAPE_BEND_LIMIT, _SHAPE_BEND_LIMIT)
        if np.abs(step).max() < _SHAPE_SETTLED:
            break
    deviation = np.sqrt(np.diag(np.linalg.inv(normal)))
    return TiltAndLens(
        level=level,
        tilt_sigma=deviation[: 2 * segments].reshape(-1, 2).max(1),
        log_focal=lens[:, 0].copy(),
        log_focal_sigma=deviation[2 * segments :: 2].copy(),
        k1=lens[:, 1] * np.exp(2.0 * lens[:, 0]) / lens[:, 2],
    )


def similarities(matches: PairMatches, records: PhotoRecords, shape: TiltAndLens) -> PairGraph:
    """The similarity of every pair between its level, undistorted pictures."""
    pairs = len(matches.first)
    table = np.zeros((pairs, 5), np.complex128)
    radius = corner_radius(records)
    lens = np.stack([shape.log_focal, shape.k1 * radius**2 * np.exp(-2.0 * shape.log_focal), radius**2], axis=1)
    floor = _SHAPE_FLOOR_SHARE * records.width
    _similarities(matches.arrays, shape.level, lens, records.lens, floor, table)
    return PairGraph(
        first=matches.first,
        second=matches.second,
        factor=table[:, 0].copy(),
        centre_first=table[:, 1].copy(),
        centre_second=table[:, 2].copy(),
        count=matches.count,
        spread=table[:, 3].real.copy(),
        residual=table[:, 4].real.copy(),
    )


def level_pixels(z: Complex, photo: Ints, records: PhotoRecords, shape: TiltAndLens) -> Complex:
    """Pixels z (M,) of photos (M,) in their level, undistorted pictures, complex (M,); the lens to first order."""
    lens = records.lens[photo]
    focal = np.exp(shape.log_focal)[lens]
    z = z / (1.0 + shape.k1[lens] * np.abs(z / focal) ** 2)
    ray = np.einsum("mij,mj->mi", shape.level[photo], np.stack([z.real, -z.imag, focal], axis=1))
    return np.asarray(focal * (ray[:, 0] - 1j * ray[:, 1]) / ray[:, 2])


def corner_radius(records: PhotoRecords) -> Array:
    """Half the diagonal of each lens's picture, float64 (L,), pixels."""
    first = [int(np.argmax(records.lens == k)) for k in range(len(records.fov_hint))]
    return np.asarray(0.5 * np.hypot(records.width[first], records.rows[first]))


@in_place_kernel
def _flatten(z, level, focal, bend, radius2, right, up):  # type: ignore[no-untyped-def]
    """Pixel (complex, y up) of a level, undistorted camera; right and up rotate it further by small angles.

    The distortion is k1 in units of the picture's half diagonal (bend), not of f, so that f and bend are independent.
    """
    s = 1.0
    r2 = (z.real * z.real + z.imag * z.imag) / radius2
    for _ in range(4):
        s = 1.0 / max(1.0 + bend * r2 * s * s, 0.3)
    x, y = z.real * s / focal, -z.imag * s / focal
    a = level[0, 0] * x + level[0, 1] * y + level[0, 2]
    b = level[1, 0] * x + level[1, 1] * y + level[1, 2]
    c = level[2, 0] * x + level[2, 1] * y + level[2, 2]
    # rotation that moves the nadir at (right, up) onto the axis: vector (-up, -right, 0) in camera axes
    a, b, c = a - right * c, b + up * c, c + right * a - up * b
    c = max(c, 0.1)
    return complex(focal * a / c, -focal * b / c)


@kernel
def _fit(p, q, n, floor, w):  # type: ignore[no-untyped-def]
    """Robust similarity q = a p + b: a, mean p, mean q, the misfit's scale (at least `floor`); w gets the weights."""
    misfit = np.empty(n)
    for k in range(n):
        w[k] = 1.0
    a, cp, cq, scale = 1.0 + 0.0j, 0.0j, 0.0j, floor
    for _ in range(_SHAPE_ROUNDS):
        total = 0.0
        cp, cq = 0.0j, 0.0j
        for k in range(n):
            total += w[k]
            cp += w[k] * p[k]
            cq += w[k] * q[k]
        cp /= total
        cq /= total
        top, bottom = 0.0j, 1e-9
        for k in range(n):
            d = p[k] - cp
            top += w[k] * d.conjugate() * (q[k] - cq)
            bottom += w[k] * (d.real * d.real + d.imag * d.imag)
        a = top / bottom
        for k in range(n):
            misfit[k] = abs(q[k] - cq - a * (p[k] - cp))
        scale = max(np.median(misfit), floor)
        for k in range(n):
            e = misfit[k] / (_SHAPE_ROBUST_SCALE * scale)
            w[k] = robust_weight(e * e, 1.0, 1.0)
    return a, cp, cq, scale


@in_place_kernel
def _derivatives(z, flat, level, focal, bend, radius2, factor, g):  # type: ignore[no-untyped-def]
    """Change of factor * flattened pixels (n,) by nadir right, nadir up, log f and bend: into g, complex (4, n)."""
    h = 1e-5
    for k in range(len(z)):
        g[0, k] = factor * (_flatten(z[k], level, focal, bend, radius2, h, 0.0) - flat[k]) / h
        g[1, k] = factor * (_flatten(z[k], level, focal, bend, radius2, 0.0, h) - flat[k]) / h
        g[2, k] = factor * (_flatten(z[k], level, focal * (1.0 + h), bend, radius2, 0.0, 0.0) - flat[k]) / h
        g[3, k] = factor * (_flatten(z[k], level, focal, bend + h, radius2, 0.0, 0.0) - flat[k]) / h


@in_place_kernel
def _project_out(g, p, cp, w, n):  # type: ignore[no-untyped-def]
    """Subtract from g (n,) the best-fitting similarity of p (n,), whose weighted mean is cp."""
    mean, total = 0.0j, 0.0
    for k in range(n):
        mean += w[k] * g[k]
        total += w[k]
    mean /= total
    top, bottom = 0.0j, 1e-9
    for k in range(n):
        d = p[k] - cp
        top += w[k] * d.conjugate() * (g[k] - mean)
        bottom += w[k] * (d.real * d.real + d.imag * d.imag)
    for k in range(n):
        g[k] -= mean + top / bottom * (p[k] - cp)


@kernel
def _fit_pair(matches, e, level, lens, lens_id, floor, zp, zq, w):  # type: ignore[no-untyped-def]
    """Flatten the matches of pair e into zp, zq and fit their similarity, see `_fit`."""
    first, second, start, p, q = matches
    i, j, n = first[e], second[e], start[e + 1] - start[e]
    fi, ki, ri = np.exp(lens[lens_id[i], 0]), lens[lens_id[i], 1], lens[lens_id[i], 2]
    fj, kj, rj = np.exp(lens[lens_id[j], 0]), lens[lens_id[j], 1], lens[lens_id[j], 2]
    for k in range(n):
        zp[k] = _flatten(p[start[e] + k], level[i], fi, ki, ri, 0.0, 0.0)
        zq[k] = _flatten(q[start[e] + k], level[j], fj, kj, rj, 0.0, 0.0)
    return _fit(zp, zq, n, floor[j], w)


@kernel
def _accumulate(matches, level, lens, lens_id, segment, floor, normal, gradient):  # type: ignore[no-untyped-def]
    """Normal equations of tilt (2 S) and lens (2 L) after each pair's similarity is projected out."""
    first, second, start, p, q = matches
    segments, most = segment.max() + 1, 0
    for e in range(len(first)):
        most = max(most, start[e + 1] - start[e])
    zp, zq, w = np.empty(most, np.complex128), np.empty(most, np.complex128), np.empty(most)
    g, r = np.empty((8, most), np.complex128), np.empty(most, np.complex128)
    column = np.empty(8, np.int64)
    for e in range(len(first)):
        i, j, n = first[e], second[e], start[e + 1] - start[e]
        pe, qe = p[start[e] : start[e + 1]], q[start[e] : start[e + 1]]
        fi, ki, ri = np.exp(lens[lens_id[i], 0]), lens[lens_id[i], 1], lens[lens_id[i], 2]
        fj, kj, rj = np.exp(lens[lens_id[j], 0]), lens[lens_id[j], 1], lens[lens_id[j], 2]
        a, cp, cq, scale = _fit_pair(matches, e, level, lens, lens_id, floor, zp, zq, w)
        for k in range(n):
            r[k] = zq[k] - cq - a * (zp[k] - cp)
        _derivatives(pe, zp, level[i], fi, ki, ri, -a, g[:4])
        _derivatives(qe, zq, level[j], fj, kj, rj, 1.0 + 0.0j, g[4:])
        for side in range(2):
            photo = i if side == 0 else j
            column[4 * side] = 2 * segment[photo]
            column[4 * side + 1] = 2 * segment[photo] + 1
            column[4 * side + 2] = 2 * segments + 2 * lens_id[photo]
            column[4 * side + 3] = 2 * segments + 2 * lens_id[photo] + 1
        for c in range(8):
            _project_out(g[c], zp, cp, w, n)
        weight = 1.0 / (scale * scale)
        for c in range(8):
            value = 0.0
            for k in range(n):
                value += w[k] * (g[c, k].real * r[k].real + g[c, k].imag * r[k].imag)
            gradient[column[c]] -= weight * value
            for d in range(8):
                value = 0.0
                for k in range(n):
                    value += w[k] * (g[c, k].real * g[d, k].real + g[c, k].imag * g[d, k].imag)
                normal[column[c], column[d]] += weight * value


@kernel
def _similarities(matches, level, lens, lens_id, floor, table):  # type: ignore[no-untyped-def]
    start = matches[2]
    for e in range(len(table)):
        n = start[e + 1] - start[e]
        zp, zq, w = np.empty(n, np.complex128), np.empty(n, np.complex128), np.empty(n)
        a, cp, cq, scale = _fit_pair(matches, e, level, lens, lens_id, floor, zp, zq, w)
        spread = 0.0
        for k in range(n):
            spread += abs(zp[k] - cp) ** 2
        table[e, 0], table[e, 1], table[e, 2] = a, cp, cq
        table[e, 3], table[e, 4] = complex(np.sqrt(spread / n), 0.0), complex(scale, 0.0)
