"""Before, after, what changed, and the truth, side by side.

    python -m benchmarks.accuracy.change_pictures SET:EAST,NORTH,SIDE ... --out FILE.jpg

SET is a folder as of benchmarks.accuracy.change with the change map in SET/out (`orthoswarm change SET/out --out
SET/out`). EAST and NORTH, metres from the middle of the change map, and SIDE say which part is shown; a row a part.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import rasterio

from orthoswarm.change.overlay import overlay_pixels

PX = 300
TRUE = (0, 190, 255)


def window(path, bounds, bands):
    """A part of a raster, PX square."""
    with rasterio.open(path) as file:
        part = rasterio.windows.from_bounds(*bounds, file.transform)
        data = file.read(bands, window=part, boundless=True, fill_value=0)
    return cv2.resize(np.moveaxis(data, 0, 2), (PX, PX), interpolation=cv2.INTER_AREA)


def row(text):
    """The four pictures of a part."""
    name, _, place = text.rpartition(":")
    folder, (east, north, side) = Path(name), (float(v) for v in place.split(","))
    with rasterio.open(folder / "out" / "change.tif") as file:
        box = file.bounds
    east, north = east + (box.left + box.right) / 2, north + (box.bottom + box.top) / 2
    bounds = (east - side / 2, north - side / 2, east + side / 2, north + side / 2)
    before = window(folder / "basemap.tif", bounds, (1, 2, 3))
    after = window(folder / "out" / "orthoimage.tif", bounds, (1, 2, 3))
    paint, _ = overlay_pixels(folder / "out", 0.5, bounds, (PX, PX))
    share = paint[..., 3:] / 255.0
    shown = np.round(after * (1 - share) + paint[..., :3] * share).astype(np.uint8)
    real = after.copy()
    truth = folder / "truth" / "disaster_mask.tif"
    if truth.exists():
        mask = (window(truth, bounds, [1]).reshape(PX, PX) > 127).astype(np.uint8)
        outlines, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(real, outlines, -1, TRUE, 2)
    gap = np.full((PX, 6, 3), 255, np.uint8)
    return np.hstack([before, gap, after, gap, shown, gap, real])


def main() -> None:
    """Draw and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="+", metavar="SET:EAST,NORTH,SIDE")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    rows = [row(part) for part in args.parts]
    gap = np.full((6, rows[0].shape[1], 3), 255, np.uint8)
    picture = np.vstack([part for one in rows for part in (one, gap)][:-1])
    cv2.imwrite(str(args.out), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
