"""Whether places of an orthoimage are as good as its confidence.tif says, on a simulated city.

    orthoswarm mosaic SET/photos --basemap SET/basemap.tif --out OUT
    python -m benchmarks.accuracy.confidence_truth SET OUT

SET is a folder of `orthoswarm twin make`. Blocks of 9 m of the reference, in which everything is where it stands, are
searched for in the orthoimage up to 5 m away. A block counts to a class if nine tenths of its cells are of it.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import rasterio

from orthoswarm.evaluation.displacement import FieldSettings
from orthoswarm.evaluation.orthoimage import displacements
from orthoswarm.mosaic.confidence import GOOD_TO_M, ORIENTATION_ONLY

_SETTINGS = FieldSettings(gsd_m=0.3, block_m=9.0, step_m=4.5, search_m=5.0, min_cover=0.9)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", type=Path)
    parser.add_argument("out", type=Path, nargs="+")
    args = parser.parse_args()
    for out in args.out:
        with rasterio.open(out / "confidence.tif") as file:
            good, profile = file.read(1), file.profile
        profile.update(driver="GTiff", dtype="uint8", nodata=None, count=1)
        profile = {k: v for k, v in profile.items() if k not in ("predictor", "compress", "layout", "interleave")}
        least = 0.0
        for most in (*GOOD_TO_M, float(ORIENTATION_ONLY)):
            of_class = (good >= 0) & (good <= most + 1e-3) & (good > least + 1e-3)
            with tempfile.TemporaryDirectory() as folder:
                mask = Path(folder) / "mask.tif"
                with rasterio.open(mask, "w", **profile) as file:
                    file.write(of_class.astype(np.uint8), 1)
                field = displacements(out / "orthoimage.tif", args.set / "truth" / "reference.tif", mask, _SETTINGS)
            length, share = field.length_m, of_class.sum() / max(int((good >= 0).sum()), 1)
            p50, p95, p98 = np.quantile(length, [0.5, 0.95, 0.98]) if len(length) else (np.nan,) * 3
            right = (length <= most).mean() if len(length) else np.nan
            print(
                f"{out.name:16s} good to {most:4.1f} m: {share:6.1%} of the cells, {len(length):5d} blocks found of "
                f"{len(field.matched):5d}, within it {right:6.1%}; median {p50:.2f}  95 % {p95:.2f}  98 % {p98:.2f} m"
            )
            least = most


if __name__ == "__main__":
    main()
