"""Tie points on the map, roofs that show how the map leans, and links between legs."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.features.patch_matching import template_of
from orthoswarm.refine.registration.map_windows import LoadedMap
from orthoswarm.refine.registration.patch_search import search_map, search_picture, templates, views_of_other_legs

Array = NDArray[np.float64]
Ints = NDArray[np.int32]
Gray = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class MapMatches:
    """Points found on the map.

    Attributes (Q): point: int32. camera: int32 whose picture was compared. shift: float64 (Q, 2) metres from the
        point to its place on the map. peak, ratio: float64 correlation and second peak / peak.
    """

    point: Ints
    camera: Ints
    shift: Array
    peak: Array
    ratio: Array

    @classmethod
    def joined(cls, parts: "Sequence[MapMatches]") -> "MapMatches":
        """All matches of at least one part, one part after the other."""
        return cls(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in cls.__slots__})

    @classmethod
    def none(cls) -> "MapMatches":
        """No matches."""
        number, pair = np.zeros(0), np.zeros((0, 2))
        ints = np.zeros(0, np.int32)
        return cls(point=ints, camera=ints, shift=pair, peak=number, ratio=number)

    def take(self, keep: NDArray[np.bool_] | NDArray[np.integer]) -> "MapMatches":
        """Some of the matches."""
        return MapMatches(**{name: getattr(self, name)[keep] for name in self.__slots__})


def match_points(
    cameras: CameraBlock,
    points: Array,
    chosen: NDArray[np.integer],
    *,
    camera: Ints,
    gray: Callable[[int], Gray],
    ground: LoadedMap,
    half: int,
    reach: int,
    level: Array | None = None,
    texture: bool = False,
) -> MapMatches:
    """Find the surroundings of points on the map.

    What surrounds a corner is mostly ground, although the corner itself sits on something raised: so the surroundings
    are rectified on the ground where the camera sees the point, not at the point's own height.

    Args:
        chosen: (Q,) indices of points; camera: (P,) the picture to take for each point.
        gray: working-scale picture of a camera (its lens is in these pixels).
        half: half the patch in map pixels; reach: search in map pixels.
        level: float64 (P,) height on which to rectify around each point; None takes the points' own heights (roofs).
        texture: compare texture instead of edges, see `patch_matching.gradients`.
    """
    config, features = active().registration, active().features
    chosen = chosen[np.argsort(camera[chosen], kind="stable")]
    by, z = camera[chosen], points[chosen, 2]
    plane = z if level is None else np.asarray(level, float)[chosen]
    along = (points[chosen, :2] - cameras.position[by, :2]) / np.maximum(cameras.position[by, 2] - z, 1.0)[:, None]
    pixel, centre = ground.pixel_centres(points[chosen, :2] + along * (z - plane)[:, None])
    place = np.column_stack([centre, plane])
    found = np.zeros((len(chosen), 4))
    for i, part in _by_picture(by):
        search_map(
            cameras.position[i], cameras.rotation[i], cameras.lens[cameras.lens_id[i]], gray(i), place[part],
            pixel[part], ground.gray, ground.valid, ground.gsd_m, half, reach, texture,
            np.float32(features.gradient_floor), features.peak_exclude_px, config.map_window_share,
            config.patch_share, features.search_wide_px, features.search_promising_share, found[part],
        )  # fmt: skip
    good = found[:, 2] > 0
    found, by = found[good], by[good]
    return MapMatches(
        point=chosen[good].astype(np.int32),
        camera=by.astype(np.int32),
        shift=found[:, :2] * [ground.gsd_m, -ground.gsd_m],
        peak=found[:, 2],
        ratio=found[:, 3] / found[:, 2],
    )


def _by_picture(ascending: NDArray[np.integer]) -> Iterator[tuple[int, slice]]:
    """Each picture of an ascending list, with where it stands in that."""
    edges = np.flatnonzero(np.diff(ascending, prepend=-1)).tolist()
    for a, b in pairwise([*edges, len(ascending)]):
        yield int(ascending[a]), slice(a, b)


def vote_lean(matches: MapMatches, height: Array, offset: Array) -> tuple[float, float] | None:
    """The map's lean (metres of shift per metre of height) from roofs.

    Args:
        height: float64 (Q,) height of each matched point above the ground.
        offset: float64 (2,) shift that ground points have now.

    Returns:
        East and north lean, or None where too few roofs agree (the caller then takes zero).
    """
    config = active().registration
    if len(height) < config.lean_fewest:
        return None
    shift = matches.shift - offset
    slope = shift / height[:, None]
    sigma = config.lean_sigma_m + config.lean_sigma_share * height

    def support(lean: Array) -> tuple[float, Array]:
        e2 = ((shift - lean * height[:, None]) ** 2).sum(1) / sigma**2
        w = 1.0 / (1.0 + e2 / config.lean_scale) ** 2
        return float(w.sum()), w

    candidates = slope[np.hypot(*slope.T) < config.lean_most]
    if not len(candidates):
        return None
    best = candidates[int(np.argmax([support(c)[0] for c in candidates]))]
    for _ in range(8):
        w = support(best)[1] / sigma**2
        best = (shift * (w * height)[:, None]).sum(0) / max(float((w * height**2).sum()), 1e-9)
    total, w = support(best)
    zero = support(np.zeros(2))[0]
    least = max(config.lean_fewest, config.lean_over_none * zero, config.lean_least_share * len(height))
    if total < least:
        return None
    return float(best[0]), float(best[1])


def link_legs(
    cameras: CameraBlock,
    points: Array,
    chosen: NDArray[np.integer],
    *,
    camera: Ints,
    leg: Ints,
    candidates: NDArray[np.integer],
    gray: Callable[[int], Gray],
    gsd_m: float,
    most: int | None = None,
    reach: int | None = None,
) -> tuple[Ints, Ints, Array, int]:
    """Find points of one leg in the pictures of other legs.

    Args:
        camera: (P,) reference picture of each point. leg: (N,) of each camera. candidates: cameras that may be linked.
        most: other legs in which a point is observed. reach: search in pixels. None: as configured.

    Returns:
        Camera (K,), point (K,), pixel (K, 2) of new observations, and how many were tried.
    """
    config, features = active().registration, active().features
    most = config.link_pictures if most is None else most
    half, reach = config.link_half_px, config.link_reach_px if reach is None else reach
    floor = np.float32(features.gradient_floor)
    chosen = chosen[np.argsort(camera[chosen], kind="stable")]
    _, number = np.unique(leg, return_inverse=True)
    views = np.empty((len(chosen), most), np.int64)
    views_of_other_legs(
        cameras.position, cameras.rotation, cameras.lens_id, cameras.lens, points[chosen], number[camera[chosen]],
        number, int(number.max(initial=-1)) + 1, np.asarray(candidates, np.int64), config.link_margin_px, views,
    )  # fmt: skip
    chosen, views = chosen[views[:, 0] >= 0], views[views[:, 0] >= 0]
    found, tried = np.zeros((*views.shape, 4)), 0
    for start in range(0, len(chosen), config.links_at_once):
        some = slice(start, start + config.links_at_once)
        own = points[chosen[some]]
        fields = np.zeros((len(own), *template_of(half).shape), np.float32)
        for i, part in _by_picture(camera[chosen[some]]):
            templates(
                cameras.position[i], cameras.rotation[i], cameras.lens[cameras.lens_id[i]], gray(i), own[part],
                gsd_m, half, floor, config.link_template_share, fields[part],
            )  # fmt: skip
        shown = np.isfinite(fields[:, 0, 0, 0])
        point, view = np.nonzero((views[some] >= 0) & shown[:, None])
        by = views[some][point, view]
        order = np.argsort(by, kind="stable")
        point, view, by = point[order], view[order], by[order]
        tried += len(by)
        result = np.zeros((len(by), 4))
        for i, part in _by_picture(by):
            search_picture(
                cameras.position[i], cameras.rotation[i], cameras.lens[cameras.lens_id[i]], gray(i),
                own[point[part]], fields, point[part], gsd_m, half, reach, floor, config.link_apart_px,
                config.link_window_share, result[part],
            )  # fmt: skip
        found[start + point, view] = result
    peak, second = found[..., 2], found[..., 3]
    point, view = np.nonzero((peak > 0) & (peak >= config.link_peak) & (second <= config.link_ratio * peak))
    moved = points[chosen[point]]
    moved[:, :2] += found[point, view, :2] * [gsd_m, -gsd_m]
    by_camera = views[point, view].astype(np.int32)
    return by_camera, chosen[point].astype(np.int32), cameras.project(by_camera, moved), tried
