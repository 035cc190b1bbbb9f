"""How near vehicles come that fly as real autopilots do, in plans by several models of their times.

    python -m benchmarks.robustness.late_vehicles

Vehicles take the times of their autopilots (orthoswarm/config/autopilot.py), and what was left beyond these in flight
(docs/vehicles.md). A pair has met if it was less than 10 m apart with less than 4.5 m between the heights. Around a
common start, where a plan has one place for vehicles that stand some metres apart, meetings are counted by themselves.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import shapely
from numpy.typing import NDArray

from orthoswarm.config import DEFAULT
from orthoswarm.config.autopilot import AutopilotTimes
from orthoswarm.config.planning import PLANNING
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.plan import Plan
from orthoswarm.planning.area.area import Area
from orthoswarm.planning.lines.line_spacing import footprint
from orthoswarm.planning.planner import plan_area
from orthoswarm.planning.sorties.assignment import PlanOptions
from orthoswarm.planning.sorties.deconfliction import Separation
from orthoswarm.planning.sorties.flight_time import Motion

Array = NDArray[np.float64]

LEFT_S = {
    "ardupilot": ((-0.3, 0.3), (-0.7, 0.8), (-1.0, 2.4), (-1.0, 2.4), (-2.0, 3.4)),
    "px4": ((-3.7, 3.5), (-3.3, 3.5), (-6.0, 12.0), (-6.2, 12.0), (-6.2, 11.7)),
}
"""Range of the seconds beyond those times: after the takeoff, the first line, the last line, the way home, landing."""
CORNER = np.array([600_000.0, 5_300_000.0])
STEP_S, GROUND_M, PAD_M = 0.25, 2.0, 15.0


def constant_speed() -> Motion:
    """A vehicle that loses time in turns alone, as plans assumed once."""
    turns = AutopilotTimes(acceleration_m_s2=2.5, corner_m_s=0.0)
    times = replace(turns, takeoff_s=0.0, set_off_s=0.0, height_change_s=0.0, home_wait_s=0.0, landing_m_s=1.5)
    return Motion(autopilot=times)


def left_over(names: Sequence[str], rng: np.random.Generator) -> list[Array]:
    """Seconds beyond its autopilot's times for each vehicle, drawn from LEFT_S."""
    return [np.array([rng.uniform(*span) for span in LEFT_S[name]]) for name in names]


def flown_tracks(plan: Plan, names: Sequence[str], left_s: list[Array]) -> list[Array]:
    """Where each vehicle is every STEP_S after the swarm's start: (n, 3) metres; on the ground nan.

    Args:
        plan: its first sorties are flown. names: the vehicles' autopilots. left_s: per vehicle, see LEFT_S.
    """
    grid = LocalGrid(32632)
    moments = np.arange(0.0, 1.5 * plan.makespan_s + 120.0, STEP_S)
    tracks = []
    for vehicle, name, left in zip(plan.vehicles, names, left_s, strict=True):
        sortie = vehicle.sorties[0]
        places = [(sortie.home_lat_deg, sortie.home_lon_deg), *((w.lat_deg, w.lon_deg) for w in sortie.waypoints)]
        east_north = grid.to_grid(*np.array(places).T) - CORNER
        path = np.column_stack([east_north[[0, 0, *range(1, len(places))]], np.zeros(len(places) + 1)])
        path[1:, 2] = [sortie.takeoff_height_m, *(w.height_m for w in sortie.waypoints)]
        path = np.vstack([path, [*path[0, :2], 0.0]])
        motion = Motion(autopilot=DEFAULT.times(name))
        passed = motion.times(path)
        times, path = motion.course(path)
        behind = np.interp(times, passed[[0, 1, 3, -3, -2, -1]], [0.0, *left])
        at = np.maximum.accumulate(sortie.start_s + times + behind)
        track = np.stack([np.interp(moments, at, path[:, axis], np.nan, np.nan) for axis in range(3)], 1)
        track[~(track[:, 2] > GROUND_M)] = np.nan
        tracks.append(track)
    return tracks


def met(tracks: list[Array], homes: Array) -> tuple[int, int, float]:
    """How many pairs met, how many around a start that they share, and the nearest of the first ones, metres."""
    count, started, nearest = 0, 0, np.inf
    for one, other in combinations(range(len(tracks)), 2):
        p, q = tracks[one], tracks[other]
        apart, height = np.hypot(*(p[:, :2] - q[:, :2]).T), np.abs(p[:, 2] - q[:, 2])
        close = (apart < 10.0) & (height < 4.5)
        if np.hypot(*(homes[one] - homes[other])) < PAD_M:
            at_start = np.hypot(*(p[:, :2] - homes[one]).T) < PAD_M
            at_start &= np.hypot(*(q[:, :2] - homes[other]).T) < PAD_M
            started += bool((close & at_start).any())
            close &= ~at_start
        if close.any():
            count, nearest = count + 1, min(nearest, float(apart[close].min()))
    return count, started, nearest


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--side", type=float, default=890.0, metavar="M", help="of the square area (default 890)")
    parser.add_argument("--seeds", type=int, default=10, help="flights of each plan (default 10)")
    parser.add_argument(
        "--in-turn-share", type=float, metavar="X", default=PLANNING.in_turn_share,
        help="take off and land in turn if it takes at most so much longer (-1 never, 99 always; default as plans do)",
    )  # fmt: skip
    args = parser.parse_args()
    grid = LocalGrid(32632)
    corner = np.array([[0, 0], [args.side, 0], [args.side, args.side], [0, args.side]]) + CORNER
    area = Area(grid, shapely.Polygon(corner), shapely.MultiPolygon())
    start = grid.to_geographic(CORNER + np.array([-20.0, 0.5 * args.side]))
    print("| vehicles | start | fleet | plan by | makespan s | pairs | met | nearest m | met at the start |")
    print("|---|---|---|---|---|---|---|---|---|")
    for vehicles in (3, 4, 8, 16, 32):
        for where, starts in (("own", []), ("one", [(float(start[0]), float(start[1]))])):
            for fleet, kinds in (("ArduCopter", ["ardupilot"]), ("PX4", ["px4"]), ("mixed", ["ardupilot", "px4"])):
                names = [kinds[k % len(kinds)] for k in range(vehicles)]
                for model, options in plans_of(kinds, starts, args.in_turn_share):
                    plan = plan_area(area, vehicles, 60.0, footprint(60.0, np.radians(75.0)), options=options)
                    homes = [(v.sorties[0].home_lat_deg, v.sorties[0].home_lon_deg) for v in plan.vehicles]
                    places = grid.to_grid(*np.array(homes).T) - CORNER
                    count, started, nearest = 0, 0, np.inf
                    for seed in range(args.seeds):
                        left = left_over(names, np.random.default_rng(seed))
                        found, at_start, least = met(flown_tracks(plan, names, left), places)
                        count, started, nearest = count + found, started + at_start, min(nearest, least)
                    pairs = vehicles * (vehicles - 1) // 2 * args.seeds
                    shown = "" if np.isinf(nearest) else f"{nearest:.1f}"
                    print(
                        f"| {vehicles} | {where} | {fleet} | {model} | {plan.makespan_s:.0f} | {pairs} | {count} | "
                        f"{shown} | {started} |",
                        flush=True,
                    )


def plans_of(
    kinds: Sequence[str], starts: list[tuple[float, float]], share: float = PLANNING.in_turn_share
) -> list[tuple[str, PlanOptions]]:
    """Plans to compare: their name, and the options of the flights."""
    times = [DEFAULT.times(kind) for kind in kinds]
    slack_s = max(t.schedule_slack_s for t in times)
    apart = Separation(slack_s=slack_s, in_turn_share=share)
    slowest = Motion(autopilot=min(times, key=lambda t: t.acceleration_m_s2))
    return [
        *(
            (f"constant speed, {allowed:g} s", PlanOptions(motion=constant_speed(), starts=starts, separation=apart))
            for allowed in (3.0, 20.0)
            for apart in [Separation(slack_s=allowed, in_turn_share=share)]
        ),
        (
            f"autopilots' times, {slack_s:g} s",
            PlanOptions(motion=slowest, autopilots=times, starts=starts, separation=apart),
        ),
    ]


if __name__ == "__main__":
    main()
