"""How far the coverage layer can be trusted: random swarm flights with faults against what their true cameras saw.

    python -m benchmarks.robustness.coverage_faults --flights 100

No picture is rendered: a plan is flown in geometry, some of it fails, and pictures are placed with the errors that
they state (blur is taken as known, not measured). Truth is Camera.project of the true cameras at the
centres of the cells. The gaps are then flown again, without faults.
"""

import argparse
import json
import math
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from gcs_plugin.plans.plan_request import gap_area, read_gaps
from orthoswarm.coverage.coverage_files import write_gaps
from orthoswarm.coverage.coverage_grid import Cells, CellState, CoverageGrid
from orthoswarm.coverage.gaps import PlannedFlight, find_gaps
from orthoswarm.coverage.missing_pictures import CameraEvent, Cause, missing_by_events
from orthoswarm.coverage.planning_lens import planning_fovs_deg
from orthoswarm.coverage.view import NO_FLAW, Flaw, View
from orthoswarm.model.camera import Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.plan import Plan
from orthoswarm.planning.area.area import Area
from orthoswarm.planning.lines.line_spacing import Footprint, footprint
from orthoswarm.planning.planner import plan_area, plan_gaps
from orthoswarm.planning.sorties.assignment import PlanOptions

EPSG = 32632
CORNER = np.array([600_000.0, 5_300_000.0])
FAULTS = ("missed triggers", "cut leg", "lost vehicle", "narrow lens", "wind", "drift", "blur", "dead link")
_WIDTH, _HEIGHT = 1600, 1200
_WIND_M_S, _SPEED_M_S = 12.0, 15.0
_ROUNDS = 4


@dataclass(frozen=True)
class Shot:
    """A picture: the camera as it was, and as it was placed."""

    true: Camera
    view: View
    sharp: bool


@dataclass(frozen=True)
class Flown:
    """What a flight gave: the pictures that arrived, the camera events, and numbers of the pictures that did not."""

    shots: list[Shot]
    events: list[CameraEvent]
    not_arrived: set[str]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One flight: shares of the area.

    Attributes:
        faults: what happened. seen: said to be seen. falsely_seen: said so and not true. falsely_missed: said to be
            missed though a true camera saw it well. doubtful: said to be seen poorly though it was seen well.
        named: share of the pictures behind a dead link that were listed by their number (1 without any).
        misnamed: pictures listed so that were not taken.
        after: truly seen well after the gap flights. pictures: how many. ms: time a picture, milliseconds of CPU.
    """

    faults: tuple[str, ...]
    seen: float
    falsely_seen: float
    falsely_missed: float
    doubtful: float
    named: float
    misnamed: int
    after: float
    pictures: int
    ms: float


def simulate(seed: int, side_m: float = 500.0) -> Outcome:
    """Plan, fly with random faults, look, fly the gaps."""
    rng = np.random.default_rng(seed)
    faults = tuple(str(f) for f in rng.choice(FAULTS, rng.integers(1, 4), replace=False))
    area = _area(rng, side_m)
    height, fov_deg = float(rng.uniform(60.0, 110.0)), float(rng.uniform(50.0, 75.0))
    foot = footprint(height, math.radians(fov_deg))
    vehicles = int(rng.integers(2, 5))
    plan = plan_area(area, vehicles, height, foot)
    true_fov = fov_deg * (rng.uniform(0.6, 0.8) if "narrow lens" in faults else rng.uniform(1.0, 1.1))
    flown = _fly(plan, area.grid, rng, faults=faults, fov_deg=true_fov)
    shots = flown.shots
    cells = Cells.of_area(EPSG, area.ground, area.no_fly)
    cover = CoverageGrid(cells)
    views = [s.view for s in shots]
    cover.put(views[:1])
    start = time.process_time()
    cover.put(views[1:])
    spent = (time.process_time() - start) / max(1, len(views) - 1)
    truth = _truly_seen(cells, shots)
    said = cover.states()
    wanted = cells.wanted
    solved = footprint(height, math.radians(min(planning_fovs_deg(cover.views).values())))
    missing, _ = missing_by_events(cover.views, flown.events)
    listed = {m.view.image for m in missing if m.cause is Cause.NOT_ARRIVED}
    after = _fly_gaps(plan, cover, truth, solved=solved, rng=rng, fov_deg=true_fov, planned=foot, events=flown.events)
    return Outcome(
        faults=faults,
        seen=float((said == CellState.SEEN)[wanted].mean()),
        falsely_seen=float(((said == CellState.SEEN) & ~truth)[wanted].mean()),
        falsely_missed=float(((said == CellState.MISSED) & truth)[wanted].mean()),
        doubtful=float(((said == CellState.POOR) & truth)[wanted].mean()),
        named=len(listed & flown.not_arrived) / max(1, len(flown.not_arrived)) if flown.not_arrived else 1.0,
        misnamed=len(listed - flown.not_arrived),
        after=after,
        pictures=len(shots),
        ms=1e3 * spent,
    )


def _area(rng: np.random.Generator, side_m: float) -> Area:
    """A random blob, now and then with a hole that must not be flown over."""
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, 9))
    radius = 0.5 * side_m * rng.uniform(0.6, 1.0, 9)
    ring = CORNER + 0.5 * side_m + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    ground = shapely.Polygon(ring).buffer(0.05 * side_m)
    hole = shapely.Point(*(CORNER + side_m * rng.uniform(0.4, 0.6, 2))).buffer(0.04 * side_m, quad_segs=2)
    no_fly = shapely.MultiPolygon([hole] if rng.random() < 0.3 else [])
    left = ground.difference(no_fly)
    return Area(LocalGrid(EPSG), shapely.MultiPolygon(list(shapely.get_parts(left))), no_fly)


def _fly(
    plan: Plan, grid: LocalGrid, rng: np.random.Generator, *, faults: tuple[str, ...], fov_deg: float, first: int = 0
) -> Flown:
    """Pictures of a plan's legs; faults hit the first vehicle, wind all of them.

    Behind a dead link pictures are taken and do not arrive; their camera events come over the vehicle's other link.
    """
    lens = Lens(_WIDTH, _HEIGHT, focal_px(math.radians(fov_deg), _WIDTH))
    believed = Lens(_WIDTH, _HEIGHT, lens.focal_px * (1.0 + 0.001 * rng.standard_normal()))
    wind = rng.uniform(0.0, 2.0 * np.pi)
    shots: list[Shot] = []
    events: list[CameraEvent] = []
    not_arrived: set[str] = set()
    number = first
    for vehicle in plan.vehicles:
        hit = vehicle.number == 1
        legs = [leg for s in vehicle.sorties for leg in s.legs]
        lost = int(rng.integers(0, len(legs))) if hit and "lost vehicle" in faults else len(legs)
        dead = int(rng.integers(0, len(legs))) if hit and "dead link" in faults else len(legs)
        cut = int(rng.integers(0, len(legs))) if hit and "cut leg" in faults else -1
        for k, leg in enumerate(legs[:lost]):
            ends = grid.to_grid([w.lat_deg for w in leg], [w.lon_deg for w in leg])
            way = ends[1] - ends[0]
            length = float(np.hypot(*way))
            count = int(length / plan.trigger_m + 1e-6) + 1
            along = np.arange(count) * plan.trigger_m
            if k == cut:
                along = along[along < rng.uniform(0.2, 0.8) * length]
            keep = np.ones(len(along), bool)
            if hit and "missed triggers" in faults and rng.random() < 0.5 and len(along):
                begin = rng.integers(0, len(along))
                keep[begin : begin + rng.integers(1, 12)] = False
            heading = math.atan2(way[0], way[1])
            crab = 0.0
            if "wind" in faults:
                crab = math.asin(_WIND_M_S / _SPEED_M_S * math.sin(wind - heading))
            sigma = float(rng.uniform(0.05, 0.3)) if not (hit and "drift" in faults) else 3.0
            bias = sigma * rng.standard_normal(2)
            for a, kept in zip(along, keep, strict=True):
                number += 1
                if not kept:
                    continue
                at = np.array([*(ends[0] + a * way / length), plan.altitude_m]) + rng.normal(0.0, 0.3, 3)
                tilt = rng.normal(0.0, math.radians(1.0), 2)
                turn = rotation_from_angles(heading - crab, -math.pi / 2 + tilt[0], tilt[1])
                true = Camera(at, turn, lens)
                placed = Camera(at + np.append(bias, 0.0), turn, believed)
                sharp = not ("blur" in faults and rng.random() < 0.1)
                view = View.of_camera(
                    placed, f"DJI_{number:05d}.JPG", vehicle.id, sigma, 10.0 * number, focal_sigma=0.001,
                    flaws=NO_FLAW if sharp else Flaw.BLURRED, recorded_height_m=plan.altitude_m,
                )  # fmt: skip
                at_m = np.array([*(at[:2] + rng.normal(0.0, 1.0, 2)), 0.0])
                events.append(CameraEvent(vehicle.id, number, 10.0 * number + float(rng.normal(0.0, 0.5)), at_m))
                if k < dead:
                    shots.append(Shot(true, view, sharp))
                else:
                    not_arrived.add(f"event {number}")
    return Flown(shots, events, not_arrived)


def _truly_seen(cells: Cells, shots: list[Shot]) -> NDArray[np.bool_]:
    """Cells whose centre a true camera with a sharp picture has in its picture, at most 45 degrees off nadir."""
    grid = cells.grid
    seen = np.zeros(cells.wanted.shape, bool)
    for shot in shots:
        if not shot.sharp:
            continue
        reach = float(shot.true.position[2])  # 45 degrees
        column, row = grid.to_pixel(shot.true.position[:2])
        r0, r1 = max(0, int(row - reach) - 1), min(grid.height, int(row + reach) + 2)
        c0, c1 = max(0, int(column - reach) - 1), min(grid.width, int(column + reach) + 2)
        if r0 >= r1 or c0 >= c1:
            continue
        columns, rows = np.meshgrid(np.arange(c0, c1), np.arange(r0, r1))
        ground = grid.to_ground(np.stack([columns, rows], -1))
        pixel = shot.true.project(np.concatenate([ground, np.zeros((*columns.shape, 1))], -1))
        steep = np.hypot(*np.moveaxis(ground - shot.true.position[:2], -1, 0)) <= reach
        inside = ((pixel >= -0.5) & (pixel <= [_WIDTH - 0.5, _HEIGHT - 0.5])).all(-1)
        seen[r0:r1, c0:c1] |= inside & steep
    return seen


def _fly_gaps(
    plan: Plan, cover: CoverageGrid, truth: NDArray[np.bool_], *, solved: Footprint, rng: np.random.Generator,
    fov_deg: float, planned: Footprint, events: list[CameraEvent],
) -> float:  # fmt: skip
    """Fly gaps without further faults until none is left; returns the share that was truly seen in the end."""
    cells, grid = cover.cells, LocalGrid(EPSG)
    seen, wanted = truth.copy(), cells.wanted
    ends = [[(w.lat_deg, w.lon_deg) for w in leg] for v in plan.vehicles for s in v.sorties for leg in s.legs]
    places = np.array(ends)
    legs = grid.to_grid(places[..., 0], places[..., 1])
    fov = 2.0 * math.atan(0.5 * planned.width_m / plan.altitude_m)
    for _ in range(_ROUNDS):
        missing, _ = missing_by_events(cover.views, events)
        gaps = find_gaps(cover, missing, PlannedFlight(legs, planned.width_m, planned.height_m, fov))
        if not gaps.gaps:
            break
        with tempfile.TemporaryDirectory() as folder:
            write_gaps(Path(folder), gaps, grid)
            found = read_gaps(Path(folder) / "gaps.geojson")
        target = gap_area(found, [], solved, fly_not_arrived=True).area
        again = plan_gaps(
            replace(target, no_fly=shapely.MultiPolygon()), 2, plan.altitude_m, solved, options=PlanOptions()
        )
        flown = _fly(again, grid, rng, faults=(), fov_deg=fov_deg, first=len(cover.views) * 10)
        cover.put(s.view for s in flown.shots)
        seen |= _truly_seen(cells, flown.shots)
        events = [*events, *flown.events]
    return float(seen[wanted].mean())


def main() -> None:
    """Run flights and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--side", type=float, default=500.0, help="extent of the areas, metres")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rows = []
    for seed in range(args.first, args.first + args.flights):
        rows.append(simulate(seed, args.side))
        r = rows[-1]
        if not args.json:
            print(
                f"{seed:4d} seen {100 * r.seen:6.2f} %  falsely seen {100 * r.falsely_seen:.3f} %  "
                f"falsely missed {100 * r.falsely_missed:.3f} %  doubtful {100 * r.doubtful:.2f} %  "
                f"after {100 * r.after:.3f} %  {r.ms:.2f} ms  {', '.join(r.faults)}",
                flush=True,
            )
    summary = {
        "flights": len(rows),
        "worst_falsely_seen": max(r.falsely_seen for r in rows),
        "worst_falsely_missed": max(r.falsely_missed for r in rows),
        "mean_doubtful": float(np.mean([r.doubtful for r in rows])),
        "least_named": min(r.named for r in rows),
        "misnamed": sum(r.misnamed for r in rows),
        "least_after": min(r.after for r in rows),
        "below_999_after": sum(r.after < 0.999 for r in rows),
        "mean_ms_a_picture": float(np.mean([r.ms for r in rows])),
    }
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
