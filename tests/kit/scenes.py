"""A made twin as the refiner is given it, with its truth."""

import csv

from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.raster.basemap import Basemap
from orthoswarm.twin.make import make_twin
from orthoswarm.twin.presets import spec
from telemetry import load


def tiny_twin(factory, seed, **changes):
    """The folder of a freshly made tiny twin."""
    folder = factory.mktemp("twin") / "tiny"
    make_twin(spec("tiny", seed=seed, **changes), folder)
    return folder


def scene_of(folder):
    """Frames by vehicle, the area's grid, the basemap, and the true cameras by picture of a twin's folder."""
    frames = load([folder / "photos"]).frames
    grid = LocalGrid(area_epsg([f.fix.lat_deg for f in frames], [f.fix.lon_deg for f in frames]))
    vehicles = {v: [f for f in frames if f.vehicle == v] for v in sorted({f.vehicle for f in frames})}
    with (folder / "truth" / "frames.csv").open() as file:
        truth = {row["image"]: row for row in csv.DictReader(file)}
    return vehicles, grid, Basemap.open(folder / "basemap.tif", grid.epsg), truth
