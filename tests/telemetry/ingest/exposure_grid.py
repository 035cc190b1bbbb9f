"""Flights whose photos and camera events are known to belong together, recorded with losses by two clocks.

Their pictures can be cut from an orthoimage, so that the pictures' own motion can be measured.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from telemetry.ingest.pairing.event_pairing import by_time
from telemetry.ingest.pairing.motion_chains import PictureMotion
from telemetry.photos.photo_tags import Photo
from telemetry.photos.picture_motion import shifts_px

Array = NDArray[np.float64]

GSD_M = 0.4
_SIZE = (320, 240)
_APART_M = 40.0
_NOISE_M = 0.15


@dataclass(frozen=True, slots=True)
class Exposures:
    """Times of photos and events, and the exposure (N,), (M,) that each is of; when each exposure was."""

    photos: Array
    events: Array
    of_photo: NDArray[np.int64]
    of_event: NDArray[np.int64]
    taken: Array


def exposures(
    rng: np.random.Generator, interval: float, *, whole: bool, missing: float, count: int = 0, jitter_s: float = 0.02
) -> Exposures:
    """A flight with straight runs and turns; up to the given share of photos and of events missing anywhere.

    A tenth of the events is recorded twice; the camera's clock is off by up to a year and up to 1,000 ppm fast or slow.
    """
    count = count or int(rng.integers(40, 160))
    gaps = interval + rng.normal(0.0, jitter_s, count)
    at = int(rng.integers(6, 18))
    while at < count:
        gaps[at] = interval + rng.uniform(2.0, 9.0)
        at += int(rng.integers(6, 18))
    taken = np.cumsum(np.maximum(gaps, 0.5 * interval))
    own = np.flatnonzero(rng.random(count) >= missing * rng.random())
    logged = np.flatnonzero(rng.random(count) >= missing * rng.random())
    twice = logged[rng.random(len(logged)) < 0.1]
    logged = np.concatenate([logged, twice])
    events = 1.7e9 + taken[logged]
    events[len(logged) - len(twice) :] += rng.uniform(0.0, 0.05, len(twice))
    order = np.argsort(events, kind="stable")
    offset = float(rng.choice([0.3, 15.2, -7200.4, 3.1e7, -3.0e7 + 0.7]))
    seen = (taken[own] + rng.normal(0.0, jitter_s, len(own))) * (1.0 + rng.uniform(-1e-3, 1e-3)) + 1.7e9 + offset
    seen = np.maximum.accumulate(seen)
    return Exposures(np.floor(seen) if whole else np.round(seen, 2), events[order], own, logged[order], taken)


@dataclass(frozen=True, slots=True)
class Score:
    """Photos whose exposure has an event too; those paired without a mark, and how many of these wrongly.

    `photos` are the indices of those without a mark.
    """

    both: int
    decided: int
    wrong_unmarked: int
    marked: int
    wrong_marked: int
    photos: frozenset[int]


def scored(flown: Exposures, motion: PictureMotion | None = None) -> Score:
    """Pair the photos of a flight and compare with the truth."""
    found = by_time(flown.photos, flown.events, motion)
    decided = [(i, j) for i, j in found.pairs if i not in found.doubtful]
    marked = [(i, j) for i, j in found.pairs if i in found.doubtful]
    both = len(np.intersect1d(flown.of_photo, flown.of_event))
    wrong, uncertain = (sum(flown.of_photo[i] != flown.of_event[j] for i, j in some) for some in (decided, marked))
    return Score(both, len(decided), int(wrong), len(marked), int(uncertain), frozenset(i for i, _ in decided))


def ground_of(path: Path) -> NDArray[np.uint8]:
    """A GeoTIFF in metres as grey values at GSD_M."""
    import rasterio

    with rasterio.open(path) as raster:
        gray = raster.read().astype(np.float32)[:3].mean(axis=0)
        scale = abs(raster.transform.a) / GSD_M
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.clip(small, 0, 255).astype(np.uint8)


def flown_over(
    ground: NDArray[np.uint8], flown: Exposures, rng: np.random.Generator, interval: float, folder: Path
) -> PictureMotion:
    """What the pictures of a flight show that flies to and fro over a grey orthoimage of GSD_M.

    Each leg has a speed (4 to 6 m/s) and a height of its own (3 %); what the camera looks at is off by 0.15 m in each
    picture and in each record of the log.
    """
    leg = np.concatenate([[0], np.cumsum(np.diff(flown.taken) > interval + 1.5)])
    legs = int(leg[-1]) + 1
    speed, height = rng.uniform(4.0, 6.0, legs), 1.0 + rng.normal(0.0, 0.03, legs)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(leg)) + 1])
    forward = np.where(np.arange(legs) % 2 == 0, 1.0, -1.0)
    along = speed[leg] * (flown.taken - flown.taken[starts][leg])
    lengths = np.append(along[starts[1:] - 1], along[-1])
    begins = np.concatenate([[0.0], np.cumsum(forward * lengths)[:-1]])
    true = np.stack([begins[leg] + forward[leg] * along, _APART_M * leg], axis=1)
    look, logged = (true + rng.normal(0.0, _NOISE_M, true.shape) for _ in range(2))
    pictures = []
    for number, exposure in enumerate(flown.of_photo.tolist()):
        n = int(leg[exposure])
        patch = _patch(ground, look[exposure] / GSD_M, float(height[n]))
        patch = patch if n % 2 == 0 else patch[::-1, ::-1]
        noisy = np.clip(patch + rng.normal(0.0, 4.0, patch.shape), 0, 255).astype(np.uint8)
        path = folder / f"{number:04d}.jpg"
        cv2.imwrite(str(path), noisy)
        pictures.append(Photo(path=path, width=_SIZE[0], height=_SIZE[1]))
    steps = np.hypot(*np.diff(logged[flown.of_event], axis=0).T)
    path_m = np.concatenate([[0.0], np.cumsum(steps)])
    return PictureMotion(path_m, lambda some: shifts_px([pictures[i] for i in some]))


def _patch(ground: NDArray[np.uint8], centre: Array, scale: float) -> NDArray[np.uint8]:
    """The ground around a place (column, row) of an orthoimage that goes on mirrored beyond its edges."""
    middle = np.array([0.5 * (_SIZE[0] - 1), 0.5 * (_SIZE[1] - 1)])
    corner = np.floor(centre - scale * middle).astype(int) - 2
    reach = np.ceil(scale * np.array(_SIZE)).astype(int) + 5
    columns, rows = (_mirrored(corner[k] + np.arange(reach[k]), ground.shape[1 - k]) for k in (0, 1))
    shift = centre - scale * middle - corner
    matrix = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    window = ground[np.ix_(rows, columns)]
    return np.asarray(cv2.warpAffine(window, matrix, _SIZE, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP))


def _mirrored(at: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    folded = np.mod(at, 2 * size)
    return np.minimum(folded, 2 * size - 1 - folded)
