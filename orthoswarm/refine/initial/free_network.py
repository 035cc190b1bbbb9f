"""Photos without recorded positions: a free network of planar similarities, placed by observations of the ground.

Each photo is a similarity a z + t of its pixels onto the ground (complex numbers, see `planar_similarity`). Pairs of
photos state a first / a second and that both show the centre of their matches at one place; surveyed points and the
positions of other photos place the whole. With log a and t as unknowns every observation is analytic in them, so the
Gauss-Newton steps are complex least squares.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.sparse.linalg import splu

from orthoswarm.compute.robust_kernel import robust_widening
from orthoswarm.model.arrays import Array, Complex, Flags, Ints
from orthoswarm.refine.initial.heading import components
from orthoswarm.refine.initial.planar_network import SparseRows
from orthoswarm.refine.initial.planar_similarity import PairGraph
from orthoswarm.refine.initial.tilt_and_lens import spaced

FREE_PAIR_SHARE: Final = 0.02  # sigma of the match centres of two level photos, in picture widths
_FREE_SCALE_SIGMA: Final = 0.02  # ... and of scales and turns from the similarity's, radians or relative
_FREE_SCHEDULE: Final = (400.0, 400.0, 100.0, 100.0, 36.0, 9.0, 9.0, 9.0)  # robust schedule of that network
_ANCHOR_APART_SIGMAS: Final = 10.0  # two surveyed points turn and scale such photos if they lie so many sigmas apart
_AGREE_SHARE: Final = 0.5  # fewest pairs that agree with a part's solution: with fewer it is a heap, not a block
_ANCHOR_MOST: Final = 60  # so many observations of the ground take part in the search for their common similarity


@dataclass(frozen=True, slots=True, kw_only=True)
class Anchors:
    """What pixels of photos are known to show (M observations).

    photo: int32 (M,). pixel: complex (M,), of the level picture, about its centre, y up. ground: complex (M,), east + i
    north. sigma_m: float64 (M,), of the ground point. sigma_px: float64 (M,), of the pixel.
    """

    photo: Ints
    pixel: Complex
    ground: Complex
    sigma_m: Array
    sigma_px: Array

    def take(self, keep: NDArray[np.intp]) -> "Anchors":
        """Some of the observations."""
        return Anchors(**{name: getattr(self, name)[keep] for name in self.__slots__})

    def joined(self, other: "Anchors") -> "Anchors":
        """Both sets of observations."""
        return Anchors(**{n: np.concatenate([getattr(self, n), getattr(other, n)]) for n in self.__slots__})


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeNetwork:
    """N photos on the ground.

    scale: complex (N,), a of each photo: metres per pixel times exp(-i yaw). centre: complex (N,), t: below the camera.
    sigma_m: float64 (N,), one sigma of the centre, an axis. placed: bool (N,). left: photos that pairs connect but that
    could not be placed, the largest part first.
    """

    scale: Complex
    centre: Complex
    sigma_m: Array
    placed: Flags
    left: list[Ints]


def solve_free_network(graph: PairGraph, count: int, width: Array, anchors: Anchors) -> FreeNetwork:
    """Place photos by their pairs and anchors.

    A connected part is not placed without two anchors at different points that agree with it, as most pairs must.

    count: N photos. width: float64 (N,), columns of the pictures.
    """
    scale, centre = np.zeros(count, np.complex128), np.zeros(count, np.complex128)
    sigma, placed = np.full(count, np.inf), np.zeros(count, bool)
    left: list[Ints] = []
    label = components(graph, count)
    for k in range(int(label.max(initial=-1)) + 1):  # the largest part first
        members = np.flatnonzero(label == k).astype(np.int32)
        if len(members) < 2:
            continue
        inside = np.isin(graph.first, members)
        held = np.flatnonzero(np.isin(anchors.photo, members))
        a, t = _chained(graph, inside, members, count)
        datum = _datum(a, t, anchors, held)
        part = None
        if datum is not None:
            turn, shift = datum
            a, t = np.asarray(turn * a), np.asarray(turn * t + shift)
            part = _adjusted(graph.take(inside), members, anchors.take(held), a=a, t=t, width=width)
        if part is None:
            left.append(members)
            continue
        scale[members], centre[members], sigma[members] = part
        placed[members] = True
    return FreeNetwork(scale=scale, centre=centre, sigma_m=sigma, placed=placed, left=left)


def _chained(graph: PairGraph, inside: Flags, members: Ints, count: int) -> tuple[Complex, Complex]:
    """Similarities (N,) of a part's photos onto the pixels of one of them, along the pairs with most matches."""
    pairs = np.flatnonzero(inside)
    first, second = graph.first[pairs], graph.second[pairs]
    number = {(int(graph.first[e]), int(graph.second[e])): int(e) for e in pairs}
    links = coo_matrix((1.0 / graph.count[pairs], (first, second)), shape=(count, count))
    tree = minimum_spanning_tree(links.tocsr())
    root = int(np.bincount(np.r_[first, second], minlength=count).argmax())
    order, before = breadth_first_order(tree, root, directed=False)
    a, t = np.zeros(count, np.complex128), np.zeros(count, np.complex128)
    a, t = np.zeros(count, np.complex128), np.zeros(count, np.complex128)
    a[root] = 1.0
    for k in order[1:].tolist():
        j = int(before[k])
        e = number.get((j, k))
        if e is not None:  # z of k = f z of j + constant
            a[k] = a[j] / graph.factor[e]
            t[k] = t[j] + a[j] * graph.centre_first[e] - a[k] * graph.centre_second[e]
        else:
            e = number[k, j]
            a[k] = a[j] * graph.factor[e]
            t[k] = t[j] + a[j] * graph.centre_second[e] - a[k] * graph.centre_first[e]
    return a, t


def _datum(a: Complex, t: Complex, anchors: Anchors, held: NDArray[np.intp]) -> tuple[complex, complex] | None:
    """The similarity onto the ground that most anchors of a part agree on, by pairs of them; None without two."""
    held = held[spaced(len(held), _ANCHOR_MOST)]
    shown = a[anchors.photo[held]] * anchors.pixel[held] + t[anchors.photo[held]]
    ground, sigma = anchors.ground[held], anchors.sigma_m[held]
    best: tuple[float, complex, complex] | None = None
    for i in range(len(held)):
        for j in range(i + 1, len(held)):
            apart = ground[j] - ground[i]
            if _near(apart, sigma[i], sigma[j]) or abs(shown[j] - shown[i]) < 1e-12:
                continue
            turn = complex(apart / (shown[j] - shown[i]))
            shift = complex(ground[i] - turn * shown[i])
            away = float(np.median(np.abs(turn * shown + shift - ground) / sigma))
            if best is None or away < best[0]:
                best = away, turn, shift
    return None if best is None else (best[1], best[2])


def _near(apart: complex, one_sigma_m: float, other_sigma_m: float) -> bool:
    """Whether two points of the ground are too near to each other to turn and scale photos."""
    return bool(abs(apart) <= _ANCHOR_APART_SIGMAS * np.hypot(one_sigma_m, other_sigma_m))


def _adjusted(
    graph: PairGraph, members: Ints, anchors: Anchors, *, a: Complex, t: Complex, width: Array
) -> tuple[Complex, Complex, Array] | None:
    """The robust adjustment of a part: a, t and the sigma of t of its members; None if the observations do not agree.

    Sigmas grow with the photos' own scale, so a part that contradicts itself can shrink to one point: most of its
    pairs, or all anchors but one, are outliers then.
    """
    n, pairs = len(members), len(graph)
    at = np.full(len(a), -1)
    at[members] = np.arange(n)
    ends = at[graph.first], at[graph.second], at[anchors.photo]
    log_a, t, share = np.log(a[members]), t[members].copy(), FREE_PAIR_SHARE * width[members]
    for c in _FREE_SCHEDULE:
        matrix, rhs = _rows(graph, anchors, ends, log_a=log_a, t=t, share=share)
        squared = np.abs(rhs) ** 2
        together = squared[:pairs] + squared[pairs : 2 * pairs]  # a wrong pair is wrong in both
        weight = robust_widening(np.r_[together, together, squared[2 * pairs :]], c) ** -2
        factor = splu((matrix.conj().T @ diags(weight) @ matrix).tocsc())
        step = factor.solve(matrix.conj().T @ (weight * rhs))
        log_a, t = log_a + step[:n], t + step[n:]
    held = anchors.take(np.flatnonzero(squared[2 * pairs :] <= _FREE_SCHEDULE[-1]))
    place, sigma = held.ground, held.sigma_m
    spread = any(not _near(g - place[0], s, sigma[0]) for g, s in zip(place, sigma, strict=True))
    if (together <= _FREE_SCHEDULE[-1]).mean() < _AGREE_SHARE or not spread:
        return None
    variance = np.diag(factor.solve(np.eye(2 * n, dtype=np.complex128)))[n:].real
    return np.exp(log_a), t, np.sqrt(np.maximum(variance, 0.0))


def _rows(
    graph: PairGraph, anchors: Anchors, ends: tuple[Ints, Ints, Ints], *, log_a: Complex, t: Complex, share: Array
) -> tuple[csc_matrix, Complex]:
    """Equations of a step: ratios of the pairs, then where they meet, then the anchors; columns log a, then t.

    ends: first and second photo of the pairs, and the photos of the anchors. share: float64 (n,), pixels, sigma of the
    place of a pair's matches in each photo.
    """
    i, j, k = ends
    a, n = np.exp(log_a), len(t)
    size = np.abs(a)
    ratio = log_a[i] - log_a[j] - np.log(graph.factor)
    ratio = ratio.real + 1j * np.angle(np.exp(1j * ratio.imag))
    ratio_sigma = np.hypot(graph.turn_sigma, _FREE_SCALE_SIGMA)
    meet = a[i] * graph.centre_first + t[i] - a[j] * graph.centre_second - t[j]
    meet_sigma = np.hypot(share[i] * size[i], share[j] * size[j])
    anchor = a[k] * anchors.pixel + t[k] - anchors.ground
    anchor_sigma = np.hypot(anchors.sigma_m, anchors.sigma_px * size[k])
    rows = SparseRows(2 * n)
    rows.add(-ratio / ratio_sigma, (i, 1.0 / ratio_sigma), (j, -1.0 / ratio_sigma))
    rows.add(
        -meet / meet_sigma,
        (i, a[i] * graph.centre_first / meet_sigma),
        (n + i, 1.0 / meet_sigma),
        (j, -a[j] * graph.centre_second / meet_sigma),
        (n + j, -1.0 / meet_sigma),
    )
    rows.add(-anchor / anchor_sigma, (k, a[k] * anchors.pixel / anchor_sigma), (n + k, 1.0 / anchor_sigma))
    return rows.matrix().tocsc(), rows.right()
