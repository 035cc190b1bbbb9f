"""How near vehicles come that are as late as real autopilots, in plans with several allowances for it.

    python -m benchmarks.robustness.late_vehicles

Vehicles fall behind a plan as ArduCopter and PX4 did in flight (docs/vehicles.md), each by a share of 0.8 to 1.2 of it.
A pair has met if it was less than 10 m apart with less than 4.5 m between the heights, away from a common start.
"""

import argparse
from itertools import combinations

import numpy as np
import shapely
from numpy.typing import NDArray

from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.plan import Plan
from orthoswarm.planning.area.area import Area
from orthoswarm.planning.lines.line_spacing import footprint
from orthoswarm.planning.planner import plan_area
from orthoswarm.planning.sorties.assignment import Options
from orthoswarm.planning.sorties.deconfliction import Separation
from orthoswarm.planning.sorties.flight_time import Motion

Array = NDArray[np.float64]

LATE_S = {"ArduCopter": (4.5, 9.0, 9.0, 18.0), "PX4": (8.0, 15.0, 24.0, 25.0)}
"""Seconds behind the plan after the takeoff, the first line, the last line and the way home."""
CORNER = np.array([600_000.0, 5_300_000.0])
STEP_S, GROUND_M, PAD_M = 0.25, 2.0, 15.0


def flown_late(plan: Plan, late_s: list[Array]) -> list[Array]:
    """Where each vehicle is every STEP_S after the swarm's start: (n, 3) metres; on the ground nan.

    Args:
        plan: its first sorties are flown. late_s: per vehicle, see LATE_S.
    """
    motion, grid = Motion(), LocalGrid(32632)
    moments = np.arange(0.0, plan.makespan_s + 60.0, STEP_S)
    tracks = []
    for vehicle, late in zip(plan.vehicles, late_s, strict=True):
        sortie = vehicle.sorties[0]
        places = [(sortie.home_lat_deg, sortie.home_lon_deg), *((w.lat_deg, w.lon_deg) for w in sortie.waypoints)]
        east_north = grid.to_grid(*np.array(places).T) - CORNER
        path = np.column_stack([east_north[[0, 0, *range(1, len(places))]], np.zeros(len(places) + 1)])
        path[1:, 2] = [sortie.takeoff_height_m, *(w.height_m for w in sortie.waypoints)]
        path = np.vstack([path, [*path[0, :2], 0.0]])
        times = motion.times(path)
        behind = np.interp(times, times[[0, 1, 3, -3, -2, -1]], [0.0, *late, late[-1]])
        at = sortie.start_s + times + behind
        track = np.stack([np.interp(moments, at, path[:, axis], np.nan, np.nan) for axis in range(3)], 1)
        track[~(track[:, 2] > GROUND_M)] = np.nan
        tracks.append(track)
    return tracks


def met(tracks: list[Array], homes: Array) -> tuple[int, float]:
    """How many pairs met, and the smallest horizontal distance among them, metres."""
    count, nearest = 0, np.inf
    for one, other in combinations(range(len(tracks)), 2):
        p, q = tracks[one], tracks[other]
        apart, height = np.hypot(*(p[:, :2] - q[:, :2]).T), np.abs(p[:, 2] - q[:, 2])
        close = (apart < 10.0) & (height < 4.5)
        if np.hypot(*(homes[one] - homes[other])) < PAD_M:
            at_start = np.hypot(*(p[:, :2] - homes[one]).T) < PAD_M
            close &= ~(at_start & (np.hypot(*(q[:, :2] - homes[other]).T) < PAD_M))
        if close.any():
            count, nearest = count + 1, min(nearest, float(apart[close].min()))
    return count, nearest


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--side", type=float, default=890.0, metavar="M", help="of the square area (default 890)")
    parser.add_argument("--seeds", type=int, default=10, help="flights of each plan (default 10)")
    args = parser.parse_args()
    grid = LocalGrid(32632)
    corner = np.array([[0, 0], [args.side, 0], [args.side, args.side], [0, args.side]]) + CORNER
    area = Area(grid, shapely.Polygon(corner), shapely.MultiPolygon())
    start = grid.to_geographic(CORNER + np.array([-20.0, 0.5 * args.side]))
    print("| vehicles | start | fleet | allowed s | makespan s | pairs | met | nearest m |")
    print("|---|---|---|---|---|---|---|---|")
    for vehicles in (3, 8, 16, 32):
        for name, starts in (("own", []), ("one", [(float(start[0]), float(start[1]))])):
            for slack_s in (3.0, 10.0, 20.0):
                options = Options(starts=starts, separation=Separation(slack_s=slack_s))
                plan = plan_area(area, vehicles, 60.0, footprint(60.0, np.radians(75.0)), options=options)
                homes = [(v.sorties[0].home_lat_deg, v.sorties[0].home_lon_deg) for v in plan.vehicles]
                places = grid.to_grid(*np.array(homes).T) - CORNER
                for fleet in ("ArduCopter", "mixed"):
                    count, nearest = 0, np.inf
                    for seed in range(args.seeds):
                        rng = np.random.default_rng(seed)
                        kinds = rng.choice(list(LATE_S), vehicles) if fleet == "mixed" else [fleet] * vehicles
                        late = [np.array(LATE_S[str(kind)]) * rng.uniform(0.8, 1.2) for kind in kinds]
                        found, least = met(flown_late(plan, late), places)
                        count, nearest = count + found, min(nearest, least)
                    pairs = vehicles * (vehicles - 1) // 2 * args.seeds
                    shown = "" if np.isinf(nearest) else f"{nearest:.1f}"
                    print(
                        f"| {vehicles} | {name} | {fleet} | {slack_s:g} | {plan.makespan_s:.0f} | {pairs} | {count} | "
                        f"{shown} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
