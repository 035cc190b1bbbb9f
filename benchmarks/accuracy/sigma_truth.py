"""Is the stated error true? Shares of pictures within one and two `sigma_m`, on maps that are right and distorted ones.

    python -m benchmarks.accuracy.sigma_truth SET... [--kinds plain season 2x150 ...] [--fields N] [--out FILE.jsonl]

SET is a folder of `orthoswarm twin make`. A kind `AxL` is the set's basemap warped by a smooth random field: its
displacements have a root mean square length of A metres and a Gaussian correlation of length L metres. The truth stays,
so that `sigma_m` has to cover what the map is wrong by. A set of a few hundred metres shows a handful of independent
places of such a field only, so that shares are counted over `--fields` of them. A line a set and kind: the error of the
pictures' middles on the stated plane, and the shares of it within one and two sigma, of each axis and of its length.

`plane_rms_m` is the error of homographies over whole pictures (root mean square of its length) against the true cameras
on the true plane of the same height over takeoff, `ground_rms_m` on the true ground's median level: the two differ by
what the stated height of the ground is off.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

import telemetry
from benchmarks.robustness.wrong_maps import altered, season
from orthoswarm.batch.refiners import make_refiner
from orthoswarm.evaluation.true_cameras import read_truth, true_ground_level
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import local_origin
from orthoswarm.mosaic.extent import from_takeoff, solved_level
from orthoswarm.mosaic.recorded_pose import area_grid
from orthoswarm.raster.basemap import Basemap

KINDS = ("plain", "season", "1x50", "1x150", "1x300", "2x150", "3x50", "3x150", "3x300")


def warped(picture, gsd_m, rms_m, length_m, seed=1):
    """A map (bands, rows, columns) whose content is displaced by a smooth random field."""
    rows, columns = picture.shape[1:]
    step = max(1, round(length_m / gsd_m / 8))  # the field is smooth: it is drawn on a coarse grid
    sigma = length_m / gsd_m / step / np.sqrt(2)  # white noise blurred by this has that correlation length
    margin = int(np.ceil(4 * sigma))
    size = (-(-rows // step) + 2 * margin, -(-columns // step) + 2 * margin)
    random = np.random.default_rng(seed)
    field = []
    for _ in range(2):
        smooth = cv2.GaussianBlur(random.normal(size=size), (0, 0), sigma)
        smooth *= 2 * np.sqrt(np.pi) * sigma * rms_m / np.sqrt(2) / gsd_m
        inner = smooth[margin:-margin, margin:-margin].astype(np.float32)
        field.append(cv2.resize(inner, (columns, rows), interpolation=cv2.INTER_CUBIC))
    column, row = np.meshgrid(np.arange(columns, dtype=np.float32), np.arange(rows, dtype=np.float32))
    moved = [
        cv2.remap(b, column + field[0], row + field[1], cv2.INTER_LINEAR, None, cv2.BORDER_REFLECT) for b in picture
    ]
    return np.stack(moved)


def write_map(source, target, kind, field=1):
    """The set's basemap, or a changed one, as a file; field: which random field it is warped by."""
    if kind in ("plain", "season"):
        altered(source, target, season if kind == "season" else lambda picture, _: picture)
        return
    rms_m, length_m = (float(v) for v in kind.split("x"))
    altered(source, target, lambda picture, gsd_m: warped(picture, gsd_m, rms_m, length_m, field))


GRID = np.stack(np.meshgrid(np.linspace(0.0, 1.0, 7), np.linspace(0.0, 1.0, 7)), -1).reshape(-1, 2)
"""Places in a picture at which homographies are compared, as shares of its width and height."""


def refined(folder, basemap_file):
    """What a set's pictures have with a map.

    Errors (n, 2), stated errors (n,), stages, states of the legs, CPU seconds, mean squares (n, 2) of the homographies'
    errors at the stated height and on the true ground.
    """
    frames = telemetry.load([folder / "photos"]).frames
    grid = area_grid(frames)
    vehicles: dict[str, list[Frame]] = {}
    for frame in frames:
        vehicles.setdefault(frame.vehicle, []).append(frame)
    start = time.process_time()
    refiner = make_refiner("swarm", grid.epsg, local_origin(grid, frames))
    refinement = refiner.refine_batch(vehicles, Basemap.open(basemap_file, grid.epsg))
    seconds = time.process_time() - start
    truth = read_truth(folder / "truth" / "frames.csv")
    placed = [p for solution in refinement.fine for p in solution.placed]
    taken, level = from_takeoff(placed, solved_level(refinement.fine), refinement.terrain)
    true_level = true_ground_level(folder / "truth" / "dtm.tif", [truth[p.frame.image][2] for p in taken])
    error, square = [], []
    for p in taken:
        true = truth[p.frame.image][2]
        middle = np.array(true.lens.principal_point)
        error.append(p.camera.to_ground(middle, level) - true.to_ground(middle, level))
        pixels = GRID * [true.lens.width - 1, true.lens.height - 1]
        there = p.camera.to_ground(pixels, level)
        square.append([((there - true.to_ground(pixels, z)) ** 2).sum(1).mean() for z in (level, true_level)])
    states = [leg.state for solution in refinement.fine for leg in solution.legs]
    sigma = np.array([p.sigma_m for p in taken])
    return np.array(error), sigma, [p.stage for p in taken], states, seconds, np.array(square)


def measure(folder, kind, fields):
    """Errors and stated errors of a set with a kind of map, over its random fields together."""
    runs = []
    for field in range(1, fields + 1) if "x" in kind else (1,):
        with tempfile.TemporaryDirectory() as scratch:
            target = Path(scratch) / "map.tif"
            write_map(folder / "basemap.tif", target, kind, field)
            runs.append(refined(folder, target))
    error, sigma = (np.concatenate([run[k] for run in runs]) for k in (0, 1))
    stages, states = ([value for run in runs for value in run[k]] for k in (2, 3))
    length = np.hypot(*error.T)
    plane, ground = np.sqrt(np.concatenate([run[5] for run in runs]).mean(axis=0))
    return {
        "pictures": len(error), "fine": stages.count("fine"), "matched": states.count("matched"),
        "legs": len(states), "median_m": round(float(np.median(length)), 3),
        "p95_m": round(float(np.percentile(length, 95)), 3), "sigma_m": round(float(np.median(sigma)), 3),
        "axis_1": share(np.abs(error), sigma[:, None]), "axis_2": share(np.abs(error), 2 * sigma[:, None]),
        "length_1": share(length, sigma), "length_2": share(length, 2 * sigma),
        "plane_rms_m": round(float(plane), 3), "ground_rms_m": round(float(ground), 3),
        "cpu_s": round(sum(run[4] for run in runs), 1),
    }  # fmt: skip


def share(error, limit):
    """Percentage of errors within a limit."""
    return round(100 * float((error <= limit).mean()))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--kinds", nargs="+", default=KINDS)
    parser.add_argument("--fields", type=int, default=1, metavar="N", help="random fields of each kind AxL (1)")
    parser.add_argument("--out", type=Path, help="lines are added to this file")
    args = parser.parse_args()
    for folder in args.sets:
        for kind in args.kinds:
            row = {"set": folder.name, "map": kind, **measure(folder, kind, args.fields)}
            print(json.dumps(row), flush=True)
            if args.out:
                with args.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
