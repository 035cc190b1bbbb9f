"""Vehicles without a basemap: python -m benchmarks.accuracy.vehicle_seams SET...

SET is a folder of `orthoswarm twin make` with several vehicles. They are refined without a basemap. A line a set: how
far ground in pictures of two neighbouring vehicles lies apart (median and largest of the pairs, metres), the error of
the ground below the pictures (median, 95 %), most of it the receivers' own, and the shares of its axes within one and
two stated sigmas.
"""

import argparse
import json
import time
from itertools import combinations
from pathlib import Path

import numpy as np

import telemetry
from orthoswarm.batch.refiners import make_refiner
from orthoswarm.evaluation.true_cameras import read_truth
from orthoswarm.model.geo import local_origin
from orthoswarm.mosaic.recorded_pose import area_grid

PAIRS = 30
"""Pairs of pictures that are compared, for each two vehicles."""


def measure(folder: Path) -> dict[str, object]:
    """What one set gives."""
    frames = telemetry.load([folder / "photos"]).frames
    grid = area_grid(frames)
    vehicles: dict[str, list] = {}
    for frame in frames:
        vehicles.setdefault(frame.vehicle, []).append(frame)
    start = time.process_time()
    fine = make_refiner("swarm", grid.epsg, local_origin(grid, frames)).refine_batch(vehicles, None).fine
    seconds = time.process_time() - start
    truth = {image: entry[2] for image, entry in read_truth(folder / "truth" / "frames.csv").items()}

    def error(solution, placed, ground):
        pixel = truth[placed.frame.image].project(np.array([[*ground, 0.0]]))
        return placed.camera.to_ground(pixel, solution.ground_z_m)[0] - ground

    jumps = []
    for one, two in combinations(fine, 2):
        a, b = (np.array([truth[p.frame.image].nadir for p in s.placed]) for s in (one, two))
        distance = np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1))
        reach = 0.8 * float(np.median([p.camera.position[2] for p in one.placed]))
        near = np.argwhere(distance < reach)
        for i, j in near[np.linspace(0, len(near) - 1, min(len(near), PAIRS)).astype(int)]:
            ground = 0.5 * (a[i] + b[j])
            jumps.append(np.hypot(*(error(one, one.placed[i], ground) - error(two, two.placed[j], ground))))
    axes = np.array([error(s, p, truth[p.frame.image].nadir) for s in fine for p in s.placed])
    sigma = np.array([p.sigma_m for s in fine for p in s.placed])
    errors = np.hypot(*axes.T)
    return {
        "set": folder.name, "vehicles": len(fine), "pictures": len(errors), "pairs": len(jumps),
        "jump_median_m": round(float(np.median(jumps)), 2), "jump_most_m": round(float(np.max(jumps)), 2),
        "median_m": round(float(np.median(errors)), 2), "p95_m": round(float(np.percentile(errors, 95)), 2),
        "sigma_m": round(float(np.median(sigma)), 2),
        "axis_1": round(100 * float((np.abs(axes) <= sigma[:, None]).mean())),
        "axis_2": round(100 * float((np.abs(axes) <= 2 * sigma[:, None]).mean())), "cpu_s": round(seconds, 1),
    }  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", type=Path)
    for folder in parser.parse_args().sets:
        print(json.dumps(measure(folder)), flush=True)


if __name__ == "__main__":
    main()
