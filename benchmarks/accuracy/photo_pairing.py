"""How well photos without positions find their camera events: python -m benchmarks.accuracy.photo_pairing ORTHOIMAGE.

Prints one line for each interval, clock resolution and share of missing exposures: photos whose exposure has an event
too, photos paired without a mark, how many of these wrongly, marked ones, and seconds a flight. The pictures are cut
from a grey or colour GeoTIFF (any ground with texture). With --times-only they are not asked; then two columns more
say for how many photos the times decide (`tests.telemetry.ingest.decidable`), and how many of these are paired.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.telemetry.ingest.decidable import decided_by_times
from tests.telemetry.ingest.exposure_grid import Exposures, Score, exposures, flown_over, ground_of, scored

INTERVALS_S = (0.3, 0.7, 1.0, 2.0, 5.0)
MISSING = (0.0, 0.1, 0.3)


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of the grid: seconds between exposures, whether the clock has whole seconds, share missing."""

    interval: float
    whole: bool
    missing: float


@dataclass(frozen=True, slots=True)
class Flight:
    """The score of a flight, photos that the times decide, those of them paired without a mark, and seconds."""

    score: Score
    decidable: int
    placed: int
    cpu_s: float


def fly(seed: int, cell: Cell, ground: NDArray[np.uint8] | None) -> Flight:
    """One flight."""
    rng = np.random.default_rng(seed)
    flown: Exposures = exposures(rng, cell.interval, whole=cell.whole, missing=cell.missing)
    if ground is None:
        start = time.process_time()
        score = scored(flown)
        cpu_s = time.process_time() - start
        decided = decided_by_times(flown, cell.interval, whole=cell.whole)
        return Flight(score, len(decided), len(decided & score.photos), cpu_s)
    with tempfile.TemporaryDirectory() as folder:
        motion = flown_over(ground, flown, rng, cell.interval, Path(folder))
        start = time.process_time()
        return Flight(scored(flown, motion), 0, 0, time.process_time() - start)


def seeds_of(cell: Cell, seed: int, flights: int) -> list[int]:
    """Seeds of a cell's flights."""
    parts = [seed, round(10 * cell.interval), int(cell.whole), round(100 * cell.missing)]
    return np.random.default_rng(parts).integers(1 << 31, size=flights).tolist()


def line(cell: Cell, flights: Sequence[Flight], *, times_only: bool) -> str:
    """One row of the table."""
    both, decided, wrong, marked, uncertain = (
        sum(getattr(flight.score, name) for flight in flights)
        for name in ("both", "decided", "wrong_unmarked", "marked", "wrong_marked")
    )
    clock = "whole seconds" if cell.whole else "sub-seconds"
    text = f"| {cell.interval:.1f} s | {clock} | {cell.missing:.0%} | {both:,} | {decided:,} | {wrong} | {marked:,} "
    text += f"| {uncertain} | {max(flight.cpu_s for flight in flights):.1f} |"
    if times_only:
        decidable, placed = (sum(getattr(flight, name) for flight in flights) for name in ("decidable", "placed"))
        text += f" {decidable:,} | {placed:,} |"
    return text


def draw(rows: Sequence[tuple[Cell, Sequence[Flight]]], path: Path) -> None:
    """Shares of photos paired without a mark, marked and wrong, and a tick at the share that the times decide."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(10, 4.6), sharey=True, layout="constrained")
    for axes, whole in zip(panels, (False, True), strict=True):
        some = [row for row in rows if row[0].whole == whole]
        for y, (_, flights) in enumerate(some):
            both = sum(flight.score.both for flight in flights)
            wrong = sum(flight.score.wrong_unmarked for flight in flights) / both
            right = sum(flight.score.decided for flight in flights) / both - wrong
            decidable = sum(flight.decidable for flight in flights) / both
            axes.barh(y, 100.0, color="0.88", label="marked as ambiguous" if y == 0 else None)
            axes.barh(y, 100.0 * right, color="tab:green", label="paired, right" if y == 0 else None)
            label = "paired, wrong" if y == 0 else None
            axes.barh(y, 100.0 * wrong, left=100.0 * right, color="tab:red", label=label)
            label = "decided by the times" if y == 0 else None
            axes.plot([100.0 * decidable] * 2, [y - 0.42, y + 0.42], color="black", lw=2, label=label)
        axes.set_yticks(range(len(some)), [f"{cell.interval:g} s, {cell.missing:.0%} missing" for cell, _ in some])
        axes.set_title("camera's clock: whole seconds" if whole else "camera's clock: hundredths of a second")
        axes.set_xlabel("photos whose exposure has an event, %")
    panels[0].invert_yaxis()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    """Run the grid."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=20, help="flights in each cell (default: 20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("orthoimage", type=Path, nargs="?", help="ground that the pictures show")
    parser.add_argument("--interval", type=float, action="append", help="seconds between exposures (default: all)")
    parser.add_argument("--times-only", action="store_true")
    parser.add_argument("--whole-only", action="store_true", help="clocks of whole seconds only")
    parser.add_argument("--workers", type=int, default=1, help="processes (default: 1)")
    parser.add_argument("--figure", type=Path, metavar="PNG", help="with --times-only: draw the grid")
    args = parser.parse_args()
    if args.orthoimage is None and not args.times_only:
        parser.error("name an orthoimage that the pictures show, or give --times-only")
    ground = None if args.times_only else ground_of(args.orthoimage)
    more = " decided by the times | of these unmarked |" if args.times_only else ""
    print(f"| interval | clock | missing | both | unmarked | wrong | marked | of these wrong | s, most |{more}")
    clocks = (True,) if args.whole_only else (False, True)
    cells = [Cell(i, w, m) for i in args.interval or INTERVALS_S for w in clocks for m in MISSING]
    rows: list[tuple[Cell, Sequence[Flight]]] = []
    with ProcessPoolExecutor(args.workers) as pool:
        for cell in cells:
            flights = list(pool.map(partial(fly, cell=cell, ground=ground), seeds_of(cell, args.seed, args.flights)))
            rows.append((cell, flights))
            print(line(cell, flights, times_only=args.times_only), flush=True)
    if args.figure is not None:
        draw(rows, args.figure)


if __name__ == "__main__":
    main()
