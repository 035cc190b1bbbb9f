"""How well photos without positions find their camera events: python -m benchmarks.accuracy.photo_pairing ORTHOIMAGE.

Prints one line for each interval, clock resolution and share of missing exposures: photos whose exposure has an event
too, photos paired without a mark, how many of these wrongly, marked ones, and seconds a flight. The pictures are cut
from a grey or colour GeoTIFF (any ground with texture); with --times-only they are not asked.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.telemetry.ingest.exposure_grid import Exposures, Score, exposures, flown_over, ground_of, scored


def fly(seed: int, interval: float, whole: bool, missing: float, ground: NDArray[np.uint8] | None) -> Score:
    """One flight."""
    rng = np.random.default_rng(seed)
    flown: Exposures = exposures(rng, interval, whole=whole, missing=missing)
    if ground is None:
        return scored(flown)
    with tempfile.TemporaryDirectory() as folder:
        return scored(flown, flown_over(ground, flown, rng, interval, Path(folder)))


def main() -> None:
    """Run the grid."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=20, help="flights in each cell (default: 20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("orthoimage", type=Path, nargs="?", help="ground that the pictures show")
    parser.add_argument("--interval", type=float, action="append", help="seconds between exposures (default: all)")
    parser.add_argument("--times-only", action="store_true")
    parser.add_argument("--whole-only", action="store_true", help="clocks of whole seconds only")
    args = parser.parse_args()
    if args.orthoimage is None and not args.times_only:
        parser.error("name an orthoimage that the pictures show, or give --times-only")
    ground = None if args.times_only else ground_of(args.orthoimage)
    print("interval  clock          missing   both  decided  wrong  marked  of these wrong  s a flight")
    for interval in args.interval or (0.3, 0.7, 1.0, 2.0, 5.0):
        for whole in (True,) if args.whole_only else (False, True):
            for missing in (0.0, 0.1, 0.3):
                start = time.process_time()
                cell = [args.seed, round(10 * interval), int(whole), round(100 * missing)]
                seeds = np.random.default_rng(cell).integers(1 << 31, size=args.flights).tolist()
                rows = [fly(seed, interval, whole, missing, ground) for seed in seeds]
                each_s = (time.process_time() - start) / args.flights
                both, decided, wrong, marked, uncertain = (
                    sum(getattr(row, name) for row in rows)
                    for name in ("both", "decided", "wrong_unmarked", "marked", "wrong_marked")
                )
                clock = "whole seconds" if whole else "sub-seconds"
                print(
                    f"{interval:5.1f} s   {clock:13}  {missing:6.0%}  {both:6} {decided:8} {wrong:6} {marked:7} "
                    f"{uncertain:15} {each_s:11.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
