"""Cost of the final orthoimage: CPU seconds and memory against the number of frames, and what decoding takes of it.

    python -m benchmarks.speed.render [--frames 250 1000] [--workers 1]

Memory is the peak of this process (and of its children, each) as the system counts it, mapped tiles included.
"""

import argparse
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.speed.made_up_flight import area, fly
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.radiometry import estimate_fields
from orthoswarm.mosaic.renderer import render, serial
from orthoswarm.raster.picture_file import read_rgb


def cpu():
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def measure(folder, frames, workers):
    grid = area(frames)
    terrain = Terrain(
        grid.west, grid.bounds[1], 100.0, np.random.default_rng(0).normal(0, 1, (60, 60)).astype(np.float32)
    )
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn")) if workers > 1 else None
    run = serial if pool is None else pool.map
    before, wall = cpu(), time.perf_counter()
    with Canvas.create(folder / "out", grid, plane="frame") as canvas:
        stats = render(frames, terrain, canvas, run=run)
        wall = time.perf_counter() - wall
        if pool is not None:
            pool.shutdown()
        spent = cpu() - before
        before = cpu()
        for placed in frames:
            read_rgb(placed.frame.path)
        decode = cpu() - before
        before = cpu()
        estimate_fields(frames, stats.thumbnails, terrain)
        gains = cpu() - before
    kilobytes = (
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss,
    )
    print(f"{len(frames)} frames, {stats.pixels.sum() / 1e6:.1f} Mpixel, {100 * stats.covered_share:.1f} % covered: "
          f"{spent:.2f} CPU s ({wall:.2f} s), decoding alone {decode:.2f} CPU s, gains {gains:.2f} CPU s; "
          f"peak {kilobytes[0] / 1024:.0f} MB, worker {kilobytes[1] / 1024:.0f} MB")  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[250, 1000])
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    for count in (30, *options.frames):  # the first compiles
        with tempfile.TemporaryDirectory() as name:
            measure(Path(name), fly(Path(name), count), options.workers)


if __name__ == "__main__":
    main()
