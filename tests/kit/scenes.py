"""A made twin as the refiner is given it, with its truth."""

import contextlib
import csv
import os
import shutil

from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.raster.basemap import Basemap
from orthoswarm.twin.make import make_twin
from orthoswarm.twin.presets import spec
from telemetry import load


def tiny_twin(factory, seed, **changes):
    """The folder of a tiny twin for one file of tests, copied from one that all processes of a test run share."""
    base = factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "twins"
    made = shared / "-".join([str(seed), *(f"{name}={changes[name]}" for name in sorted(changes))])
    if not made.exists():
        shared.mkdir(exist_ok=True)
        new = factory.mktemp("new") / "tiny"
        make_twin(spec("tiny", seed=seed, **changes), new)
        with contextlib.suppress(OSError):  # another process was as quick: its twin is the same
            new.rename(made)
    return shutil.copytree(made, factory.mktemp("twin") / "tiny")


def scene_of(folder):
    """Frames by vehicle, the area's grid, the basemap, and the true cameras by picture of a twin's folder."""
    frames = load([folder / "photos"]).frames
    grid = LocalGrid(area_epsg([f.fix.lat_deg for f in frames], [f.fix.lon_deg for f in frames]))
    vehicles = {v: [f for f in frames if f.vehicle == v] for v in sorted({f.vehicle for f in frames})}
    with (folder / "truth" / "frames.csv").open() as file:
        truth = {row["image"]: row for row in csv.DictReader(file)}
    return vehicles, grid, Basemap.open(folder / "basemap.tif", grid.epsg), truth
