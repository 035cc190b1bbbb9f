"""Wrong maps are refused, right ones are not: what the refiner accepts of maps that show other ground.

    python -m benchmarks.robustness.wrong_maps SET... --out DIR [--gsd M] [--town OTHER_SET] [--kinds mirror_ns ...]

SET is a folder of `orthoswarm twin make`. Each kind of map is made of the set's basemap, averaged to --gsd if given,
lies at the same place and is given to a refiner. A line a run: how many legs are `refine_matched`, `carried`, `failed`,
how many pictures are `fine`, and the median error of their middles on the ground.
"""

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.enums import Resampling

import telemetry
from orthoswarm.batch.refiners import make_refiner
from orthoswarm.evaluation.true_cameras import read_truth
from orthoswarm.model.frame import Frame
from orthoswarm.model.geo import local_origin
from orthoswarm.mosaic.recorded_pose import area_grid
from orthoswarm.raster.basemap import Basemap

QUARTER_M = 300.0
"""How far another quarter of the same town is away."""


def mirror_ns(picture, _):
    return picture[:, ::-1]


def mirror_ew(picture, _):
    return picture[:, :, ::-1]


def turned_90(picture, _):
    """Turned about its middle; a part that is missing of an oblong map is filled with its mirror image."""
    rows, columns = picture.shape[1:]
    side = max(rows, columns)
    square = np.pad(picture, ((0, 0), (0, side - rows), (0, side - columns)), mode="symmetric")
    return np.rot90(square, axes=(1, 2))[:, :rows, :columns]


def turned_180(picture, _):
    return picture[:, ::-1, ::-1]


def quarter(picture, gsd_m):
    return np.roll(picture, round(QUARTER_M / gsd_m), axis=(1, 2))


def blank(picture, _):
    return np.full_like(picture, 128)


def noise(picture, _):
    """Blobs of all sizes, without any line."""
    random = np.random.default_rng(5)
    total = np.zeros(picture.shape[1:], np.float32)
    for size in (1, 3, 10, 30):
        blobs = cv2.GaussianBlur(np.asarray(random.normal(size=total.shape), np.float32), (0, 0), size)
        total += blobs / float(blobs.std())
    gray = np.clip(128 + 30 * total, 0, 255).astype(np.uint8)
    return np.repeat(gray[None], len(picture), axis=0)


def right(picture, _):
    return picture


def darkened(picture, _):
    return (255 * (picture / 255.0) ** 2 * 0.5).astype(np.uint8)


def season(picture, _):
    """Another season and sensor: colours change places, green ground turns brown, light is flat and the air hazy."""
    red, green, blue = (band.astype(np.float32) for band in picture[:3])
    lit = np.stack([0.8 * green + 60, 0.5 * red + 0.3 * blue + 50, 0.6 * red + 40])
    vegetation = np.clip((green - 0.5 * (red + blue)) / 40.0, 0, 1)
    lit = lit * (1 - 0.5 * vegetation) + 60 * vegetation
    lit = np.stack([cv2.GaussianBlur(band, (0, 0), 1.2) for band in lit])
    lit += np.random.default_rng(3).normal(0, 4, lit.shape)
    return np.clip(lit, 0, 255).astype(np.uint8)


WRONG = {f.__name__: f for f in (mirror_ns, mirror_ew, turned_90, turned_180, quarter, blank, noise)}
RIGHT = {f.__name__: f for f in (right, darkened, season)}


def averaged(source: Path, target: Path, gsd_m: float) -> None:
    """Write a map averaged to a ground pixel."""
    with rasterio.open(source) as file:
        shape = (max(2, round(file.height * file.res[1] / gsd_m)), max(2, round(file.width * file.res[0] / gsd_m)))
        picture = file.read(out_shape=(file.count, *shape), resampling=Resampling.average)
        place = file.transform * file.transform.scale(file.width / shape[1], file.height / shape[0])
        profile = {"crs": file.crs, "count": file.count, "dtype": picture.dtype}
    with rasterio.open(
        target, "w", driver="GTiff", width=shape[1], height=shape[0], transform=place, **profile
    ) as file:
        file.write(picture)


def altered(source, target, change, town=None):
    """Write a map of the same place with other content (of another town's map, cut or mirrored to size, if given)."""
    with rasterio.open(source) as file:
        picture, profile = file.read(), file.profile
    if town is not None:
        with rasterio.open(town) as file:
            other = file.read()
        rows, columns = (max(0, n - m) for n, m in zip(picture.shape[1:], other.shape[1:], strict=True))
        other = np.pad(other, ((0, 0), (0, rows), (0, columns)), mode="symmetric")
        picture = other[: len(picture), : picture.shape[1], : picture.shape[2]]
    changed = picture.copy()
    changed[:3] = change(picture[:3], abs(profile["transform"].a))
    kept = {key: profile[key] for key in ("crs", "transform", "width", "height", "count", "dtype")}
    with rasterio.open(target, "w", driver="GTiff", compress="deflate", **kept) as file:
        file.write(changed)


def measure(folder, basemap_file, refiner="swarm"):
    """What the refiner makes of a set with a map."""
    frames = telemetry.load([folder / "photos"]).frames
    grid = area_grid(frames)
    basemap = Basemap.open(basemap_file, grid.epsg)
    vehicles: dict[str, list[Frame]] = {}
    for frame in frames:
        vehicles.setdefault(frame.vehicle, []).append(frame)
    start = time.process_time()
    refinement = make_refiner(refiner, grid.epsg, local_origin(grid, frames)).refine_batch(vehicles, basemap)
    seconds = time.process_time() - start
    truth = read_truth(folder / "truth" / "frames.csv")
    placed = [p for solution in refinement.fine for p in solution.placed]
    states = [leg.state for solution in refinement.fine for leg in solution.legs]
    error = []
    for p in placed:
        middle = np.array([[(p.frame.width - 1) / 2, (p.frame.height - 1) / 2]])
        error.append(np.hypot(*(p.camera.to_ground(middle) - truth[p.frame.image][2].to_ground(middle))[0]))
    return {
        **{state: states.count(state) for state in ("matched", "carried", "failed")},
        "fine": sum(p.stage == "fine" for p in placed), "pictures": len(placed),
        "median_m": round(float(np.median(error)), 3), "p95_m": round(float(np.percentile(error, 95)), 3),
        "sigma_m": round(float(np.median([p.sigma_m for p in placed])), 2), "cpu_s": round(seconds, 1),
    }  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--refine", default="swarm", choices=("swarm", "paper"))
    parser.add_argument("--town", type=Path, help="another set, whose map is given as that of another town")
    parser.add_argument("--gsd", type=float, metavar="M", help="average the maps to this ground pixel first, metres")
    parser.add_argument("--kinds", nargs="+", choices=[*WRONG, "town", *RIGHT])
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    kinds = args.kinds or [*WRONG, *(["town"] if args.town else []), *RIGHT]
    accepted = lost = 0
    with (args.out / "results.jsonl").open("a", encoding="utf-8") as results:
        for folder in args.sets:
            for kind in kinds:
                target = args.out / f"{folder.name}-{kind}.tif"
                town = args.town / "basemap.tif" if kind == "town" else None
                source = folder / "basemap.tif"
                if args.gsd:
                    averaged(source, args.out / "averaged.tif", args.gsd)
                    source = args.out / "averaged.tif"
                if town and args.gsd:
                    averaged(town, args.out / "town.tif", args.gsd)
                    town = args.out / "town.tif"
                altered(source, target, {**WRONG, **RIGHT}.get(kind, right), town)
                row = {"set": folder.name, "map": kind, **measure(folder, target, args.refine)}
                target.unlink()
                print(json.dumps(row), flush=True)
                results.write(json.dumps(row) + "\n")
                results.flush()
                if kind in RIGHT:
                    lost += row["failed"]
                else:
                    accepted += row["matched"] + row["carried"]
    print(f"legs accepted on wrong maps: {accepted}; legs lost on right ones: {lost}")


if __name__ == "__main__":
    main()
