"""Wrong maps are not followed in flight: what is found on them of a vehicle's pictures as they come.

    python -m benchmarks.robustness.wrong_maps_live SET --out DIR [--flights N] [--processes P]

SET is a folder of `orthoswarm twin make`. A flight begins at some picture of a vehicle and has 120. It is looked for on
the map as the daemon does it: after 20 pictures and whenever there are 1.4 times as many, the newest 60 of them. The
kinds of maps are those of `wrong_maps`, and the right one. A line a kind: flights, and how many were found.
"""

import argparse
import itertools
import json
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

import telemetry
from benchmarks.robustness.wrong_maps import WRONG, altered, right
from gcs_plugin.daemon.layers.live_registration import FIRST, MORE, MOST_LOOKED_FOR
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.geo import local_origin
from orthoswarm.mosaic.recorded_pose import area_grid
from orthoswarm.raster.basemap import Basemap
from orthoswarm.refine.registration.block_state import WorkArea
from orthoswarm.refine.strategy.vehicle_passes import RefinerOptions, refine_alone

PICTURES = 120


def found(map_file, frames, epsg, origin):
    """After how many pictures a flight is found on a map, 0 if it never is."""
    area, count = WorkArea(epsg, origin, Basemap.open(map_file, epsg)), FIRST
    while count <= len(frames):
        try:
            if refine_alone(frames[:count][-MOST_LOOKED_FOR:], area=area, options=RefinerOptions()).on_map:
                return count
        except OrthoSwarmError:
            pass
        count = int(MORE * count)
    return 0


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--flights", type=int, default=29, help="a map")
    parser.add_argument("--processes", type=int, default=2)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    frames = telemetry.load([args.set / "photos"]).frames
    grid = area_grid(frames)
    origin = local_origin(grid, frames)
    vehicles = [[f for f in frames if f.vehicle == v] for v in sorted({f.vehicle for f in frames})]
    starts = np.linspace(0, min(map(len, vehicles)) - PICTURES, -(-args.flights // len(vehicles))).astype(int)
    flights = [own[s : s + PICTURES] for s, own in itertools.product(starts, vehicles)][: args.flights]
    with ProcessPoolExecutor(args.processes) as pool:
        for kind, change in {**WRONG, "right": right}.items():
            target = args.out / f"{kind}.tif"
            altered(args.set / "basemap.tif", target, change)
            after = list(pool.map(found, *zip(*((target, f, grid.epsg, origin) for f in flights), strict=True)))
            row = {"map": kind, "flights": len(flights), "found": sum(n > 0 for n in after), "after": sorted(after)}
            print(json.dumps(row), flush=True)
            target.unlink()


if __name__ == "__main__":
    main()
