"""Wide roofs in an orthoimage beside their true places.

    orthoswarm mosaic SET/photos --basemap SET/basemap.tif --out OUT
    python -m benchmarks.accuracy.roof_truth SET OUT

SET is a folder of `orthoswarm twin make`. What stands more than 1.5 m over the ground and holds a disc of 20 m is
wide: halls, stands, woods. Blocks of 12 m of the reference, in which each roof is where it stands, are searched for in
the orthoimage up to 5 m away: a line for those tops with their edges, one for open ground within 12 m of them. A
roof that is bent, or drawn on the ground, is displaced or not found. `jump` is the 95 % of the differences of
displacement between neighbouring blocks 6 m apart: 0 for a straight edge.
"""

import argparse
import tempfile
from pathlib import Path

import cv2
import numpy as np
import rasterio

from orthoswarm.evaluation.displacement import FieldSettings
from orthoswarm.evaluation.orthoimage import evaluate_ortho

TALL_M = 1.5
"""What stands higher over the bare ground than this is raised, metres: the refiner's `tall_from_m`."""
DISC_M = 10.0
"""Radius of the disc that a wide object holds, metres."""
EDGE_M = 1.5
"""A roof's edge belongs to its blocks up to this distance, metres."""
BESIDE_M = 12.0
"""Ground up to this distance from a wide object is beside it, metres: its wall's smear and what it hides."""
OPEN_M = 0.3
"""Ground is open where nothing stands higher than this, metres."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path)
    parser.add_argument("out", type=Path, nargs="+")
    args = parser.parse_args()
    truth = args.set / "truth"
    settings = FieldSettings(block_m=12.0, step_m=6.0, search_m=5.0)
    with tempfile.TemporaryDirectory() as folder:
        masks = write_masks(truth, Path(folder))
        for out in args.out:
            ortho = out if out.is_file() else out / "orthoimage.tif"
            for name, mask in masks.items():
                a = evaluate_ortho(ortho, truth / "reference.tif", mask, settings)
                print(
                    f"{ortho.parent.name:16s} {name:7s} {a.blocks:6d} blocks  median {a.median_m:.2f} m  "
                    f"95 % {a.p95_m:.2f} m  within 1 m {a.share_within_1m:.1%}  not found {a.unmatched_share:.1%}  "
                    f"jump {a.seam_p95_m:.2f} m"
                )


def write_masks(truth: Path, folder: Path) -> dict[str, Path]:
    """Masks of wide tops with their edges and of open ground beside them, as rasters in a folder."""
    with rasterio.open(truth / "dsm.tif") as file:
        over, profile, cell = file.read(1), file.profile, file.res[0]
    with rasterio.open(truth / "dtm.tif") as file:
        over = over - file.read(1)
    wide, beside = wide_and_beside(over, cell)
    profile.update(dtype="uint8", nodata=None, count=1)
    out = {}
    for name, mask in (("roofs", wide), ("beside", beside)):
        out[name] = folder / f"{name}.tif"
        with rasterio.open(out[name], "w", **profile) as file:
            file.write(mask.astype(np.uint8), 1)
    return out


def wide_and_beside(over: np.ndarray, cell_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Wide tops with their edges, and open ground beside them, bool; over: heights above ground, cell_m: their cell."""

    def disc(radius_m: float) -> np.ndarray:
        side = 2 * round(radius_m / cell_m) + 1
        return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))

    top = cv2.morphologyEx((over > TALL_M).astype(np.uint8), cv2.MORPH_OPEN, disc(DISC_M))
    edge, near = cv2.dilate(top, disc(EDGE_M)) > 0, cv2.dilate(top, disc(BESIDE_M)) > 0
    return edge, near & ~edge & (over < OPEN_M)


if __name__ == "__main__":
    main()
