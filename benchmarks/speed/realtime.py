"""Speed of the real-time module: frames per second of one core, JPEG decoding included, at the default ground pixel.

    python -m benchmarks.speed.realtime [--frames 500] [--quality 90] [--runs 5]

Prints the median of several runs, by the process's CPU time, of frame after frame (as the daemon draws them while
they arrive) and of all frames at once (as `orthoswarm mosaic` does).
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from benchmarks.speed.made_up_flight import area, fly
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.mosaic.realtime import RealtimeMosaic, mosaic
from orthoswarm.raster.picture_file import read_rgba


def one_by_one(folder, grid, frames):
    """CPU seconds of decoding and of drawing, and pixels won."""
    reading = won = 0.0
    with Canvas.create(folder, grid) as canvas:
        module = RealtimeMosaic(canvas)
        start = time.process_time()
        for placed in frames:
            before = time.process_time()
            picture = read_rgba(placed.frame.path)
            reading += time.process_time() - before
            won += module.add(picture, placed.camera).won
        return time.process_time() - start, reading, won


def at_once(folder, grid, frames):
    with Canvas.create(folder, grid, plane="frame") as canvas:
        start = time.process_time()
        mosaic(frames, canvas)
        return time.process_time() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--quality", type=int, default=90, help="of the JPEGs")
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames = fly(folder, options.frames, options.quality)
        grid = area(frames)
        n = len(frames)
        size = sum(f.frame.path.stat().st_size for f in frames) / n / 1000
        print(f"{n} frames of 640x480, {size:.0f} kB each; map {grid.width}x{grid.height} at {grid.gsd_m:.3f} m")
        one_by_one(folder / "warm", grid, frames[:20])  # compiles, or loads what was compiled
        at_once(folder / "warm2", grid, frames[:20])
        drawn = [one_by_one(folder / f"one{k}", grid, frames) for k in range(options.runs)]
        batch = [at_once(folder / f"all{k}", grid, frames) for k in range(options.runs)]
    total, reading = (statistics.median(d[k] for d in drawn) for k in (0, 1))
    best = n / min(d[0] for d in drawn)
    decode_ms, draw_ms = 1e3 * reading / n, 1e3 * (total - reading) / n
    print(f"frame after frame: {n / total:.0f} frames/s a core (best run {best:.0f})")
    print(f"    decoding {decode_ms:.2f} ms, drawing {draw_ms:.2f} ms, {drawn[0][2] / n:.0f} pixels won a frame")
    print(f"all at once:       {n / statistics.median(batch):.0f} frames/s a core (best run {n / min(batch):.0f}); "
          f"{1e3 * statistics.median(batch) / n:.2f} ms a frame")  # fmt: skip


if __name__ == "__main__":
    main()
