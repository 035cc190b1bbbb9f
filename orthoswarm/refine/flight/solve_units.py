"""Units that are solved at once (one lens of one vehicle, of limited length), and the merging of their solutions."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np

from orthoswarm.config import active
from orthoswarm.model.frame import Frame
from orthoswarm.model.placement import Solution
from orthoswarm.trajectory.separate_places import separate_places

_OWN_UNIT_PHOTOS: Final = 6  # fewer photos of another camera name but the same size stay with the vehicle's main camera
_UNIT_GAP_M: Final = 500.0
"""Groups of photos at least so far apart are solved like different vehicles: they show no common ground, so what places
the one says nothing about the other (more than the footprint of a photo from 200 m) ..."""
_UNIT_GAP_STEPS: Final = 10.0
"""... and at least so many times the usual distance of a photo to the nearest one: of high flights lines are far apart
(with overlaps of 80 and 20 % lines are five times as far apart as photos)."""


def split_units(vehicles: Mapping[str, Sequence[Frame]]) -> list[list[Frame]]:
    """Split frames into units of one vehicle, camera, size and place, in order.

    A change of zoom or orientation starts a new lens. A few frames with another camera name but the same size stay
    with the vehicle's main camera; a few frames far from all others stay with them, since their positions may be wrong.
    """
    units: list[list[Frame]] = []
    for frames in vehicles.values():
        groups: dict[tuple[str, int, int], list[Frame]] = {}
        for frame in frames:
            groups.setdefault((frame.camera, frame.width, frame.height), []).append(frame)
        for group in _absorb(groups):
            for there in _by_place(group):
                parts = max(1, int(np.ceil(len(there) / active().flight.longest_unit_photos)))
                units += [list(part) for part in _even(there, parts)]
    return units


def _by_place(frames: list[Frame]) -> list[list[Frame]]:
    """Frames by the place where they were taken, groups of a few with the largest."""
    lat, lon = (np.array([getattr(f.fix, name) for f in frames], float) for name in ("lat_deg", "lon_deg"))
    group = separate_places(lat, lon, _UNIT_GAP_M, _UNIT_GAP_STEPS)
    count = np.bincount(group)
    group[count[group] < _OWN_UNIT_PHOTOS] = count.argmax()
    return [[f for f, k in zip(frames, group, strict=True) if k == number] for number in np.unique(group)]


def _absorb(groups: dict[tuple[str, int, int], list[Frame]]) -> list[list[Frame]]:
    by_size: dict[tuple[int, int], list[tuple[str, int, int]]] = {}
    for key in groups:
        by_size.setdefault(key[1:], []).append(key)
    out = []
    for keys in by_size.values():
        main = max(keys, key=lambda k: len(groups[k]))
        for key in keys:
            if key != main and len(groups[key]) < _OWN_UNIT_PHOTOS:
                groups[main] = _in_order([*groups[main], *groups.pop(key)])
        out += [groups[k] for k in keys if k in groups]
    return out


def _in_order(frames: list[Frame]) -> list[Frame]:
    timed = all(f.time_s is not None for f in frames)
    return sorted(frames, key=lambda f: (f.time_s or 0.0, f.image) if timed else (0.0, f.image))


def _even(frames: list[Frame], parts: int) -> list[list[Frame]]:
    edges = np.linspace(0, len(frames), parts + 1).round().astype(int)
    return [frames[a:b] for a, b in pairwise(edges.tolist())]


def merge_units(solutions: Sequence[Solution]) -> list[Solution]:
    """Merge the units of each vehicle into one solution; its field of view is that of the largest unit."""
    by_vehicle: dict[str, list[Solution]] = {}
    for solution in solutions:
        by_vehicle.setdefault(solution.vehicle, []).append(solution)
    return [parts[0] if len(parts) == 1 else _merged(parts) for parts in by_vehicle.values()]


def _merged(parts: Sequence[Solution]) -> Solution:
    main = max(parts, key=lambda s: len(s.placed))
    legs, offset = [], 0
    for part in parts:
        legs += [replace(leg, first=leg.first + offset, last=leg.last + offset) for leg in part.legs]
        offset += len(part.placed) + len(part.dropped)
    timings: dict[str, float] = {}
    for part in parts:
        for name, seconds in part.timings.items():
            timings[name] = timings.get(name, 0.0) + seconds
    return replace(
        main,
        placed=[p for part in parts for p in part.placed],
        dropped={image: reason for part in parts for image, reason in part.dropped.items()},
        legs=legs,
        state=[part.state for part in parts if part.state is not None],
        warnings=list(dict.fromkeys(w for part in parts for w in part.warnings)),
        timings=timings,
        false_matches=float(np.fmax.reduce([part.false_matches for part in parts])),
    )
