"""What vehicles of an area have in common: who sees whom, the lean of the map, one terrain; how tasks are run."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoswarm.frame import Frame
from orthoswarm.geo import LocalGrid
from orthoswarm.placement import Terrain
from orthoswarm.swarm.ground import ground_points
from orthoswarm.swarm.state import VehicleState
from orthoswarm.swarm.surface import FitSettings
from orthoswarm.swarm.terrain import fit_terrain
from orthoswarm.swarm.ties import MapMatches, vote_lean

Array = NDArray[np.float64]
T = TypeVar("T")

DRAWN = FitSettings(held_out_se=1.0)
"""The surface for drawing reaches to the border, where few points hold it: rubble in the middle must not roughen it."""


class Run(Protocol):
    """How tasks are run: serially, in processes, on a cluster; results come in the order of the items."""

    def __call__(self, function: Callable[[Any], T], items: Sequence[Any], /) -> Iterable[T]:
        """Yield function(item) for each item."""


def serial(function: Callable[[Any], T], items: Sequence[Any], /) -> Iterable[T]:
    """Run tasks one after the other in this process."""
    return map(function, items)


def local_origin(grid: LocalGrid, frames: Iterable[Frame]) -> Array:
    """Origin (2,) of the local frame: the middle of the fixes, on a multiple of 16 m so that pixel grids agree."""
    fixes = np.array([(f.fix.lat_deg, f.fix.lon_deg) for f in frames])
    return np.asarray(np.round(np.median(grid.to_grid(fixes[:, 0], fixes[:, 1]), axis=0) / 16.0) * 16.0)


def neighbours_of(state: VehicleState, states: Sequence[VehicleState]) -> list[VehicleState]:
    """The other vehicles whose paths come within sight of this one's."""
    own = state.flight.adjustment.rig.position
    reach = 1.5 * float(np.median(own[:, 2]))
    low, high = own[:, :2].min(0) - reach, own[:, :2].max(0) + reach
    out = []
    for other in states:
        xy = other.flight.adjustment.rig.position[:, :2]
        if other is not state and ((xy > low) & (xy < high)).all(1).any():
            out.append(other)
    return out


def pooled_lean(states: Sequence[VehicleState]) -> tuple[float, float]:
    """The map's lean by vote over the roofs of all vehicles that lie on it; zero where they do not agree."""
    mapped = [s for s in states if s.on_map]
    if not mapped:
        return (0.0, 0.0)
    shifts = [s.roofs[0].shift - s.ground_shift for s in mapped]
    roofs = [s.roofs[0] for s in mapped]
    joint = MapMatches(
        np.concatenate([r.point for r in roofs]),
        np.concatenate([r.camera for r in roofs]),
        np.concatenate(shifts),
        np.concatenate([r.peak for r in roofs]),
        np.concatenate([r.ratio for r in roofs]),
    )
    return vote_lean(joint, np.concatenate([s.roofs[1] for s in mapped]), np.zeros(2)) or (0.0, 0.0)


def common_terrain(states: Sequence[VehicleState]) -> Terrain | None:
    """One surface over all vehicles for rendering, in the local frame; None where there are too few points."""
    if not states:
        return None
    own = [ground_points(s.flight.adjustment) for s in states]
    points = np.concatenate([p for p, _ in own] + [s.dense[0] for s in states])
    sigma = np.concatenate([q for _, q in own] + [s.dense[1] for s in states])
    if len(points) < 60:
        return states[0].surface.terrain()
    path = np.concatenate([s.flight.adjustment.rig.position for s in states])
    reach = 1.1 * float(np.median(path[:, 2]))
    low, high = path[:, :2].min(0) - reach, path[:, :2].max(0) + reach
    fit = fit_terrain(points, sigma, (float(low[0]), float(low[1]), float(high[0]), float(high[1])), settings=DRAWN)
    return fit.rendering(float(np.median([s.surface.lift_m for s in states])))
