"""Headings of photos: relative ones from the rotation between pictures, absolute ones from the course flown.

Yaw tags may be flipped by 180 degrees, relative to the airframe, or missing; they are used only for photos whose
heading cannot be found from pairs.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, identity
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import spsolve

from orthoswarm.compute.robust_kernel import robust_widening
from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Complex, Flags, Ints
from orthoswarm.refine.initial.planar_similarity import PairGraph, PhotoRecords

_COURSE_SIGMA_DEG: Final = 2.0  # sigma of the course between two photos, besides that of their positions
_COURSE_SIGMA_LIMIT_RAD: Final = 1.0  # a course known no better than this is dropped
_COURSE_SHIFT_SHARE: Final = 0.3  # ... and one whose pair shows less than this share of the recorded way
_HEADING_SCHEDULE: Final = (400.0, 100.0, 36.0, 9.0, 9.0)  # robust schedule of the headings
_HEADING_CANDIDATES: Final = 360  # angles that are tried for the one that most courses support (its cost)
_HEADING_AGREE_DEG: Final = 20.0  # angles within this of each other agree
_HEADING_ROUNDS: Final = 5  # rounds of the robust mean of those that agree
_TAG_LEAST_PHOTOS: Final = 3  # fewest photos with a yaw tag for it to be compared with the pictures
_TAG_BETTER_SHARE: Final = 0.1  # a second kind of yaw tag must agree on so many more of the photos
_TAG_AGREE_SHARE: Final = 0.5  # share of the photos whose tag must follow the pictures


@dataclass(frozen=True, slots=True)
class TagHeading:
    """Relation between one vehicle's recorded angles and the pictures' headings.

    source: "yaw", "flight_yaw" or "", if neither agrees. offset: picture - tag, radians. agree: share of photos.
    """

    source: str
    offset: float
    agree: float


def components(graph: PairGraph, count: int) -> Ints:
    """Connected parts of the pair graph, int32 (N,), the largest is 0; a photo without pairs is one by itself."""
    links = coo_matrix((np.ones(len(graph)), (graph.first, graph.second)), shape=(count, count))
    _, label = connected_components(links, directed=False)
    size = np.bincount(label)
    first = np.full(len(size), count)
    np.minimum.at(first, label, np.arange(count))
    rank = np.empty(len(size), np.int32)
    rank[np.lexsort((first, -size))] = np.arange(len(size), dtype=np.int32)
    return np.asarray(rank[label])


def chain_headings(graph: PairGraph, count: int) -> Array:
    """Headings relative to one photo of each connected part, float64 (N,), along the strongest pairs."""
    cost = 1.0 / np.maximum(graph.count.astype(float), 1.0)
    links = csr_matrix((cost, (graph.first, graph.second)), shape=(count, count))
    tree = minimum_spanning_tree(links)
    tree = tree + tree.T
    turn = dict(zip(zip(graph.first.tolist(), graph.second.tolist()), np.angle(graph.factor).tolist()))
    yaw = np.zeros(count)
    visited = np.zeros(count, bool)
    for root in range(count):
        if visited[root]:
            continue
        order, before = breadth_first_order(tree, root, directed=False)
        visited[order] = True
        for k in order[1:].tolist():
            p = int(before[k])
            yaw[k] = yaw[p] + (turn[p, k] if (p, k) in turn else -turn[k, p])
    return wrap_rad(yaw)


def course_headings(
    graph: PairGraph, records: PhotoRecords, metres: Array, offset: Complex, offset_sigma_px: Array
) -> tuple[Array, Array]:
    """Absolute heading of each pair's first photo, from the recorded movement and the picture's shift.

    metres: float64 (N,), metres per pixel. offset: complex (N,), nadir pixel of each photo; offset_sigma_px: float64
    (N,). Returns the headings (E,) and their one sigma (E,), infinite where the movement is too short.
    """
    i, j = graph.first, graph.second
    back = np.conj(graph.turn)
    ratio = metres[j] / metres[i]
    shift = (graph.centre_first - offset[i]) - ratio * back * (graph.centre_second - offset[j])
    way = records.position[j] - records.position[i]
    blur = np.hypot(records.gps_sigma()[i], records.gps_sigma()[j])
    length = np.maximum(np.abs(way), 1e-9)
    tilt = np.abs(1.0 - ratio * back) * offset_sigma_px[i] * metres[i] / length
    sigma = np.sqrt(float(np.radians(_COURSE_SIGMA_DEG)) ** 2 + (blur / length) ** 2 + tilt**2)
    short = np.abs(shift) * metres[i] < _COURSE_SHIFT_SHARE * length
    sigma[(sigma > _COURSE_SIGMA_LIMIT_RAD) | short] = np.inf
    return wrap_rad(np.angle(shift) - np.angle(way)), sigma


def solve_headings(
    graph: PairGraph, component: Ints, start: Array, course: Array, course_sigma: Array
) -> tuple[Array, Flags]:
    """Headings of all photos, and which of them follow from pairs.

    Each connected component is rotated to the angle that most courses support, then all headings are solved
    together, robustly.

    component: int32 (N,). start: float64 (N,), relative headings within each component. course: float64 (E,), absolute
    headings of the first photos; course_sigma: (E,), infinite where unknown.
    """
    yaw = start.copy()
    known = np.zeros(len(start), bool)
    part_of_pair = component[graph.first]
    useful = np.isfinite(course_sigma)
    for part in np.unique(part_of_pair[useful]):
        rows = np.flatnonzero(useful & (part_of_pair == part))
        turn = circular_mode(wrap_rad(course[rows] - yaw[graph.first[rows]]), course_sigma[rows] ** -2)
        yaw[component == part] += turn
        known[component == part] = True
    for c in _HEADING_SCHEDULE:
        yaw = yaw + _heading_step(graph, yaw, course, course_sigma, c)
    return wrap_rad(yaw), known


def _heading_step(graph: PairGraph, yaw: Array, course: Array, course_sigma: Array, c: float) -> Array:
    """Gauss-Newton step of all headings, float64 (N,), with robust scale c."""
    count, pairs = len(yaw), len(graph)
    i, j = graph.first, graph.second
    turn_sigma = graph.turn_sigma
    relative = wrap_rad(np.angle(graph.factor) - (yaw[j] - yaw[i])) / turn_sigma
    finite = np.isfinite(course_sigma)
    sigma = np.where(finite, course_sigma, 1.0)
    absolute = np.where(finite, wrap_rad(course - yaw[i]) / sigma, 0.0)
    w = np.concatenate([1.0 / robust_widening(relative**2, c), finite / robust_widening(absolute**2, c)])
    row = np.arange(pairs)
    pull = w[:pairs] / turn_sigma
    differences = coo_matrix((np.r_[-pull, pull], (np.r_[row, row], np.r_[i, j])), shape=(2 * pairs, count))
    matrix = differences + coo_matrix((w[pairs:] / sigma, (row + pairs, i)), shape=(2 * pairs, count))
    rhs = w * np.concatenate([relative, absolute])
    normal = (matrix.T @ matrix + 1e-3 * identity(count, format="csr")).tocsc()
    return np.asarray(spsolve(normal, matrix.T @ rhs), dtype=np.float64).reshape(-1)


def circular_mode(angle: Array, weight: Array) -> float:
    """Mode of weighted angles: the mean around the densest window."""
    width = float(np.radians(_HEADING_AGREE_DEG))
    tried = angle[:: max(1, len(angle) // _HEADING_CANDIDATES)]
    support = (weight[None, :] * (np.abs(wrap_rad(angle[None, :] - tried[:, None])) < width)).sum(1)
    mode = float(tried[int(support.argmax())])
    for _ in range(_HEADING_ROUNDS):
        r = wrap_rad(angle - mode)
        w = weight / robust_widening((r / (0.5 * width)) ** 2, 1.0) ** 2
        mode += float((w * r).sum() / w.sum())
    return wrap_rad(mode)


def tag_heading(records: PhotoRecords, rows: NDArray[np.intp], yaw: Array) -> TagHeading:
    """The recorded angle that follows the headings `yaw` (N,), up to a constant, on those `rows` of one vehicle."""
    best = TagHeading("", 0.0, 0.0)
    for source in ("yaw", "flight_yaw"):
        tag = getattr(records, source)[rows]
        finite = np.isfinite(tag)
        if finite.sum() < _TAG_LEAST_PHOTOS:
            continue
        difference = wrap_rad(yaw[rows] - tag)[finite]
        offset = circular_mode(difference, np.ones(len(difference)))
        agree = float((np.abs(wrap_rad(difference - offset)) < np.radians(_HEADING_AGREE_DEG)).mean())
        if agree > best.agree + _TAG_BETTER_SHARE:
            best = TagHeading(source, offset, agree)
    return best if best.agree >= _TAG_AGREE_SHARE else TagHeading("", 0.0, best.agree)
