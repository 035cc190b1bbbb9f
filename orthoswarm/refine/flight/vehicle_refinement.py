"""What every refiner does with one vehicle's frames before and after its units are solved.

A unit is solved at once: one lens of one vehicle, of limited length.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import Leg, MapWindow, PlacedFrame, Solution
from orthoswarm.mosaic.recorded_pose import hint_lone_photos, recorded_cameras
from orthoswarm.refine.flight.unsolved_pictures import RefinableSplit, place_by_neighbours, split_refinable
from orthoswarm.trajectory.near_paths import separate_places

LONGEST_UNIT_PHOTOS: Final = 600
"""Longer flights are solved in stretches that hold each other as neighbours, so that cost and memory stay bounded."""
_OWN_UNIT_PHOTOS: Final = 6  # fewer photos of another camera name but the same size stay with the vehicle's main camera
_UNIT_GAP_M: Final = 500.0
"""Groups of photos at least so far apart are solved like different vehicles: they show no common ground, so what places
the one says nothing about the other (more than the footprint of a photo from 200 m) ..."""
_UNIT_GAP_STEPS: Final = 10.0
"""... and at least so many times the usual distance of a photo to the nearest one: of high flights lines are far apart
(with overlaps of 80 and 20 % lines are five times as far apart as photos)."""


@dataclass(frozen=True, slots=True)
class UnitRefiner(ABC):
    """What refiners have in common: the area's grid and origin (2,), and a vehicle that is solved unit by unit."""

    epsg: int
    origin: Array

    def refine(self, frames: Sequence[Frame], neighbours: Sequence[Solution], basemap: MapWindow | None) -> Solution:
        """Solve one vehicle's frames, in order of time, as far as they can be solved, and place the others.

        Frames too few of their camera and size move as their solved neighbours do; a vehicle that took all pictures at
        one spot stays as recorded; a frame whose position cannot be true is left out. The neighbours, earlier results
        of this refiner, are held as they are.

        Raises:
            OrthoSwarmError: if there are no frames, or nothing can be made of them.
        """
        if not frames:
            raise OrthoSwarmError("there are no frames to refine; check the vehicle's pictures")
        recorded = recorded_cameras(frames, LocalGrid(self.epsg))
        kinds = split_refinable(recorded.placed)
        if kinds.fit:
            solution = self.solve(_units(kinds), neighbours, basemap)
        else:
            solution = as_recorded(frames[0].vehicle, kinds.still)
        return replace(
            solution,
            placed=[*solution.placed, *place_by_neighbours(kinds.odd, kinds.fit, solution.placed)],
            dropped={**solution.dropped, **{r.image: r.reason for r in recorded.rejected}},
            warnings=[*solution.warnings, *kinds.warnings],
        )

    def units(self, frames: Sequence[Frame]) -> list[list[Frame]]:
        """The units that `refine` solves of one vehicle's frames."""
        kinds = split_refinable(recorded_cameras(frames, LocalGrid(self.epsg)).placed)
        return _units(kinds) if kinds.fit else []

    @abstractmethod
    def solve(self, units: list[list[Frame]], neighbours: Sequence[Solution], basemap: MapWindow | None) -> Solution:
        """Solve the units of one vehicle (frames of one lens each) to one solution."""


def _units(kinds: RefinableSplit) -> list[list[Frame]]:
    return split_units({kinds.fit[0].frame.vehicle: hint_lone_photos(kinds.fit)})


def units_of_area(vehicles: Mapping[str, Sequence[Frame]]) -> list[list[Frame]]:
    """The units of all vehicles of an area, frames of one lens each; an OrthoSwarmError if there is no vehicle."""
    if not vehicles:
        raise OrthoSwarmError("there is no vehicle with frames to refine; check the inputs")
    return split_units(vehicles)


def unit_states(solution: Solution) -> list[Any]:
    """What the refiner left in a solution for each of the vehicle's units."""
    state = solution.state
    return [] if state is None else list(state) if isinstance(state, list) else [state]


def as_recorded(vehicle: str, placed: Sequence[PlacedFrame]) -> Solution:
    """A vehicle placed as recorded: it did not move, so that its pictures have no scale of their own."""
    sigma = float(np.median([p.sigma_m for p in placed])) if placed else float("nan")
    return Solution(
        vehicle=vehicle,
        placed=list(placed),
        dropped={},
        legs=[Leg.of([p.frame for p in placed], np.arange(len(placed)), sigma_m=sigma)] if placed else [],
        fov_deg=float(np.degrees(np.median([p.camera.lens.fov_rad for p in placed]))) if placed else float("nan"),
        fov_sigma_deg=float("nan"),
        terrain=None,
    )


def unrefined(frames: Sequence[Frame], why: str, grid: LocalGrid) -> Solution:
    """A vehicle that could not be refined, placed as recorded; why: the reason, for its warning."""
    placed = recorded_cameras(frames, grid).placed
    warning = f"it could not be refined ({why}); it lies where its receiver says"
    return replace(as_recorded(frames[0].vehicle, placed), warnings=[warning])


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
                parts = max(1, int(np.ceil(len(there) / LONGEST_UNIT_PHOTOS)))
                edges = np.linspace(0, len(there), parts + 1).round().astype(int)
                units += [there[a:b] for a, b in pairwise(edges.tolist())]
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
                together = [*groups[main], *groups.pop(key)]
                timed = all(f.time_s is not None for f in together)
                groups[main] = sorted(together, key=lambda f: (f.time_s or 0.0, f.image) if timed else (0.0, f.image))
        out += [groups[k] for k in keys if k in groups]
    return out


def merge_units(solutions: Sequence[Solution]) -> list[Solution]:
    """Merge the units of each vehicle into one solution; its field of view is that of the largest unit."""
    by_vehicle: dict[str, list[Solution]] = {}
    for solution in solutions:
        by_vehicle.setdefault(solution.vehicle, []).append(solution)
    return [parts[0] if len(parts) == 1 else _merged(parts) for parts in by_vehicle.values()]


def _merged(parts: Sequence[Solution]) -> Solution:
    legs, offset, timings = [], 0, Counter[str]()
    for part in parts:
        legs += [replace(leg, first=leg.first + offset, last=leg.last + offset) for leg in part.legs]
        offset += len(part.placed) + len(part.dropped)
        timings.update(part.timings)
    return replace(
        max(parts, key=lambda s: len(s.placed)),
        placed=[p for part in parts for p in part.placed],
        dropped={image: reason for part in parts for image, reason in part.dropped.items()},
        legs=legs,
        state=[part.state for part in parts if part.state is not None],
        warnings=list(dict.fromkeys(w for part in parts for w in part.warnings)),
        timings=dict(timings),
        false_matches=float(np.fmax.reduce([part.false_matches for part in parts])),
    )
