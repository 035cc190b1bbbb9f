"""Initial exterior and interior orientation of every photo from pairs of photos, without a map.

It takes milliseconds and needs no tags except positions. The shapes of matches give the tilt and, where the photos
point in several directions, the focal length (`tilt_and_lens`). Level pictures are similar to the ground: rotations
give headings (`heading`), scales give relative heights (`relative_scale`), shifts give positions (`planar_network`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.arrays import Array, Complex, Flags, Ints
from orthoswarm.refine.features.pair_matching import Pair
from orthoswarm.refine.features.sift_features import SiftFeatures
from orthoswarm.refine.initial.heading import (
    TagHeading,
    chain_headings,
    circular_mode,
    components,
    course_headings,
    solve_headings,
    tag_heading,
)
from orthoswarm.refine.initial.planar_network import NetworkPriors, solve_network
from orthoswarm.refine.initial.planar_similarity import PhotoRecords, level_from_nadir, rotation_of
from orthoswarm.refine.initial.relative_scale import (
    RecordedHeights,
    first_scale,
    focal_by_height,
    focal_by_hint,
    recorded_heights,
    relative_scales,
)
from orthoswarm.refine.initial.tilt_and_lens import PairMatches, TiltAndLens, similarities, solve_tilt_and_lens

_TAG_TILT_SIGMA_DEG: Final = 3.0  # sigma of a segment's recorded tilt
_FREE_TILT_SIGMA_DEG: Final = 9.0  # sigma of the tilt about straight down where most photos record none
_TAG_TILT_SHARE: Final = 0.5  # share of a segment's photos that must record a tilt
_TILT_FLOOR_DEG: Final = 0.7  # least sigma of a tilt for the nadir's prior
_TILT_SIGMA_FACTOR: Final = 2.0  # the nadir's prior is so many times looser than the shapes' own sigma
_HEIGHT_FOCAL_SIGMA: Final = 0.12  # relative sigma of a focal length by recorded height
_FOCAL_CHANGE: Final = 0.03  # a focal length by height that differs by more is solved for again
_ROUNDS: Final = 2  # rounds of shapes, headings, scales and network (a third changed nothing)
_LINK_SIGMA: Final = 0.15  # relative sigma of a segment's ground scale about its lens's
_LINK_HEIGHT_SIGMA: Final = 0.03  # the same where recorded heights scale it
_COURSE_LEAST_M_S: Final = 0.3  # slower photos have no course for a heading


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialOrientation:
    """Orientation of N photos of L lenses in S segments with E pairs.

    Attributes:
        position: complex (N,), east + i north of the network.
        yaw: float64 (N,) grid heading. level: float64 (N, 3, 3), camera to level camera.
        metres: float64 (N,), metres per pixel straight below. height: float64 (N,), metres above the ground.
        focal: float64 (L,), pixels. focal_sigma: float64 (L,), relative. k1: float64 (L,).
        tilt_sigma: float64 (S,), radians.
        component: int32 (N,), connected parts of the pair graph, the largest is 0.
        pair_ok: bool (E,), pairs that agree with the network. gps_ok: bool (N,), recorded positions that do.
        gps_residual: complex (N,), recorded minus network's position, lag removed. lag: float64 (V,) seconds.
        yaw_known: bool (N,), heading found from pairs. scale_known: bool (L,), ground scale found.
        recorded_focal: float64 (L,), focal length that the recorded heights imply, NaN where they are impossible.
        tags: the recorded heading that follows the pictures, for each vehicle.
    """

    position: Complex
    yaw: Array
    level: Array
    metres: Array
    height: Array
    focal: Array
    focal_sigma: Array
    k1: Array
    tilt_sigma: Array
    component: Ints
    pair_ok: Flags
    gps_ok: Flags
    gps_residual: Complex
    lag: Array
    yaw_known: Flags
    scale_known: Flags
    recorded_focal: Array
    tags: tuple[TagHeading, ...]

    def rotation(self) -> Array:
        """Camera-to-ground rotations, float64 (N, 3, 3)."""
        return rotation_of(self.yaw, self.level)

    def middle(self) -> Complex:
        """Ground point at each picture's centre, complex (N,)."""
        axis = self.level[:, :, 2]
        ahead = (axis[:, 0] - 1j * axis[:, 1]) / np.maximum(axis[:, 2], 0.3)
        return np.asarray(self.position + self.height * ahead * np.exp(-1j * self.yaw))


def find_initial_orientation(
    records: PhotoRecords, pairs: Sequence[Pair], features: Sequence[SiftFeatures]
) -> InitialOrientation:
    """Solve tilt and lens, relative scales, headings and network of N photos in rounds, from verified matches."""
    count, segments = len(records), int(records.segment.max()) + 1
    lens_of = records.lens[np.unique(records.segment, return_index=True)[1]]
    matches = PairMatches.of(pairs, features)
    tilt_floor = float(np.radians(_TILT_FLOOR_DEG))
    hint, hint_sigma = focal_by_hint(records)
    shape = shape_of(matches, records, hint, hint_sigma)
    graph = similarities(matches, records, shape)
    metres, scale_known = first_scale(graph, records, lens_of, np.exp(shape.log_focal))
    component = components(graph, count)
    yaw = chain_headings(graph, count)
    no_offset = np.zeros(count, np.complex128)
    for round_ in range(_ROUNDS):
        focal = np.exp(shape.log_focal)
        heights = recorded_heights(records, metres * focal[lens_of])
        by_height = focal_by_height(records, heights, metres, lens_of)
        differs = np.isfinite(by_height) & (np.abs(np.log(by_height / focal)) > _FOCAL_CHANGE)
        if round_ == 0 or differs.any():
            shape = shape_of(matches, records, *_combine(hint, hint_sigma, by_height))
            graph = similarities(matches, records, shape)
            focal = np.exp(shape.log_focal)
        relative = relative_scales(graph, records, heights, count)
        tilt_px = np.maximum(_TILT_SIGMA_FACTOR * shape.tilt_sigma, tilt_floor) * focal[lens_of]
        course, sigma = course_headings(
            graph, records, metres[records.segment] * relative, no_offset, tilt_px[records.segment]
        )
        yaw, yaw_known = solve_headings(graph, component, yaw, course, sigma)
        link, link_sigma = _links(heights, lens_of, by_height)
        priors = NetworkPriors(
            metres=metres,
            relief=relative,
            link=link,
            link_sigma=link_sigma,
            offset_sigma=tilt_px,
            lens=lens_of,
        )
        network = solve_network(graph, records, yaw, priors)
        metres = network.metres
    level = shape.level.copy()
    for s in range(segments):
        turn = level_from_nadir(complex(network.offset[s]), float(focal[lens_of[s]]))
        level[records.segment == s] = turn @ level[records.segment == s]
    vehicles = [np.flatnonzero(yaw_known & (records.vehicle == v)) for v in range(int(records.vehicle.max()) + 1)]
    tags = tuple(tag_heading(records, rows, yaw) for rows in vehicles)
    below = metres[records.segment] * relative
    return InitialOrientation(
        position=network.position,
        yaw=_fill_headings(records, yaw, yaw_known, component, tags),
        level=level,
        metres=below,
        height=below * focal[records.lens],
        focal=focal,
        focal_sigma=shape.log_focal_sigma,
        k1=shape.k1,
        tilt_sigma=np.minimum(shape.tilt_sigma, network.offset_sigma / focal[lens_of]),
        component=component,
        pair_ok=network.pair_ok,
        gps_ok=network.gps_ok,
        gps_residual=network.gps_residual,
        lag=network.lag,
        yaw_known=yaw_known,
        scale_known=scale_known,
        recorded_focal=focal_by_height(records, heights, metres, lens_of),
        tags=tags,
    )


def shape_of(matches: PairMatches, records: PhotoRecords, log_focal: Array, log_focal_sigma: Array) -> TiltAndLens:
    """Tilt of each segment and lens, with the priors of its tags; log_focal, log_focal_sigma: float64 (L,), priors."""
    tagged = np.isfinite(records.pitch)
    share = np.array([tagged[records.segment == s].mean() for s in range(int(records.segment.max()) + 1)])
    tilt_sigma = np.radians(np.where(share > _TAG_TILT_SHARE, _TAG_TILT_SIGMA_DEG, _FREE_TILT_SIGMA_DEG))
    return solve_tilt_and_lens(
        matches, records, records.tag_level(), log_focal=log_focal, log_focal_sigma=log_focal_sigma,
        tilt_sigma=tilt_sigma,
    )  # fmt: skip


def _combine(log_focal: Array, sigma: Array, by_height: Array) -> tuple[Array, Array]:
    """Weighted mean of the log focal lengths from tags and from recorded heights, and its sigma; both float64 (L,)."""
    weight = np.where(np.isfinite(by_height), _HEIGHT_FOCAL_SIGMA**-2, 0.0)
    total = sigma**-2 + weight
    return (log_focal * sigma**-2 + weight * np.log(np.where(weight > 0, by_height, 1.0))) / total, total**-0.5


def _links(heights: RecordedHeights, lens_of: Ints, by_height: Array) -> tuple[Array, Array]:
    """Scale of each segment over its lens's, by its plausible recorded height, else 1, and its relative sigma (S,)."""
    link, link_sigma = np.ones(len(lens_of)), np.full(len(lens_of), _LINK_SIGMA)
    for k in range(len(by_height)):
        rows = lens_of == k
        if np.isfinite(by_height[k]) and np.isfinite(heights.segment[rows]).all():
            link[rows] = heights.segment[rows] / np.median(heights.segment[rows])
            link_sigma[rows] = _LINK_HEIGHT_SIGMA
    return link, link_sigma


def _fill_headings(
    records: PhotoRecords, yaw: Array, known: Flags, component: Ints, tags: tuple[TagHeading, ...]
) -> Array:
    """Fill unknown headings: from the tag that follows the pictures elsewhere, else from the course flown."""
    yaw = yaw.copy()
    velocity = records.velocity()
    course = np.where(np.abs(velocity) > _COURSE_LEAST_M_S, wrap_rad(np.pi / 2 - np.angle(velocity)), np.nan)
    guess = np.full(len(yaw), np.nan)
    for v, tag in enumerate(tags):
        rows = records.vehicle == v
        source = tag.source or ("yaw" if np.isfinite(records.yaw[rows]).any() else "flight_yaw")
        guess[rows] = getattr(records, source)[rows] + tag.offset
    guess = np.where(np.isfinite(guess), guess, course)
    for part in np.unique(component[~known]):
        rows = np.flatnonzero((component == part) & np.isfinite(guess))
        if len(rows):
            yaw[component == part] += circular_mode(wrap_rad(guess[rows] - yaw[rows]), np.ones(len(rows)))
    return wrap_rad(yaw)
