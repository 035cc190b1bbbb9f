"""Basemaps of larger and larger pixels: python -m benchmarks.accuracy.coarse_maps SET... --out DIR [--gsd 1 2 5 10].

SET is a folder of `orthoswarm twin make`. Its basemap is averaged to each ground pixel, in metres, and given to the
refiner. A line a run: legs by state, error of the pictures' middles on the ground (median, 95 %), usual stated sigma.
"""

import argparse
import json
from pathlib import Path

from benchmarks.robustness.wrong_maps import averaged, measure


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="folder for the averaged maps")
    parser.add_argument("--gsd", nargs="+", type=float, default=[0.5, 1.0, 2.0, 3.0, 5.0, 10.0], metavar="M")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for folder in args.sets:
        for gsd_m in args.gsd:
            target = args.out / f"{folder.name}-{gsd_m:g}m.tif"
            averaged(folder / "basemap.tif", target, gsd_m)
            print(json.dumps({"set": folder.name, "gsd_m": gsd_m, **measure(folder, target)}), flush=True)


if __name__ == "__main__":
    main()
