"""Tie points on the map, roofs that show how the map leans, and links between legs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthoswarm.config import active
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.features.patch_matching import gradient_field, match, rectify
from orthoswarm.refine.registration.map_windows import LoadedMap

Array = NDArray[np.float64]
Ints = NDArray[np.int32]
Gray = NDArray[np.uint8]
Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
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

    def take(self, keep: NDArray[np.bool_] | NDArray[np.integer]) -> "MapMatches":
        """Some of the matches."""
        return MapMatches(self.point[keep], self.camera[keep], self.shift[keep], self.peak[keep], self.ratio[keep])


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
    field: Callable[[Floats], Floats] = gradient_field,
) -> MapMatches:
    """Find the surroundings of points on the map.

    What surrounds a corner is mostly ground, although the corner itself sits on something raised: so the surroundings
    are rectified on the ground where the camera sees the point, not at the point's own height.

    Args:
        chosen: (Q,) indices of points; camera: (P,) the picture to take for each point.
        gray: working-scale picture of a camera (its lens is in these pixels).
        half: half the patch in map pixels; reach: search in map pixels.
        level: float64 (P,) height on which to rectify around each point; None takes the points' own heights (roofs).
        field: what is compared of pictures.
    """
    config = active().registration
    order = np.argsort(camera[chosen], kind="stable")
    patch = np.empty((2 * half + 3, 2 * half + 3), np.float32)
    rows: list[tuple[int, int, float, float, float, float]] = []
    for k in order:
        p, i = int(chosen[k]), int(camera[chosen[k]])
        x, y, z = points[p]
        plane = z if level is None else float(level[p])
        along = (points[p, :2] - cameras.position[i, :2]) / max(cameras.position[i, 2] - z, 1.0)
        x, y = x + along[0] * (z - plane), y + along[1] * (z - plane)
        row, column, cx, cy = ground.pixel_centre(x, y)
        window = ground.window(row, column, half + reach + 1)
        if window is None or window[1] < config.map_window_share:
            continue
        lens = cameras.lens[cameras.lens_id[i]]
        seen = rectify(
            cameras.position[i], cameras.rotation[i], lens, gray(i), cx, cy, plane, ground.gsd_m, half + 1, patch
        )
        if seen < config.patch_share:
            continue
        dc, dr, peak, second = match(field(patch), field(window[0]))
        if peak > 0:
            rows.append((p, i, dc * ground.gsd_m, -dr * ground.gsd_m, peak, second / peak))
    if not rows:
        return MapMatches(*(np.zeros(0, np.int32),) * 2, np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    a = np.array(rows)
    return MapMatches(a[:, 0].astype(np.int32), a[:, 1].astype(np.int32), a[:, 2:4], a[:, 4], a[:, 5])


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
    config = active().registration
    most = config.link_pictures if most is None else most
    half, reach = config.link_half_px, config.link_reach_px if reach is None else reach
    cams, pts, uvs, tried = [], [], [], 0
    size = 2 * (half + reach) + 3
    template, window = np.empty((2 * half + 3, 2 * half + 3), np.float32), np.empty((size, size), np.float32)
    nadir = cameras.position[candidates, :2]
    for p in chosen:
        i = int(camera[p])
        x, y, z = points[p]
        distance = np.hypot(nadir[:, 0] - x, nadir[:, 1] - y)
        uv = cameras.project(candidates, np.broadcast_to(points[p], (len(candidates), 3)))
        lens = cameras.lens[cameras.lens_id[candidates]]
        margin = config.link_margin_px
        sees = (uv[:, 0] > margin) & (uv[:, 1] > margin)
        sees &= (uv[:, 0] < lens[:, 6] - margin) & (uv[:, 1] < lens[:, 7] - margin)
        sees &= leg[candidates] != leg[i]
        near = np.flatnonzero(sees)[np.argsort(distance[sees], kind="stable")]
        _, first = np.unique(leg[candidates[near]], return_index=True)
        picks = candidates[near[np.sort(first)[:most]]]
        if not len(picks):
            continue
        li = cameras.lens[cameras.lens_id[i]]
        shown = rectify(cameras.position[i], cameras.rotation[i], li, gray(i), x, y, z, gsd_m, half + 1, template)
        if shown < config.link_template_share:
            continue
        field = gradient_field(template)
        for j in picks:
            lj = cameras.lens[cameras.lens_id[j]]
            tried += 1
            seen = rectify(
                cameras.position[j], cameras.rotation[j], lj, gray(int(j)), x, y, z, gsd_m, half + reach + 1, window
            )
            if seen < config.link_window_share:
                continue
            dc, dr, peak, second = match(field, gradient_field(window), exclude=config.link_apart_px)
            if peak >= config.link_peak and second <= config.link_ratio * peak:
                moved = np.array([[x + dc * gsd_m, y - dr * gsd_m, z]])
                cams.append(int(j))
                pts.append(int(p))
                uvs.append(cameras.project(np.array([j]), moved)[0])
    return np.array(cams, np.int32), np.array(pts, np.int32), np.array(uvs, float).reshape(-1, 2), tried
