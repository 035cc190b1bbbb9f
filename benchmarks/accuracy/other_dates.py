"""Maps of another date, whose ground looks different: python -m benchmarks.accuracy.other_dates SET... --out DIR.

SET is a folder of `orthoswarm twin make`. In its basemap what is wider than 3 m stays: roads, roofs, fields, and their
shadows, which are of another hour than those of the photos. The detail in it is replaced, wholly or in blobs of a
given share, by that of another place of the same map, mirrored, as if plants had grown, cars had gone and sand were
washed away. A line a run: legs by state, error of the pictures' middles on the ground (median, 95 %), usual sigma.
"""

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.robustness.wrong_maps import altered, measure, right, season

WIDTH_M = 3.3
"""What is narrower is detail: lane markings, cars, crowns of shrubs, ruts."""
AWAY_M = 170.0
"""How far off the place is whose detail is taken."""
BLOB_M = 8.0
"""Scale of the parts of the ground that have changed."""

Picture = NDArray[np.uint8]


def other_detail(picture: Picture, gsd_m: float, share: float) -> Picture:
    """A map (3, rows, columns) whose detail is another one on a share of its ground."""
    odd = round(WIDTH_M / gsd_m) | 1
    wide = np.stack([cv2.medianBlur(band, odd) for band in picture]).astype(np.float32)
    detail = picture - wide
    other = np.roll(detail[:, ::-1], round(AWAY_M / gsd_m), axis=2)
    blobs = np.random.default_rng(2).normal(size=picture.shape[1:]).astype(np.float32)
    blobs = cv2.GaussianBlur(blobs, (0, 0), BLOB_M / gsd_m)
    changed = blobs <= np.quantile(blobs, share)
    return np.clip(wide + np.where(changed, other, detail), 0, 255).astype(np.uint8)


def other_detail_and_season(picture: Picture, gsd_m: float) -> Picture:
    """All detail replaced, in the colours and the light of another season."""
    return np.asarray(season(other_detail(picture, gsd_m, 1.0), gsd_m), np.uint8)


KINDS: dict[str, Callable[[Picture, float], Picture]] = {
    "as it is": right,
    "another season": season,
    "half of the detail": partial(other_detail, share=0.5),
    "85 % of the detail": partial(other_detail, share=0.85),
    "all detail": partial(other_detail, share=1.0),
    "all detail, another season": other_detail_and_season,
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="folder for the changed maps")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--refine", default="swarm", choices=("swarm", "paper"), help="paper: with learned features")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for folder in args.sets:
        for kind in args.kinds:
            target = args.out / f"{folder.name}.tif"
            altered(folder / "basemap.tif", target, KINDS[kind])
            row = {"set": folder.name, "map": kind, **measure(folder, target, args.refine)}
            print(json.dumps(row), flush=True)
            target.unlink()


if __name__ == "__main__":
    main()
