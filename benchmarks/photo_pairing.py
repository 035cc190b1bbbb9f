"""How well photos without positions find their camera events: python -m benchmarks.photo_pairing [--flights N].

Prints one line for each interval, clock resolution and share of missing exposures: photos whose exposure has an event
too, photos paired without a mark, how many of these wrongly, marked ones, and seconds a flight.
"""

import argparse
import time

import numpy as np

from tests.telemetry.ingest.exposure_grid import exposures, scored


def main() -> None:
    """Run the grid."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=20, help="flights in each cell (default: 20)")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    print("interval  clock          missing   both  decided  wrong  marked  of these wrong  s a flight")
    for interval in (0.3, 0.7, 1.0, 2.0, 5.0):
        for whole in (False, True):
            for missing in (0.0, 0.1, 0.3):
                start = time.process_time()
                rows = [scored(exposures(rng, interval, whole=whole, missing=missing)) for _ in range(args.flights)]
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
