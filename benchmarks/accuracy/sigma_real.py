"""Is the stated error true on real photos? Shares of errors within one and two `sigma_m`.

    python -m benchmarks.accuracy.sigma_real PHOTOS --map MAP.tif [--kinds plain season 1x50 ...] [--out FILE.jsonl]
    python -m benchmarks.accuracy.sigma_real PHOTOS --points GCP_LIST.txt [--pixel-scale S] [--out FILE.jsonl]

With `--map` the photos are mapped on MAP and the orthoimage is compared with it, block by block. Kinds are those of
`sigma_truth`: the photos are mapped on the map changed to another season or warped by random fields, and compared with
the unchanged one. A block belongs to the photo that the orthoimage shows at its middle (seamlines.gpkg), whose
`sigma_m` is compared with the median displacement of that photo's blocks, since errors of one photo are alike. What a
median is displaced by contains the noise of the comparison and the lean of what stands on the ground: `noise_m` is its
sigma (an axis), by the spread of the blocks within a photo.

With `--points` the photos are mapped without a map. A line for each number of control points, 0 to all but one: every
choice of them moves the block, the others are checked. Their errors contain the survey's own, which is added in squares
to the median `sigma_m` of the photos that show them.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from itertools import combinations
from pathlib import Path

import numpy as np
import pyogrio
import rasterio
import shapely
from rasterio.enums import Resampling
from rasterio.transform import from_origin
from rasterio.vrt import WarpedVRT

import telemetry
from benchmarks.accuracy.sigma_truth import share, write_map
from orthoswarm.batch.refiners import make_refiner
from orthoswarm.control.control_observations import in_photos
from orthoswarm.control.ground_control import place_on_control
from orthoswarm.evaluation.checkpoints import SURVEY_SIGMA_M, read_checkpoints
from orthoswarm.evaluation.displacement import FieldSettings, displacement_field
from orthoswarm.evaluation.photo_names import photo_named
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import local_origin
from orthoswarm.model.robust import mad_sigma
from orthoswarm.mosaic.recorded_pose import area_grid

BLOCK_SHARE, STEP_SHARE, SEARCH_SHARE = 0.2, 0.1, 0.05
"""Side of a block, distance of blocks and search, as shares of the flying height."""
FEWEST = 3
"""Fewest blocks of a photo that is counted."""


def mapped(photos, basemap, out):
    """The output folder of `mosaic`."""
    command = [sys.executable, "-m", "gcs_plugin.cli.main", "mosaic", str(photos), "--out", str(out)]
    command += [] if basemap is None else ["--basemap", str(basemap)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return out


def grey_on(file, crs, west, north, shape, gsd_m):
    """Grey values and validity of a raster on a grid."""
    coarser = file.transform.a < 0.7 * gsd_m
    with WarpedVRT(
        file, crs=crs, transform=from_origin(west, north, gsd_m, gsd_m), height=shape[0], width=shape[1],
        resampling=Resampling.average if coarser else Resampling.cubic,
        add_alpha=file.nodata is None and file.count in (1, 3),
    ) as view:  # fmt: skip
        data = view.read(list(range(1, min(view.count, 3) + 1))).astype(np.float32)
        return data.mean(axis=0), view.dataset_mask() > 0


def displacements(out, reference, height_m):
    """Middles (n, 2) of blocks on the ground and their displacements (n, 2), metres, of those that found a place."""
    with rasterio.open(out / "orthoimage.tif") as ortho, rasterio.open(reference) as other:
        gsd_m = max(ortho.transform.a, 0.3 * height_m / 60.0)
        west, south, east, north = ortho.bounds
        shape = (int((north - south) / gsd_m), int((east - west) / gsd_m))
        grid = (ortho.crs, west, north, shape, gsd_m)
        ours, theirs = grey_on(ortho, *grid), grey_on(other, *grid)
    settings = FieldSettings(
        gsd_m=gsd_m, block_m=BLOCK_SHARE * height_m, step_m=STEP_SHARE * height_m, search_m=SEARCH_SHARE * height_m,
        apart_m=0.03 * height_m,
    )  # fmt: skip
    field = displacement_field(*ours, *theirs, settings=settings)
    found = field.matched
    middle = field.position[found] + 0.5
    return np.column_stack([west + gsd_m * middle[:, 0], north - gsd_m * middle[:, 1]]), field.shift_m[found]


def by_photo(out, place, shift):
    """Median displacement (n, 2) of each photo's blocks, its noise (an axis) and the photo's `sigma_m`."""
    _, _, wkb, columns = pyogrio.raw.read(out / "seamlines.gpkg", layer="seamlines", columns=["sigma_m"])
    shapes, sigma = shapely.from_wkb(wkb), columns[0]
    points = shapely.points(place)
    error, noise, stated = [], [], []
    for shape, s in zip(shapes, sigma, strict=True):
        mine = shift[shapely.contains(shape, points)]
        if len(mine) >= FEWEST:
            error.append(np.median(mine, axis=0))
            noise.append(1.25 * mad_sigma(mine - error[-1]) / np.sqrt(0.5 * len(mine)))  # blocks overlap by half
            stated.append(s)
    return np.array(error), np.array(noise), np.array(stated)


def flying_height(out):
    """Median height of the cameras over the ground, metres, of an output folder."""
    frames = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    level = json.loads((out / "report.json").read_text())["ground_z_m"]
    return float(np.median([f["camera"]["height_m"] - level for f in frames if f.get("camera")]))


def at_points(photos, table, pixel_scale):
    """Rows for each number of control points."""
    frames = telemetry.load([photos]).frames
    grid = area_grid(frames)
    vehicles: dict[str, list[Frame]] = {}
    for frame in frames:
        vehicles.setdefault(frame.vehicle, []).append(frame)
    refined = make_refiner("swarm", grid.epsg, local_origin(grid, frames)).refine_batch(vehicles, None)
    points, survey_m = read_checkpoints(table, pixel_scale), SURVEY_SIGMA_M
    for count in range(len(points)):
        error, sigma = [], []
        for chosen in combinations(points, count):
            moved = place_on_control(refined, list(chosen), grid, None)[0] if chosen else refined
            placed = {p.frame.image: p for s in moved.fine for p in s.placed}
            assert moved.terrain is not None
            checked = [p for p in points if p not in chosen]
            for found in in_photos(checked, list(placed.values()), moved.terrain, grid, False):
                marks = next(p.marks for p in points if p.name == found.name)
                own = [placed[name].sigma_m for m in marks if (name := photo_named(placed, m.image))]
                error.append(found.placed - found.surveyed)
                sigma.append(np.hypot(np.median(own), survey_m))
        yield {"control": count, "checked": len(error), **figures(np.array(error), np.array(sigma))}


def on_map(photos, true_map, kind, fields, scratch):
    """Shares of the photos' errors within sigma, over all fields of a kind."""
    runs = []
    for field in range(1, fields + 1) if "x" in kind else (1,):
        basemap = true_map
        if kind != "plain":
            basemap = scratch / f"map-{kind}-{field}.tif"
            write_map(true_map, basemap, kind, field)
        out = mapped(photos, basemap, scratch / f"out-{kind}-{field}")
        stages = [json.loads(line)["stage"] for line in (out / "frames.jsonl").read_text().splitlines()]
        runs.append((*by_photo(out, *displacements(out, true_map, flying_height(out))), stages))
    error, noise, sigma = (np.concatenate([run[k] for run in runs]) for k in range(3))
    fine = sum(run[3].count("fine") for run in runs)
    return {
        "map": kind, "photos": len(error), "fine": fine, "noise_m": round(float(np.median(noise)), 3),
        **figures(error, sigma),
    }  # fmt: skip


def figures(error, sigma):
    """Errors (n, 2) and what was stated (n,), summed up."""
    length = np.hypot(*error.T)
    return {
        "median_m": round(float(np.median(length)), 3), "p95_m": round(float(np.percentile(length, 95)), 3),
        "sigma_m": round(float(np.median(sigma)), 3),
        "axis_1": share(np.abs(error), sigma[:, None]), "axis_2": share(np.abs(error), 2 * sigma[:, None]),
        "length_1": share(length, sigma), "length_2": share(length, 2 * sigma),
    }  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--map", type=Path)
    parser.add_argument("--points", type=Path)
    parser.add_argument("--pixel-scale", type=float, default=1.0, help="pixels of PHOTOS to one of the marks")
    parser.add_argument("--kinds", nargs="+", default=["plain"])
    parser.add_argument("--fields", type=int, default=1, metavar="N", help="random fields of each kind AxL (1)")
    parser.add_argument("--out", type=Path, help="lines are added to this file")
    args = parser.parse_args()
    if (args.points is None) == (args.map is None):
        parser.error("give either --map or --points")
    with tempfile.TemporaryDirectory() as scratch:
        rows = (
            (on_map(args.photos, args.map, kind, args.fields, Path(scratch)) for kind in args.kinds)
            if args.map
            else at_points(args.photos, args.points, args.pixel_scale)
        )
        for row in rows:
            line = json.dumps({"set": args.photos.name, **row})
            print(line, flush=True)
            if args.out:
                with args.out.open("a", encoding="utf-8") as file:
                    file.write(line + "\n")


if __name__ == "__main__":
    main()
