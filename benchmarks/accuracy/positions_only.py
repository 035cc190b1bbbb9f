"""Photos with nothing but positions: how well they are placed, also where the aircraft turns.

    python -m benchmarks.accuracy.positions_only SET... [--every 1 2]

SET is a folder of `orthoswarm twin make`. Heights and angles are removed from its records, and with `--every N` all but
every Nth photo of each vehicle. A line for each: errors of the photos' middles and of the worst of their corners on the
stated plane against the true cameras, and how many photos are held weakly (drawn only where no other shows the ground).
"""

import argparse
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

import telemetry
from orthoswarm.batch.refiners import make_refiner
from orthoswarm.evaluation.true_cameras import read_truth
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import local_origin
from orthoswarm.mosaic.extent import from_takeoff, solved_level
from orthoswarm.mosaic.recorded_pose import area_grid
from orthoswarm.raster.basemap import Basemap


def bare(frame: Frame) -> Frame:
    """A frame with its position alone."""
    fix = replace(frame.fix, height_m=None, altitude_m=None)
    return replace(frame, fix=replace(fix, yaw_rad=None, pitch_rad=None, roll_rad=None, flight_yaw_rad=None))


def measure(folder: Path, every: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Errors of the middles and of the worst corners, metres, and the number of photos that are held weakly."""
    frames = [bare(frame) for frame in telemetry.load([folder / "photos"]).frames]
    grid = area_grid(frames)
    vehicles: dict[str, list[Frame]] = defaultdict(list)
    for frame in frames:
        vehicles[frame.vehicle].append(frame)
    some = {vehicle: own[::every] for vehicle, own in vehicles.items()}
    refiner = make_refiner("swarm", grid.epsg, local_origin(grid, frames))
    refinement = refiner.refine_batch(some, Basemap.open(folder / "basemap.tif", grid.epsg))
    placed = [p for solution in refinement.fine for p in solution.placed]
    taken, level = from_takeoff(placed, solved_level(refinement.fine), refinement.terrain)
    truth = read_truth(folder / "truth" / "frames.csv")
    middle, corner = [], []
    for p in taken:
        true = truth[p.frame.image][2]
        place = np.array(true.lens.principal_point)
        middle.append(np.hypot(*(p.camera.to_ground(place, level) - true.to_ground(place, level))))
        corner.append(np.hypot(*(p.camera.corners(level) - true.corners(level)).T).max())
    return np.array(middle), np.array(corner), sum(p.weak for p in taken)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--every", nargs="+", type=int, default=[1])
    args = parser.parse_args()
    print("| set | photos | middle: median, 95 %, most, m | corner: median, 95 %, most, m | held weakly |")
    print("|---|---|---|---|---|")
    for folder in args.sets:
        for every in args.every:
            *errors, weak = measure(folder, every)
            said = [f"{np.median(e):.2f}, {np.percentile(e, 95):.2f}, {e.max():.2f}" for e in errors]
            which = "all" if every == 1 else f"1 of {every}"
            print(f"| {folder.name} | {which}: {len(errors[0])} | {said[0]} | {said[1]} | {weak} |")


if __name__ == "__main__":
    main()
