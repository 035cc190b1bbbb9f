"""Time and memory of a swarm many times as large: one set of photos, flown again in other places.

    python -m benchmarks.speed.repeated_swarm SET --copies 4 --out DIR [--workers N] [--area-pictures N]

SET is a folder of `orthoswarm twin make`. Each copy lies beside the others as the set's own basemap repeats, and has
the same photos by symbolic links: the system's cache of files helps more than it would otherwise.
"""

import argparse
import gc
import math
import time
from dataclasses import replace
from pathlib import Path

import rasterio
from rasterio.windows import Window

import telemetry
from orthoswarm.batch.pipeline import run
from orthoswarm.batch.run_state import MapOptions
from orthoswarm.compute.workers import prepare_process, workers
from orthoswarm.config import config_of
from orthoswarm.model.frame import Frame, Ingest
from orthoswarm.model.geo import LocalGrid

_STRIP = 2048
"""Rows of the basemap that are copied at once."""


def repeated_basemap(source: Path, out: Path, columns: int, rows: int) -> tuple[float, float]:
    """Write a map that repeats another; returns metres from copy to copy, to the east and to the south."""
    with rasterio.open(source) as one:
        profile = {**one.profile, "width": one.width * columns, "height": one.height * rows, "bigtiff": "if_safer"}
        profile |= {"tiled": True, "blockxsize": 512, "blockysize": 512, "compress": "deflate"}
        with rasterio.open(out, "w", **profile) as many:
            for r in range(rows):
                for top in range(0, one.height, _STRIP):
                    count = min(_STRIP, one.height - top)
                    strip = one.read(window=Window(0, top, one.width, count))
                    for c in range(columns):
                        many.write(strip, window=Window(c * one.width, r * one.height + top, one.width, count))
        return one.width * one.res[0], one.height * one.res[1]


def moved(frame: Frame, grid: LocalGrid, *, photos: Path, east_m: float, south_m: float) -> Frame:
    """A photo as if it had been taken elsewhere; its heading follows the meridians, so that it fits the map there."""
    fix = frame.fix
    east, north = grid.to_grid([fix.lat_deg], [fix.lon_deg])[0]
    lat, lon = (float(v) for v in grid.to_geographic([east + east_m, north - south_m]))
    turn = float(grid.convergence_rad(lat, lon) - grid.convergence_rad(fix.lat_deg, fix.lon_deg))

    def turned(yaw_rad: float | None) -> float | None:
        return None if yaw_rad is None else yaw_rad + turn

    there = replace(
        fix, lat_deg=lat, lon_deg=lon, yaw_rad=turned(fix.yaw_rad), flight_yaw_rad=turned(fix.flight_yaw_rad)
    )
    name = photos.name
    return replace(
        frame, image=f"{name}/{frame.image}", path=photos / frame.image, vehicle=f"{name}/{frame.vehicle}", fix=there
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path)
    parser.add_argument("--copies", type=int, default=4)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--area-pictures", type=int)
    args = parser.parse_args()
    prepare_process()
    gc.set_threshold(100_000, 50, 50)  # as `orthoswarm mosaic`
    args.out.mkdir(parents=True, exist_ok=True)
    columns = math.ceil(math.sqrt(args.copies))
    basemap = args.out / "basemap.tif"
    step = repeated_basemap(args.set / "basemap.tif", basemap, columns, -(-args.copies // columns))
    with rasterio.open(basemap) as whole:
        epsg = whole.crs.to_epsg()

    links = [args.out / "photos" / str(n) for n in range(args.copies)]
    for link in links:
        link.parent.mkdir(exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to((args.set / "photos").resolve(), target_is_directory=True)

    def load(progress) -> Ingest:
        once = telemetry.load([args.set / "photos"], progress=progress, options=telemetry.LoadOptions(run=pool.map))
        grid = LocalGrid(epsg)
        frames = [
            moved(frame, grid, photos=link, east_m=step[0] * (n % columns), south_m=step[1] * (n // columns))
            for n, link in enumerate(links)
            for frame in once.frames
        ]
        return Ingest(frames, list(once.rejected), list(once.warnings))

    config = config_of({} if args.area_pictures is None else {"strategy": {"area_pictures": args.area_pictures}})
    pool, said = workers(args.workers), set()

    def progress(what: str, done: int, count: int) -> None:
        if done == count and what not in said:
            said.add(what)
            print(f"{time.perf_counter() - begun:8.0f} s  {what}: {count}", flush=True)

    begun = time.perf_counter()
    try:
        report = run(load, args.out / "map", MapOptions(basemap=basemap, config=config), pool, progress)
    finally:
        pool.close()
    states = [leg["state"] for leg in report["legs"]]
    print(
        f"{report['frames']['used']} pictures, {report['wall_s']:.0f} s, {report['cpu_s']:.0f} CPU s, "
        f"{report['peak_rss_mb']:.0f} MB, legs matched {states.count('matched')} of {len(states)}"
    )
    for stage in report["stages"]:
        print(f"  {stage['name']}: {stage['wall_s']:.0f} s, {stage['cpu_s']:.0f} CPU s")


if __name__ == "__main__":
    main()
