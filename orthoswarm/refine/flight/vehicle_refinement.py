"""What every refiner does with one vehicle's frames before and after its units are solved."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthoswarm.model.arrays import Array
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import Leg, MapWindow, PlacedFrame, Solution
from orthoswarm.mosaic.recorded_pose import hint_lone_photos, recorded_cameras
from orthoswarm.refine.flight.solve_units import split_units
from orthoswarm.refine.flight.unsolved_pictures import RefinableSplit, place_by_neighbours, split_refinable


@dataclass(frozen=True, slots=True)
class UnitRefiner(ABC):
    """What refiners have in common: the area's grid, and a vehicle that is solved unit by unit (placement.Refiner).

    Attributes:
        epsg: the area's grid. origin: (2,) of the local frame, the same for all vehicles of an area.
    """

    epsg: int
    origin: Array

    def refine(self, frames: Sequence[Frame], neighbours: Sequence[Solution], basemap: MapWindow | None) -> Solution:
        """Solve one vehicle's frames as far as they can be solved, and place the others.

        Frames too few of their camera and size move as their solved neighbours do; a vehicle that took all pictures at
        one spot stays as recorded; a frame whose position cannot be true is left out.

        Args:
            frames: of one vehicle, in order of time. neighbours: earlier results of this refiner, held as they are.
            basemap: the map, or None.

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
    """The units of all vehicles of an area, frames of one lens each.

    Raises:
        OrthoSwarmError: if there is no vehicle.
    """
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
        legs=[
            Leg(
                vehicle=vehicle,
                first=0,
                last=len(placed) - 1,
                images=(placed[0].frame.image, placed[-1].frame.image),
                sigma_m=sigma,
            )
        ]
        if placed
        else [],
        fov_deg=float(np.degrees(np.median([p.camera.lens.fov_rad for p in placed]))) if placed else float("nan"),
        fov_sigma_deg=float("nan"),
        terrain=None,
    )


def unrefined(frames: Sequence[Frame], why: str, grid: LocalGrid) -> Solution:
    """A vehicle that could not be refined, placed as recorded.

    Args:
        frames: its own. why: the reason, for its warning. grid: the area's.
    """
    placed = recorded_cameras(frames, grid).placed
    warning = f"it could not be refined ({why}); it lies where its receiver says"
    return replace(as_recorded(frames[0].vehicle, placed), warnings=[warning])
