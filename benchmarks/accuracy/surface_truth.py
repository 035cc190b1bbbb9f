"""A surface model beside the true heights of its scene.

    orthoswarm mosaic SET/photos --basemap SET/basemap.tif --out OUT --surface OUT/dsm.tif
    python -m benchmarks.accuracy.surface_truth SET OUT/dsm.tif

SET is a folder of `orthoswarm twin make`. A line for all cells, for those on the ground and for those on what stands
more than 1 m over it: number, median and 95 % of the error, and the shares within one and two stated sigmas. The
takeoff level is known to some decimetres only; it is taken off as the median error of the cells on the ground.
"""

import argparse
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import rowcol, xy


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path)
    parser.add_argument("surface", type=Path)
    args = parser.parse_args()
    with rasterio.open(args.surface) as file:
        height, sigma, _ = file.read(masked=True)
        rows, columns = np.nonzero(~np.ma.getmaskarray(height))
        east, north = (np.array(v) for v in xy(file.transform, rows, columns))
        cell = file.res[0]
    height, sigma = height[rows, columns].data, sigma[rows, columns].data
    true, inside = _sampled(args.set / "truth" / "dsm.tif", east, north)
    ground, _ = _sampled(args.set / "truth" / "dtm.tif", east, north)
    tall = true - ground > 1.0
    error = height - true
    error = np.abs(error - np.median(error[inside & ~tall]))
    print(f"cell {cell:.2f} m")
    for name, some in (("all", inside), ("ground", inside & ~tall), ("tall", inside & tall)):
        e, s = error[some], sigma[some]
        print(
            f"{name:7s} {len(e):8d} cells  median {np.median(e):.2f} m  95 % {np.quantile(e, 0.95):.2f} m  "
            f"within 1 / 2 sigma {(e < s).mean():.0%} / {(e < 2 * s).mean():.0%}  (sigma {np.median(s):.2f} m)"
        )


def _sampled(path: Path, east, north):
    """Values of a raster at places, and which places lie on it."""
    with rasterio.open(path) as file:
        row, column = (np.asarray(v) for v in rowcol(file.transform, east, north))
        inside = (row >= 0) & (column >= 0) & (row < file.height) & (column < file.width)
        values = np.full(len(row), np.nan, np.float32)
        values[inside] = file.read(1)[row[inside], column[inside]]
    return values, inside


if __name__ == "__main__":
    main()
